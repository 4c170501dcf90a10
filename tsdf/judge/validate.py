"""Is a table right? Its structure, its statistics against its pixels, and both against physics.

`validate` runs three parts: the structure (`format.check`), what the header says about the pixels and about
itself (codes ``STATISTICS_``), and what is known of the grain without tracing it (``PHYSICS_``): the exact sphere,
the published curves of Zhou, Li & Stamnes 2003, and theorems. An error is more than the table's own stated error
and its cells allow; limits are `SIGMAS` standard errors, so that an honest table passes. Where a table is too
noisy or too coarse to show a fault, nothing is said.
"""

import math
import os
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from typing import Any, NamedTuple

import numpy as np

from tsdf.data import format
from tsdf.data.table import Table
from tsdf.errors import Finding, FormatWarning
from tsdf.judge import analytic, equilibrium

# code: (severity, rule). The set is closed; SPEC.md, annex A, lists it and `golden/checks` breaks each one.
CODES = {
    "STATISTICS_METHOD": ("error", "an exact table is of a sphere and of 0 paths, a traced one of some"),
    "STATISTICS_LOSSLESS": ("error", "nothing was absorbed"),
    "STATISTICS_LEDGER": ("error", "hit_probability and albedo are those of the energy ledger within 1e-8"),
    "STATISTICS_DROPPED": ("warning", "at most 1e-6 of the light launched was truncated or lost"),
    "STATISTICS_DROPPED_MUCH": (
        "error",
        "at most 1e-4 of the light launched was truncated or lost",
    ),
    "STATISTICS_STANDARD_ERRORS": (
        "error",
        "standard errors are 0 in an exact table; in a traced one neither 0 nor above those of unrelated paths",
    ),
    "STATISTICS_TABLE_ERROR": (
        "error",
        "total_variation is the sum of its parts, sampling_noise is 0 if and only if the table is exact",
    ),
    "STATISTICS_ATOMS": ("error", "atom_forward and atom_backward are the masses of the outer columns"),
    "STATISTICS_MEANS": ("error", "mean_cosine, mean_r, mean_z and mean_path_length are those of the blocks"),
    "STATISTICS_LEGENDRE": ("error", "P_0 is 1, P_1 is mean_cosine, and all are those of p_theta"),
    "STATISTICS_FACTORISATION": ("error", "the offsets of factorisation_error are those of p_r and p_z"),
    "STATISTICS_FITS": ("error", "each fit is as far from p_theta as it states"),
    "STATISTICS_RECORDS": ("error", "the joint records are a sample of the conditionals of their column"),
    "STATISTICS_RECORD_SUPPORT": ("error", "no joint record lies where the conditionals have no mass"),
    "STATISTICS_MEMORY_HIT": ("error", "the mean of memory_hit is hit_probability"),
    "STATISTICS_MEMORY": (
        "error",
        "records by entry, as many as memory_hit says, have the mean cosine, r, z and l of the statistics",
    ),
    "PHYSICS_SPHERE_STATISTICS": ("error", "the statistics of a sphere are those of geometrical optics"),
    "PHYSICS_SPHERE_P_THETA": ("error", "p_theta of a sphere is that of geometrical optics"),
    "PHYSICS_SPHERE_PLANE": ("error", "phi_delta of a sphere is 0 or pi"),
    "PHYSICS_SPHERE_CONDITIONALS": (
        "error",
        "p_phi, p_r, p_z and p_l of a sphere are those of geometrical optics",
    ),
    "PHYSICS_SPHERE_MEMORY": ("error", "records by entry of a sphere are its rays, by geometrical optics"),
    "PHYSICS_ZHOU_CURVE": (
        "error",
        "at eta 1.333 p_theta follows Fig. 8 of Zhou et al. 2003, or its average",
    ),
    "PHYSICS_ZHOU_MONTE_CARLO": (
        "error",
        "at eta 1.333 p_theta meets the Monte Carlo results in that figure",
    ),
    "PHYSICS_HIT_PROBABILITY": ("error", "a convex grain is met as often as its surface says (Cauchy)"),
    "PHYSICS_CHORD": (
        "error",
        "chords of hits and misses agree with 4/3 R, the mean of all, and with the grain",
    ),
    "PHYSICS_PATH_LENGTH": (
        "error",
        "paths inside are no longer than equilibrium allows, as long in spheres, boxes, prisms and if eta <= 1",
    ),
    "PHYSICS_IDENTITY": ("error", "a grain of eta 1 lets light pass straight on"),
    "PHYSICS_RECIPROCITY": ("error", "joint records agree with their reversed paths: mean z is that of both"),
}
WAYS_OUT = {
    "STATISTICS_DROPPED": "trace more paths to be sure; mend the mesh, or raise --max-bounces",
    "STATISTICS_DROPPED_MUCH": "mend the mesh, or raise --max-bounces",
    "STATISTICS": "header and pixels do not belong together, build the table again",
    "PHYSICS": "the table does not show this grain at this eta, build it again or report the tracer",
}

SIGMAS = 5.0  # allowed standard errors; with 64 replicates, 1 in 200 000 exceeds them by chance
ROUNDING = 1e-6  # of float32 masses summed over the table, and of the oracles
LEDGER_ROUNDING = 1e-8  # hit_probability and albedo are quotients of integers
RECORD_EXCESS = 2.0  # records may scatter this many times more than unrelated draws
RECORD_ROUNDING = 2e-3  # [R] of float32 near grazing entry, as in SPEC.md; there is more of it the more chords
CHORD = 0.02  # shortest chord by which records of a sphere are judged [R]
DROPPED, DROPPED_MUCH = 1e-6, 1e-4
ZHOU_ETA = 1.333
ZHOU_CELLS = 0.01  # cell means of the published curve between its half degrees; 0.0065 measured
READING = 0.05  # of the circles in the printed figure: 4 % stated, and 1 px in doubt
BOW_DISTANCE = 2.0  # published curve and cell means agree this far from each rainbow [deg]
MOMENTS = 17


