"""Random scenes whose pictures are known are right, and would be found if they were not."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from fuzz import pictures


def test_random_scenes_are_right(monkeypatch, capsys):
    monkeypatch.setitem(pictures.SPP, "pair", 16)
    assert pictures.main(["--first", "2", "--count", "2"]) == 0
    assert "4 scenes: 0 wrong" in capsys.readouterr().out


def test_a_furnace_that_loses_light_is_found(monkeypatch, tmp_path):
    maker = pictures.Maker(0, 0, tmp_path)
    scene, level = maker.furnace()
    darker = replace(scene, lights=(pictures.ConstantLight((1.0, 1.0, 1.0 - 1e-8)),))
    monkeypatch.setattr(maker, "furnace", lambda: (darker, level))
    assert "off by 1e-08" in pictures.wrong_furnace(maker)


def test_a_body_that_absorbs_more_as_a_mesh_is_found(monkeypatch, tmp_path):
    maker = pictures.Maker(0, 0, tmp_path)
    exact, meshes, level = maker.pair()
    more = tuple(
        replace(medium, grains=(replace(medium.grains[0], absorption=pictures.Absorption("grey", (0.5,))),))
        for medium in meshes.media
    )
    monkeypatch.setattr(maker, "pair", lambda: (exact, replace(meshes, media=more), level))
    assert "standard errors" in pictures.wrong_pair(maker)


def test_what_is_not_a_number_is_found(monkeypatch, tmp_path):
    dark = SimpleNamespace(rgb=np.full((2, 2, 3), np.nan), variance=np.zeros((2, 2, 3)), samples=np.ones((2, 2)),
                           truncated=0, faults=0)  # fmt: skip
    monkeypatch.setattr(pictures, "taken", lambda *_: dark)
    assert pictures.wrong_furnace(pictures.Maker(0, 0, tmp_path))
    assert pictures.wrong_pair(pictures.Maker(0, 0, tmp_path))
