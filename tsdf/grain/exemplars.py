"""Exemplars: built-in grains made by formula, each a closed triangle mesh by construction.

Units are arbitrary (`grains` normalises); vertices are shared, faces wound counter-clockwise seen from
outside. The exact sphere is not here: it has no mesh (`grains.load_grain("sphere")`). Curved grains are
star-shaped, a radius for every direction of a subdivided icosahedron, so they cannot cross themselves; crystals with
re-entrant corners are `crystals`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from tsdf.errors import UsageError
from tsdf.grain.crystals import (
    Floats,
    Mesh,
    bullet_rosette,
    column_aggregate,
    droxtal,
    hexprism,
    hollow_column,
    hull,
    koch_snowflake,
    turned,
)


@dataclass(frozen=True)
class Parameter:
    """A number that shapes an exemplar: its default, its valid range [low, high], unit and meaning."""

    default: float | int
    low: float
    high: float
    unit: str
    meaning: str

    def parse(self, name: str, value: Any) -> float | int:
        """Return the value as int or float, like the default; UsageError if it is not one or out of range."""
        whole = isinstance(self.default, int)
        try:
            number = float(value)
            valid = self.low <= number <= self.high and (not whole or number == int(number))
        except (TypeError, ValueError):
            valid = False
        if not valid:
            kind = "a whole number" if whole else "a number"
            unit = f" {self.unit}" if self.unit else ""
            raise UsageError(f"{name}={value}: must be {kind} from {self.low:g} to {self.high:g}{unit}")
        return int(number) if whole else number


@dataclass(frozen=True)
class Exemplar:
    """A built-in grain: what it is, how it is built, and the parameters of `build`."""

    summary: str
    build: Callable[..., Mesh]
    parameters: Mapping[str, Parameter]

    def resolve(self, given: Mapping[str, Any]) -> dict[str, float | int]:
        """Return every parameter, given (as number or text) or default; UsageError for what is not valid."""
        for name in given:
            if name not in self.parameters:
                valid = ", ".join(self.parameters) or "none"
                raise UsageError(f"{name}: no parameter of this grain; valid names: {valid}")
        return {name: p.parse(name, given.get(name, p.default)) for name, p in self.parameters.items()}


# ------------------------------------------------------------------------------------------- polyhedra


def cube(bevel: float) -> Mesh:
    """Return a cube of edge 1; bevels at 45 degrees cut `bevel` off each face along each of its edges."""
    if bevel == 0:
        return hull(np.array(list(product((-0.5, 0.5), repeat=3))))
    signs = np.array(list(product((-1, 1), repeat=3)))
    corner = np.full((3, 3), 0.5 - bevel) + bevel * np.eye(3)
    return hull((signs[:, None, :] * corner).reshape(-1, 3))


def octahedron() -> Mesh:
    """Return a regular octahedron of circumradius 1."""
    return hull(np.vstack([np.eye(3), -np.eye(3)]))


def tetrahedron() -> Mesh:
    """Return a regular tetrahedron of circumradius sqrt(3)."""
    return hull(np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]))


# ------------------------------------------------------------------------------------ star-shaped grains


ICOSAHEDRON = (
    (0, 8, 4), (5, 0, 2), (2, 0, 4), (7, 3, 1), (8, 1, 6), (4, 8, 6), (1, 3, 6), (10, 1, 8), (10, 0, 5), (8, 0, 10),
    (10, 7, 1), (5, 7, 10), (11, 7, 5), (5, 2, 11), (3, 7, 11), (4, 6, 9), (9, 2, 4), (9, 6, 3), (9, 11, 2), (3, 11, 9),
)  # fmt: skip


def icosphere(subdivisions: int) -> Mesh:
    """Return a unit sphere of 20 * 4^`subdivisions` faces: an icosahedron, edges halved and pushed out."""
    golden = (1 + 5**0.5) / 2
    ring = np.array([[0.0, s, t * golden] for s, t in product((-1, 1), repeat=2)])
    vertices = np.vstack([np.roll(ring, k, axis=1) for k in range(3)]) / np.hypot(1, golden)
    faces = np.array(ICOSAHEDRON)
    for _ in range(subdivisions):
        n = len(vertices)
        ends = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        edges, index = np.unique(ends, axis=0, return_inverse=True)
        middle = vertices[edges].sum(axis=1)
        vertices = np.vstack([vertices, middle / np.linalg.norm(middle, axis=1, keepdims=True)])
        (a, b, c), (ab, bc, ca) = faces.T, n + index.reshape(-1, 3).T
        faces = np.column_stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca]).reshape(-1, 3)
    return vertices, faces


def ellipsoid(a: float, b: float, c: float, subdivisions: int) -> Mesh:
    """Return an icosphere stretched to semi-axes a, b, c along x, y, z."""
    vertices, faces = icosphere(subdivisions)
    return vertices * [a, b, c], faces


def covariance_weights(gamma_deg: float) -> Floats:
    """Return the Legendre coefficients c_n of the modified Gaussian correlation function, which sum to 1 [1].

    exp(−2 sin²(g/2)/l²) = sum c_n P_n(cos g), c_n = (2n+1) e^(−1/l²) i_n(1/l²), l = 2 sin(Gamma/2), i_n
    the modified spherical Bessel function; Gamma is `gamma_deg`. Cut off where the rest is below 1e-6.

    [1] K. Muinonen, T. Nousiainen, P. Fast, K. Lumme, J. I. Peltoniemi, JQSRT 55 (1996) 577.
    """
    from scipy.special import ive  # scaled by e^(−x)

    x = 1 / (2 * np.sin(np.radians(gamma_deg) / 2)) ** 2
    n = np.arange(400)
    weights = (2 * n + 1) * np.sqrt(np.pi / (2 * x)) * ive(n + 0.5, x)
    return weights[: int((1 - np.cumsum(weights) > 1e-6).sum()) + 1]


def sand(sigma: float, gamma: float, seed: int, subdivisions: int) -> Mesh:
    """Return a Gaussian random sphere: log-normal radii of relative standard deviation `sigma` [1].

    r(u) = exp(s(u) − beta²/2), s a Gaussian field of variance beta² = ln(1 + sigma²) whose correlation
    falls to e^(−1/2) at the angle `gamma` [degrees]; see `covariance_weights`.

    [1] K. Muinonen, T. Nousiainen, P. Fast, K. Lumme, J. I. Peltoniemi, JQSRT 55 (1996) 577.
    """
    vertices, faces = icosphere(subdivisions)
    rng = np.random.default_rng(seed)
    beta2 = np.log1p(sigma**2)
    weights = covariance_weights(gamma)
    # g[n, m]: cosine terms for m >= 0, h[n, m]: sine terms; degree by degree, so that gamma adds detail only
    draws = [rng.normal(size=(2, n + 1)) for n in range(len(weights))]
    z, longitude = vertices[:, 2], np.arctan2(vertices[:, 1], vertices[:, 0])
    field = np.zeros(len(z))
    diagonal = np.full(len(z), 1.0)  # P_mm, normalised so that sum over m of the squares at degree n is 1
    for m in range(len(weights)):
        if m:
            diagonal = diagonal * np.sqrt((2 * m - 1) / (2 * m)) * np.sqrt(np.maximum(0, 1 - z * z))
        previous, legendre = np.zeros_like(z), diagonal * (1 if m == 0 else 2**0.5)
        cosine, sine = np.cos(m * longitude), np.sin(m * longitude)
        for n in range(m, len(weights)):
            g, h = draws[n][:, m]
            field += np.sqrt(beta2 * weights[n]) * legendre * (g * cosine + h * sine)
            ahead = (2 * n + 1) * z * legendre - np.sqrt(n * n - m * m) * previous
            previous, legendre = legendre, ahead / np.sqrt((n + 1) ** 2 - m * m)
    return vertices * np.exp(field - beta2 / 2)[:, None], faces


def _rounded_maximum(values: Floats, radius: Floats | float) -> Floats:
    """Return along axis 0 a maximum whose ridges are filleted: s + k where sum max(0, v − s)² = k².

    Where one value stands out by more than the radius k it is exactly that value.
    """
    top = values.max(axis=0)
    s = top - radius  # the sum is at least k² here and falls as s grows: Newton's steps go up and never pass the root
    for _ in range(30):
        excess = np.maximum(0, values - s)
        s = s + ((excess**2).sum(axis=0) - np.square(radius)) / (2 * excess.sum(axis=0))
    return s + radius


def _rounded_polytope(u: Floats, normals: Floats, heights: Floats, radius: Floats) -> Floats:
    """Return the radius along u (n, 3) of a polytope of facets n.x = h with edges rounded by `radius` (n,).

    The root r of sum max(0, r n.u − h + radius)² = radius²: a facet alone stays exactly flat, two at
    right angles are joined by a circular arc.
    """
    slope = np.maximum(u @ normals.T, 0)
    r = (heights / np.maximum(slope, 1e-9)).min(axis=1)  # the sharp polytope is outside: Newton comes down
    moving = np.arange(len(r))
    for _ in range(30):
        before, at, within = r[moving], slope[moving], radius[moving]
        excess = np.maximum(0, before[:, None] * at - heights + within[:, None])
        r[moving] = before - ((excess**2).sum(axis=1) - within**2) / (2 * (excess * at).sum(axis=1))
        moving = moving[r[moving] != before]
    return r


def snow(lobes: int, rounding: float, seed: int, subdivisions: int) -> Mesh:
    """Return an irregular snow grain: hexagonal crystals grown together, partly faceted, partly melted.

    Each of the `lobes` is a hexagonal prism of random aspect, turned at random and set off its own way but
    around the origin; `_rounded_maximum` unites the radii and leaves fillets like sintered necks. Edges are
    rounded with a radius that grows over the grain from a crisp to a melted side; `rounding` from 0 to 1
    moves both.
    """
    u, faces = icosphere(subdivisions)
    rng = np.random.default_rng(seed)

    def turned() -> Floats:
        q, r = np.linalg.qr(rng.normal(size=(3, 3)))
        return q * np.sign(np.diag(r))

    angle = np.arange(6) * np.pi / 3
    prism = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(6)])
    normals = np.vstack([prism, [[0, 0, 1], [0, 0, -1]]])
    warmth = 1 / (1 + np.exp(-5 * (u @ turned()[0])))  # 1 on the side that melted
    radius = 0.08 + rounding * (0.2 * rounding + 0.4 * warmth)
    corners = np.array([[1, 1, 1], [-1, -1, 1], [-1, 1, -1], [1, -1, -1]])[:lobes] @ turned()
    away = corners - corners.mean(axis=0) + rng.normal(0, 0.25, (lobes, 3))  # lobes lie apart: a simplex, jittered
    radii = []
    for k in range(lobes):
        offset = rng.uniform(0.35, 0.6) * away[k] / np.linalg.norm(away[k]) * (lobes > 1)
        heights = np.r_[rng.uniform(0.5, 0.65) * rng.uniform(0.9, 1.1, 6), np.full(2, rng.uniform(0.4, 0.75))]
        n = normals @ turned().T
        heights = np.maximum(heights + n @ offset, 0.3)  # the origin stays well inside
        radii.append(_rounded_polytope(u, n, heights, np.minimum(radius, 0.95 * heights.min())))
    return u * _rounded_maximum(np.array(radii), 0.06 + 0.2 * rounding)[:, None], faces


_SIDES = np.array([[np.cos(k * np.pi / 3), np.sin(k * np.pi / 3), 0.0] for k in range(6)])  # of a hexagonal prism
_SIMPLEX = np.array([[1, 1, 1], [-1, -1, 1], [-1, 1, -1], [1, -1, -1]])


@dataclass(frozen=True)
class _Habit:
    """How crystals that grow together look: ranges of the half-width and half-length of their prisms and of how far
    they are set off, how near the origin a facet may come at least, and the radii of edges and of the necks between.
    """

    width: tuple[float, float]
    length: tuple[float, float]
    offset: tuple[float, float]
    least: float
    edge: float
    neck: float

    def grown(self, crystals: int, seed: int, subdivisions: int) -> Mesh:
        """Return hexagonal prisms turned at random and united, each set off its own way but around the origin."""
        u, faces = icosphere(subdivisions)
        rng = np.random.default_rng(seed)
        normals = np.vstack([_SIDES, [[0, 0, 1], [0, 0, -1]]])
        away = _SIMPLEX[:crystals] @ turned(rng)
        away = away - away.mean(axis=0) + rng.normal(0, 0.25, (crystals, 3))
        radii = []
        for way in away:
            offset = rng.uniform(*self.offset) * way / np.linalg.norm(way) * (crystals > 1)
            sides = rng.uniform(*self.width) * rng.uniform(0.9, 1.1, 6)
            n = normals @ turned(rng).T
            heights = np.maximum(np.r_[sides, np.full(2, rng.uniform(*self.length))] + n @ offset, self.least)
            radii.append(_rounded_polytope(u, n, heights, np.full(len(u), min(self.edge, 0.95 * heights.min()))))
        return u * _rounded_maximum(np.array(radii), self.neck)[:, None], faces


def fresh(crystals: int, thickness: float, seed: int, subdivisions: int) -> Mesh:
    """Return fresh snow: thin hexagonal plates grown through each other, of `thickness` over width about."""
    habit = _Habit((0.5, 0.9), (0.5 * thickness, 0.9 * thickness), (0, 0.05), 0.4 * thickness, 0.02, 0.03)
    return habit.grown(crystals, seed, subdivisions)


def faceted(crystals: int, stretch: float, seed: int, subdivisions: int) -> Mesh:
    """Return a faceted crystal: hexagonal prisms with sharp edges, one or joined, drawn out `stretch` times along z."""
    vertices, faces = _Habit((0.5, 0.65), (0.4, 0.75), (0.1, 0.3), 0.3, 0.02, 0.03).grown(crystals, seed, subdivisions)
    return vertices * [1, 1, stretch], faces


def rounded(crystals: int, stretch: float, seed: int, subdivisions: int) -> Mesh:
    """Return a rounded grain: prisms melted until little of their facets is left, drawn out `stretch` times along z."""
    vertices, faces = _Habit((0.5, 0.65), (0.4, 0.75), (0.35, 0.6), 0.3, 0.5, 0.2).grown(crystals, seed, subdivisions)
    return vertices * [1, 1, stretch], faces


_SUBDIVISIONS = Parameter(5, 2, 7, "", "halvings of an icosahedron's edges; 20 * 4^n faces")
_SEED = Parameter(0, 0, 2**32 - 1, "", "of the random shape")

EXEMPLARS: dict[str, Exemplar] = {
    "cube": Exemplar(
        "cube, sharp or bevelled",
        cube,
        {"bevel": Parameter(0.0, 0.0, 0.49, "of the edge", "width cut off each face along each edge, at 45 degrees")},
    ),
    "octahedron": Exemplar("regular octahedron", octahedron, {}),
    "tetrahedron": Exemplar("regular tetrahedron", tetrahedron, {}),
    "hexprism": Exemplar(
        "hexagonal ice prism: plate, crystal or column",
        hexprism,
        {"aspect": Parameter(1.0, 0.01, 100.0, "", "L/2a, length over the width across corners")},
    ),
    "icosphere": Exemplar("sphere of triangles", icosphere, {"subdivisions": _SUBDIVISIONS}),
    "ellipsoid": Exemplar(
        "ellipsoid of triangles",
        ellipsoid,
        {
            "a": Parameter(1.0, 0.01, 100.0, "", "semi-axis along x"),
            "b": Parameter(0.8, 0.01, 100.0, "", "semi-axis along y"),
            "c": Parameter(0.6, 0.01, 100.0, "", "semi-axis along z"),
            "subdivisions": _SUBDIVISIONS,
        },
    ),
    "sand": Exemplar(
        "sand grain: Gaussian random sphere",
        sand,
        {
            "sigma": Parameter(0.2, 0.0, 0.6, "", "standard deviation of the radius over its mean"),
            "gamma": Parameter(35.0, 10.0, 90.0, "degrees", "correlation angle; smaller is rougher"),
            "seed": _SEED,
            "subdivisions": _SUBDIVISIONS,
        },
    ),
    "snow": Exemplar(
        "irregular snow grain: joined crystals, partly faceted, partly melted",
        snow,
        {
            "lobes": Parameter(3, 1, 4, "", "crystals grown together"),
            "rounding": Parameter(0.5, 0.0, 1.0, "", "from crisp facets to melted"),
            "seed": _SEED,
            "subdivisions": _SUBDIVISIONS,
        },
    ),
    "fresh": Exemplar(
        "fresh snow: plates grown through each other, g of natural snow",
        fresh,
        {
            "crystals": Parameter(2, 1, 4, "", "plates"),
            "thickness": Parameter(0.225, 0.05, 1.0, "", "of a plate over its width"),
            "seed": _SEED,
            "subdivisions": _SUBDIVISIONS,
        },
    ),
    "rounded": Exemplar(
        "rounded snow grain: melted crystals, drawn out, g of natural snow",
        rounded,
        {
            "crystals": Parameter(3, 1, 4, "", "crystals grown together"),
            "stretch": Parameter(2.55, 1.0, 4.0, "", "along z"),
            "seed": _SEED,
            "subdivisions": _SUBDIVISIONS,
        },
    ),
    "faceted": Exemplar(
        "faceted snow crystal: irregular prism with sharp edges, drawn out, g of natural snow",
        faceted,
        {
            "crystals": Parameter(1, 1, 4, "", "crystals grown together"),
            "stretch": Parameter(2.7, 1.0, 4.0, "", "along z"),
            "seed": _SEED,
            "subdivisions": _SUBDIVISIONS,
        },
    ),
    "droxtal": Exemplar(
        "droxtal: ice crystal of 20 facets inscribed in a sphere",
        droxtal,
        {
            "theta1": Parameter(32.35, 1.0, 44.9, "degrees", "between the axis and the corners of the basal hexagons"),
            "theta2": Parameter(71.81, 45.1, 89.0, "degrees", "between the axis and the corners of the prism"),
        },
    ),
    "bullet_rosette": Exemplar(
        "bullet rosette: columns grown together at their pyramidal tips",
        bullet_rosette,
        {
            "bullets": Parameter(6, 2, 6, "", "columns"),
            "aspect": Parameter(2.0, 0.1, 20.0, "", "length of a column without its tip over its width across corners"),
            "tip": Parameter(28.0, 5.0, 44.0, "degrees", "between the axis of a tip and its edges"),
        },
    ),
    "column_aggregate": Exemplar(
        "aggregate of hexagonal columns that touch",
        column_aggregate,
        {
            "columns": Parameter(8, 2, 32, "", "how many"),
            "aspect": Parameter(1.5, 0.1, 10.0, "", "mean length over width across corners"),
            "seed": _SEED,
        },
    ),
    "koch_snowflake": Exemplar(
        "plate with the outline of Koch's snowflake",
        koch_snowflake,
        {
            "order": Parameter(3, 0, 5, "", "times that triangles grow on all sides"),
            "aspect": Parameter(0.1, 0.01, 10.0, "", "thickness over the circle's diameter around it"),
        },
    ),
    "hollow_column": Exemplar(
        "hexagonal column with pyramids sunk into both ends",
        hollow_column,
        {
            "aspect": Parameter(1.5, 0.1, 100.0, "", "L/2a, length over the width across corners"),
            "depth": Parameter(0.7, 0.0, 0.95, "of half the length", "of the pyramids"),
        },
    ),
}