@dataclass(frozen=True)
class Report:
    """What `validate` found.

    Parameters
    ----------
    path : str
        The file, as it was named.
    findings : tuple of Finding
        What is broken, worst part first; empty for a sound table.
    parts : tuple of str
        The parts that ran: "structure", "statistics", "physics".
    checks : int
        Comparisons of numbers made in the last two.
    table : Table or None
        None if the structure is broken.
    """

    path: str
    findings: tuple[Finding, ...]
    parts: tuple[str, ...]
    checks: int
    table: Table | None

    @property
    def ok(self) -> bool:
        """Whether no error was found; warnings do not count."""
        return all(finding.severity != "error" for finding in self.findings)


def validate(path: str | os.PathLike[str], structure_only: bool = False) -> Report:
    """Return what is wrong with a file; nothing is raised for a file that cannot be read."""
    name = os.fspath(path)
    findings = tuple(format.check(path))
    if any(finding.severity == "error" for finding in findings):
        return Report(name, findings, ("structure",), 0, None)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FormatWarning)  # it is among the findings
        table = format.read(path)
    if structure_only:
        return Report(name, findings, ("structure",), 0, table)
    more, checks = judge(table)
    return Report(name, findings + more, ("structure", "statistics", "physics"), checks, table)


def judge(table: Table) -> tuple[tuple[Finding, ...], int]:
    """Return what statistics and physics have against a table, and how many comparisons were made."""
    gavel = _Judge()
    subject = _Subject.of(table)
    _statistics(gavel, subject)
    _records(gavel, subject)
    _memory(gavel, subject)
    if subject.kind == "sphere":
        _sphere(gavel, subject)
    _theorems(gavel, subject)
    return tuple(gavel.findings), gavel.checks


@cache
def reference(name: str) -> Mapping[str, np.ndarray]:
    """Return the columns of a CSV of ``reference_data`` by name, (n,) float64."""
    text = resources.files("tsdf.reference_data").joinpath(name).read_text("ascii")
    names, *rows = [line.split(",") for line in text.splitlines() if not line.startswith("#")]
    return dict(zip(names, np.array(rows, dtype=np.float64).T, strict=True))


class CurveMeans(NamedTuple):
    """A published curve and a table where they can be compared; see `zhou_curve`."""

    columns: np.ndarray  # (n,) int, columns of the table
    curve: np.ndarray  # (n,) mean of the curve over each
    table: np.ndarray  # (n,) mean of the table's phase function over each, normalised to 4 pi


def zhou_curve(table: Table) -> CurveMeans:
    """Return Fig. 8 of Zhou et al. 2003 averaged over the table's cells.

    Left out are cells wider than 6 degrees, those within 2 degrees of a rainbow of order 2 to 13, below 1 and
    above 177 degrees, where the curve is too steep for its half degrees. The averaged convention has the
    independently computed `P_un` in place of the figure's curve.
    """
    data = reference("gomsphere_n1333.csv")
    curve = data["PN_fine" if table.header["optics"]["fresnel"] == "sp" else "P_un"]
    edges = table.cos_theta_edges
    high, low = np.degrees(np.arccos(edges[:-1])), np.degrees(np.arccos(edges[1:]))
    usable = (high > low) & (low >= 1.0) & (high <= 177.0) & (high - low < 6.0)
    for bow in np.degrees(analytic.rainbow_angles(ZHOU_ETA, np.arange(2, 14))):
        usable &= (high < bow - BOW_DISTANCE) | (low > bow + BOW_DISTANCE)
    at = np.flatnonzero(usable)
    parts = (np.arange(64) + 0.5) / 64.0
    theta = np.degrees(np.arccos(edges[at, None] + np.diff(edges)[at, None] * parts))
    means = np.exp(np.interp(theta, data["theta_deg"], np.log(curve))).mean(axis=1)
    return CurveMeans(at, means, 2.0 * table.p_theta[at] / np.diff(edges)[at])


# --- the court ----------------------------------------------------------------------


@dataclass
class _Judge:
    """Compares, counts, and keeps what is wrong."""

    findings: list[Finding] = field(default_factory=list)
    checks: int = 0

    def require(self, ok: Any, code: str, pointer: str, message: str) -> bool:
        self.checks += 1
        if not ok:
            text = f"{message}; {WAYS_OUT.get(code) or WAYS_OUT[code.partition('_')[0]]}"
            self.findings.append(Finding(code, CODES[code][0], pointer, text))
        return bool(ok)

    def near(
        self,
        code: str,
        pointer: str,
        what: str,
        measured: float,
        expected: float,
        allowed: float,
        hint: str = "",
    ) -> bool:
        text = f"{what} is {measured:.9g}, expected {expected:.9g}, allowed +-{allowed:.3g}{hint}"
        return self.require(abs(measured - expected) <= allowed, code, pointer, text)

    def all_near(
        self,
        code: str,
        pointer: str,
        what: str,
        measured: np.ndarray,
        expected: np.ndarray,
        allowed: np.ndarray,
    ) -> None:
        """Compare a row of numbers and report the worst; `what` has a place for its index."""
        n = int(np.argmax(np.abs(measured - expected) - allowed))
        self.checks += len(measured) - 1
        hint = f", the worst of {len(measured)}"
        values = float(measured[n]), float(expected[n]), float(allowed[n])
        self.near(code, f"{pointer}/{n}", what.format(n), *values, hint)

    def within(self, code: str, pointer: str, what: str, measured: float, low: float, high: float) -> bool:
        text = f"{what} is {measured:.9g}, allowed from {low:.9g} to {high:.9g}"
        return self.require(low <= measured <= high, code, pointer, text)


