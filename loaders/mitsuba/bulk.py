"""Bulk of grains: what a medium is made of, as the stock medium (`medium`) and as parameters of ``granular``."""

import difflib
import math
import os
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from tsdf.data import format as tsdf_format
from tsdf.data.table import Table
from tsdf.errors import TSDFError, UsageError
from tsdf.scene.deep import absorption_of_colour
from tsdf.scene.medium import Component, free_path, volume_parameters
from tsdf.scene.sizes import SIZES, WORDS, convert

MAX_NODES = 4097  # of a tabulated phase function
COLOURS = ("albedo", "deep_colour")  # two words for the colour of a deep medium in diffuse light
LENGTH_OF_UNIT = "metres_per_unit"  # [m]; only ssa needs it


class Grain(NamedTuple):
    """One kind of grain of a mixture."""

    table: Table | str | os.PathLike[str]
    fraction: float = 1.0  # share of the number of grains [1]
    absorption: float | Sequence[float] = 0.0  # sigma_a of its material, one number or RGB [1/scene unit]
    deep_colour: float | Sequence[float] | None = None  # of a deep medium of these grains, instead of the absorption


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


def _in_numbers(
    grains: Sequence[tuple[Table, float]], packing_fraction: float | None, radius: float | None, said: dict[str, Any]
) -> tuple[float, float]:
    """Return packing fraction and bounding radius, whatever words say them."""
    ours = {"packing_fraction": packing_fraction, "radius": radius}
    words = {word: value for word, value in ours.items() if value is not None} | said
    metres = words.pop(LENGTH_OF_UNIT, None)
    try:
        numbers = {word: float(value) for word, value in words.items()}
        unit = None if metres is None else float(metres)
    except (TypeError, ValueError):
        raise UsageError(f"sizes and amounts are numbers, not {words!r}") from None
    if set(numbers) == {"packing_fraction", "radius"}:
        return numbers["packing_fraction"], numbers["radius"]  # `Component` and `free_path` know their ranges
    if not any(word in numbers for word in SIZES):
        raise UsageError(f"how large grains are is missing: give grain_radius, or one of {', '.join(SIZES)}")
    packed = convert(grains, numbers, unit)
    return packed.fraction, packed.radius


def _colour(
    value: Any, wanted: str = "absorption must be one finite number >= 0 [1/scene unit] or three for RGB"
) -> tuple[float, float, float]:
    try:
        numbers = [float(value)] * 3 if np.ndim(value) == 0 else [float(v) for v in value]
    except (TypeError, ValueError):
        numbers = []
    if len(numbers) != 3 or not all(0.0 <= v < math.inf for v in numbers):
        raise UsageError(f"{wanted}, not {value!r}")
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
    **said
        `deep_colour` or `albedo`, one number or linear RGB, in place of the absorption: the colour of a deep medium in
        diffuse light (`tsdf.scene.deep`). Any of `tsdf.scene.sizes.WORDS` in place of packing_fraction and
        grain_radius, with `metres_per_unit` for ssa.

    Raises
    ------
    UsageError
        For a value out of range, and for words that are unknown or say a thing twice.
    FormatError
        For a file that is not a table, or of a newer version.
    """

    def __init__(
        self,
        grains: Grains,
        packing_fraction: float | None = None,
        grain_radius: float | None = None,
        absorption: Any = 0.0,
        **said: Any,
    ) -> None:
        colours = [said.pop(word) for word in COLOURS if word in said]
        if len(colours) + (bool(colours) and bool(np.any(np.asarray(absorption) != 0.0))) > 1:
            raise UsageError("absorption, albedo and deep_colour all say how grains absorb: give one")
        if isinstance(grains, Table | str | os.PathLike):
            grains = [Grain(grains, 1.0, absorption, *colours)]
        elif colours or np.any(np.asarray(absorption) != 0.0):
            raise UsageError("the grains of a mixture have their own absorption: Grain(table, fraction, absorption)")
        try:
            grains = [(g := Grain(*one))._replace(fraction=float(g.fraction)) for one in grains]
        except (TypeError, ValueError):
            raise UsageError(f"grains are a table, or a list of Grain(table, fraction), not {grains!r:.80}") from None
        tables = [_table(g.table) for g in grains]
        self.packing_fraction, self.radius = _in_numbers(
            [(t, g.fraction) for t, g in zip(tables, grains, strict=True)], packing_fraction, grain_radius, said
        )
        self.grains = grains
        self.components = [Component(t, g.fraction, self.radius) for t, g in zip(tables, grains, strict=True)]
        self.sigma_a = np.array(
            [self._absorption(g, t) for g, t in zip(grains, tables, strict=True)]
        )  # (components, 3)
        self.path = free_path(self.components, self.packing_fraction)

    def _absorption(self, grain: Grain, table: Table) -> tuple[float, float, float]:
        """Return the absorption coefficient of a grain's material, red, green, blue [1/scene unit]."""
        if grain.deep_colour is None:
            return _colour(grain.absorption)
        asked = _colour(grain.deep_colour, "deep_colour must be one number or three for RGB, > 0 and < 1")
        red, green, blue = (x / self.radius for x in absorption_of_colour(table, asked))
        return red, green, blue

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
    table: Grains,
    packing_fraction: float | None = None,
    grain_radius: float | None = None,
    absorption: float | Sequence[float] = 0.0,
    **said: Any,
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
    **said
        Other words for these: see `Bulk`.

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
    return Bulk(table, packing_fraction, grain_radius, absorption, **said).stock()


