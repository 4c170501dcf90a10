"""Rows about rays at surfaces and light in single grains: the ray engine at its precision, meshes, trapped light."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from tsdf.data.table import Table
from tsdf.errors import GrainError
from tsdf.grain.grains import Grain, embree_scene, first_hit, grain_from_mesh, load_grain, triangle_scene
from tsdf.grain.optics import OFFSET, RETRY
from tsdf.judge import analytic
from tsdf.make import tally as T
from tsdf.make.tally import Tally
from tsdf.make.tracer import MAX_BOUNCES, Tracer, in_order
from tsdf.stress.cells import REFUSED, TABLES, TRACER, Measured, Row, Setting, relative, share
from tsdf.study.ranking import mean_of

GROUP = "Rays at surfaces, light in one grain"
ALONG, FIXED = 1e-6, 1e-4
FAR = 1e4  # [R]
ETA = 1.33
CELLS = 40  # of cos theta, of equal mass of the exact sphere


def normals_of(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(normals / np.linalg.norm(normals, axis=1)[:, None])


def leaving(
    vertices: np.ndarray, faces: np.ndarray, rays: int, rng: np.random.Generator, steepest: float = 1.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return facets, points on them, their normals and directions outward, of cosines up to `steepest`."""
    facet = rng.integers(0, len(faces), rays)
    points = np.einsum("ij,ijk->ik", rng.dirichlet((1.0, 1.0, 1.0), rays), vertices[faces[facet]])
    normals = normals_of(vertices, faces)[facet]
    aside = np.cross(normals, rng.normal(size=normals.shape))
    aside /= np.linalg.norm(aside, axis=1)[:, None]
    cosine = steepest * rng.random((rays, 1))
    return facet, points, normals, cosine * normals + np.sqrt(1.0 - cosine**2) * aside


def restart(setting: Setting, steepest: float) -> Iterator[Measured]:
    """Rays that leave a convex grain outward must not meet it again."""
    grain, rays = load_grain("icosphere", subdivisions=3), setting.some(2_000_000)
    _, points, normals, ways = leaving(grain.vertices, grain.faces, rays, setting.rng(1), steepest)
    scene = embree_scene(grain)
    for method, starts in (
        (TRACER, points + OFFSET * normals), ("no offset", points), ("along the ray", points + ALONG * ways)
    ):  # fmt: skip
        yield share(method, int((first_hit(scene, starts, ways) >= 0).sum()), rays)


def grazing(setting: Setting) -> Iterator[Measured]:
    return restart(setting, 0.01)


def even(setting: Setting) -> Iterator[Measured]:
    return restart(setting, 1.0)


def _inward(setting: Setting, ours: Grain, raw: np.ndarray, size: float) -> Iterator[Measured]:
    """Light inside a convex grain must meet another of its facets: in the grain that we make of a mesh, and in the mesh
    as it comes, where rays restart as far from its facets, or so many scene units."""
    rays = setting.some(2_000_000)
    for method, vertices, offset in (
        (TRACER, ours.vertices, OFFSET), ("as it comes", raw, OFFSET * size), ("fixed offset", raw, FIXED)
    ):  # fmt: skip
        facet, points, normals, ways = leaving(vertices, ours.faces, rays, setting.rng(2))
        scene = triangle_scene(vertices, ours.faces)
        found = first_hit(scene, points - offset * normals, -ways)
        yield share(method, int(((found < 0) | (found == facet)).sum()), rays)


def far(setting: Setting) -> Iterator[Measured]:
    ball = load_grain("icosphere", subdivisions=3)
    raw = ball.vertices + np.array((FAR, 0.0, -FAR))
    return _inward(setting, grain_from_mesh(raw, ball.faces), raw, 1.0)


def small(setting: Setting) -> Iterator[Measured]:
    ball = load_grain("icosphere", subdivisions=3)
    raw = 1e-6 * ball.vertices
    return _inward(setting, grain_from_mesh(raw, ball.faces), raw, 1e-6)