@dataclass(frozen=True)
class _Subject:
    """A table with what every check needs of it."""

    table: Table
    header: Mapping[str, Any]
    s: Mapping[str, Any]  # statistics
    se: Mapping[str, Any]  # standard errors
    p: np.ndarray  # p_theta
    edges: np.ndarray
    middle: np.ndarray  # of the columns
    exact: bool
    kind: str
    eta: float
    dropped: float  # share of the light that met the grain and was truncated or lost

    @classmethod
    def of(cls, table: Table) -> "_Subject":
        header, edges, ledger = table.header, table.cos_theta_edges, table.header["energy_ledger"]
        met = ledger["launched"] - ledger["unscattered"]
        return cls(
            table=table,
            header=header,
            s=header["statistics"],
            se=header["standard_errors"],
            p=table.p_theta,
            edges=edges,
            middle=0.5 * (edges[1:] + edges[:-1]),
            exact=header["provenance"]["method"] == "exact",
            kind=header["grain"]["kind"],
            eta=float(header["optics"]["eta"]),
            dropped=(ledger["truncated"] + ledger["lost"]) / met if met else 0.0,
        )

    def noise(self, *names: str) -> float:
        """Return the allowance for the sampling noise of these statistics together."""
        return SIGMAS * math.fsum(self.se[name] for name in names)

    @property
    def column_errors(self) -> np.ndarray:
        """Standard error of each column of p_theta: that of counts, scaled to the stated noise, (columns,)."""
        spread = np.sqrt(np.maximum(self.p * (1.0 - self.p), 0.0))
        noise = self.header["table_error"]["sampling_noise"]
        return spread * (noise / (math.sqrt(0.5 / math.pi) * max(spread.sum(), 1e-300)))

    def variation_allowance(self, truth: np.ndarray) -> float:
        """Return the total variation to the truth that the stated noise explains.

        It states the mean; the sum of the columns' absolute errors scatters about it the less the more columns
        take part. A column that no path has reached does not show in it, but holds less than ten paths' light.
        """
        error, paths = self.column_errors, self.header["provenance"]["paths"]
        noise = self.header["table_error"]["sampling_noise"]
        scatter = math.sqrt(math.pi / 2.0 - 1.0) * math.sqrt((error**2).sum()) / max(error.sum(), 1e-300)
        unseen = np.minimum(truth, 10.0 / paths)[self.p == 0.0].sum() if paths else 0.0
        return float(noise * (1.0 + SIGMAS * scatter) + unseen + ROUNDING)


# --- statistics ---------------------------------------------------------------------


def _statistics(gavel: _Judge, t: _Subject) -> None:
    """The header against itself and against the pixels."""
    s, ledger = t.s, t.header["energy_ledger"]
    paths = t.header["provenance"]["paths"]
    sound = t.kind == "sphere" and paths == 0 if t.exact else paths > 0
    method = t.header["provenance"]["method"]
    message = f"method {method} with {paths} paths of a {t.kind}"
    gavel.require(sound, "STATISTICS_METHOD", "/provenance/method", message)
    absorbed = ledger["absorbed"]
    gavel.require(absorbed == 0, "STATISTICS_LOSSLESS", "/energy_ledger/absorbed", f"{absorbed} is absorbed, 0 allowed")

    launched, met = ledger["launched"], ledger["launched"] - ledger["unscattered"]
    for name, part, whole in (("hit_probability", met, launched), ("albedo", ledger["scattered"], met)):
        if gavel.require(whole > 0, "STATISTICS_LEDGER", "/energy_ledger", f"{name} has no light to be the share of"):
            pointer = f"/statistics/{name}"
            gavel.near("STATISTICS_LEDGER", pointer, name, s[name], part / whole, LEDGER_ROUNDING)
    ledger = t.header["energy_ledger"]
    dropped = (ledger["truncated"] + ledger["lost"]) / ledger["launched"] if ledger["launched"] else 0.0
    code = "STATISTICS_DROPPED_MUCH" if dropped > DROPPED_MUCH else "STATISTICS_DROPPED"
    limit = DROPPED_MUCH if dropped > DROPPED_MUCH else DROPPED
    what = "the share of light truncated or lost"
    gavel.within(code, "/energy_ledger", what, dropped, 0.0, limit)

    _stated_errors(gavel, t)
    for name, column in (("atom_backward", 0), ("atom_forward", -1)):
        mass = float(t.p[column])
        gavel.near("STATISTICS_ATOMS", f"/statistics/{name}", name, s[name], mass, ROUNDING)
    _means(gavel, t)
    _moments(gavel, t)
    _factorisation(gavel, t)
    inner, smeared = t.edges[1:-1], t.p[1:-1].copy()  # lobes have no atoms: theirs count in the cells beside them
    smeared[0] += t.p[0]
    smeared[-1] += t.p[-1]
    for name, stated in t.header["fits"].items():
        if name == "henyey_greenstein":
            masses = analytic.henyey_greenstein(stated["g"], inner)
        elif name == "two_lobe":
            first, second = (analytic.henyey_greenstein(stated[g], inner) for g in ("g1", "g2"))
            masses = stated["weight"] * first + (1.0 - stated["weight"]) * second
        else:
            continue
        variation = 0.5 * float(np.abs(masses - smeared).sum())
        pointer, what = f"/fits/{name}/total_variation", f"total variation of {name}"
        gavel.near("STATISTICS_FITS", pointer, what, stated["total_variation"], variation, 1e-4)


