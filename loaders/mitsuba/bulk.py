"""Bulk of grains: what a medium is made of, as the stock medium (`medium`) and as parameters of ``granular``."""

import math
import os
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from tsdf.data import format as tsdf_format
from tsdf.data.table import Table
from tsdf.errors import TSDFError, UsageError
from tsdf.scene.medium import Component, free_path, volume_parameters

MAX_NODES = 4097  # of a tabulated phase function


class Grain(NamedTuple):
    """One kind of grain of a mixture."""

    table: Table | str | os.PathLike[str]
    fraction: float = 1.0  # share of the number of grains [1]
    absorption: float | Sequence[float] = 0.0  # sigma_a of its material, one number or RGB [1/scene unit]


Grains = Table | str | os.PathLike[str] | Sequence[Grain]
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


def bulk_of(props: Any) -> Bulk:
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
