"""A few of the mutated scenes of fuzz/scenes.py, and what that must find if it is there."""

import random

import pytest

from fuzz import scenes
from tsdf.errors import SceneError
from tsdf.picture import world


@pytest.mark.slow
def test_mutated_scenes_are_rendered_or_refused():
    """Nothing but our own errors, in one line, within the bounds of time and memory per scene."""
    found = scenes.run(60, seed=2, loud=False, warm=False)
    assert found["failed"] == 0
    assert found["rendered"] > 3 and found["refused"] > 20


def test_a_scene_is_the_same_every_time():
    assert scenes.mutated(random.Random("0/7")) == scenes.mutated(random.Random("0/7"))
    assert scenes.mutated(random.Random("0/7")) != scenes.mutated(random.Random("0/8"))


@pytest.mark.parametrize("error", [ValueError("foreign"), SceneError("two\nlines"), SceneError("x" * 5000)])
def test_what_must_not_happen_is_found(error, monkeypatch, capsys):
    """Negative control: a foreign exception, and messages that are not one short line, are failures and shown."""

    def build(*_):
        raise error

    monkeypatch.setattr(world, "build", build)
    found = scenes.run(20, seed=3, loud=False, warm=False)
    assert found["failed"] > 0
    assert "--- scene" in capsys.readouterr().err
