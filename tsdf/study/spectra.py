"""What a grain does to light by wavelength: tables at a few refractive indices, and everything else between them.

Absorption needs no table of its own: each holds the path lengths of its lossless grain. What is left is n, which
changes slowly over a spectrum, so polynomials through a few tables (at Chebyshev's points, each set holding the one
before) give the rest; what the last doubling of the points changed bounds what they miss. What k makes of the surface
is added: light that it sends back outside, which is exact where grains are convex and let nothing through. Slabs are
`slabs`.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tsdf.data.phase import far_field, legendre
from tsdf.data.table import Table
from tsdf.errors import UsageError
from tsdf.grain.grains import Grain
from tsdf.grain.materials import OpticalConstants
from tsdf.grain.optics import Optics
from tsdf.make.scatterometer import Build, Effort, exact_sphere
from tsdf.study.reflection import Surface

TOLERANCE = 5e-4  # of g and of B/n^2, up to which the last doubling of the points may change them
MOST_STEPS = 16  # between the points, one fewer than points
SAME = 1e-6  # indices nearer to each other are one
NM = 1e-9  # [m]
MOST_WAVELENGTHS = 20_000
NOTABLE = 1e-3  # of the albedo, from which on what k does to reflectance is told


def wavelengths(text: str) -> np.ndarray:
    """Return wavelengths (w,) float64 [nm], ascending, from "550", "450,550,650" or "FROM:TO:STEP", ends included.

    Raises
    ------
    UsageError
    """

    def wrong(why: str) -> UsageError:
        return UsageError(f"wavelengths {text!r}: {why}; give FROM:TO:STEP (300:2500:10), or A,B,.. [nm]")

    spans = [part.split(":") for part in text.split(",")]
    try:
        numbers = [[float(number) for number in span] for span in spans]
    except ValueError:
        raise wrong("not numbers") from None
    found: list[float] = []
    for span in numbers:
        if len(span) == 3 and (span[0] > span[1] or span[2] <= 0.0):
            raise wrong("FROM:TO:STEP rises, FROM to TO by a STEP above 0")
        if not all(0.0 < number < 1e9 for number in span):
            raise wrong("each is above 0 and finite")
        if len(span) == 1:
            found += span
        elif len(span) == 3 and span[0] <= span[1]:
            steps = math.floor((span[1] - span[0]) / span[2] * (1.0 + 1e-12) + 1e-9)
            if steps > MOST_WAVELENGTHS:
                raise wrong(f"more than {MOST_WAVELENGTHS}")
            found += [span[0] + span[2] * step for step in range(steps + 1)]
        else:
            raise wrong("neither one number nor FROM:TO:STEP with FROM below TO")
    if len(found) > MOST_WAVELENGTHS:
        raise wrong(f"more than {MOST_WAVELENGTHS}")
    return np.unique(found)


@dataclass(frozen=True, eq=False)
class Constants:
    """Optical constants by wavelength.

    Attributes
    ----------
    wavelength_nm, n : (w,) float64
    k : (w,) float64
        Not a number where the source has none.
    material, source : str
    """

    wavelength_nm: np.ndarray
    n: np.ndarray
    k: np.ndarray
    material: str
    source: str

    @classmethod
    def of(cls, constants: Sequence[OpticalConstants]) -> "Constants":
        """Return the constants found one by one."""
        columns = [(c.wavelength_nm, c.n, math.nan if c.k is None else c.k) for c in constants]
        wavelength, n, k = np.array(columns, np.float64).T
        return cls(wavelength, n, k, constants[0].material, constants[0].source)

    def absorption(self) -> np.ndarray:
        """Return the absorption coefficient 4 pi k / wavelength, (w,) float64 [1/m]."""
        return 4.0 * math.pi * self.k / (self.wavelength_nm * NM)


def wavelength_heads(constants: Constants) -> list[str]:
    """Return a name for each wavelength, no two alike."""
    return [f"{w:.12g}nm" for w in constants.wavelength_nm]


def lagrange(nodes: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return how much the value at each node weighs in the polynomial through all, (len(at), len(nodes)) float64."""
    weights = np.ones((len(at), len(nodes)))
    for i, node in enumerate(nodes):
        for other in np.delete(nodes, i):
            weights[:, i] *= (at - other) / (node - other)
    return weights


def points(low: float, high: float, steps: int) -> np.ndarray:
    """Return Chebyshev's points of the second kind from low to high, (steps + 1,) float64 ascending."""
    share = 0.5 * (1.0 - np.cos(np.pi * np.arange(steps + 1) / steps))
    return low + (high - low) * share


