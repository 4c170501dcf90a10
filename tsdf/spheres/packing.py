"""Packing: equal hard spheres at random in a periodic cube, and the straight lines through them.

The truth that models of granular media are measured against; what stands in the spheres, and how light goes on, is
not here. Lengths are in units of the spheres' radius. Tile (0, 0, 0) is the cube [0, side)^3 and tiles repeat for ever.
A packing is relaxed from random points (soft spheres, FIRE), then moved by the hard-sphere Monte Carlo method of
Metropolis et al. 1953: up to the freezing point (0.494) the equilibrium fluid, above it a glass, for the run is too
short for crystals to grow. Above 0.625, where random starts jam, a dense fluid is compressed in small steps, moved
after each: it jams later, the slower the later.
"""

import math
import os
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tsdf import archive
from tsdf.compiled import njit
from tsdf.errors import TSDFError, UsageError
from tsdf.sampling import key_of, mix, unit
from tsdf.vectors import KERNEL

MAX = 0.64  # volume fraction; compressed fluids jam at about 0.65
MIN_SPHERES = 64  # the cube is then at least six radii wide: no sphere meets a neighbour twice
CLOSEST = 2.0 - 1e-9  # centres of two spheres are nowhere closer [R]

_VERSION = 1  # of the algorithm; a change that moves a sphere changes it
_RELAXED = 0.62  # volume fraction to which larger spheres are relaxed, so that there is room when they have their size
_SLACK = 5e-4  # overlap of larger spheres that does not matter [diameter]
_RANDOM = 0.625  # volume fraction up to which packings are made of random starts; they jam at 0.64 (O'Hern et al. 2003)
_FLUID, _STIRRED = 0.58, 6_000  # volume fraction and sweeps of the fluid that is compressed to more than that
_STEP, _BETWEEN = 0.005, 1_500  # steps of its compression in volume fraction, and sweeps after each
_CLEAR = 1e-4  # overlap of larger spheres that does not matter, while it is compressed [diameter]
_ATTEMPTS = 20  # at MAX two in three starts of 64 spheres are jammed and one in three of 300; of 1000 and more none was
_STEPS = 10_000  # of one relaxation
_SWEEPS = 4_000
_PAD = 1e-3  # cells list spheres that come this close, far more than the rounding of the walk through them


@dataclass(frozen=True, eq=False)
class Packing:
    """Equal spheres of radius 1 in a periodic cube.

    Parameters
    ----------
    centres : (n, 3) float64
        Centres of the spheres in tile (0, 0, 0), in [0, side) [R]; read-only.
    side : float
        Edge of the cube [R].
    fraction : float
        Share of the volume that lies in spheres [1].
    seed : int
        What the packing was drawn from.
    """

    centres: np.ndarray
    side: float
    fraction: float
    seed: int

    def __post_init__(self) -> None:
        centres = np.array(self.centres, dtype=np.float64, order="C")
        centres.flags.writeable = False
        object.__setattr__(self, "centres", centres)


# ------------------------------------------------------------------------------------------ making


@njit(cache=True)
def _cell(x, y, z, side, m):
    """Return the number of the cell of m^3 that a point of the cube lies in."""
    s = m / side
    return (min(int(x * s), m - 1) * m + min(int(y * s), m - 1)) * m + min(int(z * s), m - 1)


@njit(cache=True)
def _wrapped(x, side):
    """Return a coordinate moved into [0, side)."""
    x -= side * math.floor(x / side)
    return x if x < side else 0.0


@njit(cache=True)
def _shortest(x, side):
    """Return the difference of two coordinates of the cube, to the nearest image."""
    if x > 0.5 * side:
        return x - side
    return x + side if x < -0.5 * side else x


@njit(cache=True)
def _link(centres, side, m, head, link):
    """Thread the spheres of each cell on a list: `head` by cell, `link` by sphere, -1 at the end."""
    head[:] = -1
    for i in range(len(centres)):
        cell = _cell(centres[i, 0], centres[i, 1], centres[i, 2], side, m)
        link[i] = head[cell]
        head[cell] = i


@njit(cache=True)
def _around(cell, m, cells):
    """Write the numbers of a cell and the 26 around it into `cells`."""
    x, y, z = cell // (m * m), cell // m % m, cell % m
    k = 0
    for i in range(x - 1, x + 2):
        for j in range(y - 1, y + 2):
            for n in range(z - 1, z + 2):
                cells[k] = (i % m * m + j % m) * m + n % m
                k += 1