def _stated_errors(gavel: _Judge, t: _Subject) -> None:
    """Whether the stated errors can be what they are said to be."""
    code, met = "STATISTICS_STANDARD_ERRORS", t.header["provenance"]["paths"] * t.s["hit_probability"]
    scattering = ("mean_cosine", "mean_z", "mean_r", "mean_path_length")
    width = {"hit_probability": 1.0, "albedo": 1.0, "atom_forward": 1.0, "atom_backward": 1.0}
    width |= {"mean_cosine": 2.0, "mean_z": 3.0, "mean_r": 2.0}
    for name, error in t.se.items():
        if name == "legendre_moments" or name.startswith("x_"):
            continue
        pointer, what = f"/standard_errors/{name}", f"the standard error of {name}"
        if t.exact:
            gavel.near(code, pointer, what, error, 0.0, 0.0)
            continue
        certain = t.s[name] == 0.0 or (name == "mean_cosine" and t.s[name] == 1.0)  # a mirror; almost no boundary
        if name in scattering and t.eta != 1.0 and not certain:
            gavel.require(error > 0.0, code, pointer, f"{what} is 0 in a traced table")
        if name in width and met > 0.0:
            # no variance of a bounded quantity is larger than (range / 2)^2; 1.5 for the error of the error
            gavel.within(code, pointer, what, error, 0.0, 0.75 * width[name] / math.sqrt(met) + 1e-12)
    if t.exact:
        largest = max(t.se["legendre_moments"])
        gavel.near(code, "/standard_errors/legendre_moments", "the largest of them", largest, 0.0, 0.0)

    error = t.header["table_error"]
    total = error["sampling_noise"] + error["cell_width"]
    pointer, code = "/table_error/total_variation", "STATISTICS_TABLE_ERROR"
    gavel.near(code, pointer, "total_variation", error["total_variation"], total, 1e-9)
    noise, whole = error["sampling_noise"], t.p.max() == 1.0  # nothing is uncertain if one column holds all
    sound = noise == 0.0 if t.exact else noise > 0.0 or whole
    method = t.header["provenance"]["method"]
    message = f"sampling_noise is {noise:.3g} in a table of method {method}"
    gavel.require(sound, code, "/table_error/sampling_noise", message)


def _block_bounds(t: _Subject, name: str) -> tuple[float, float]:
    """Return the least and the largest mean that the masses of a block allow."""
    edges, share = t.table.edges(name), t.table.block(name).astype(np.float64) @ t.p
    return float(edges[:-1] @ share), float(edges[1:] @ share)


def _means(gavel: _Judge, t: _Subject) -> None:
    for name, block in (("mean_r", "p_r"), ("mean_z", "p_z")):
        # reversed paths are in the blocks and not in the header, hence the noise
        low, high = _block_bounds(t, block)
        slack = t.noise(name) + 10.0 * ROUNDING
        gavel.within("STATISTICS_MEANS", f"/statistics/{name}", name, t.s[name], low - slack, high + slack)
    lengths = t.table.p_l.astype(np.float64) * t.table.block("mean_l")
    mean = float(lengths.sum(axis=0) @ t.p)
    stated = t.s["mean_path_length"]
    # the quadrature that fills the exact blocks stops short of the last orders
    allowed = 10.0 * ROUNDING * max(stated, 1.0)
    gavel.near("STATISTICS_MEANS", "/statistics/mean_path_length", "mean_path_length", stated, mean, allowed)


def _moments(gavel: _Judge, t: _Subject) -> None:
    """Mean cosine and Legendre moments against the columns.

    Moving the light of a cell from where its mean density puts it costs at most the oscillation of P_n over the
    cell, and `cell_width` says how much light there is to move.
    """
    moments, errors = np.array(t.s["legendre_moments"]), np.array(t.se["legendre_moments"])
    code, pointer = "STATISTICS_LEGENDRE", "/statistics/legendre_moments"
    gavel.near(code, f"{pointer}/0", "moment P_0", moments[0], 1.0, 1e-9)
    gavel.near(code, f"{pointer}/1", "moment P_1", moments[1], t.s["mean_cosine"], 1e-9)
    theta = np.arccos(t.edges)
    fractions = np.linspace(0.0, 1.0, 65)
    samples = np.cos(theta[:-1, None] + np.diff(theta)[:, None] * fractions)
    values = np.polynomial.legendre.legvander(samples, MOMENTS - 1)
    oscillation = np.ptp(values, axis=1)
    weights = np.sin(theta[:-1, None] + np.diff(theta)[:, None] * fractions)
    weights[:, [0, -1]] *= 0.5  # trapezoids in theta
    weights = np.where(weights.sum(axis=1, keepdims=True) > 1e-12, weights, 1.0)
    means = np.einsum("cs,csn->cn", weights / weights.sum(axis=1, keepdims=True), values)
    means = t.p @ means
    moved = 1.5 * t.header["table_error"]["cell_width"] * oscillation.max(axis=0)
    noise = SIGMAS * np.maximum(errors, t.se["mean_cosine"])
    slack = np.minimum(t.p @ oscillation, moved + noise) + 100.0 * ROUNDING
    pointer_g, g = "/statistics/mean_cosine", t.s["mean_cosine"]
    gavel.near("STATISTICS_MEANS", pointer_g, "mean_cosine", g, float(means[1]), float(slack[1]))
    means[:2] = moments[:2]
    gavel.all_near(code, pointer, "moment P_{}", moments, means, slack)


