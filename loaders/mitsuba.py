"""Tables in Mitsuba 3: a stock medium (`medium`), and teleportation path tracing: plugins ``granular`` and ``tpt``.

Importing this module registers the plugins with every variant that is set, before or after. A shape with BSDF ``null``
and interior medium ``granular`` holds grains; the integrator ``tpt`` follows Algorithm 1 and the boundary rules of Meng
et al. 2015 (supplemental), as `tsdf.walk.transport` does, which is the arbiter. Deep inside a medium, farther from
every surface than the next step reaches by a grid of distances, it needs no ray. Constant light is never drawn, so a
furnace reads exactly 1. Lengths are in scene units. What light does in a grain is `tsdf.data.sampler`.
"""

# ruff: noqa: SIM102 - of nested conditions the outer is decided when a kernel is made, the inner in it
import importlib
import math
import os
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from tsdf.data import format as tsdf_format
from tsdf.data.table import Table
from tsdf.errors import SceneError, TSDFError, UsageError
from tsdf.scene.medium import Component, free_path, volume_parameters

OLDEST = (3, 6)  # version of Mitsuba: dr.syntax, Properties that hold objects
INSTALL = 'pip install "tsdf-toolkit[mitsuba]"'

try:
    # Untyped: what names stand for changes with the variant
    dr: Any = importlib.import_module("drjit")
    mi: Any = importlib.import_module("mitsuba")
except ImportError as _error:
    raise UsageError(f"Mitsuba 3 cannot be imported ({_error}): {INSTALL}") from None
if tuple(int(part) for part in mi.__version__.split(".")[:2]) < OLDEST:
    raise UsageError(f"Mitsuba {mi.__version__} is too old, 3.6 is needed: {INSTALL} --upgrade")

AXES = ("p_r", "p_z", "p_phi", "p_l")
R, Z, PHI, LENGTH = range(len(AXES))
MAX_NODES = 4097  # of a tabulated phase function
GUIDE = 1024  # parts of the cosines from -1 to 1
VOXELS = 112  # along the longest side of a medium, at most
FINE = 0.25  # side of a voxel over the bounding radius that is fine enough
PROBES = 16384, 256  # rays that look for gaps in boundaries, in vectorised and in scalar variants
GAPS = 0.002  # share of them that may slip through an edge
DIM = 0.25  # paths dimmer than this may end
FAINT = 0.02  # shadows fainter than this may end
SLACK = 2e-5  # times 1 + the largest coordinate: nearer than that is at a surface; Mitsuba starts rays 9e-5 off it


class Grain(NamedTuple):
    """One kind of grain of a mixture."""

    table: Table | str | os.PathLike[str]
    fraction: float = 1.0  # share of the number of grains [1]
    absorption: float | Sequence[float] = 0.0  # sigma_a of its material, one number or RGB [1/scene unit]


Grains = Table | str | os.PathLike[str] | Sequence[Grain]


# ------------------------------------------------------------------------------------------------ tables

_given: dict[str, Table] = {}  # tables that scenes name by a handle instead of a path


def _table(table: Table | str | os.PathLike[str]) -> Table:
    if isinstance(table, Table):
        return table
    name = os.fspath(table)
    if name in _given:
        return _given[name]
    if name.startswith("table:"):
        raise UsageError(f"{name} stands for a table of another process: give the file instead")
    return tsdf_format.read(name)


def _colour(value: Any) -> tuple[float, float, float]:
    try:
        numbers = [float(value)] * 3 if np.ndim(value) == 0 else [float(v) for v in value]
    except (TypeError, ValueError):
        numbers = []
    if len(numbers) != 3 or not all(0.0 <= v < math.inf for v in numbers):
        raise UsageError(f"absorption must be one finite number >= 0 [1/scene unit] or three for RGB, not {value!r}")
    return numbers[0], numbers[1], numbers[2]


class Bulk:
    """Grains in bulk: what the medium and the integrator need to know of them.

    Parameters
    ----------
    grains : Table, path or sequence of Grain
    packing_fraction : float
        Share of the volume in bounding spheres [1], in (0, 0.74].
    grain_radius : float
        Bounding radius R [scene unit].
    absorption : float or (3,) float
        Absorption coefficient of the material [1/scene unit]; of a mixture, each grain has its own.

    Raises
    ------
    UsageError
        For a value out of range.
    FormatError
        For a file that is not a table, or of a newer version.
    """

    def __init__(self, grains: Grains, packing_fraction: float, grain_radius: float, absorption: Any = 0.0) -> None:
        if isinstance(grains, Table | str | os.PathLike):
            grains = [Grain(grains, 1.0, absorption)]
        elif np.any(np.asarray(absorption) != 0.0):
            raise UsageError("the grains of a mixture have their own absorption: Grain(table, fraction, absorption)")
        grains = [Grain(*g) for g in grains]
        self.components = [Component(_table(g.table), float(g.fraction), float(grain_radius)) for g in grains]
        self.sigma_a = np.array([_colour(g.absorption) for g in grains])  # (components, 3)
        self.packing_fraction, self.radius = float(packing_fraction), float(grain_radius)
        self.path = free_path(self.components, self.packing_fraction)

    def phase(self) -> np.ndarray:
        """Return the phase function as values at uniformly spaced cosines, (n,) float64 from -1 to 1, mean density 1.

        Each cell is shared out over the nodes by the weights of linear interpolation, an atom over the nearest node;
        that keeps the mean cosine up to the atoms, and a tilt by 1 + k (cosine - mean) makes up for the rest and
        for what the columns themselves do not resolve. With coloured absorption it is the mean of the channels.
        """
        finest = min(np.diff(c.table.cos_theta_edges)[1:-1].min() for c in self.components)
        nodes = min(MAX_NODES, 1 + (1 << max(6, math.ceil(math.log2(2.0 / finest)))))
        x = np.linspace(-1.0, 1.0, nodes)
        spacing = 2.0 / (nodes - 1)
        mass, mean, weight = np.zeros(nodes), 0.0, 0.0
        for c, chosen, sigma in zip(self.components, self.path.choice, self.sigma_a, strict=True):
            for s in sigma[:1] if np.all(sigma == sigma[0]) else sigma:
                share = chosen * c.table.albedo(s * c.radius) * (3.0 if np.all(sigma == sigma[0]) else 1.0)
                if share > 0.0:
                    mass += share * _shared_out(c.table.cos_theta_edges, c.table.deflection_masses(s * c.radius), x)
                    mean += share * c.table.mean_cosine(s * c.radius)
                    weight += share
        if not weight > 0.0:
            return np.ones(nodes)
        values = mass / mass.sum() * 2.0 / spacing
        values[[0, -1]] *= 2.0
        integral = np.full(nodes, spacing)  # of each node's hat, and of the hat times the cosine and its square
        integral[[0, -1]] *= 0.5
        first = integral * x
        first[[0, -1]] += np.array([1.0, -1.0]) * spacing**2 / 6.0
        m1 = values @ first / (values @ integral)
        tilt = 0.0
        for _ in range(4):  # Newton's method, on a nearly linear function
            tilted = values * (1.0 + tilt * (x - m1))
            tilt += (mean / weight - tilted @ first / (tilted @ integral)) / max(
                values @ (first * (x - m1)) / 2.0, 1e-9
            )
            if not abs(tilt) * 2.0 < 1.0:
                raise UsageError(
                    f"{self.components[0].table!r}: the columns contradict the mean cosine; build it again"
                )
        tilted = values * (1.0 + tilt * (x - m1))
        return tilted / (tilted @ integral) * 2.0

    def stock(self) -> dict[str, Any]:
        """Return the dict of the homogeneous medium (see `medium`)."""
        channels = [volume_parameters(self.components, self.packing_fraction, list(s)) for s in self.sigma_a.T]
        sigma_t, albedo = ([getattr(c, name) for c in channels] for name in ("sigma_t", "albedo"))

        def spectrum(values: list[float]) -> Any:
            return values[0] if values[0] == values[1] == values[2] else {"type": "rgb", "value": values}

        values = ",".join(f"{v:.9g}" for v in self.phase())
        # Colours are reflectances to Mitsuba, at most 1 (its issue 1620)
        scale = 1.0 if len(set(sigma_t)) == 1 else max(sigma_t)
        return {
            "type": "homogeneous",
            "albedo": spectrum([min(a, 1.0) for a in albedo]),
            "sigma_t": spectrum([s / scale for s in sigma_t]),
            "scale": scale,
            "phase": {"type": "tabphase", "values": values},
        }