def vertices(setting: Setting) -> Iterator[Measured]:
    """Rays inside a grain aimed at its vertices must not get out between the facets."""
    grain, rays, rng = load_grain("icosphere", subdivisions=5), setting.some(2_000_000), setting.rng(3)
    facet, points, normals, _ = leaving(grain.vertices, grain.faces, rays, rng)
    starts = points - OFFSET * normals
    ways = grain.vertices[rng.integers(0, len(grain.vertices), rays)] - starts
    length = np.linalg.norm(ways, axis=1)
    kept = length > 0.1  # not those of the facet itself
    facet, points, normals, starts = facet[kept], points[kept], normals[kept], starts[kept]
    ways = ways[kept] / length[kept, None]
    scene = embree_scene(grain)
    lost = np.flatnonzero(first_hit(scene, starts, ways) < 0)
    middle = grain.vertices[grain.faces[facet[lost]]].mean(axis=1)
    again = points[lost] + RETRY * (middle - points[lost]) - OFFSET * normals[lost]
    still = first_hit(scene, again, ways[lost]) < 0
    yield share(TRACER, int(still.sum()), len(ways), f"{len(lost)} of {len(ways)} are sent off again")
    yield share("engine alone", len(lost), len(ways))


def _ledger(grain: Grain, paths: int, setting: Setting, bounces: int = MAX_BOUNCES, eta: float = ETA) -> np.ndarray:
    """Return scalar sums by replicate of a grain."""
    tally = Tally()
    Tracer(grain, eta, max_bounces=bounces, seed=setting.seed).trace(in_order(0, paths), tally)
    return tally.scalars.astype(np.float64)


def trapped(setting: Setting, grain: Grain, eta: float) -> Iterator[Measured]:
    """Light that total reflection holds must come out, or be said to be missing."""
    for method, bounces in ((TRACER, MAX_BOUNCES), ("cap 10", 10), ("cap 32", 32)):
        s = _ledger(grain, setting.some(400_000), setting, bounces, eta)
        yield Measured(method, *mean_of(100.0 * (s[:, T.TRUNCATED] + s[:, T.LOST]) / s[:, T.LAUNCHED]))


def bubble(setting: Setting) -> Iterator[Measured]:
    """A sphere of eta .75 turns light as the analytic one does."""
    s = _ledger(load_grain("sphere"), setting.some(1_000_000), setting, eta=0.75)
    truth = analytic.sphere_statistics(0.75).mean_cosine
    yield relative(TRACER, mean_of(s[:, T.COS_THETA] / s[:, T.SCATTERED]), (truth, 0.0))


def facets(setting: Setting) -> Iterator[Measured]:
    """Deflection by a sphere and by what stands for one, against the analytic sphere."""
    edges = np.cos(np.arange(T.FINE, -1, -1) * np.pi / T.FINE)
    exact = analytic.deflection_masses(edges, ETA)[::-1]
    cut = np.unique(np.searchsorted(np.cumsum(exact), np.arange(1, CELLS) / CELLS))
    for method, grain in (
        (TRACER, load_grain("sphere")), ("1280 facets", load_grain("icosphere", subdivisions=3)),
        ("5120 facets", load_grain("icosphere", subdivisions=4)),
    ):  # fmt: skip
        tally = Tally()
        Tracer(grain, ETA, seed=setting.seed).trace(in_order(0, setting.some(2_000_000)), tally)
        found = tally.theta[:, : T.FINE] / tally.theta.sum(axis=1)[:, None]
        off = np.add.reduceat(found - exact, np.concatenate(([0], cut)), axis=1)
        noise = off.std(axis=0, ddof=1) / len(off) ** 0.5
        yield Measured(method, float(50.0 * np.abs(off.mean(axis=0)).sum()), float(50.0 * noise.sum() * 0.6))


def inverted(setting: Setting) -> Iterator[Measured]:
    """A mesh whose facets are turned inside out sends light where the right one does."""
    ball = load_grain("icosphere", subdivisions=3)
    turned_round = ball.faces[:, ::-1].copy()

    def cosine_of(grain: Grain) -> tuple[float, float]:
        s = _ledger(grain, setting.some(400_000), setting)
        return mean_of(s[:, T.COS_THETA] / s[:, T.LAUNCHED])

    truth = cosine_of(ball)
    for method, grain in (
        (TRACER, grain_from_mesh(ball.vertices, turned_round)), ("as it comes", replace(ball, faces=turned_round))
    ):  # fmt: skip
        yield relative(method, cosine_of(grain), truth)