def _factorisation(gavel: _Judge, t: _Subject) -> None:
    """What the header says of offsets, against the blocks that a sampler draws them from."""
    code, stated = "STATISTICS_FACTORISATION", t.header["factorisation_error"]
    r, z = t.table.edges("p_r"), t.table.edges("p_z")
    mass = (t.table.p_r.astype(np.float64) * t.p) @ t.table.p_z.astype(np.float64).T
    near_z = np.where((z[:-1] < 0.0) & (z[1:] > 0.0), 0.0, np.minimum(np.abs(z[:-1]), np.abs(z[1:])))
    least = np.hypot(r[:-1, None], near_z[None, :])
    most = np.hypot(r[1:, None], np.maximum(np.abs(z[:-1]), np.abs(z[1:]))[None, :])
    place, slack = "/factorisation_error", 10.0 * ROUNDING
    low, high = float((mass * least).sum()), float((mass * most).sum())
    value = stated["mean_offset_factorised"]
    gavel.within(code, f"{place}/mean_offset_factorised", "mean_offset_factorised", value, low - slack, high + slack)
    low, high = float(mass[least >= 2.0].sum()), float(mass[most > 2.0].sum())
    value = stated["impossible_offsets"]
    gavel.within(code, f"{place}/impossible_offsets", "impossible_offsets", value, low - slack, high + slack)
    # the mean of a length is no less than the length of the mean
    low = math.hypot(t.s["mean_r"], t.s["mean_z"]) - slack
    gavel.within(code, f"{place}/mean_offset", "mean_offset", stated["mean_offset"], low, 2.0 + slack)
    for name in ("total_variation", "total_variation_noise"):
        gavel.within(code, f"{place}/{name}", name, stated[name], 0.0, 1.0)


# --- joint records ------------------------------------------------------------------


def _records(gavel: _Judge, t: _Subject) -> None:
    """The joint records against the conditionals, and against reciprocity.

    The rank of a record in the cumulative distribution of its column is uniform. The squares of the mean ranks of
    all columns, summed, are their variances' sum for unrelated draws, and far more for records of another column.
    Records that share `entry_b2` are parts of one path, and count once.
    """
    joint = t.table.joint
    if not joint:
        return
    distinct = 1 + (np.diff(np.sort(joint["entry_b2"], axis=0), axis=0) != 0.0).sum(axis=0)
    drawn, columns = t.p > 0.0, np.arange(len(t.p))
    place = {block["name"]: i for i, block in enumerate(t.header["blocks"])}
    for name, block in (("r", "p_r"), ("z", "p_z"), ("phi_delta", "p_phi"), ("l", "p_l")):
        masses, edges = t.table.block(block).astype(np.float64), t.table.edges(block)
        values = joint[name].astype(np.float64)
        if block == "p_phi":
            values = np.where(values < edges[0], values + 2.0 * math.pi, values)
        cell = np.searchsorted(edges, values, side="right").astype(np.int32) - 1  # there may be many
        np.clip(cell, 0, len(masses) - 1, out=cell)
        if block == "p_l":
            cell = np.where(values <= 0.0, np.int32(0), np.maximum(cell, 1))
        pointer = f"/blocks/{place[f'joint_{name}']}"
        about = np.pad(masses, ((1, 1), (0, 0)), mode="wrap" if block == "p_phi" else "constant")
        about = about[2:] + about[1:-1] + about[:-2]  # float32 may round a record over an edge
        outside = int(np.count_nonzero((about == 0.0)[cell, columns] & drawn))
        text = f"{outside} of {values[:, drawn].size} values of joint_{name} lie where {block} is 0, 0 allowed"
        gavel.require(outside == 0, "STATISTICS_RECORD_SUPPORT", pointer, text)

        rank = (np.cumsum(masses, axis=0) - 0.5 * masses - 0.5)[cell, columns]
        variance = (1.0 - (masses**3).sum(axis=0)) / 12.0
        variance = np.where(drawn, variance, 0.0)
        total = float(variance.sum())
        if total < 1e-9:
            continue  # each column has but one cell
        mean = float((rank.mean(axis=0) ** 2 * distinct)[drawn].sum()) / total
        # of a bounded rank the fourth moment is at most 1/4 of the second; Bernstein's inequality
        spread = math.sqrt(float((2.0 * variance**2 + 0.25 * variance / distinct).sum()))
        limit = RECORD_EXCESS * (1.0 + (SIGMAS * spread + 0.1 * SIGMAS**2) / total)
        text = f"mean square deviation of joint_{name} from {block} [that of unrelated draws]"
        gavel.within("STATISTICS_RECORDS", pointer, text, mean, 0.0, limit)

    del values, cell  # large
    # (x_o - x_i) . d_in and, of the reversed path, (x_o - x_i) . d_out have the same mean at each theta
    theta = np.arccos(t.edges)
    sines = np.sin(0.5 * (theta[:-1] + theta[1:]))
    along, across = joint["z"].astype(np.float64), joint["r"] * np.cos(joint["phi_delta"].astype(np.float64))
    difference = along * (1.0 - np.cos(0.5 * (theta[:-1] + theta[1:]))) - across * sines
    variance = difference.var(axis=0)
    variance += t.p @ variance + np.where(distinct < 4, 4.0, 0.0)
    error = math.sqrt(float((t.p**2 * variance / distinct).sum()))
    turned = 0.5 * (theta[:-1] - theta[1:]) * np.hypot(along, across)  # cell width, no larger than this
    allowed = SIGMAS * error + float(t.p @ turned.mean(axis=0)) + ROUNDING
    mean = float(t.p @ difference.mean(axis=0))
    what = "mean z of the records less that of their reversed paths"
    gavel.near("PHYSICS_RECIPROCITY", f"/blocks/{place['joint_z']}", what, mean, 0.0, allowed)


