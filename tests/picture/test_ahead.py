"""Kernels compiled ahead are those that pictures call, and the process that does it ends with the one that asked."""

import io
import os
from types import SimpleNamespace

import pytest
import trimesh

from tsdf.compiled import compiling
from tsdf.data import library
from tsdf.picture import ahead, world
from tsdf.picture.render import Walkers, render
from tsdf.scene.levels import AUTO
from tsdf.scene.scene import Box, Camera, ConstantLight, GrainSpec, MediumSpec, Mesh, Scene, Sphere
from tsdf.walk import lanes, transport

BEADS = GrainSpec(library.FOLDER / f"glass-beads{library.SUFFIX}")
BODIES = (Box((-3.0,) * 3, (3.0,) * 3), Sphere((0.0, 8.0, 0.0), 3.0))


@pytest.fixture
def begun(monkeypatch):
    """Return what keeps the kernel, having begun as where nothing is kept."""
    kept = transport.advance._cache
    monkeypatch.setattr(kept, "process", None)
    monkeypatch.setattr(type(kept), "missing", True)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 1}, raising=False)
    ahead.begin()
    with kept.process as process:
        yield kept
        process.kill()


def test_what_is_compiled_ahead_is_what_pictures_call():
    ahead.compile_all()
    before = list(transport.advance.signatures)
    media = tuple(MediumSpec(body, 0.3, 1.0, (BEADS,), packing_spheres=64) for body in BODIES)
    camera = Camera((20.0, 4.0, 0.0), (0.0, 4.0, 0.0), 4, 4)
    scene = Scene(camera, (ConstantLight((1.0, 1.0, 1.0)),), media)
    for level in ("teleport", "explicit"):
        render(world.build(scene, level), spp=1, threads=1)
    assert transport.advance.signatures == before


def test_who_calls_a_kernel_waits_for_it(begun):
    assert not compiling()
    begun.load_overload(transport.advance.signatures[0], transport.advance.targetctx)
    assert begun.process.returncode == 0
    assert not compiling()


def test_a_process_ends_when_the_one_that_began_it_is_gone(begun):
    begun.process.stdin.close()
    assert begun.process.wait(60) == 1


@pytest.mark.parametrize("radius, ends", [(0.4, True), (0.001, False)])
def test_it_is_told_to_end_where_a_mesh_is_walked_in_lanes(radius, ends, monkeypatch, tmp_path):
    process = SimpleNamespace(stdin=io.BytesIO(), poll=lambda: 0)
    monkeypatch.setattr(transport.advance._cache, "process", process)
    trimesh.creation.icosphere(2, radius=3.0).export(tmp_path / "ball.ply")
    medium = MediumSpec(Mesh(tmp_path / "ball.ply"), 0.3, radius, (BEADS,))
    scene = Scene(Camera((20.0, 4.0, 0.0), (0.0, 0.0, 0.0), 4, 4), (ConstantLight((1.0, 1.0, 1.0)),), (medium,))
    assert (Walkers(world.build(scene, "teleport")).lanes is not None) == ends
    assert process.stdin.closed == ends


def test_nothing_is_begun_where_kernels_are_kept(monkeypatch):
    monkeypatch.setattr(transport.advance._cache, "process", None)
    ahead.compile_all()
    ahead.begin()
    assert transport.advance._cache.process is None


@pytest.mark.parametrize(
    ("bodies", "level", "needed"),
    [
        (1, "teleport", False),
        (2, "teleport", True),
        (1, "explicit", True),
        (1, "teleport-memory", True),
        (1, "auto", True),
    ],
)
def test_nothing_is_begun_for_a_lone_box(bodies, level, needed, monkeypatch):
    begun = []
    monkeypatch.setattr(ahead, "compile_ahead", lambda *asked: begun.append(asked))
    media = tuple(MediumSpec(body, 0.3, 1.0, (BEADS,), packing_spheres=64) for body in BODIES[:bodies])
    scene = Scene(Camera((20.0, 4.0, 0.0), (0.0, 4.0, 0.0), 4, 4), (ConstantLight((1.0, 1.0, 1.0)),), media)
    ahead.begin(scene, level)
    assert bool(begun) == needed
    if level != AUTO:
        made = world.build(scene, level)
        assert lanes.suited(made.place.arrays, made.media) != needed