def hollow(setting: Setting) -> Iterator[Measured]:
    """Of a mesh with a hole no table is made without a word; light that gets in through the hole is lost."""
    ball, rays = load_grain("icosphere", subdivisions=3), setting.some(1_000_000)
    rest = ball.faces[10:]

    def lost(method: str, scene: Any) -> Measured:
        _, points, normals, ways = leaving(ball.vertices, rest, rays, setting.rng(4))
        return share(method, int((first_hit(scene, points - OFFSET * normals, -ways) < 0).sum()), rays)

    try:
        yield lost(TRACER, embree_scene(grain_from_mesh(ball.vertices, rest)))
    except GrainError as error:
        yield Measured(TRACER, 0.0, note=f"{REFUSED}: {error}")
    yield lost("as it comes", triangle_scene(ball.vertices, rest))


def nearly_alike(setting: Setting) -> Iterator[Measured]:
    """Grains that hardly differ from what is around them hardly turn light: 1 - g is 1e-4."""
    import tsdf

    eta = 1.005
    truth = 1.0 - analytic.sphere_statistics(eta).mean_cosine
    tally = Tally()
    Tracer(load_grain("sphere"), eta, seed=setting.seed).trace(in_order(0, setting.some(10_000_000)), tally)
    s = tally.scalars.astype(np.float64)
    yield relative(TRACER, mean_of((s[:, T.SCATTERED] - s[:, T.COS_THETA]) / s[:, T.SCATTERED]), (truth, 0.0))
    table = tsdf.build("sphere", eta, tsdf.Effort(cells=256, memory=64), setting.threads)
    yield relative(TABLES, (1.0 - table.mean_cosine(), 0.0), (truth, 0.0))
    yield relative("teleport-memory", (turn_of_records(table), 0.0), (truth, 0.0), "64 records by entry in 258 cells")


def turn_of_records(table: Table) -> float:
    """Return 1 - g of a table's records by entry."""
    weight = table.hit.astype(np.float64) if table.hit.any() else np.ones(table.hit.shape)
    kept = table.memory["cos_theta"].astype(np.float64)
    return float(1.0 - np.average(kept.mean(axis=0), weights=weight))


def turned_back(setting: Setting) -> Iterator[Measured]:
    """A mirror that is a sphere sends light evenly everywhere."""
    tally = Tally()
    Tracer(load_grain("sphere"), 1e9, seed=setting.seed).trace(in_order(0, setting.some(1_000_000)), tally)
    s = tally.scalars.astype(np.float64)
    yield Measured(TRACER, *mean_of(100.0 * s[:, T.COS_THETA] / s[:, T.LAUNCHED]))


ROWS = (
    Row("restart", GROUP, "ray restarts at a facet", "rays that meet the convex grain they leave", "%", 0.002, even),
    Row("grazing-restart", GROUP, "the same, within half a degree of the facet",
        "rays that meet the convex grain they leave", "%", 0.002, grazing),
    Row("far", GROUP, "grain 1e4 R from the origin", "rays inside that meet no other facet", "%", 0.002, far),
    Row("small", GROUP, "grain of 1e-6 scene units", "rays inside that meet no other facet", "%", 0.002, small),
    Row("vertices", GROUP, "rays aimed at vertices", "rays that get out between facets", "%", 0.002, vertices),
    Row("trapped", GROUP, "light held by total reflection, 5120 facets", "light missing", "%", 0.01,
        lambda s: trapped(s, load_grain("icosphere", subdivisions=4), ETA)),
    Row("diamond", GROUP, "light held by a cube, eta = 2.4", "light missing", "%", 0.01,
        lambda s: trapped(s, load_grain("cube"), 2.4)),
    Row("facets", GROUP, "facets for a sphere, eta 1.33", "total variation of p_theta", "%", 0.5, facets),
    Row("inverted", GROUP, "mesh turned inside out", "mean cosine", "%", 2.0, inverted),
    Row("hole", GROUP, "mesh with a hole", "rays inside that get out through it", "%", 0.002, hollow),
    Row(
        "eta-1", GROUP, "eta = 1.005", "1 - g", "%", 5.0, nearly_alike,
        known={"teleport-memory": "memory.md, How right it is"},
    ),
    Row("bubble", GROUP, "bubble, eta = .75", "mean cosine", "%", 0.5, bubble),
    Row("mirror", GROUP, "mirror", "mean cosine times 100", "1", 0.5, turned_back),
)  # fmt: skip