# --- records by entry ---------------------------------------------------------------


def _memory(gavel: _Judge, t: _Subject) -> None:
    """The records by entry against the statistics, which the same light has."""
    memory = t.table.memory
    if not memory:
        return
    hit, paths = t.table.hit, t.header["provenance"]["paths"]
    place = {block["name"]: i for i, block in enumerate(t.header["blocks"])}
    # of rays that do not know of each other; a cell in which none entered says 0
    doubt = hit * (1.0 - hit) * len(hit) / paths if paths else np.zeros(len(hit))
    unlit = math.exp(-paths / len(hit)) if paths else 0.0
    allowed = t.noise("hit_probability") + SIGMAS * math.sqrt(doubt.mean() / len(hit)) + ROUNDING
    allowed += unlit + SIGMAS * math.sqrt(unlit / len(hit))
    pointer, what = f"/blocks/{place['memory_hit']}", "the mean of memory_hit"
    gavel.near("STATISTICS_MEMORY_HIT", pointer, what, float(hit.mean()), t.s["hit_probability"], allowed)
    if not hit.any():
        return

    weight = hit / hit.sum()
    distinct = 1 + (np.diff(memory["entry_b2"], axis=0) != 0.0).sum(axis=0)
    names = {"cos_theta": "mean_cosine", "r": "mean_r", "z": "mean_z", "l": "mean_path_length"}
    for name, statistic in names.items():
        values = memory[name].astype(np.float64)
        means = values.mean(axis=0)
        mean = float(weight @ means)
        variance = values.var(axis=0) + float(weight @ ((values - mean) ** 2).mean(axis=0)) / distinct
        error = float((weight**2 * variance / distinct).sum()) * RECORD_EXCESS
        error += float((doubt * (means - mean) ** 2).sum()) / hit.sum() ** 2
        slack = SIGMAS * math.sqrt(error) + t.noise(statistic) + ROUNDING
        slack += 2.0 * (unlit + t.dropped) * float(np.abs(values).max())
        pointer, what = f"/blocks/{place[f'memory_{name}']}", f"the mean of memory_{name}"
        gavel.near("STATISTICS_MEMORY", pointer, what, mean, t.s[statistic], slack)


def _sphere_memory(gavel: _Judge, t: _Subject) -> None:
    """Each record by entry is a ray of the sphere: a whole number of chords, in one plane, by Snell's law."""
    memory = {name: values.astype(np.float64).ravel() for name, values in t.table.memory.items()}
    if not memory:
        return
    b2 = np.clip(memory["entry_b2"], 0.0, 1.0)
    chord = 2.0 * np.sqrt(np.maximum(1.0 - b2 / t.eta**2, 0.0))
    told = (chord > CHORD) | (memory["l"] == 0.0)  # else float32 does not tell how many there are
    order = np.where(memory["l"] == 0.0, 0.0, np.rint(memory["l"] / np.maximum(chord, CHORD)))
    path = analytic.sphere_path(b2, order, t.eta)
    azimuth, sine = memory["entry_azimuth"], np.sqrt(np.maximum(1.0 - memory["cos_theta"] ** 2, 0.0))
    phi_p = memory["phi_delta"] + azimuth
    deviations = (
        memory["cos_theta"] - path.along,
        sine * np.cos(azimuth) - path.aside,
        sine * np.sin(azimuth),
        memory["z"] - np.sqrt(1.0 - b2) - path.exit_along,
        memory["r"] * np.cos(phi_p) + np.sqrt(b2) - path.exit_aside,
        memory["r"] * np.sin(phi_p),
        (memory["l"] - order * chord) / np.maximum(order, 1.0),
    )
    off = np.abs(deviations).max(axis=0) > RECORD_ROUNDING * (1.0 + 0.01 * order)
    count = int(np.count_nonzero(off & told))
    pointer = f"/blocks/{next(i for i, b in enumerate(t.header['blocks']) if b['name'] == 'memory_cos_theta')}"
    text = f"{count} of {int(told.sum())} records by entry are no ray of this sphere, 0 allowed"
    gavel.require(count == 0, "PHYSICS_SPHERE_MEMORY", pointer, text)


# --- physics ------------------------------------------------------------------------


@cache
def _sphere_truth(eta: float, fresnel: str) -> analytic.SphereStatistics:
    return analytic.sphere_statistics(eta, fresnel)


@cache
def _sphere_masses(edges: tuple[float, ...], eta: float, fresnel: str) -> np.ndarray:
    return analytic.deflection_masses(np.array(edges), eta, fresnel)