def granular(
    table: Grains,
    packing_fraction: float | None = None,
    grain_radius: float | None = None,
    absorption: float | Sequence[float] = 0.0,
    **said: Any,
) -> dict[str, Any]:
    """Return the dict of the medium ``granular`` for the integrator ``tpt``; parameters and errors as `medium`.

    Tables in memory are named by a handle that is good for this process.
    """
    bulk = Bulk(table, packing_fraction, grain_radius, absorption, **said)

    def name(of: Table | str | os.PathLike[str]) -> str:
        if not isinstance(of, Table):
            return os.fspath(of)
        _given[f"table:{id(of):x}"] = of
        return f"table:{id(of):x}"

    return {
        "type": "granular",
        "file": ";".join(name(g.table) for g in bulk.grains),
        "fraction": ";".join(repr(float(g.fraction)) for g in bulk.grains),
        "absorption": ";".join(" ".join(map(repr, sigma.tolist())) for sigma in bulk.sigma_a),
        "packing_fraction": bulk.packing_fraction,
        "grain_radius": bulk.radius,
    }


def bulk_of(props: Any) -> Bulk:
    """Return what the properties of a ``granular`` medium say."""
    where = f"medium granular {props.id()!r}"
    words = {*WORDS, LENGTH_OF_UNIT} - {"radius", "packing_fraction"}
    known = {"file", "fraction", "absorption", "packing_fraction", "grain_radius", *COLOURS, *words}
    for key in list(props.keys()):
        if key not in known:
            near = difflib.get_close_matches(key, sorted(known), 1)
            hint = f"did you mean {near[0]!r}? " if near else ""
            raise UsageError(f"{where}: unknown parameter {key!r}; {hint}it knows {', '.join(sorted(known))}")
    said = {key: props[key] for key in sorted(words) if key in props}
    for key in ("file",) if said else ("file", "packing_fraction", "grain_radius"):
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

    asked = [key for key in COLOURS if key in props]
    if len(asked) + ("absorption" in props) > 1 and asked:
        raise UsageError(f"{where}: absorption, albedo and deep_colour all say how grains absorb: give one")
    colours = several(asked[0], "") if asked else [None] * len(files)
    columns = (files, several("fraction", "1"), several("absorption", "0"), colours)
    grains = [Grain(*g) for g in zip(*columns, strict=True)]
    try:
        return Bulk(grains, props.get("packing_fraction"), props.get("grain_radius"), **said)
    except TSDFError as error:
        raise type(error)(f"{where}: {error}") if not hasattr(error, "code") else error from None