def _shared_out(edges: np.ndarray, masses: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return the masses of cells (uniform in each) shared out over nodes x by the weights of linear interpolation."""
    inner = masses[1:-1] / np.diff(edges)[1:-1]
    points = np.union1d(edges, x)  # between neighbours the density and the weights are linear
    low, high = points[:-1], points[1:]
    middle = 0.5 * (low + high)
    mass = inner[np.clip(np.searchsorted(edges[1:-1], middle) - 1, 0, len(inner) - 1)] * (high - low)
    left = np.clip(np.searchsorted(x, middle) - 1, 0, len(x) - 2)
    right = (middle - x[left]) / (x[left + 1] - x[left])
    out = np.bincount(left, mass * (1.0 - right), len(x)) + np.bincount(left + 1, mass * right, len(x))
    out[0] += masses[0]
    out[-1] += masses[-1]
    return out


def medium(
    table: Grains, packing_fraction: float, grain_radius: float, absorption: float | Sequence[float] = 0.0
) -> dict[str, Any]:
    """Return the stock ``homogeneous`` medium with ``tabphase`` that stands for grains, for the stock ``volpath``.

    Parameters
    ----------
    table : Table, path or sequence of Grain
    packing_fraction : float
        Share of the volume in bounding spheres [1], in (0, 0.74].
    grain_radius : float
        Bounding radius R [scene unit].
    absorption : float or (3,) float
        Absorption coefficient sigma_a of the material [1/scene unit], one number or linear RGB.

    Returns
    -------
    dict
        For ``interior`` or ``exterior`` of a shape in ``mi.load_dict``; its sigma_t times scale, albedo and mean cosine
        are those of `tsdf.scene.medium.volume_parameters`. ``tabphase`` is grey: coloured absorption colours sigma_t
        and albedo only.

    Raises
    ------
    UsageError, FormatError
        As `Bulk`.
    """
    return Bulk(table, packing_fraction, grain_radius, absorption).stock()


def granular(
    table: Grains, packing_fraction: float, grain_radius: float, absorption: float | Sequence[float] = 0.0
) -> dict[str, Any]:
    """Return the dict of the medium ``granular`` for the integrator ``tpt``; parameters and errors as `medium`.

    Tables in memory are named by a handle that is good for this process.
    """
    Bulk(table, packing_fraction, grain_radius, absorption)
    grains = [Grain(table, 1.0, absorption)] if isinstance(table, Table | str | os.PathLike) else table

    def name(of: Table | str | os.PathLike[str]) -> str:
        if not isinstance(of, Table):
            return os.fspath(of)
        _given[f"table:{id(of):x}"] = of
        return f"table:{id(of):x}"

    return {
        "type": "granular",
        "file": ";".join(name(g.table) for g in grains),
        "fraction": ";".join(repr(float(g.fraction)) for g in grains),
        "absorption": ";".join(" ".join(map(repr, _colour(g.absorption))) for g in grains),
        "packing_fraction": float(packing_fraction),
        "grain_radius": float(grain_radius),
    }


def _bulk_of(props: Any) -> Bulk:
    """Return what the properties of a ``granular`` medium say."""
    where = f"medium granular {props.id()!r}"
    known = {"file", "fraction", "absorption", "packing_fraction", "grain_radius"}
    for key in list(props.keys()):
        if key not in known:
            raise UsageError(f"{where}: unknown parameter {key!r}; it knows {', '.join(sorted(known))}")
    for key in ("file", "packing_fraction", "grain_radius"):
        if key not in props:
            raise UsageError(f"{where}: {key} is missing")
    files = [name.strip() for name in props["file"].split(";")]

    def several(key: str, default: str) -> list[Any]:
        value = props.get(key, default)
        if not isinstance(value, str):
            return [value if np.ndim(value) == 0 else list(value)] * len(files)
        try:
            numbers = [[float(v) for v in part.replace(",", " ").split()] for part in value.split(";")]
        except ValueError:
            raise UsageError(f"{where}: {key} must be numbers, not {value!r}") from None
        numbers = numbers * len(files) if len(numbers) == 1 else numbers
        if len(numbers) != len(files) or not all(numbers):
            raise UsageError(f"{where}: {key} is for {len(numbers)} tables, file names {len(files)}")
        return [v[0] if len(v) == 1 else v for v in numbers]

    grains = [Grain(*g) for g in zip(files, several("fraction", "1"), several("absorption", "0"), strict=True)]
    try:
        return Bulk(grains, props["packing_fraction"], props["grain_radius"])
    except TSDFError as error:
        raise type(error)(f"{where}: {error}") if not hasattr(error, "code") else error from None


# ------------------------------------------------------------------------------------- arrays for Dr.Jit


def _array(kind: str, values: Any) -> Any:
    """Return a Dr.Jit array of the variant ("Float", "UInt32", "Int32"); a dynamic scalar one where it has none."""
    dtype = {"Float": np.float32, "UInt32": np.uint32, "Int32": np.int32}[kind]
    values = np.ascontiguousarray(np.asarray(values, dtype=dtype).ravel())
    if not _vectorised():
        return values.tolist()
    return getattr(mi, kind)(values)


def _vectorised() -> bool:
    return bool(dr.is_jit_v(mi.Float))


def _not(mask: Any) -> Any:
    """Return the opposite of a mask of any variant: ~ of a Python bool is a number."""
    return mask ^ True


def _at(kind: Any, array: Any, index: Any, active: Any = True) -> Any:
    """Return the elements of an array, or its only one."""
    if not _vectorised():
        return array[index if 0 <= index < len(array) else 0]
    if dr.width(array) == 1:
        return kind(array)
    return dr.gather(kind, array, mi.UInt32(index), active)


def _pair(array: Any, index: Any, active: Any = True) -> tuple[Any, Any]:
    """Return the elements 2 index and 2 index + 1."""
    if not _vectorised():
        return array[2 * index], array[2 * index + 1]
    both = dr.gather(mi.Point2f if dr.is_float_v(array) else mi.Point2u, array, mi.UInt32(index), active)
    return both.x, both.y


def _alias(masses: np.ndarray, bits: int) -> np.ndarray:
    """Return the alias table (Walker 1977, by Vose 1991) of each row as words: a share above, an alias below `bits`."""
    count = masses.shape[1]
    out = np.empty(masses.shape, dtype=np.uint32)
    one = 1 << (32 - bits)
    for row, mass in enumerate(masses):
        total = mass.sum()
        share = (mass / total * count).tolist() if total > 0.0 else [1.0] * count
        other = list(range(count))
        small = [i for i, s in enumerate(share) if s < 1.0]
        large = [i for i, s in enumerate(share) if s >= 1.0]
        while small and large:
            i, j = small.pop(), large[-1]
            other[i] = j
            share[j] -= 1.0 - share[i]
            if share[j] < 1.0:
                small.append(large.pop())
        for i in (*small, *large):  # what is left differs from 1 by rounding errors
            share[i] = 1.0
        kept = np.minimum(np.rint(np.array(share) * one), one - 1).astype(np.uint32)
        # A share of exactly 1 has no word: its alias is itself
        out[row] = (kept << np.uint32(bits)) | np.where(np.array(share) >= 1.0, np.arange(count), other).astype(
            np.uint32
        )
    return out


class Arrays:
    """Tables and media of a scene as arrays of the variant.

    The draws are by alias tables: one number chooses the cell and the place in it, without a search.
    """

    def __init__(self, bulks: Sequence[Bulk]) -> None:
        components = [c for b in bulks for c in b.components]
        self.first_component = _array("UInt32", np.cumsum([0] + [len(b.components) for b in bulks])[:-1])
        self.mixed = max(len(b.components) for b in bulks) > 1
        self.kinds = _array("UInt32", [len(b.components) for b in bulks])
        self.choice = _array("Float", np.concatenate([np.cumsum(b.path.choice) for b in bulks]))
        self.free = _array("Float", [b.path.lambda_beta for b in bulks])
        self.radius = _array("Float", [c.radius for c in components])
        sigma = np.concatenate([b.sigma_a for b in bulks])
        self.absorbs = bool(sigma.any())
        self.sigma = [_array("Float", sigma[:, k]) for k in range(3)]

        widths = [c.table.pixels.shape[1] for c in components]
        self.most = max(widths)
        self.column_bits = max(1, (self.most - 1).bit_length())
        p_theta = np.zeros((len(components), self.most))
        columns = np.zeros((sum(widths), 2))
        density = np.zeros(sum(widths))
        edges = np.full((len(components), self.most + 1), 1.0)
        first = np.concatenate(([0], np.cumsum(widths)))
        for i, c in enumerate(components):
            p_theta[i, : widths[i]] = c.table.p_theta / c.table.p_theta.sum()
            e = c.table.cos_theta_edges
            edges[i, : widths[i] + 1] = e
            width = np.diff(e)
            columns[first[i] : first[i + 1]] = np.stack((e[:-1], width), axis=1)
            density[first[i] + 1 : first[i + 1] - 1] = p_theta[i, 1 : widths[i] - 1] / width[1:-1] / (2.0 * math.pi)
        self.first_column = _array("UInt32", first[:-1])
        guide = np.zeros((len(components), GUIDE + 1), dtype=np.int64)
        for i, width in enumerate(widths):
            cosines = np.linspace(-1.0, 1.0, GUIDE + 1)
            guide[i] = np.clip(np.searchsorted(edges[i, : width + 1], cosines, side="right") - 1, 1, width - 2)
        self.guide = _array("UInt32", np.stack((guide[:, :-1], guide[:, 1:]), axis=-1))
        self.halvings = int(np.diff(guide, axis=1).max()).bit_length()
        self.p_theta = _array("UInt32", _alias(p_theta, self.column_bits))
        self.columns = _array("Float", columns)
        self.density = _array("Float", density)
        self.edges = _array("Float", edges)

        blocks = [[c.table.block(name).astype(np.float64) for c in components] for name in AXES]
        spans = [[np.flatnonzero(b.any(axis=1))[[0, -1]] + (0, 1) for b in axis] for axis in blocks]
        self.cells = [int(max(high - low for low, high in axis)) for axis in spans]
        self.bits = max(1, (max(self.cells) - 1).bit_length())
        self.words, self.bounds, reach = [], [], np.zeros(len(components))
        for axis, name in enumerate(AXES):
            masses = np.zeros((sum(widths), self.cells[axis]))
            bounds = np.zeros((len(components), self.cells[axis], 2))
            for i, c in enumerate(components):
                low, high = spans[axis][i]
                e = c.table.edges(name)[low : high + 1]
                masses[first[i] : first[i + 1], : high - low] = blocks[axis][i][low:high].T
                bounds[i, : high - low] = np.stack((e[:-1], np.diff(e)), axis=1)
                if axis in (R, Z):
                    reach[i] = math.hypot(reach[i], np.abs(e).max() * c.radius)
            self.words.append(_array("UInt32", _alias(masses, self.bits)))
            self.bounds.append(_array("Float", bounds))
        ends = np.cumsum([len(b.components) for b in bulks])
        self.reach = _array("Float", [reach[e - len(b.components) : e].max() for e, b in zip(ends, bulks, strict=True)])

    def component(self, m: Any, u: Any) -> Any:
        """Return the component of the next grain met in medium m."""
        first = _at(mi.UInt32, self.first_component, m)
        if not self.mixed:
            return first
        last = _at(mi.UInt32, self.kinds, m) - 1
        most = max(self.kinds) if not _vectorised() else int(dr.max(self.kinds)[0])
        c = mi.UInt32(0)
        for k in range(most - 1):
            c += dr.select((c == k) & (k < last) & (u >= _at(mi.Float, self.choice, first + dr.minimum(k, last))), 1, 0)
        return first + c

    def share(self, m: Any, bound: Any) -> Any:
        """Return the probability to look for far light at a grain that deep: what gets through after half a jump."""
        return dr.minimum(dr.exp((0.5 * _at(mi.Float, self.reach, m) - bound) / _at(mi.Float, self.free, m)), 1.0)

    def column(self, c: Any, u: Any) -> tuple[Any, Any, Any]:
        """Return the column of a deflection drawn by u, its cosine and its density [1/sr], 0 for an atom."""
        k, v = _cell(self.p_theta, c * self.most, self.most, self.column_bits, u)
        k += _at(mi.UInt32, self.first_column, c)
        low, width = _pair(self.columns, k)
        return k, dr.clip(dr.fma(v, width, low), -1.0, 1.0), _at(mi.Float, self.density, k)

    def column_of(self, c: Any, cosine: Any) -> Any:
        """Return the column, not an atom, that holds a cosine, by bisection between two guides."""
        part = dr.minimum(mi.UInt32((cosine + 1.0) * (0.5 * GUIDE)), GUIDE - 1)
        first, last = _pair(self.guide, c * GUIDE + part)
        for _ in range(self.halvings):
            middle = (first + last + 1) >> 1
            above = cosine >= _at(mi.Float, self.edges, c * (self.most + 1) + middle)
            first, last = dr.select(above, middle, first), dr.select(above, last, dr.maximum(middle, first + 1) - 1)
        return first + _at(mi.UInt32, self.first_column, c)

    def draw(self, axis: int, c: Any, column: Any, u: Any) -> Any:
        """Return the value on an axis that u stands for given the column."""
        k, v = _cell(self.words[axis], column * self.cells[axis], self.cells[axis], self.bits, u)
        low, width = _pair(self.bounds[axis], c * self.cells[axis] + k)
        return dr.fma(v, width, low)

    def kept(self, c: Any, length: Any) -> Any:
        """Return the colour that a length [scene unit] of a component's material leaves of white light."""
        return mi.Color3f(*(dr.exp(-_at(mi.Float, s, c) * length) for s in self.sigma))


def _cell(words: Any, row: Any, count: int, bits: int, u: Any) -> tuple[Any, Any]:
    """Return the cell of an alias table's row that u in [0, 1) chooses, and where in it, in [0, 1)."""
    x = u * count
    k = dr.minimum(mi.UInt32(x), count - 1)
    rest = x - mi.Float(k)
    word = _at(mi.UInt32, words, row + k)
    alias = word & ((1 << bits) - 1)
    share = mi.Float(word >> bits) * (0.5 ** (32 - bits))
    own = (rest < share) | (alias == k)
    low, width = dr.select(own, 0.0, share), dr.select(own, dr.select(alias == k, 1.0, share), 1.0 - share)
    return dr.select(own, k, alias), (rest - low) / dr.maximum(width, 1e-9)


# ------------------------------------------------------------------------------------------------ scenes


class Distances:
    """For each medium a grid of lower bounds of the distance from a voxel's centre to the nearest surface [voxel]."""

    def __init__(self, shapes: Sequence[Any], boundaries: Sequence[Sequence[int]], radii: Sequence[float]) -> None:
        low, inverse, size, first, bounds = [], [], [], [0], []
        for own, radius in zip(boundaries, radii, strict=True):
            boxes = [shapes[i].bbox() for i in own]
            lowest = np.min([np.array(b.min) for b in boxes], axis=0).ravel()
            extent = np.max([np.array(b.max) for b in boxes], axis=0).ravel() - lowest
            step = max(float(extent.max()) / VOXELS, min(FINE * radius, float(extent.max()) / 16.0))
            lowest = lowest - step
            count = np.maximum(np.ceil(extent / step).astype(int) + 2, 3)
            grid = _distances(shapes, lowest, step, count)
            low.append(lowest)
            inverse.append(1.0 / step)
            size.append(count)
            first.append(first[-1] + grid.size)
            bounds.append(grid.ravel())
        self.low = [_array("Float", np.array(low)[:, k]) for k in range(3)]
        self.size = [_array("UInt32", np.array(size)[:, k]) for k in range(3)]
        self.inverse = _array("Float", inverse)
        self.first = _array("UInt32", first[:-1])
        self.bounds = _array("Float", np.concatenate(bounds))

    def __call__(self, m: Any, p: Any) -> Any:
        """Return a lower bound of the distance from points in media m to any surface, -1 outside the medium's box."""
        inverse = _at(mi.Float, self.inverse, m)
        x = [(p[k] - _at(mi.Float, self.low[k], m)) * inverse for k in range(3)]
        size = [_at(mi.UInt32, self.size[k], m) for k in range(3)]
        inside = True
        for k in range(3):
            inside = inside & (x[k] >= 0.0) & (x[k] < mi.Float(size[k]))
        i, j, k = (mi.UInt32(dr.select(inside, v, 0.0)) for v in x)
        at = _at(mi.UInt32, self.first, m) + (i * size[1] + j) * size[2] + k
        a, b, c = (v - mi.Float(n) - 0.5 for v, n in zip(x, (i, j, k), strict=True))
        from_centre = dr.sqrt(a * a + b * b + c * c)
        bound = (_at(mi.Float, self.bounds, at, inside) - from_centre) / inverse
        return dr.select(inside, dr.maximum(bound, 0.0), -1.0)


def _distances(shapes: Sequence[Any], low: np.ndarray, step: float, count: np.ndarray) -> np.ndarray:
    from scipy.ndimage import distance_transform_edt

    free = np.ones(count, dtype=bool)
    for shape in shapes:
        box_low, box_high = (np.array(corner, dtype=float).ravel() for corner in (shape.bbox().min, shape.bbox().max))
        kind = shape.class_name()
        if shape.is_mesh() or kind == "Rectangle":
            for boxes_low, boxes_high in _small_boxes(_triangles(shape), low, step, count):
                for corner in range(8):
                    pick = np.array([(corner >> k) & 1 for k in range(3)], dtype=bool)
                    cell = np.floor((np.where(pick, boxes_high, boxes_low) - low) / step).astype(int)
                    cell = cell[((cell >= 0) & (cell < count)).all(axis=1)]
                    free[tuple(cell.T)] = False
        elif kind == "Sphere":
            centre, radius = 0.5 * (box_low + box_high), 0.5 * float((box_high - box_low).max())
            at = np.meshgrid(
                *(low[k] + step * (np.arange(count[k]) + 0.5) - centre[k] for k in range(3)), indexing="ij"
            )
            free[np.abs(np.sqrt(sum(a * a for a in at)) - radius) <= step] = False
        else:  # all of its box
            begin = np.clip(np.floor((box_low - low) / step), 0, count).astype(int)
            end = np.clip(np.floor((box_high - low) / step) + 1, 0, count).astype(int)
            free[tuple(slice(b, e) for b, e in zip(begin, end, strict=True))] = False
    if free.all():
        return np.full(count, -2.0)
    # A surface is half a diagonal from the centre of its voxel, at most
    grid: np.ndarray = distance_transform_edt(free) - 0.501 * math.sqrt(3.0)
    return grid


def _triangles(shape: Any) -> np.ndarray:
    """Return the corners of the triangles of a mesh or a rectangle, (n, 3, 3)."""
    if shape.class_name() == "Rectangle":
        corners = [
            np.array(shape.eval_parameterization(mi.Point2f(u, v)).p).ravel()
            for u, v in ((0, 0), (1, 0), (1, 1), (0, 1))
        ]
        return np.array([[corners[0], corners[1], corners[2]], [corners[0], corners[2], corners[3]]], dtype=float)
    parameters = mi.traverse(shape)
    points = np.array(parameters["vertex_positions"], dtype=float).reshape(-1, 3)
    return points[np.array(parameters["faces"]).reshape(-1, 3)]


def _small_boxes(
    triangles: np.ndarray, low: np.ndarray, step: float, count: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield boxes no larger than a voxel that cover what triangles have in the grid."""
    high = low + step * count
    while len(triangles):
        begin, end = triangles.min(axis=1), triangles.max(axis=1)
        near = ((end >= low) & (begin <= high)).all(axis=1)
        triangles, begin, end = triangles[near], begin[near], end[near]
        large = ((end - begin) > step).any(axis=1)
        yield begin[~large], end[~large]
        a, b, c = triangles[large].transpose(1, 0, 2)
        ab, bc, ca = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)
        triangles = np.concatenate([np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])


def _state(scene: Any) -> list[Any]:
    """Return what tells whether a scene has been changed."""
    state: list[Any] = [scene, len(scene.emitters())]
    for shape in scene.shapes():
        box = shape.bbox()
        state += [tuple(np.array(box.min).ravel()), tuple(np.array(box.max).ravel())]
        if shape.is_mesh() and _vectorised() and shape.class_name() != "Rectangle":
            state.append(shape.vertex_positions_buffer().index)
    return state


class Prepared:
    """What the integrator knows of a scene before it follows light."""

    def __init__(self, scene: Any) -> None:
        self.state = _state(scene)
        shapes: list[Any] = list(scene.shapes())
        media: list[Any] = []
        boundaries: list[list[int]] = []
        for i, shape in enumerate(shapes):
            inside = {id(m): m for m in (shape.interior_medium(), shape.exterior_medium()) if m is not None}
            for found in inside.values():
                if not hasattr(found, "bulk"):
                    raise SceneError(
                        f"shape {shape.id()!r}: the integrator tpt knows only media of type granular, not "
                        f"{found.class_name()}; render with volpath instead"
                    )
                if found not in media:
                    media.append(found)
                    boundaries.append([])
                boundaries[media.index(found)].append(i)
        self.media = media
        self.index: Any = None
        self.arrays: Any = None
        if media:
            self.arrays = Arrays([m.bulk for m in media])
            self.distance = Distances(shapes, boundaries, [m.bulk.radius for m in media])
            if _vectorised():
                rows = [int(dr.reinterpret_array(mi.UInt32, mi.MediumPtr(m))[0]) for m in media]
                index = np.full(max(rows) + 1, -1)
                index[rows] = np.arange(len(media))
                self.index = _array("Int32", index)
        self.shapes = shapes
        inner, outer = (
            [-1 if m is None else media.index(m) for m in sides]
            for sides in ([s.interior_medium() for s in shapes], [s.exterior_medium() for s in shapes])
        )
        self.inner, self.outer = _array("Int32", inner), _array("Int32", outer)
        self.bounds = _array("UInt32", [max(pair) >= 0 for pair in zip(inner, outer, strict=True)])
        self.passes = _array("UInt32", [_passes(s.bsdf()) for s in shapes])
        if _vectorised() and shapes:
            rows = [int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(s))[0]) for s in shapes]
            table = np.zeros(max(rows) + 1)
            table[rows] = np.arange(len(shapes))
            self.rows = _array("UInt32", table)
        box = scene.bbox()
        largest = max(float(np.abs(np.array(c)).max()) for c in (box.min, box.max)) if shapes else 1.0
        self.slack = SLACK * (1.0 + largest)
        self._lights(scene)
        self.dims = bool(media) and self.arrays.absorbs
        if media:
            self._check(scene)

    def _lights(self, scene: Any) -> None:
        all_lights = list(scene.emitters())
        sky = scene.environment()
        self.sky = sky
        self.constant = sky is None or sky.class_name() == "ConstantBackgroundEmitter"
        drawn = [i for i, e in enumerate(all_lights) if e.class_name() != "ConstantBackgroundEmitter"]
        far = [i for i in drawn if mi.has_flag(all_lights[i].flags(), mi.EmitterFlags.Infinite)]
        near = [i for i in drawn if i not in far]
        self.far, self.near = len(far), len(near)
        order = far + near
        if _vectorised():
            self.lights: Any = dr.gather(mi.EmitterPtr, scene.emitters_dr(), _array("UInt32", order)) if order else None
        else:
            self.lights = [all_lights[i] for i in order]
        for i in near:
            if self.media and mi.has_flag(all_lights[i].flags(), mi.EmitterFlags.DeltaPosition):
                raise SceneError(
                    f"emitter {all_lights[i].id()!r} ({all_lights[i].class_name()}) is a point, which no jump of tpt "
                    "can aim at: use a small sphere with an area emitter"
                )

    def number(self, medium: Any) -> Any:
        """Return the number of a medium, -1 for none."""
        if not _vectorised():
            return next((i for i, m in enumerate(self.media) if m is medium), -1)
        if self.index is None or medium is None:
            return mi.Int32(-1)
        there = medium != None  # noqa: E711
        return dr.select(there, dr.gather(mi.Int32, self.index, dr.reinterpret_array(mi.UInt32, medium), there), -1)

    def boundary(self, si: Any) -> Any:
        """Return whether a surface lets everything through, as an index-matched boundary does, and its row."""
        if _vectorised():
            row = _at(mi.UInt32, self.rows, dr.reinterpret_array(mi.UInt32, si.shape))
        else:
            row = next(i for i, s in enumerate(self.shapes) if s is si.shape)
        return _at(mi.UInt32, self.passes, row) == 1, row

    def across(self, row: Any, si: Any, d: Any, m: Any) -> Any:
        """Return the medium on the side of a surface to which d goes, m if it bounds none."""
        inside = dr.dot(si.n, d) < 0.0
        after = dr.select(inside, _at(mi.Int32, self.inner, row), _at(mi.Int32, self.outer, row))
        return dr.select(_at(mi.UInt32, self.bounds, row) == 1, after, m)

    def light_is_far(self, ds: Any) -> Any:
        """Return whether a sample is of a light at infinity."""
        return mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)

    def light(self, k: Any) -> Any:
        """Return the k-th light that is drawn."""
        return dr.gather(mi.EmitterPtr, self.lights, k) if _vectorised() else self.lights[k]

    def _check(self, scene: Any) -> None:
        """Send rays through the whole scene: each must enter a medium before it leaves it, and no other in between."""
        count = PROBES[0] if _vectorised() else PROBES[1]
        rng = np.random.default_rng(1)
        boxes = [s.bbox() for s in scene.shapes() if s.interior_medium() is not None or s.exterior_medium() is not None]
        low = np.min([np.array(b.min).ravel() for b in boxes], axis=0)
        high = np.max([np.array(b.max).ravel() for b in boxes], axis=0)
        way = rng.normal(size=(count, 3))
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        start = low + rng.random((count, 3)) * (high - low) - 2.0 * way * np.linalg.norm(high - low)
        if _vectorised():
            rays = [mi.Ray3f(mi.Point3f(*start.T.astype(np.float32)), mi.Vector3f(*way.T.astype(np.float32)))]
        else:
            rays = [mi.Ray3f(mi.Point3f(*s), mi.Vector3f(*w)) for s, w in zip(start, way, strict=True)]
        gap, overlap = 0, 0
        for ray in rays:
            a, b = self._crossings(scene, ray)
            gap, overlap = gap + a, overlap + b
        if overlap > GAPS * count:
            raise SceneError(
                f"media overlap: {overlap} of {count} rays enter a granular medium inside another; boundaries must not "
                "cross, and a body inside a medium names that as its exterior medium"
            )
        if gap > GAPS * count:
            raise SceneError(
                f"the boundary of a granular medium is open or inside out: {gap} of {count} rays leave it without "
                "having entered; close the mesh, normals outward"
            )

    def _crossings(self, scene: Any, ray: Any) -> tuple[int, int]:
        inside, active = mi.Int32(-1), mi.Bool(True)
        gap, overlap = mi.Bool(False), mi.Bool(False)
        for _ in range(256):
            si = scene.ray_intersect(ray, active)
            active = active & si.is_valid()
            if not dr.any(active):
                break
            crossing = active & si.is_medium_transition() if _vectorised() else active and si.is_medium_transition()
            if _vectorised() or crossing:
                before, after = self.number(si.target_medium(-ray.d)), self.number(si.target_medium(ray.d))
                wrong = crossing & (before != inside)
                overlap = overlap | (wrong & (inside >= 0) & (after >= 0))
                gap = gap | (wrong & _not((inside >= 0) & (after >= 0)))
                inside = dr.select(crossing, after, inside)
            ray = si.spawn_ray(ray.d)
        gap = gap | (inside >= 0)
        return int(np.count_nonzero(np.array(gap))), int(np.count_nonzero(np.array(overlap)))


# --------------------------------------------------------------------------------------------- integrator


def _passes(bsdf: Any) -> bool:
    """Return whether a surface with a BSDF is an index-matched boundary."""
    flags = int(bsdf.flags()) if bsdf is not None else 0
    stops = int(mi.BSDFFlags.Smooth) | int(mi.BSDFFlags.DeltaReflection) | int(mi.BSDFFlags.DeltaTransmission)
    return bool(flags & int(mi.BSDFFlags.Null)) and not flags & stops


def _nothing(kind: Any) -> Any:
    """Return a structure of zeros, of any variant."""
    return dr.zeros(kind) if _vectorised() else kind()


def _reference(p: Any) -> Any:
    """Return an interaction at a point in space, for emitters to be seen from."""
    ref = _nothing(mi.Interaction3f)
    ref.p = p
    return ref


def _turned(d: Any, side: Any, cosine: Any, u: Any) -> Any:
    """Return d deflected by an angle of given cosine at azimuth 2 pi u, and the side it goes to."""
    sine, co = dr.sincos(2.0 * math.pi * u)
    a, b = mi.coordinate_system(d)
    side = a * co + b * sine
    return d * cosine + side * dr.safe_sqrt(1.0 - cosine * cosine), side


def _offset(g: Any, c: Any, column: Any, d: Any, side: Any, sampler: Any) -> Any:
    """Return x_o - x_i [scene unit], drawn given the column; `side` is that to which the light is deflected."""
    r, z = g.draw(R, c, column, sampler.next_1d()), g.draw(Z, c, column, sampler.next_1d())
    sine, co = dr.sincos(g.draw(PHI, c, column, sampler.next_1d()))
    across = side * co + dr.cross(d, side) * sine
    return (d * z + across * r) * _at(mi.Float, g.radius, c)


@dr.syntax
def _open(  # noqa: PLR0913 - what a vectorised ray knows, each an argument
    k: Any, scene: Any, p: Any, d: Any, distance: Any, m: Any, jump: Any, e: Any, size: Any, length: Any,
    c: Any, sampler: Any, active: Any,
) -> Any:  # fmt: skip
    """Return how much light comes from a distance along d to p in medium m; first of all by a jump along e."""
    p, d, m, jump = mi.Point3f(p), mi.Vector3f(d), mi.Int32(m), mi.Bool(jump)
    distance, active = mi.Float(distance), mi.Bool(active)
    through = dr.select(active, mi.Color3f(1.0), mi.Color3f(0.0))
    g = k.arrays
    while dr.hint(active, label="shadow"):
        reach = dr.select(jump, size + k.slack, distance)
        ray = mi.Ray3f(p, dr.select(jump, e, d), reach, 0.0, [])
        pi = scene.ray_intersect_preliminary(ray, False, active=active)
        hit = pi.is_valid()
        t = dr.select(hit, pi.t, reach)
        if dr.hint(k.media, mode="scalar"):
            if jump:
                if dr.hint(g.absorbs, mode="scalar"):
                    through *= g.kept(c, length * dr.minimum(1.0, t / size))
            else:
                if m >= 0:
                    through *= dr.exp(-t / _at(mi.Float, g.free, m))
        if hit:
            si = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal)
            passes, row = k.boundary(si)
            if passes ^ True:
                if jump:
                    through = mi.Color3f(0.0)
                else:
                    seen = pi.compute_surface_interaction(ray)
                    through *= seen.bsdf().eval_null_transmission(seen)
            distance -= dr.select(jump, 0.0, t)
            p = si.spawn_ray(d).o
            m = k.across(row, si, d, m)
        else:
            p = mi.Point3f(p + e * size)
            active &= jump
        jump = mi.Bool(False)
        brightest = dr.max(through)
        active &= brightest > 0.0
        if active & (brightest < FAINT):
            active &= sampler.next_1d() * FAINT < brightest
            through *= FAINT / brightest
            if active ^ True:
                through = mi.Color3f(0.0)
    return through


@dr.syntax
def _light(k: Any, scene: Any, p: Any, count: int, sampler: Any) -> Any:
    """Return a light as seen from p, nothing unless it is of the first `count`: its sample, radiance over density."""
    ref = _reference(p)
    which = dr.minimum(mi.UInt32(sampler.next_1d() * (k.far + k.near)), k.far + k.near - 1)
    ds, light = _nothing(mi.DirectionSample3f), mi.Color3f(0.0)
    u = sampler.next_2d()
    if which < count:
        ds, light = k.light(which).sample_direction(ref, u)
        ds.pdf /= k.far + k.near
        light *= k.far + k.near
    return ds, light


@dr.syntax
def trace(  # noqa: C901 - Dr.Jit reads the loop of light and all its branches in one function
    self: Any, k: Any, scene: Any, sampler: Any, ray: Any, medium: Any, active: Any
) -> Any:
    """Return the radiance that arrives along rays, whether they met anything, and how many grains."""
    p, d = mi.Point3f(ray.o), mi.Vector3f(ray.d)
    active = mi.Bool(active)
    g = k.arrays
    m = mi.Int32(k.number(medium))
    radiance, left = mi.Color3f(0.0), mi.Color3f(1.0)
    eta = mi.Float(1.0)
    free, size, length = mi.Float(-1.0), mi.Float(0.0), mi.Float(0.0)
    jump, ready, met = mi.Bool(False), mi.Bool(False), mi.Bool(False)
    wants, asked = mi.Bool(False), mi.Bool(False)  # light from afar at the grain that has been reached
    e, c = mi.Vector3f(0.0, 0.0, 1.0), mi.UInt32(0)
    origin, pdf, pdf_near = mi.Point3f(p), mi.Float(-1.0), mi.Float(-1.0)
    depth, events = mi.UInt32(0), mi.UInt32(0)
    most = mi.UInt32(self.max_depth if self.max_depth >= 0 else 0xFFFFFFFF)

    while dr.hint(active, label="TPT"):
        if dr.hint(k.media, mode="scalar"):
            if active & (m >= 0) & _not(jump):
                mean = _at(mi.Float, g.free, m)
                bound = k.distance(m, p)
                if bound < 0.0:
                    m = mi.Int32(-1)
                    free = mi.Float(-1.0)
                    ready, wants, asked = mi.Bool(False), mi.Bool(False), mi.Bool(False)
                else:
                    free = dr.select(free < 0.0, -mean * dr.log(1.0 - sampler.next_1d()), free)
                    ready = ready | (bound > free)

            if dr.hint(k.far > 0, mode="scalar"):
                if active & wants:
                    c = g.component(m, sampler.next_1d() if g.mixed else mi.Float(0.0))
                    ds, light = _light(k, scene, p, k.far, sampler)
                    toward = ds.d
                    cosine = dr.clip(dr.dot(d, toward), -1.0, 1.0)
                    column = g.column_of(c, cosine)
                    f = _at(mi.Float, g.density, column)
                    across = toward - d * cosine
                    width = dr.norm(across)
                    any_side, _ = mi.coordinate_system(d)
                    side = dr.select(width > 1e-6, across / width, any_side)
                    offset = _offset(g, c, column, d, side, sampler)
                    l_shadow = mi.Float(0.0)
                    if dr.hint(g.absorbs, mode="scalar"):
                        l_shadow = g.draw(LENGTH, c, column, sampler.next_1d()) * _at(mi.Float, g.radius, c)
                    far = dr.norm(offset)
                    bound = k.distance(m, p)
                    share = g.share(m, bound)
                    weight = f * dr.select(ds.delta, 1.0, ds.pdf / (ds.pdf + f)) / share
                    arriving = light * dr.select(ds.pdf > 0.0, weight, 0.0)
                    blocked = far > bound
                    start = mi.Point3f(dr.select(blocked, p, p + offset))
                    if dr.hint(g.absorbs, mode="scalar"):
                        arriving *= dr.select(blocked, mi.Color3f(1.0), g.kept(c, l_shadow))
                    through = _open(k, scene, start, toward, dr.inf, m, blocked, offset / dr.maximum(far, 1e-30),
                                    far, l_shadow, c, sampler, dr.max(arriving) > 0.0)  # fmt: skip
                    radiance += left * arriving * through
                    asked = mi.Bool(True)
                    ready = mi.Bool(True)
                    wants = mi.Bool(False)

            # Event after event, as long as nothing else can be met
            while dr.hint(active & ready, label="grains"):
                mean = _at(mi.Float, g.free, m)
                p = mi.Point3f(p + d * free)
                free = mi.Float(0.0)
                bound = k.distance(m, p)
                if dr.hint(k.far > 0, mode="scalar"):
                    wants = _not(asked) & (sampler.next_1d() < g.share(m, bound)) & (depth + 1 < most)
                if wants:
                    ready = mi.Bool(False)
                else:
                    if asked ^ True:
                        c = g.component(m, sampler.next_1d() if g.mixed else mi.Float(0.0))
                    asked = mi.Bool(False)
                    column, cosine, f = g.column(c, sampler.next_1d())
                    turned, side = _turned(d, d, cosine, sampler.next_1d())
                    offset = _offset(g, c, column, d, side, sampler)
                    if dr.hint(g.absorbs, mode="scalar"):
                        length = g.draw(LENGTH, c, column, sampler.next_1d()) * _at(mi.Float, g.radius, c)
                    d = dr.normalize(turned)
                    pdf = dr.select(f > 0.0, f, -1.0)
                    pdf_near = mi.Float(-1.0)
                    size = dr.norm(offset)
                    depth += 1
                    events += 1
                    met = mi.Bool(True)
                    free = mi.Float(-1.0)
                    jump = bound < size
                    ready = mi.Bool(False)
                    if jump:
                        e = offset / size
                    else:
                        p = mi.Point3f(p + offset)
                        if dr.hint(g.absorbs, mode="scalar"):
                            left *= g.kept(c, length)
                        free = -mean * dr.log(1.0 - sampler.next_1d())
                        ready = k.distance(m, p) > free
                    active &= depth < most
                    if dr.hint(k.dims, mode="scalar"):
                        faint = dr.max(left) * eta * eta
                        if faint < DIM:
                            active &= sampler.next_1d() < 2.0 * faint
                            left /= dr.maximum(2.0 * faint, 1e-30)

        # What is met along a jump or a flight
        ready = mi.Bool(False)
        going = active & _not(wants)
        reach = dr.select(jump, size, dr.select(m >= 0, free, dr.inf)) + k.slack
        segment = mi.Ray3f(p, dr.select(jump, e, d), reach, 0.0, [])
        pi = scene.ray_intersect_preliminary(segment, False, active=going)
        hit = pi.is_valid()
        if going & hit:
            if dr.hint(k.media and g.absorbs, mode="scalar"):
                if jump:
                    left *= g.kept(c, length * dr.minimum(1.0, pi.t / size))
            si = pi.compute_surface_interaction(segment, mi.RayFlags.Minimal)
            passes, row = k.boundary(si)
            if dr.hint(k.near > 0, mode="scalar"):
                emitter = si.emitter(scene)
                if emitter != None:  # noqa: E711
                    if met | (self.hide_emitters ^ True):
                        ds = mi.DirectionSample3f(scene, si, _reference(origin))
                        p_light = emitter.pdf_direction(_reference(origin), ds) / (k.far + k.near)
                        weight = dr.select(jump | (pdf_near < 0.0), 1.0, pdf_near / (pdf_near + p_light))
                        radiance += left * emitter.eval(si) * weight
            if passes:
                origin = mi.Point3f(dr.select(jump, si.p, origin))
                p = si.spawn_ray(d).o
                m = k.across(row, si, d, m)
            else:
                si = pi.compute_surface_interaction(segment)
                bsdf = si.bsdf()
                met = mi.Bool(True)
                depth += 1
                context = mi.BSDFContext()
                if dr.hint(k.far + k.near > 0, mode="scalar"):
                    if mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth) & (depth < most):
                        ds, light = _light(k, scene, si.p, k.far + k.near, sampler)
                        value, density = bsdf.eval_pdf(context, si, si.to_local(ds.d))
                        weight = dr.select(ds.delta, 1.0, ds.pdf / (ds.pdf + density))
                        weight = dr.select(ds.pdf > 0.0, weight, 0.0)
                        arriving = light * value * weight
                        m_shadow = k.across(row, si, ds.d, m)
                        start = si.spawn_ray_to(ds.p)
                        endless = k.light_is_far(ds)
                        distance = dr.select(endless, dr.inf, start.maxt)
                        found = dr.max(arriving) > 0.0
                        through = _open(k, scene, start.o, ds.d, distance, m_shadow, mi.Bool(False), e, size, length,
                                        c, sampler, found)  # fmt: skip
                        radiance += left * arriving * through
                bs, value = bsdf.sample(context, si, sampler.next_1d(), sampler.next_2d())
                left *= value
                eta *= bs.eta
                active &= (bs.pdf > 0.0) & (dr.max(left) > 0.0) & (depth < most)
                d = dr.normalize(si.to_world(bs.wo))
                if mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null):
                    depth -= 1
                else:
                    origin = si.p
                    pdf = dr.select(mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta), -1.0, bs.pdf)
                    pdf_near = pdf
                p = si.spawn_ray(d).o
                m = k.across(row, si, d, m)
                faint = dr.max(left) * eta * eta
                if faint < DIM:
                    active &= sampler.next_1d() < 2.0 * faint
                    left /= dr.maximum(2.0 * faint, 1e-30)
            free = mi.Float(-1.0)
            jump = mi.Bool(False)
        elif going:
            if jump:
                p = mi.Point3f(p + e * size)
                if dr.hint(k.media and g.absorbs, mode="scalar"):
                    left *= g.kept(c, length)
                jump = mi.Bool(False)
            else:
                if m < 0:
                    if dr.hint(k.sky is not None, mode="scalar"):
                        if met | (self.hide_emitters ^ True):
                            away = _nothing(mi.SurfaceInteraction3f)
                            away.wi = -d
                            weight = mi.Float(1.0)
                            if dr.hint(not k.constant, mode="scalar"):
                                ds = _nothing(mi.DirectionSample3f)
                                ds.d = d
                                p_light = k.sky.pdf_direction(_reference(p), ds) / (k.far + k.near)
                                weight = dr.select(pdf < 0.0, 1.0, pdf / (pdf + p_light))
                            radiance += left * k.sky.eval(away) * weight
                    active = mi.Bool(False)
                else:
                    ready = mi.Bool(True)
                    if dr.hint(k.far > 0 and k.media, mode="scalar"):
                        p = mi.Point3f(p + d * free)
                        free = mi.Float(0.0)
                        wants = (sampler.next_1d() < g.share(m, k.distance(m, p))) & (depth + 1 < most)
                        asked = _not(wants)
                        ready = mi.Bool(asked)
    return radiance, met, events


# ------------------------------------------------------------------------------------------- registration


def _plugins() -> tuple[Any, Any]:
    """Return the classes of the variant that is set."""

    class Granular(mi.Medium):
        """Grains in bulk; to an integrator that knows no grains, the medium of point scatterers (VPT)."""

        def __init__(self, props: Any) -> None:
            self.bulk = _bulk_of(props)
            stock = self.bulk.stock()
            where = props.id()
            for key in list(props.keys()):
                del props[key]
            props["phase"] = mi.load_dict(stock["phase"])
            super().__init__(props)
            self.where = where
            self.sigma_t, self.albedo = (
                [by * float(v) for v in (s["value"] if isinstance(s, dict) else [s] * 3)]
                for s, by in ((stock["sigma_t"], stock["scale"]), (stock["albedo"], 1.0))
            )

        def intersect_aabb(self, ray: Any) -> Any:
            return mi.Bool(True), mi.Float(0.0), mi.Float(math.inf)

        def get_majorant(self, mei: Any, active: Any = True) -> Any:
            return mi.Color3f(self.sigma_t)

        def get_scattering_coefficients(self, mei: Any, active: Any = True) -> Any:
            sigma_t = mi.Color3f(self.sigma_t)
            return sigma_t * mi.Color3f(self.albedo), mi.Color3f(0.0), sigma_t

        def traverse(self, callback: Any) -> None:
            pass

        def to_string(self) -> str:
            return f"Granular[{self.bulk.components}, packing_fraction={self.bulk.packing_fraction:g}]"

    class TPT(mi.SamplingIntegrator):
        """Teleportation path tracing."""

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.max_depth = int(props.get("max_depth", -1))
            self.count = bool(props.get("count", False))
            if self.max_depth < -1:
                raise UsageError(f"integrator tpt: max_depth must be >= 0, or -1 for no limit, not {self.max_depth}")
            self._prepared: Prepared | None = None
            self._lock = threading.Lock()

        def prepared(self, scene: Any) -> Prepared:
            with self._lock:
                if self._prepared is None or self._prepared.state[0] is not scene:
                    self._prepared = Prepared(scene)
                return self._prepared

        def render(self, scene: Any, *args: Any, **kwargs: Any) -> Any:
            if self._prepared is not None and self._prepared.state != _state(scene):
                self._prepared = None
            self.prepared(scene)
            return super().render(scene, *args, **kwargs)

        def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True) -> Any:
            radiance, met, events = trace(self, self.prepared(scene), scene, sampler, ray, medium, active)
            return radiance, met, [mi.Float(events)] if self.count else []

        def aov_names(self) -> list[str]:
            return ["events"] if self.count else []

        def to_string(self) -> str:
            return f"TPT[max_depth={self.max_depth}]"

    return Granular, TPT


_registered: set[str] = set()


def register() -> None:
    """Register ``granular`` and ``tpt`` with the variant that is set; importing this module sees to that.

    Raises
    ------
    UsageError
        If no variant is set, or one that is not RGB.
    """
    variant = mi.variant()
    if variant is None:
        raise UsageError('no variant of Mitsuba is set: call tsdf.loaders.mitsuba.set_variant("llvm_ad_rgb") first')
    if variant in _registered:
        return
    if not variant.endswith("_rgb"):
        raise UsageError(f"granular and tpt are for RGB variants, not {variant}: set scalar_rgb or llvm_ad_rgb")
    medium_class, integrator_class = _plugins()
    mi.register_medium("granular", medium_class)
    mi.register_integrator("tpt", integrator_class)
    _registered.add(variant)


def _changed(old: str | None, new: str | None) -> None:
    if new is not None and new.endswith("_rgb"):
        register()


mi.detail.add_variant_callback(_changed)
if mi.variant() is not None:
    _changed(None, mi.variant())

PROBE = (
    "import drjit as dr, mitsuba as mi\n"
    "mi.set_variant({variant!r})\n"
    "x = dr.arange(mi.Float, 32)\n"
    "dr.eval(x)\n"
    "print(float(dr.max(dr.maximum(x, 3.0))[0]))\n"
)


def set_variant(variant: str = "llvm_ad_rgb") -> None:
    """Set a variant of Mitsuba, after a look at whether its compiler works: some versions of LLVM end the process.

    Parameters
    ----------
    variant : str
        ``scalar_rgb``, ``llvm_ad_rgb`` or ``cuda_ad_rgb``.

    Raises
    ------
    UsageError
        If Mitsuba has no such variant, or it cannot run here.
    """
    if variant not in mi.variants():
        known = ", ".join(v for v in mi.variants() if v.endswith("_rgb"))
        raise UsageError(f"Mitsuba {mi.__version__} has no variant {variant!r}; for tpt it has {known}")
    if not variant.startswith("scalar"):
        code = PROBE.format(variant=variant)
        done = subprocess.run([sys.executable, "-I", "-c", code], capture_output=True, text=True, check=False)
        if done.returncode or done.stdout.strip() != "31.0":
            said = [line for line in done.stderr.splitlines() if line.strip()]
            reason = next(
                (s for s in said if "LLVM ERROR" in s), said[-1] if said else f"exit status {done.returncode}"
            )
            raise UsageError(f"{variant} does not work here ({' '.join(reason.split())[:160]}): {_way_out(variant)}")
    mi.set_variant(variant)


def _way_out(variant: str) -> str:
    if variant.startswith("cuda"):
        return "it needs an NVIDIA GPU and driver; set llvm_ad_rgb or scalar_rgb"
    return (
        "install LLVM 17 or newer (Debian: apt install libllvm19) and name its library in DRJIT_LIBLLVM_PATH, or set "
        "scalar_rgb"
    )
