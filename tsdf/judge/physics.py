"""Physics: what is known of a grain without tracing it (codes ``PHYSICS_``).

The exact sphere, the published curves of Zhou, Li & Stamnes 2003, and theorems.
"""

import math
from collections.abc import Mapping
from functools import cache
from importlib import resources
from typing import NamedTuple

import numpy as np

from tsdf.data.table import Table
from tsdf.judge import analytic, equilibrium
from tsdf.judge.court import ROUNDING, SIGMAS, Gavel, Subject

RECORD_ROUNDING = 2e-3  # [R] of float32 near grazing entry, as in SPEC.md; there is more of it the more chords
CHORD = 0.02  # shortest chord by which records of a sphere are judged [R]
STRAIGHT = 1e-5  # [rad] deflections that the tracer counts as none, or as straight back, as SPEC.md says
FINE = math.pi / 4096  # [rad] cells of theta in which the tracer counts
ZHOU_ETA = 1.333
ZHOU_CELLS = 0.01  # cell means of the published curve between its half degrees; 0.0065 measured
READING = 0.05  # of the circles in the printed figure: 4 % stated, and 1 px in doubt
BOW_DISTANCE = 2.0  # published curve and cell means agree this far from each rainbow [deg]


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


def _sphere_memory(gavel: Gavel, t: Subject) -> None:
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


@cache
def _sphere_truth(eta: float, fresnel: str) -> analytic.SphereStatistics:
    return analytic.sphere_statistics(eta, fresnel)


@cache
def _sphere_masses(edges: tuple[float, ...], eta: float, fresnel: str, traced: bool) -> np.ndarray:
    """Return the masses of cells and atoms; in atoms, if it was traced, what is deflected by less than STRAIGHT."""
    masses = analytic.deflection_masses(np.array(edges), eta, fresnel)
    if traced and eta != 1.0:
        nearly = math.cos(STRAIGHT)
        backward, _, forward = analytic.deflection_masses(np.array((-1.0, -nearly, nearly, 1.0)), eta, fresnel)
        masses[:2] += backward, -backward
        masses[-2:] += -forward, forward
    return masses


def judge_sphere(gavel: Gavel, t: Subject) -> None:
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
    edges = tuple(t.edges.tolist())
    masses = _sphere_masses(edges, t.eta, fresnel, not t.exact)
    expected |= {"atom_forward": float(masses[-1]), "atom_backward": float(masses[0])}
    code = "PHYSICS_SPHERE_STATISTICS"
    for name, value in expected.items():
        allowed = t.noise(name) + ROUNDING + t.dropped * lever.get(name, 2.0)
        gavel.near(code, f"/statistics/{name}", name, t.s[name], value, allowed)
    moments, errors = np.array(t.s["legendre_moments"]), np.array(t.se["legendre_moments"])
    pointer, slack = "/statistics/legendre_moments", np.full(len(moments), ROUNDING + 2.0 * t.dropped)
    if not t.exact:  # light within one fine cell counts as if spread over it, where P_l may have its greatest slope
        nearly, order = math.cos(FINE), np.arange(len(moments))
        ahead = _sphere_masses((-1.0, nearly, 1.0), t.eta, fresnel, False)[-1]
        slack = slack + 0.5 * order * (order + 1.0) * (1.0 - nearly) * float(ahead)
    gavel.all_near(code, pointer, "moment P_{}", moments, truth.legendre, SIGMAS * errors + slack)

    variation = 0.5 * float(np.abs(t.p - masses).sum())
    allowed, hint = t.variation_allowance(masses) + t.dropped, ""
    if variation > allowed:
        other = "un" if fresnel == "sp" else "sp"
        if 0.5 * float(np.abs(t.p - _sphere_masses(edges, t.eta, other, not t.exact)).sum()) <= allowed:
            hint = f" (it is that of the convention {other!r}, the header says {fresnel!r})"
    what = "total variation of p_theta to the exact sphere"
    gavel.near("PHYSICS_SPHERE_P_THETA", "/optics/fresnel", what, variation, 0.0, allowed, hint)
    _sphere_conditionals(gavel, t, fresnel, truth)
    _sphere_memory(gavel, t)
    if abs(t.eta - ZHOU_ETA) < ROUNDING:
        _zhou(gavel, t)


def _sphere_conditionals(gavel: Gavel, t: Subject, fresnel: str, truth: analytic.SphereStatistics) -> None:
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
    p, weight = t.p, events.weight
    if truth.atom_forward:
        column[:] = len(t.p) - 1
    elif not t.exact:  # what counts as not deflected has an azimuth of its own
        p, weight = np.r_[0.0, p[1:-1], 0.0], np.where(np.abs(middle) < math.cos(STRAIGHT), weight, 0.0)
    inside = np.bincount(group[column], weight, minlength=groups)
    held = np.bincount(group, p, minlength=groups)
    told = (held > 1e-4) & (inside > 1e-4)

    def by_group(values: np.ndarray) -> np.ndarray:
        return np.bincount(group, values * p, minlength=groups)[told] / held[told]

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
        reference_means = np.bincount(group[column], weight * exact, minlength=groups)[told]
        deviation = np.abs(by_group(values) - reference_means / inside[told])
        mean = float((deviation * held[told]).sum() / held[told].sum())
        allowed = half_cell + scale * (0.01 + 2.0 * SIGMAS * noise + t.dropped * 1e3)
        what = f"mean deviation of {name} by cos theta from the exact sphere"
        gavel.near(code, f"/blocks/{place[name]}", what, mean, 0.0, allowed)


def _zhou(gavel: Gavel, t: Subject) -> None:
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


def judge_theorems(gavel: Gavel, t: Subject) -> None:
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