@dataclass(frozen=True, eq=False)
class Family:
    """Tables of one grain, by ascending refractive index.

    Raises
    ------
    UsageError
        If they are of several grains or conventions of Fresnel, or two of them have the same index.
    """

    tables: tuple[Table, ...]

    def __post_init__(self) -> None:
        def shape(table: Table) -> tuple[object, ...]:
            grain = table.header["grain"]
            return grain["mesh_sha256"], grain["kind"], dict(grain["parameters"])

        if any(shape(table) != shape(self.tables[0]) for table in self.tables):
            raise UsageError("the tables are of different grains: give tables of one grain at several indices")
        if len({str(table.header["optics"]["fresnel"]) for table in self.tables}) > 1:
            raise UsageError("the tables are made with --fresnel sp and --fresnel un: give tables of one of them")
        if (np.diff(self.eta) <= SAME).any():
            raise UsageError("two of the tables have the same index: give each once")

    @classmethod
    def of(cls, tables: Sequence[Table]) -> "Family":
        """Return tables in their order."""
        return cls(tuple(sorted(tables, key=lambda table: float(table.header["optics"]["eta"]))))

    @property
    def eta(self) -> np.ndarray:
        """Refractive indices, (t,) float64."""
        return np.array([table.header["optics"]["eta"] for table in self.tables], np.float64)

    def weights(self, n: np.ndarray) -> np.ndarray:
        """Return what each table counts at each index, (len(n), t) float64; one table alone stands for all.

        Raises
        ------
        UsageError
            If an index is beyond those of the tables.
        """
        eta = self.eta
        if len(eta) > 1 and (n.min() < eta[0] - SAME or n.max() > eta[-1] + SAME):
            raise UsageError(
                f"n runs from {n.min():.6g} to {n.max():.6g}, the tables from {eta[0]:.6g} to {eta[-1]:.6g}: "
                "add tables at the ends"
            )
        return lagrange(eta, n)

    def coarser(self, n: np.ndarray) -> np.ndarray | None:
        """Return what each table counts if every other one between the ends is left out, None for one table."""
        count = len(self.tables)
        if count == 1:
            return None
        if count == 2:
            return np.full((len(n), 2), 0.5)
        kept = sorted({*range(0, count, 2), count - 1})
        weights = np.zeros((len(n), count))
        weights[:, kept] = lagrange(self.eta[kept], n)
        return weights

    def masses(self, found: "Spectrum") -> tuple[np.ndarray, np.ndarray]:
        """Return edges of cos theta and the deflections of what absorbing grains let out, (w, columns) float64, sum 1.

        Between tables they are mixed linearly: rainbows and halos move with n, and polynomials through cells that they
        pass would be negative beside them. Moments of the mixture are not quite `moments_of`.

        Raises
        ------
        UsageError
            If the tables have different cells.
        """
        edges = self.tables[0].cos_theta_edges
        if any(not np.array_equal(table.cos_theta_edges, edges) for table in self.tables):
            raise UsageError("the tables have different cells of theta: build them with the same --cells")
        x = np.nan_to_num(found.absorption_times_radius)
        whole, last = np.zeros((len(x), len(edges) - 1)), len(self.tables) - 1
        place = np.interp(found.constants.n, self.eta, np.arange(last + 1.0))
        shares = np.maximum(0.0, 1.0 - np.abs(place[:, None] - np.arange(last + 1.0)))
        for table, share in zip(self.tables, found.weighed(shares).T, strict=True):
            for w in np.flatnonzero(share):
                whole[w] += share[w] * table.deflection_masses(float(x[w]))
        felt = found.surface.felt
        if felt.any():
            sent = found.surface.sent(edges)
            energy = np.maximum(found.surface.energy(shares[felt], whole[felt].sum(axis=1), whole[felt], sent), 0.0)
            whole[felt] = np.nan_to_num(_over(energy, energy.sum(axis=1)))
        return edges, whole


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Single scattering by wavelength; arrays (w,) float64, each `_error` a standard error plus what n between tables
    may miss.

    Attributes
    ----------
    constants : Constants
    radius : float
        Bounding radius R [m].
    absorption_times_radius : sigma_a R [1].
    albedo, g : of geometrical optics, energy that leaves over energy that met the grain, and its mean cosine [1].
    albedo_far, g_far : with diffraction, Q_ext = 2.
    enhancement : B, the lossless mean path in the grain times its projected area over its volume [1].
    noise, between : dict
        The two parts of the errors of albedo, g and enhancement.
    notes : tuple of str
        What the reader should know, one line each.
    surface : Surface
        What k makes of the grain's surface, which `albedo` and `g` have; `moments_of` and `Family.masses`, too.
    albedo_of_tables : (t, w) float64
        Of each table at these absorptions, as of n alone.
    """

    constants: Constants
    radius: float
    absorption_times_radius: np.ndarray
    albedo: np.ndarray
    g: np.ndarray
    albedo_far: np.ndarray
    g_far: np.ndarray
    enhancement: np.ndarray
    noise: dict[str, np.ndarray]
    between: dict[str, np.ndarray]
    notes: tuple[str, ...]
    surface: Surface
    albedo_of_tables: np.ndarray

    def error(self, name: str) -> np.ndarray:
        """Return the error of albedo, g, enhancement or those of the far field."""
        if name == "albedo_far":
            return 0.5 * self.error("albedo")
        if name == "g_far":
            w, g = self.albedo, np.where(self.albedo > 0.0, self.g, 0.0)
            return np.hypot(w * self.error("g"), (g - self.g_far) * self.error("albedo")) / (1.0 + w)
        return self.noise[name] + self.between[name]

    def weighed(self, weights: np.ndarray) -> np.ndarray:
        """Return weights of tables (w, t) for means over what leaves: of energies, where k is felt at the surface."""
        return np.where(self.surface.felt[:, None], weights * self.albedo_of_tables.T, weights)


def _over(energy: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """Return means (w, ...) of energies over all that leaves (w,), not a number where nothing does."""
    whole = np.where(whole > 0.0, whole, math.nan).reshape((-1,) + (1,) * (energy.ndim - 1))
    return np.asarray(energy / whole)


def convexity(table: Table) -> float:
    """Return four times the mean projected area of a grain over its surface, 1 of convex ones [1]."""
    return min(4.0 * table.projected_area.value / float(table.header["grain"]["area"]), 1.0)


def absorbed(table: Table, x: np.ndarray) -> np.ndarray:
    """Return albedo, mean cosine, and their standard errors, (4, len(x)) float64, at absorptions x = sigma_a R.

    The albedo is over that of the lossless grain, as in renderings. Errors are those of the lossless path length and
    mean cosine, scaled as the spread of exp(-x l) and cos theta over the light is: as if they were sampled as well.
    """
    share = table.p_theta * table.p_l.astype(np.float64)
    share /= share.sum()
    length = table.block("mean_l").astype(np.float64)
    edges = table.cos_theta_edges
    middle = np.broadcast_to(0.5 * (edges[1:] + edges[:-1]), share.shape)
    filled = share > 0.0
    share, length, middle = share[filled], length[filled], middle[filled]
    errors = table.header["standard_errors"]
    mean_l, mean_c = float(share @ length), float(share @ middle)
    spread_l = math.sqrt(max(float(share @ length**2) - mean_l**2, 1e-300))
    spread_c = math.sqrt(max(float(share @ middle**2) - mean_c**2, 1e-300))
    lossless = min(max(float(table.statistics["mean_cosine"]), -1.0), 1.0)
    found = np.zeros((4, len(x)))
    with np.errstate(under="ignore"):
        for i, a in enumerate(x):
            if math.isnan(a):
                found[:, i] = math.nan
                continue
            left: np.ndarray = share * np.exp(-a * length)
            albedo = float(left.sum())
            cosine = left @ middle / albedo if albedo > 0.0 else math.nan
            again = left**2 / share
            spread = math.sqrt(max(float(again.sum()) - albedo**2, 0.0))
            shifted = math.sqrt(max(float(again @ (middle - cosine) ** 2), 0.0)) / albedo if albedo > 0.0 else math.nan
            found[:, i] = (
                albedo,
                min(max(lossless + cosine - mean_c, -1.0), 1.0),
                errors["mean_path_length"] * spread / spread_l,
                errors["mean_cosine"] * shifted / spread_c,
            )
    return found


def spectrum(family: Family, constants: Constants, radius: float) -> Spectrum:
    """Return what grains of a bounding radius [m] do to light by wavelength.

    Raises
    ------
    UsageError
        If the index goes beyond those of the tables, or the radius is no length.
    """
    if not 0.0 < radius < math.inf:
        raise UsageError(f"the bounding radius is a finite number of metres above 0, not {radius:g}")
    n, x = constants.n, constants.absorption() * radius
    unknown = np.isnan(x)
    weights, coarser = family.weights(n), family.coarser(n)
    rows = []
    for table in family.tables:
        b, b_error = table.absorption_enhancement
        albedo, g, albedo_error, g_error = absorbed(table, np.where(unknown, 0.0, x))
        # n^2 is nearly all that B knows of n, and is exact
        eta2 = float(table.header["optics"]["eta"]) ** 2
        ones = np.ones(len(n))
        rows.append((albedo, g, b / eta2 * ones, albedo_error, g_error, b_error / eta2 * ones))
    values = np.array(rows)  # (t, 6, w)
    of_n = np.stack([np.ones(len(n)), np.ones(len(n)), (n if len(family.tables) > 1 else family.eta) ** 2 * ones])
    found = np.einsum("wt,tqw->qw", weights, values[:, :3]) * of_n
    noise = np.sqrt(np.einsum("wt,tqw->qw", weights**2, values[:, 3:] ** 2)) * of_n
    missed = np.zeros_like(found)
    if coarser is not None:
        missed = np.abs(np.einsum("wt,tqw->qw", coarser, values[:, :3]) * of_n - found)
    notes = []
    if coarser is None and np.abs(n - family.eta[0]).max() > 1e-4:
        notes.append(
            f"n is that of the one table, {family.eta[0]:.6g}, where that of {constants.material} runs from "
            f"{n.min():.5g} to {n.max():.5g}: what that costs is not in the errors (give tables at several indices, "
            "or the grain instead)"
        )
    found[0] = np.clip(found[0], 0.0, 1.0)
    # without a material k stands for an absorption of which nobody said a wavelength
    k = np.where(unknown, 0.0, constants.k) if constants.material else np.zeros(len(n))
    surface = Surface(n, k, family.eta, convexity(family.tables[0]))
    if (felt := surface.felt).any():
        each = values[:, 0] * np.stack([np.ones_like(values[:, 0]), np.nan_to_num(values[:, 1])])  # (2, t, w)

        def put(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            """Return albedo and g with k, and the share of what k changes that may be wrong."""
            alone = np.einsum("wt,qtw->wq", weights, each[:, :, felt])
            energy = surface.energy(weights, alone[:, 0], alone, surface.whole)
            both = np.stack([np.clip(energy[:, 0], 0.0, 1.0), _over(energy[:, 1], energy[:, 0])])
            return both, surface.unsure(weights, alone[:, 0])

        with_k, unsure = put(weights[felt])
        change = np.abs(with_k - np.nan_to_num(found[:2, felt]))
        far = unsure * change
        found[:2, felt] = with_k
        missed[:2, felt] = far + (np.abs(put(coarser[felt])[0] - with_k) if coarser is not None else 0.0)
        notable = change[0] > NOTABLE
        if notable.any():
            there = constants.wavelength_nm[felt][notable]
            where = f"at {there[0]:g}" if len(there) == 1 else f"between {there.min():g} and {there.max():g}"
            notes.append(
                f"{where} nm k changes what the surface sends back, the albedo by up to "
                f"{change[0].max():.2g}: put in as of convex grains; what that may miss, up to "
                f"{far[0].max():.1g} of the albedo and {far[1].max():.1g} of g, is in the errors"
            )
    if unknown.any():
        found[0, unknown] = noise[0, unknown] = missed[0, unknown] = math.nan
        notes.append(
            f"k of {constants.material} is not known at {int(unknown.sum())} of {len(n)} wavelengths: no albedo there, "
            "and g is that of the lossless grain"
        )
    albedo_far, g_far = far_field(np.where(unknown, 1.0, found[0]), found[1])
    names = ("albedo", "g", "enhancement")
    return Spectrum(
        constants, radius, x, found[0], found[1], np.where(unknown, math.nan, albedo_far), g_far, found[2],
        dict(zip(names, noise, strict=True)), dict(zip(names, missed, strict=True)), tuple(notes),
        surface, values[:, 0],
    )  # fmt: skip


def columns(found: Spectrum) -> dict[str, np.ndarray]:
    """Return a spectrum as named columns, each quantity followed by its error."""
    c = found.constants
    sheet = {"wavelength_nm": c.wavelength_nm, "n": c.n, "k": c.k, "absorption_times_radius":
             found.absorption_times_radius}  # fmt: skip
    for name, values in (
        ("albedo", found.albedo), ("g", found.g), ("albedo_far", found.albedo_far), ("g_far", found.g_far),
        ("enhancement", found.enhancement),
    ):  # fmt: skip
        sheet[name], sheet[f"{name}_error"] = values, found.error(name)
    return sheet


def moments_of(family: Family, found: Spectrum, orders: int) -> tuple[np.ndarray, np.ndarray]:
    """Return Legendre moments by wavelength, (w, orders + 1) float64, and the share that goes straight on, (w,)."""
    x = np.where(np.isnan(found.absorption_times_radius), 0.0, found.absorption_times_radius)
    weights = family.weights(found.constants.n)
    whole, straight = np.zeros((len(x), orders + 1)), np.zeros(len(x))
    for table, share in zip(family.tables, found.weighed(weights).T, strict=True):
        masses = np.array([table.deflection_masses(float(a)) for a in x])
        whole += share[:, None] * legendre(table.cos_theta_edges, masses, orders)
        straight += share * masses[:, -1]
    felt = found.surface.felt
    if felt.any():
        edges = np.linspace(-1.0, 1.0, 4 * orders + 65)
        tables, here = (legendre(edges, masses, orders) for masses in found.surface.sent(edges))
        weights, albedo = weights[felt], whole[felt, 0]
        energy = found.surface.energy(weights, albedo, whole[felt], (tables, here))
        none = np.zeros(len(family.tables)), np.zeros(int(felt.sum()))
        ahead = found.surface.energy(weights, albedo, straight[felt], none)
        straight[felt] = np.nan_to_num(_over(ahead, energy[:, 0]))
        whole[felt] = np.nan_to_num(_over(energy, energy[:, 0]))
    return whole, np.clip(straight, 0.0, 1.0)


def build(
    grain: Grain,
    n: np.ndarray,
    effort: Effort,
    tolerance: float = TOLERANCE,
    threads: int = 1,
    fresnel: str = "un",
    told: Callable[[float, str], None] = lambda share, word: None,
) -> Family:
    """Return tables at as few indices as serve all of n.

    They are doubled until that changes g and B/n^2 nowhere by more than the tolerance and twice the noise, from two at
    the ends up to `MOST_STEPS` + 1.

    Parameters
    ----------
    grain : Grain
    n : (w,) float64
        Refractive indices that are asked for.
    effort : Effort
        For each table.
    tolerance : float
        Of g and of B/n^2 [1].
    threads : int
    fresnel : {"un", "sp"}
        Polarisations averaged, or kept apart (sphere only).
    told : callable
        Called with the share done, in [0, 1], and a word about it.
    """
    effort = effort if effort.cells else replace(effort, cells=256)  # the same for all, so that masses can be mixed
    low, high = float(n.min()), float(n.max())

    def table(eta: float, share: float, step: float) -> Table:
        word = f"table at n = {eta:.5g}"
        told(share, word)
        optics = Optics(eta, fresnel)
        if grain.kind == "sphere":
            return exact_sphere(grain, optics, effort)
        made = Build.start(grain, optics, effort)
        made.run(grain, threads, report=lambda done: told(share + step * done.paths / max(done.total or 1, 1), word))
        return made.table()

    if high - low < SAME:
        return Family((table(0.5 * (low + high), 0.0, 1.0),))
    made: dict[float, Table] = {}
    steps, family = 1, None
    while True:
        fresh = [eta for eta in points(low, high, steps).tolist() if not any(abs(eta - e) < SAME for e in made)]
        for count, eta in enumerate(fresh):
            made[eta] = table(eta, count / len(fresh), 1.0 / len(fresh))
        family = Family.of(list(made.values()))
        if steps >= MOST_STEPS or (steps > 1 and _converged(family, low, high, tolerance)):
            return family
        steps *= 2


def _converged(family: Family, low: float, high: float, tolerance: float) -> bool:
    """Tell whether leaving out every other table changes little."""
    n = np.linspace(low, high, 65)
    here, there = family.weights(n), family.coarser(n)
    assert there is not None
    b = np.array([table.absorption_enhancement for table in family.tables]) / family.eta[:, None] ** 2
    g = np.array([(t.statistics["mean_cosine"], t.header["standard_errors"]["mean_cosine"]) for t in family.tables])
    return all(
        (np.abs((here - there) @ values) <= tolerance + 2.0 * np.sqrt((here - there) ** 2 @ errors**2)).all()
        for values, errors in (b.T, g.T)
    )