def _sphere(gavel: _Judge, t: _Subject) -> None:
    """The table of a sphere against geometrical optics."""
    if not analytic.ETA[0] <= t.eta <= analytic.ETA[1]:
        return  # a mirror, or nearly, of which theorems alone say what it does
    fresnel = t.header["optics"]["fresnel"]
    truth = _sphere_truth(t.eta, fresnel)
    # what the tracer dropped had travelled as far as its bounces go
    bounces = t.header["provenance"]["max_bounces"] or 0
    lever = {"mean_z": 3.0, "mean_r": 2.0, "mean_path_length": 2.0 * bounces + 2.0}
    expected = {"hit_probability": 1.0, "mean_miss_chord": 0.0}
    expected |= {
        name: getattr(truth, name) for name in ("albedo", "mean_cosine", "mean_z", "mean_r", "mean_path_length")
    }
    expected |= {"atom_forward": truth.atom_forward, "atom_backward": truth.atom_backward}
    code = "PHYSICS_SPHERE_STATISTICS"
    for name, value in expected.items():
        allowed = t.noise(name) + ROUNDING + t.dropped * lever.get(name, 2.0)
        gavel.near(code, f"/statistics/{name}", name, t.s[name], value, allowed)
    moments, errors = np.array(t.s["legendre_moments"]), np.array(t.se["legendre_moments"])
    pointer, slack = "/statistics/legendre_moments", ROUNDING + 2.0 * t.dropped
    gavel.all_near(code, pointer, "moment P_{}", moments, truth.legendre, SIGMAS * errors + slack)

    edges = tuple(t.edges.tolist())
    masses = _sphere_masses(edges, t.eta, fresnel)
    variation = 0.5 * float(np.abs(t.p - masses).sum())
    allowed, hint = t.variation_allowance(masses) + t.dropped, ""
    if variation > allowed:
        other = "un" if fresnel == "sp" else "sp"
        if 0.5 * float(np.abs(t.p - _sphere_masses(edges, t.eta, other)).sum()) <= allowed:
            hint = f" (it is that of the convention {other!r}, the header says {fresnel!r})"
    what = "total variation of p_theta to the exact sphere"
    gavel.near("PHYSICS_SPHERE_P_THETA", "/optics/fresnel", what, variation, 0.0, allowed, hint)
    _sphere_conditionals(gavel, t, fresnel, truth)
    _sphere_memory(gavel, t)
    if abs(t.eta - ZHOU_ETA) < ROUNDING:
        _zhou(gavel, t)


def _sphere_conditionals(gavel: _Judge, t: _Subject, fresnel: str, truth: analytic.SphereStatistics) -> None:
    """Conditional means over groups of columns; the whole distribution where only two values can be."""
    phi, edges = t.table.p_phi.astype(np.float64), t.table.edges("p_phi")
    straight = [int(np.searchsorted(edges, angle, side="right")) - 1 for angle in (0.0, math.pi)]
    aside = 1.0 - float(phi[straight].sum(axis=0) @ t.p)
    row = next(b["first_row"] for b in t.header["blocks"] if b["name"] == "p_phi")
    # atan2 puts a few rays that leave where they came, or straight on, anywhere
    what = "the share of light that does not leave in the plane of incidence"
    gavel.near("PHYSICS_SPHERE_PLANE", f"row {row}, column 0", what, aside, 0.0, 1e-5 + t.dropped)

    noise = t.header["table_error"]["sampling_noise"]
    code = "PHYSICS_SPHERE_CONDITIONALS"
    place = {block["name"]: i for i, block in enumerate(t.header["blocks"])}
    outer = float(t.table.p_l[0].astype(np.float64) @ t.p)
    allowed = SIGMAS * noise + 10.0 * ROUNDING + t.dropped
    what = "the share of light that was reflected outside"
    share = float(truth.order_energy[0])
    gavel.near(code, f"/blocks/{place['p_l']}", what, outer, share, allowed)

    events = analytic.sphere_events(t.eta, fresnel, 16384)
    middle = 0.5 * (events.cos_theta_from + events.cos_theta_to)
    inner = t.edges[1:-1]
    column = np.clip(np.searchsorted(inner, middle, side="right"), 1, len(inner) - 1)
    groups = np.minimum(len(t.p), 32)
    group = np.arange(len(t.p)) * groups // len(t.p)
    if truth.atom_forward:
        column[:] = len(t.p) - 1
    inside = np.bincount(group[column], events.weight, minlength=groups)
    held = np.bincount(group, t.p, minlength=groups)
    told = (held > 1e-4) & (inside > 1e-4)

    def by_group(values: np.ndarray) -> np.ndarray:
        return np.bincount(group, values * t.p, minlength=groups)[told] / held[told]

    tables = {
        "p_phi": (phi[straight[1]], np.where(events.phi_delta > 1.0, 1.0, 0.0), 1.0, 0.0),
        "p_l": (
            (t.table.p_l.astype(np.float64) * t.table.block("mean_l")).sum(axis=0),
            events.path_length,
            4.0,
            0.0,
        ),
    }
    for name, exact in (("p_r", events.r), ("p_z", events.z)):
        axis = t.table.edges(name)
        cell = 0.5 * (axis[1:] + axis[:-1])
        values = t.table.block(name).astype(np.float64).T @ cell
        tables[name] = (values, exact, 2.0, 0.5 * float(np.diff(axis).max()))
    for name, (values, exact, scale, half_cell) in tables.items():
        reference_means = np.bincount(group[column], events.weight * exact, minlength=groups)[told]
        deviation = np.abs(by_group(values) - reference_means / inside[told])
        mean = float((deviation * held[told]).sum() / held[told].sum())
        allowed = half_cell + scale * (0.01 + 2.0 * SIGMAS * noise + t.dropped * 1e3)
        what = f"mean deviation of {name} by cos theta from the exact sphere"
        gavel.near(code, f"/blocks/{place[name]}", what, mean, 0.0, allowed)