@njit(cache=True)
def _push(centres, side, m, diameter, head, link, cells, force):
    """Write the force of linear springs between overlapping spheres, and return the least distance of centres."""
    _link(centres, side, m, head, link)
    force[:] = 0.0
    closest = math.inf
    for cell in range(m * m * m):
        if head[cell] < 0:
            continue
        _around(cell, m, cells)
        i = head[cell]
        while i >= 0:
            for neighbour in cells:
                j = head[neighbour]
                while j >= 0:
                    if j < i:
                        x = _shortest(centres[i, 0] - centres[j, 0], side)
                        y = _shortest(centres[i, 1] - centres[j, 1], side)
                        z = _shortest(centres[i, 2] - centres[j, 2], side)
                        r2 = x * x + y * y + z * z
                        if r2 < diameter * diameter:
                            r = math.sqrt(r2)
                            closest = min(closest, r)
                            k = diameter / max(r, 1e-9) - 1.0
                            force[i, 0] += k * x
                            force[i, 1] += k * y
                            force[i, 2] += k * z
                            force[j, 0] -= k * x
                            force[j, 1] -= k * y
                            force[j, 2] -= k * z
                    j = link[j]
            i = link[i]
    return closest


@njit(cache=True, nogil=True)
def _relax(centres, side, m, diameter, enough, steps):
    """Push spheres apart until centres are `enough` apart, and return whether they are (FIRE, Bitzek et al. 2006)."""
    n = len(centres)
    head, link, cells = np.empty(m * m * m, np.int64), np.empty(n, np.int64), np.empty(27, np.int64)
    force, velocity = np.empty((n, 3)), np.zeros((n, 3))
    dt, mixing, downhill = 0.1, 0.1, 0
    for _ in range(steps):
        if _push(centres, side, m, diameter, head, link, cells, force) >= enough:
            return True
        power = ff = vv = 0.0
        for i in range(n):
            for k in range(3):
                power += force[i, k] * velocity[i, k]
                ff += force[i, k] * force[i, k]
                vv += velocity[i, k] * velocity[i, k]
        keep, turn = 0.0, 0.0
        if power > 0.0:
            keep, turn = 1.0 - mixing, mixing * math.sqrt(vv / ff)
            downhill += 1
            if downhill > 5:
                dt, mixing = min(1.1 * dt, 0.5), 0.99 * mixing
        else:
            dt, mixing, downhill = max(0.5 * dt, 0.01), 0.1, 0
        for i in range(n):
            for k in range(3):
                velocity[i, k] = keep * velocity[i, k] + (turn + dt) * force[i, k]
                centres[i, k] = _wrapped(centres[i, k] + dt * velocity[i, k], side)
    return False


