"""Rows about slabs and bulks of packed grains: levels against the same grains traced one by one."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from tsdf.data.table import Table
from tsdf.errors import TSDFError
from tsdf.picture.world import World, beam, build
from tsdf.scene.scene import Absorption, GrainSpec, Render, Slab
from tsdf.stress.cells import HYBRID, Measured, Row, Setting, attempted, known_to, relative
from tsdf.stress.ends import level_of
from tsdf.study.experiment import (
    WIDE,
    Ends,
    Experiment,
    Sums,
    bulk_experiment,
    cuts,
    gather,
    scene_of,
    slab_experiment,
)

GROUP = "Slabs and bulks against the same grains traced one by one"
BASE = ("teleport-packed", "teleport-memory", HYBRID, "teleport-joint", "teleport", "volume")
PACKED = ("explicit", "teleport-packed", HYBRID)
SIMPLE = ("4R/3f flights", "reset flights")
FORGETS = "memory.md, How right it is"
FORGETFUL = {"teleport-joint": FORGETS, "teleport": FORGETS, "volume": FORGETS}
BACK = "memory.md, What it cannot know"
PATHS = 600_000  # of each level; of explicit twice as many
PACKINGS = 4  # of levels of single grains; of the truth of some slabs more, where how grains lie is most of its error


class Case(NamedTuple):
    """A slab: what it is made of, packing fraction, layer of centres [R], cosine of the light's angle, absorption."""

    grains: str
    fraction: float
    layer: float
    cosine: float = 1.0
    absorption: float = 0.0
    times: int = 1  # as many paths as else
    packings: int = PACKINGS  # of the truth


def grain_of(setting: Setting, name: str) -> GrainSpec:
    """Return the grain that a case names."""
    table: Table = {
        "ball": lambda: setting.ball, "mirror": lambda: setting.mirror, "cube": lambda: setting.traced("cube", 1.31),
        "nearly": lambda: setting.once("nearly", lambda: _ball(setting, 1.02)), "own": lambda: setting.own,
        "bubble": lambda: setting.once("bubble", lambda: _ball(setting, 0.75)),
        "plates": lambda: setting.traced("hexprism", 1.31, 1_000_000, aspect=0.1),
    }[name]()  # fmt: skip
    return GrainSpec(table, mesh=setting.mesh if name == "own" else None)


def _ball(setting: Setting, eta: float) -> Table:
    import tsdf

    return tsdf.build("sphere", eta, tsdf.Effort(cells=256, joint=32, memory=64), setting.threads)


def forgotten(world: World, rng: np.random.Generator) -> None:
    """Let flights be drawn without regard to the exit: gap and entry of any other exit, the side turned evenly."""
    law = world.memory.law.copy()
    known = law[0, :, : int(world.memory.records[0])]
    flat = known.reshape(-1, known.shape[-1])[rng.permutation(known.shape[0] * known.shape[1])]
    turn = rng.uniform(0.0, math.pi, len(flat))
    flat[:, 2], flat[:, 3] = np.cos(turn), np.sin(turn)
    known[:] = flat.reshape(known.shape)
    gaps = np.concatenate(([0.0], np.cumsum(law[0, :, :, 0].astype(np.float64))))  # by which first flights begin in one
    world.memory = world.memory._replace(law=law, gaps=(gaps / gaps[-1])[None])


def experiment(setting: Setting, method: str, case: Case, packing: int = 0, top: float = 0.0) -> Experiment:
    """Return a slab as a method has it."""
    level, _, singles = level_of({"4R/3f flights": "volume", "reset flights": "teleport-memory"}.get(method, method))
    grain = grain_of(setting, case.grains)
    coefficients: tuple[float, ...] | None = (case.absorption,)
    if level == "volume":  # whose free paths depend on absorption
        grain, coefficients = replace(grain, absorption=Absorption("grey", (case.absorption,))), None
    one = slab_experiment(
        level, grain, case.fraction, case.layer, case.cosine, packing, coefficients, top, 0.0, singles
    )
    if method == "4R/3f flights":
        one.world.media.free[:] = 4.0 / (3.0 * case.fraction)
    if method == "reset flights":
        forgotten(one.world, setting.rng(60))
    return one


