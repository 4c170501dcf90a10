"""Consistency: what a table's header says about its pixels and about itself (codes ``STATISTICS_``)."""

import math

import numpy as np

from tsdf.judge import analytic
from tsdf.judge.court import MOMENTS, ROUNDING, SIGMAS, Gavel, Subject

LEDGER_ROUNDING = 1e-8  # hit_probability and albedo are quotients of integers
RECORD_EXCESS = 2.0  # records may scatter this many times more than unrelated draws
DROPPED, DROPPED_MUCH = 1e-6, 1e-4


def judge_statistics(gavel: Gavel, t: Subject) -> None:
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


def _stated_errors(gavel: Gavel, t: Subject) -> None:
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


def _block_bounds(t: Subject, name: str) -> tuple[float, float]:
    """Return the least and the largest mean that the masses of a block allow."""
    edges, share = t.table.edges(name), t.table.block(name).astype(np.float64) @ t.p
    return float(edges[:-1] @ share), float(edges[1:] @ share)


def _means(gavel: Gavel, t: Subject) -> None:
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


def _moments(gavel: Gavel, t: Subject) -> None:
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


def _factorisation(gavel: Gavel, t: Subject) -> None:
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


def judge_records(gavel: Gavel, t: Subject) -> None:
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
        if block == "p_z":
            values = values + 1e-9  # a reflection, z = 0, may be a rounding error less, and counts in the cell above
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


def judge_memory(gavel: Gavel, t: Subject) -> None:
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
    names = {"cos_theta": ("mean_cosine", 2.0), "r": ("mean_r", 2.0), "z": ("mean_z", 3.0)}  # and how far they reach
    names["l"] = "mean_path_length", 2.0
    for name, (statistic, reach) in names.items():
        values = memory[name].astype(np.float64)
        means = values.mean(axis=0)
        mean = float(weight @ means)
        variance = values.var(axis=0) + float(weight @ ((values - mean) ** 2).mean(axis=0)) / distinct
        error = float((weight**2 * variance / distinct).sum()) * RECORD_EXCESS
        error += float((doubt * (means - mean) ** 2).sum()) / hit.sum() ** 2
        # light so rare that no record need be of it, by exp(-SIGMAS^2 / 2), has no variance here
        error += (0.5 * SIGMAS * reach * float((weight / distinct).max())) ** 2
        slack = SIGMAS * math.sqrt(error) + t.noise(statistic) + ROUNDING
        slack += 2.0 * (unlit + t.dropped) * float(np.abs(values).max())
        pointer, what = f"/blocks/{place[f'memory_{name}']}", f"the mean of memory_{name}"
        gavel.near("STATISTICS_MEMORY", pointer, what, mean, t.s[statistic], slack)