@njit(cache=True, nogil=True)
def _stir(centres, side, m, key, sweeps):
    """Move spheres at random where there is room for them; the length of moves is set in the first half."""
    n = len(centres)
    head, link, cells = np.empty(m * m * m, np.int64), np.empty(n, np.int64), np.empty(27, np.int64)
    _link(centres, side, m, head, link)
    reach, accepted = 0.2, 0
    for sweep in range(sweeps):
        for i in range(n):
            k = key_of(key, sweep, i)
            x = _wrapped(centres[i, 0] + reach * (2.0 * unit(k) - 1.0), side)
            y = _wrapped(centres[i, 1] + reach * (2.0 * unit(mix(k + np.uint64(1))) - 1.0), side)
            z = _wrapped(centres[i, 2] + reach * (2.0 * unit(mix(k + np.uint64(2))) - 1.0), side)
            new = _cell(x, y, z, side, m)
            _around(new, m, cells)
            free = True
            for neighbour in cells:
                j = head[neighbour]
                while j >= 0 and free:
                    if j != i:
                        u = _shortest(x - centres[j, 0], side)
                        v = _shortest(y - centres[j, 1], side)
                        w = _shortest(z - centres[j, 2], side)
                        free = u * u + v * v + w * w >= 4.0
                    j = link[j]
                if not free:
                    break
            if not free:
                continue
            accepted += 1
            old = _cell(centres[i, 0], centres[i, 1], centres[i, 2], side, m)
            if new != old:
                if head[old] == i:
                    head[old] = link[i]
                else:
                    j = head[old]
                    while link[j] != i:
                        j = link[j]
                    link[j] = link[i]
                link[i] = head[new]
                head[new] = i
            centres[i, 0], centres[i, 1], centres[i, 2] = x, y, z
        if sweep % 10 == 9:
            if 2 * sweep < sweeps:  # a third of the moves taken is about best for hard spheres
                reach = min(reach * (1.1 if accepted > 10 * n // 3 else 0.9), 0.5 * side)
            accepted = 0


def closest(centres: np.ndarray, side: float) -> float:
    """Return the least distance of two centres, images included, if it is below 2, and infinity if not [R]."""
    n, m = len(centres), _grid(side, len(centres))
    lists = np.empty(m**3, np.int64), np.empty(n, np.int64), np.empty(27, np.int64)
    return float(_push(centres, side, m, 2.0, *lists, np.empty((n, 3))))


def _grid(side: float, spheres: int) -> int:
    """Return into how many cells an edge is divided to find neighbours: not narrower than 2, nor mostly empty."""
    return int(min(side / 2.0, 2.0 * math.ceil(spheres ** (1.0 / 3.0))))


def pack(fraction: float, spheres: int = 2000, seed: int = 0, cache: bool = True) -> Packing:
    """Return a random packing of hard spheres in a periodic cube; the same arguments give the same bytes.

    Parameters
    ----------
    fraction : float
        Share of the volume that lies in spheres, in (0, MAX] [1].
    spheres : int
        Spheres in the cube, MIN_SPHERES or more; what is measured of a packing of n spheres wanders by about n^-1/2.
    seed : int
        Seed, in [0, 2^64).
    cache : bool
        Whether to keep the packing in the user's cache directory, and to take it from there: the folder that
        ``$TSDF_CACHE`` names, else ``tsdf`` in ``$XDG_CACHE_HOME`` or ``~/.cache``.

    Raises
    ------
    UsageError
        For arguments out of range.
    TSDFError
        If no start relaxes to a packing; only at fractions near MAX with few spheres.
    """
    if not (0.0 < fraction <= MAX):
        raise UsageError(
            f"the packing fraction must be above 0 and at most {MAX}, near where random spheres jam, got {fraction}"
        )
    if not (spheres >= MIN_SPHERES and spheres % 1 == 0):
        raise UsageError(f"a packing needs a whole number of spheres, {MIN_SPHERES} or more, got {spheres}")
    if not (0 <= seed < 2**64 and seed % 1 == 0):
        raise UsageError(f"the seed of a packing must be a whole number in [0, 2^64), got {seed}")
    fraction, spheres, seed = float(fraction), int(spheres), int(seed)
    side = (spheres * 4.0 / 3.0 * math.pi / fraction) ** (1.0 / 3.0)
    name = f"packing-{_VERSION}-{fraction!r}-{spheres}-{seed}"
    centres = _cached(name, spheres, side) if cache else None
    if centres is None:
        centres = _made(fraction, spheres, seed, side)
        if cache:
            _keep(name, centres)
    return Packing(centres, side, spheres * 4.0 / 3.0 * math.pi / side**3, seed)


def _made(fraction: float, spheres: int, seed: int, side: float) -> np.ndarray:
    for attempt in range(_ATTEMPTS):
        key = np.uint64(key_of(np.uint64(seed), attempt, spheres))
        if fraction <= _RANDOM:
            centres = _quenched(fraction, spheres, key, side)
        else:
            centres = _compressed(fraction, spheres, key, side)
        if centres is not None:
            return centres
    raise TSDFError(
        f"{spheres} spheres could not be packed to a fraction of {fraction}; "
        "take more spheres, another seed or a smaller fraction"
    )


def _quenched(fraction: float, spheres: int, key: np.uint64, side: float, sweeps: int = _SWEEPS) -> np.ndarray | None:
    """Return the centres of spheres pushed apart from random points and moved, None if they jammed."""
    diameter = 2.0 * max(min(1.2, _RELAXED / fraction) ** (1.0 / 3.0), 1.0 + _SLACK)
    enough = max(2.0, diameter * (1.0 - _SLACK))
    centres = side * np.random.Generator(np.random.PCG64(int(key))).random((spheres, 3))
    if not _relax(centres, side, _grid(2.0 * side / diameter, spheres), diameter, enough, _STEPS):
        return None
    _stir(centres, side, _grid(side, spheres), key, sweeps)
    return centres


def _compressed(fraction: float, spheres: int, key: np.uint64, side: float) -> np.ndarray | None:
    """Return the centres of a fluid compressed in small steps, pushed apart and moved at each, None if it jammed."""
    diameter = 2.0 * (1.0 + _CLEAR)
    steps = math.ceil((fraction - _FLUID) / _STEP)
    sides = [side * (fraction / (_FLUID + (fraction - _FLUID) * k / steps)) ** (1.0 / 3.0) for k in range(steps)]
    centres = _quenched(_FLUID, spheres, key, sides[0], _STIRRED)
    for step, (old, new) in enumerate(pairwise([*sides, side])):
        if centres is None:
            return None
        centres *= new / old
        centres[centres >= new] = 0.0
        if not _relax(centres, new, _grid(2.0 * new / diameter, spheres), diameter, 2.0, _STEPS):
            return None
        _stir(centres, new, _grid(new, spheres), np.uint64(key_of(key, step, 1)), _BETWEEN)
    return centres


# ------------------------------------------------------------------------------------------ keeping


def cache_folder() -> Path:
    """Return the folder for what is kept between runs: `pack` says where it is."""
    own = os.environ.get("TSDF_CACHE")
    if own:
        return Path(own)
    base = os.environ.get("XDG_CACHE_HOME", "")
    return Path(base if os.path.isabs(base) else os.path.expanduser("~/.cache")) / "tsdf"


def _cached(name: str, spheres: int, side: float) -> np.ndarray | None:
    """Return the centres that are kept under a name, if they are there and are that packing.

    The name says fraction, number and seed, and stands in the file under one digest with the centres.
    """
    try:
        kept = archive.read(cache_folder() / f"{name}.npz", limit=24 * spheres + 8192)
        centres, label = kept["centres"], str(kept["name"])
    except (OSError, ValueError, KeyError):  # not there or damaged: it is made
        return None
    if label != name or centres.shape != (spheres, 3) or centres.dtype != np.float64:
        return None
    whole = ((centres >= 0.0) & (centres < side)).all() and closest(centres, side) >= CLOSEST
    return centres if whole else None


def _keep(name: str, centres: np.ndarray) -> None:
    try:
        folder = cache_folder()
        folder.mkdir(parents=True, exist_ok=True)
        archive.write(folder / f"{name}.npz", {"centres": centres, "name": np.array(name)})
    except (OSError, TSDFError):  # the packing is made again next time
        pass


# ------------------------------------------------------------------------------------------ lines


class Cells(NamedTuple):
    """A grid over the cube: which spheres reach into each of its m^3 cells. For kernels.

    Cell (x, y, z) is number (x m + y) m + z and lists `entries[first[number] : first[number + 1]]`. An entry is the
    number of the sphere times 64 plus its tile relative to the cell's, (i + 1) 16 + (j + 1) 4 + (k + 1).
    """

    side: float
    m: int
    reach: float  # how far beyond t_min a line is followed [R]
    centres: np.ndarray
    first: np.ndarray
    entries: np.ndarray


def cells_of(packing: Packing, edge: float | None = None) -> Cells:
    """Return the grid that `next_sphere` walks through.

    Parameters
    ----------
    packing : Packing
    edge : float, optional
        About how wide a cell is [R]; where it is not given, what was measured to be fastest.
    """
    side, centres = packing.side, packing.centres
    if edge is None:
        edge = 1.0 / packing.fraction ** (1.0 / 3.0)
    m = max(3, round(side / edge))
    edge, reach = side / m, 1.0 + _PAD
    lowest = np.floor((centres - reach) / edge).astype(np.int64)
    steps = np.arange(int(2.0 * reach / edge) + 2)
    places = lowest[:, :, None] + steps  # (n, axis, step), cells that run on beyond the cube
    gap = np.maximum(places * edge - centres[:, :, None], centres[:, :, None] - (places + 1) * edge).clip(min=0.0) ** 2
    near = gap[:, 0, :, None, None] + gap[:, 1, None, :, None] + gap[:, 2, None, None, :] <= reach * reach
    sphere, *found = np.nonzero(near)
    cell, code = np.zeros(len(sphere), np.int64), sphere
    for axis, step in enumerate(found):
        place = places[sphere, axis, step]
        cell, code = cell * m + place % m, code * 4 + (1 - place // m)
    order = np.argsort(cell, kind="stable")
    first = np.searchsorted(cell[order], np.arange(m**3 + 1))
    far = max(1e4, 100.0 * 4.0 / 3.0 / packing.fraction)
    return Cells(side, m, far, centres, first.astype(np.int32), code[order].astype(np.int32))


@njit(**KERNEL)
def _first_border(p, d, place, edge):
    """Return the distance to the first border of cells along an axis, and between borders; infinity if parallel."""
    if abs(d) < 1e-12:  # within the reach of a line it does not come out of its cells' padding
        return math.inf, math.inf
    per_d = 1.0 / d
    return ((place + (1 if d > 0.0 else 0)) * edge - p) * per_d, edge * abs(per_d)


@njit(**KERNEL)
def next_sphere(cells, origin, direction, t_min, t_max):
    """Return the first sphere that a ray enters beyond t_min: distance, tile (three integers) and number.

    Parameters
    ----------
    cells : Cells
    origin : (3,) triple of float
        Anywhere [R]; far from the cube only the rounding of the coordinates themselves is lost.
    direction : (3,) triple of float
        Unit vector.
    t_min, t_max : float
        Entries at distances t with t_min < t <= t_max count [R]. A sphere that contains the origin has no entry.
        The ray is followed for `cells.reach` at most, 1e4 or a hundred mean gaps, for there are rays along the axes
        that never meet a sphere.

    Returns
    -------
    t, i, j, k, sphere
        The centre of the sphere met is ``centres[sphere] + side * (i, j, k)``. infinity, 0, 0, 0, -1 if there is none.
        The t of a sphere is the same to the last bit in every call for the same ray, so the t of one call as the t_min
        of the next walks all spheres along the ray.
    """
    side, m, centres, first, entries = cells.side, cells.m, cells.centres, cells.first, cells.entries
    edge, per_edge, per_side = side / m, m / side, 1.0 / side
    dx, dy, dz = direction
    hx, hy, hz = math.floor(origin[0] * per_side), math.floor(origin[1] * per_side), math.floor(origin[2] * per_side)
    px, py, pz = origin[0] - hx * side, origin[1] - hy * side, origin[2] - hz * side
    start = max(t_min, 0.0)
    end = min(t_max, start + cells.reach)
    x, y, z = px + start * dx, py + start * dy, pz + start * dz
    i, j, k = math.floor(x * per_side), math.floor(y * per_side), math.floor(z * per_side)
    cx = min(max(int((x - i * side) * per_edge), 0), m - 1)
    cy = min(max(int((y - j * side) * per_edge), 0), m - 1)
    cz = min(max(int((z - k * side) * per_edge), 0), m - 1)
    tx, ex = _first_border(px, dx, i * m + cx, edge)
    ty, ey = _first_border(py, dy, j * m + cy, edge)
    tz, ez = _first_border(pz, dz, k * m + cz, edge)
    best, ci, cj, ck, sphere = math.inf, 0, 0, 0, -1
    t = start
    for _ in range(
        int(3.0 * cells.reach / edge) + 4
    ):  # no ray crosses more borders, if its direction is of unit length
        if not (t <= end):
            break
        cell = (cx * m + cy) * m + cz
        for entry in range(first[cell], first[cell + 1]):
            code = entries[entry]
            s = code >> 6
            ti, tj, tk = i + ((code >> 4) & 3) - 1, j + ((code >> 2) & 3) - 1, k + (code & 3) - 1
            # from the centre in its own tile, so that t does not depend on the cell in which the sphere is found
            rx = centres[s, 0] + ti * side - px
            ry = centres[s, 1] + tj * side - py
            rz = centres[s, 2] + tk * side - pz
            along = rx * dx + ry * dy + rz * dz
            ox, oy, oz = rx - along * dx, ry - along * dy, rz - along * dz  # Haines et al. 2019: no cancellation
            left = 1.0 - (ox * ox + oy * oy + oz * oz)
            if left > 0.0:
                entered = along - math.sqrt(left)
                if t_min < entered < best and 0.0 <= entered <= t_max:
                    best, ci, cj, ck, sphere = entered, ti, tj, tk, s
        t = min(tx, ty, tz)
        if best <= t:  # what is entered in a later cell is farther
            break
        if tx <= t:
            tx += ex
            cx += 1 if dx > 0.0 else -1
            if cx == m:
                cx, i = 0, i + 1
            elif cx < 0:
                cx, i = m - 1, i - 1
        elif ty <= t:
            ty += ey
            cy += 1 if dy > 0.0 else -1
            if cy == m:
                cy, j = 0, j + 1
            elif cy < 0:
                cy, j = m - 1, j - 1
        else:
            tz += ez
            cz += 1 if dz > 0.0 else -1
            if cz == m:
                cz, k = 0, k + 1
            elif cz < 0:
                cz, k = m - 1, k - 1
    if sphere < 0:
        return math.inf, 0, 0, 0, -1
    return best, hx + ci, hy + cj, hz + ck, sphere