def reflected(setting: Setting, method: str, case: Case, number: int) -> tuple[float, float]:
    """Return the reflectance of a slab and its standard error, of packed grains over packings and places in them."""
    several, whole = method in PACKED, case.packings if method == "explicit" else PACKINGS
    packings = range(2 if setting.quick else whole) if several else (0,)
    places = [
        (k, top)
        for k in packings
        for top in (cuts(case.fraction, case.layer)[: 2 if setting.quick else 4] if several else [0.0])
    ]
    paths = case.times * setting.some(PATHS) * (2 if method == "explicit" else 1)
    found = []
    for k, (packing, top) in enumerate(places):
        one = experiment(setting, method, case, packing, top)
        found.append(gather(one, max(64, paths // len(places)), None, setting.seed + 101 * number + k, setting.threads))
    return pooled(found)


def pooled(found: Sequence[Sums]) -> tuple[float, float]:
    """Return the mean of the first number of all runs and its error, from their paths or, if that says more, from how
    four or more of them differ: places of grains count too."""
    means, errors = (np.array([float(getattr(one, name)[0]) for one in found]) for name in ("mean", "error"))
    error = math.sqrt(float((errors**2).sum())) / len(found)
    if len(found) >= 4:
        error = max(error, float(means.std(ddof=1)) / math.sqrt(len(found)))
    return float(means.mean()), error


def slab(setting: Setting, case: Case, methods: Sequence[str] = (*BASE, *SIMPLE)) -> Iterator[Measured]:
    """Reflectance of a slab against explicit."""
    try:
        truth = reflected(setting, "explicit", case, 0)
    except TSDFError as error:
        for method in methods:
            yield Measured(method, math.nan, note=f"no truth: {str(error).splitlines()[0]}")
        return
    yield known_to("explicit", truth)
    yield from attempted(
        methods, lambda method: relative(method, reflected(setting, method, case, 1 + methods.index(method)), truth)
    )


def mixture(setting: Setting) -> Iterator[Measured]:
    """Half mirrors, half clear spheres, a layer of 10 R at f = .6."""
    grains = (GrainSpec(setting.ball), GrainSpec(setting.mirror))
    scene = scene_of(Slab(-10.0, 0.0), grains[0], 0.6)

    def sent_back(method: str, number: int) -> tuple[float, float]:
        level, _, singles = level_of(method)
        packings = range(2 if setting.quick else 4) if method in PACKED else (0,)
        found = []
        for k in packings:
            medium = replace(scene.media[0], grains=grains, packing_seed=k)
            whole = replace(scene, media=(medium,), render=Render(explicit_grains=singles))
            world = build(whole, level, leap=0.0)
            made = Experiment(world, beam(world, (0.0, 0.0, 5.0), (0.0, 0.0, -1.0), WIDE), 1, upward)
            paths = max(64, setting.some(PATHS) // len(packings))
            found.append(gather(made, paths, None, setting.seed + 101 * number + k, setting.threads))
        return pooled(found)

    truth = sent_back("explicit", 0)
    yield known_to("explicit", truth)
    yield from attempted(BASE, lambda method: relative(method, sent_back(method, 1 + BASE.index(method)), truth))


def upward(places: np.ndarray, ends: Ends) -> np.ndarray:
    """Return the light that comes back of each path, (n, 1)."""
    return np.where(ends.direction[:, 2] > 0.0, ends.weight, 0.0)[:, None]


def bulk(setting: Setting, grains: str, fraction: float) -> Iterator[Measured]:
    """Mean squared displacement per event in an endless medium."""
    grain = grain_of(setting, grains)

    def moved(method: str, number: int) -> tuple[float, float]:
        packings = range(4) if method in ("explicit", "teleport-packed") else (0,)
        found = []
        for k in packings:
            one = bulk_experiment(method, grain, fraction, k)
            paths = max(64, setting.some(40_000) // len(packings))
            found.append(gather(one, paths, None, setting.seed + 10 * number + k, setting.threads))
        return pooled(found)

    truth = moved("explicit", 0)
    levels = ("teleport-packed", "teleport-memory", "teleport", "volume")
    yield known_to("explicit", truth)
    yield from attempted(levels, lambda level: relative(level, moved(level, 1 + levels.index(level)), truth))


def _slab(
    name: str, title: str, case: Case, limit: float, known: dict[str, str] = FORGETFUL, quick: bool = True,
    methods: Sequence[str] = (*BASE, *SIMPLE),
) -> Row:  # fmt: skip
    return Row(name, GROUP, title, "reflectance", "%", limit, lambda s: slab(s, case, methods), known, quick)


ROWS = (
    _slab("thin", "layer of 2 R", Case("ball", 0.6, 2.0, times=3, packings=32), 6.0),
    _slab(
        "monolayer",
        "layer of .5 R, light at 60 degrees",
        Case("ball", 0.6, 0.5, 0.5, times=2, packings=16),
        12.0,
        quick=False,
    ),
    _slab(
        "thin-60",
        "layer of 2 R, light at 60 degrees",
        Case("ball", 0.6, 2.0, 0.5, times=2, packings=32),
        6.0,
        quick=False,
    ),
    _slab("thin-4", "layer of 4 R, light at 60 degrees", Case("ball", 0.6, 4.0, 0.5, packings=16), 4.0, quick=False),
    _slab("grazing", "layer of 10 R, sun 5 degrees high", Case("ball", 0.6, 10.0, math.sin(math.radians(5.0))), 4.0),
    _slab("f-01", "layer of 40 R, f = .01", Case("ball", 0.01, 40.0, times=2), 12.0, {}),
    _slab("f-30", "layer of 10 R, f = .3", Case("ball", 0.3, 10.0, times=2, packings=16), 4.0, {}, quick=False),
    _slab("f-64", "layer of 10 R, f = .64", Case("ball", 0.64, 10.0), 4.0, quick=False),
    _slab(
        "f-57",
        "layer of 10 R, f = .57, between those tabulated",
        Case("ball", 0.57, 10.0, times=2, packings=16),
        3.0,
        quick=False,
    ),
    _slab("deep", "layer of 40 R, f = .6", Case("ball", 0.6, 40.0), 2.0, quick=False),
    _slab("dark", "layer of 10 R, light that gets in is absorbed", Case("ball", 0.6, 10.0, 1.0, 50.0, 4), 12.0),
    _slab("mirrors", "layer of 10 R of mirrors", Case("mirror", 0.6, 10.0), 2.0),
    _slab(
        "eta-102",
        "layer of 40 R, eta = 1.02",
        Case("nearly", 0.6, 40.0, times=10, packings=16),
        6.0,
        FORGETFUL,
        False,
    ),
    _slab("facets-traced", "layer of 10 R of cubes, eta = 1.31", Case("cube", 0.6, 10.0), 4.0, {}, quick=False),
    _slab(
        "bubbles",
        "layer of 10 R of bubbles, eta = .75",
        Case("bubble", 0.6, 10.0, times=2, packings=16),
        3.0,
        quick=False,
    ),
    _slab(
        "plates", "layer of 10 R of plates, half of which are missed", Case("plates", 0.6, 10.0), 4.0, {}, quick=False
    ),
    Row(
        "mirrors-bulk",
        GROUP,
        "endless mirrors, f = .6",
        "squared displacement",
        "%",
        4.0,
        lambda s: bulk(s, "mirror", 0.6),
        FORGETFUL | {"teleport-memory": BACK},
    ),
    Row(
        "mixture",
        GROUP,
        "mirrors and clear spheres, half and half",
        "reflectance",
        "%",
        3.0,
        mixture,
        FORGETFUL | {"teleport-memory": BACK},
    ),
)
