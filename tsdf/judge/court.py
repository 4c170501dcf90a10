"""Court of `validate`: the rules, what compares and keeps what is wrong, and a table with what every check needs."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tsdf.data.table import Table
from tsdf.errors import Finding

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
MOMENTS = 17


@dataclass
class Gavel:
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
class Subject:
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
    def of(cls, table: Table) -> "Subject":
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

        It states the mean; the sum of the columns' absolute errors scatters about it the less the more columns take
        part, of which one less is free, for they sum to 1; where one alone is, SIGMAS of it are allowed. A column no
        path has reached does not show in it, but holds less than ten paths' light.
        """
        error, paths = self.column_errors, self.header["provenance"]["paths"]
        noise = self.header["table_error"]["sampling_noise"]
        free = max(error.sum() ** 2 / max((error**2).sum(), 1e-300) - 1.0, 1.0)
        scatter = SIGMAS * math.sqrt(math.pi / 2.0 - 1.0)  # of the size of a normal error, over its mean
        beyond = scatter / math.sqrt(free) + (SIGMAS * math.sqrt(math.pi / 2.0) - 1.0 - scatter) / free
        unseen = np.minimum(truth, 10.0 / paths)[self.p == 0.0].sum() if paths else 0.0
        return float(noise * (1.0 + beyond) + unseen + ROUNDING)