def _zhou(gavel: _Judge, t: _Subject) -> None:
    """The validation of Meng et al. 2015: Zhou et al. 2003, Fig. 8."""
    at, curve, mine = zhou_curve(t.table)
    if len(at) == 0:
        return
    row = "row 0, column"
    noise = 2.0 * 2.0 * SIGMAS * t.column_errors / np.maximum(np.diff(t.edges), 1e-300)  # of the phase function
    unseen = 0.0 if t.exact else 20.0 / t.header["provenance"]["paths"]
    noise += unseen / np.maximum(np.diff(t.edges), 1e-300)
    excess = np.abs(mine - curve) - ZHOU_CELLS * curve - noise[at]
    worst = int(np.argmax(excess))
    theta = math.degrees(math.acos(t.middle[at[worst]]))
    what = f"phase function at {theta:.1f} degrees, the worst of {len(at)} cells away from rainbows,"
    allowed = ZHOU_CELLS * curve[worst] + noise[at[worst]]
    gavel.near("PHYSICS_ZHOU_CURVE", f"{row} {at[worst]}", what, mine[worst], curve[worst], allowed)

    data, circles = reference("gomsphere_n1333.csv"), reference("zhou2003_fig8_montecarlo.csv")
    fresnel = t.header["optics"]["fresnel"]
    columns = np.clip(
        np.searchsorted(t.edges, np.cos(np.radians(circles["theta_deg"])), side="right") - 1, 0, len(t.p) - 1
    )
    excess, expected, allowances, indices = [], [], [], []
    for theta, circle, column in zip(circles["theta_deg"], circles["P_MC_digitised"], columns, strict=True):
        where = np.flatnonzero(at == column)
        if len(where) == 0:
            continue
        i = int(where[0])
        value = {name: float(np.interp(theta, data["theta_deg"], data[name])) for name in ("P_sp", "P_un")}
        # the circles keep the polarisations apart, and stand for a point where the table has a cell
        target = circle * curve[i] / value[f"P_{fresnel}"]
        allowed = (READING + abs(value["P_un"] / value["P_sp"] - 1.0) * (fresnel == "un")) * target
        expected.append(target)
        allowances.append(allowed + noise[column])
        excess.append(abs(mine[i] - target) - allowances[-1])
        indices.append(i)
    if excess:
        k = int(np.argmax(excess))
        theta = math.degrees(math.acos(t.middle[at[indices[k]]]))
        what = f"phase function at {theta:.1f} degrees, the worst of {len(excess)} circles of Fig. 8,"
        values = float(mine[indices[k]]), float(expected[k]), float(allowances[k])
        gavel.near("PHYSICS_ZHOU_MONTE_CARLO", f"{row} {at[indices[k]]}", what, *values)


def _theorems(gavel: _Judge, t: _Subject) -> None:
    """What holds for any lossless grain, and for any convex one (Cauchy; equilibrium of radiance)."""
    s, grain = t.s, t.header["grain"]
    area, volume, hit = float(grain["area"]), float(grain["volume"]), s["hit_probability"]
    if grain["convex"]:
        allowed = t.noise("hit_probability") + 1e-7
        expected = area / (4.0 * math.pi)
        pointer = "/statistics/hit_probability"
        gavel.near("PHYSICS_HIT_PROBABILITY", pointer, "hit_probability", hit, expected, allowed)
    if not (hit > 0.0):
        return

    # beta hit_chord + (1 - beta) miss_chord = 4/3, the mean chord of the sphere, [R]
    chord = (4.0 / 3.0 - (1.0 - hit) * s["mean_miss_chord"]) / hit
    blur = t.noise("mean_miss_chord") * (1.0 - hit) / hit
    blur += t.noise("hit_probability") * abs(s["mean_miss_chord"] - chord) / hit
    slack = blur + ROUNDING
    low = volume / math.pi / hit  # the mean chord inside the grain, of which its bounding sphere's is the larger part
    pointer, what = "/statistics/mean_miss_chord", "the mean chord of hits that follows from mean_miss_chord"
    gavel.within("PHYSICS_CHORD", pointer, what, chord, min(low, 2.0) - slack, 2.0 + slack)

    # in equilibrium the radiance inside is eta^2 times that outside, wherever light gets at all
    reached = equilibrium.reach(grain, t.eta)
    bound = t.eta**2 * volume / (math.pi * hit) * (1.0 if reached is None else reached)
    slack = t.noise("mean_path_length") + t.noise("hit_probability") * bound / hit
    slack += ROUNDING * max(bound, 1.0)
    bounces = t.header["provenance"]["max_bounces"] or 0
    low = 0.0 if reached is None else bound - slack - t.dropped * (2.0 * bounces + 2.0)
    pointer, mean = "/statistics/mean_path_length", s["mean_path_length"]
    gavel.within("PHYSICS_PATH_LENGTH", pointer, "mean_path_length", mean, low, bound + slack)

    if t.eta == 1.0:
        straight = {
            "mean_cosine": 1.0,
            "atom_forward": 1.0,
            "atom_backward": 0.0,
            "mean_r": 0.0,
            "mean_z": chord,
        }
        for name, value in straight.items():
            allowed = t.noise(name) + (blur if name == "mean_z" else 0.0) + 10.0 * ROUNDING
            gavel.near("PHYSICS_IDENTITY", f"/statistics/{name}", name, s[name], value, allowed)
