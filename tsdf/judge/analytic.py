"""Analytic answers: geometrical optics of the dielectric sphere, and theorems for any grain.

Nothing here traces a ray or reads a table, and nothing of the package is imported but its errors: this
module judges the rest. Lengths are in units of the sphere's radius, angles in radians, `eta` is
n_inside/n_outside. Conventions, order by order (p chords; p = 0 is the outer reflection):

* In the plane of incidence, +y is the side of the entry point. The signed deviation is
  pi - 2 theta_i - p (pi - 2 theta_t) = D + pi (1 - p), D = 2 (p theta_t - theta_i); its cosine is cos_theta.
* The offset exit - entry is 2 cos(theta_i + deviation/2) along the direction that halves the deviation, hence
  r = |z| tan(theta/2), and phi_delta is 0 where z > 0 and pi where z < 0.
* `fresnel="sp"` keeps s and p apart through all bounces, `"un"` averages the reflectance at every hit.

Rays are named by u, the larger of theta_i and theta_t: all else is analytic in it, for eta above and below 1.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial.legendre import leggauss, legval
from numpy.typing import ArrayLike, NDArray

from tsdf.compiled import njit
from tsdf.errors import UsageError

Array = NDArray[np.float64]

ROUNDING = 4.5e-16  # two units in the last place [1]
LEGENDRE_ORDERS = 17  # P_0 .. P_16
EXACT_ORDERS = 12  # orders whose cell masses are found by roots; the rest by intervals
LISTED_ORDERS = 32  # length of SphereStatistics.order_energy
MEAN_R_NODES = 65536
TAIL_INTERVALS = 16384
ETA = (0.01, 100.0)  # beyond, light stays inside for more orders than can be summed

# Panels of u: uniform, the last one halved again and again towards grazing, where the reflectance runs to 1.
_PANELS = np.concatenate([np.linspace(0, 1, 33)[:-1], 1 - 0.5 ** np.arange(6, 40), [1.0]]) * (np.pi / 2)
_NODES, _WEIGHTS = leggauss(12)

_jit = njit(cache=True, error_model="numpy")


# --- geometry and Fresnel of one ray ------------------------------------------------------------------------


@_jit
def _ray(u: float, eta: float) -> tuple[float, float, float, float]:
    """(theta_i, theta_t, cos theta_i, cos theta_t) of the ray named u."""
    c, s = np.cos(u), np.sin(u)
    if eta > 1:
        ct = np.sqrt((eta - 1) * (eta + 1) + c * c) / eta
        return u, np.arctan2(s, eta * ct), c, ct
    if eta < 1:
        ci = np.sqrt((1 - eta) * (1 + eta) + (eta * c) ** 2)
        return np.arctan2(eta * s, ci), u, ci, c
    return u, u, c, c


@_jit
def _fresnel(ci: Any, ct: Any, eta: float, apart: bool) -> tuple[Any, Any, Any, Any]:
    """Reflectance and transmittance of the two states that bounce independently: (R_1, R_2, T_1, T_2)."""
    rs = ((ci - eta * ct) / (ci + eta * ct)) ** 2
    rp = ((eta * ci - ct) / (eta * ci + ct)) ** 2
    ts = 4 * eta * ci * ct / (ci + eta * ct) ** 2  # not 1 - R: it must keep its digits at grazing
    tp = 4 * eta * ci * ct / (eta * ci + ct) ** 2
    if apart:
        return rs, rp, ts, tp
    r, t = (rs + rp) / 2, (ts + tp) / 2
    return r, r, t, t


@_jit
def _energy(u: float, p: int, eta: float, apart: bool, absorption: float) -> float:
    """Share of the ray's energy that leaves after p chords."""
    _, _, ci, ct = _ray(u, eta)
    r1, r2, t1, t2 = _fresnel(ci, ct, eta, apart)
    if p == 0:
        return (r1 + r2) / 2
    both = t1 * t1 * r1 ** (p - 1) + t2 * t2 * r2 ** (p - 1)
    return both / 2 * np.exp(-2 * p * absorption * ct)


@_jit
def _turn(u: float, p: int, eta: float) -> tuple[float, float, float]:
    """D = 2 (p theta_t - theta_i), dD/du, and the size of D's terms (for its rounding error)."""
    ti, tt, ci, ct = _ray(u, eta)
    if eta >= 1:
        slope = 2 * (p * ci / (eta * ct) - 1)
    else:
        slope = 2 * (p - eta * ct / ci)
    return 2 * (p * tt - ti), slope, 2 * (p * tt + ti)


@_jit
def _extremum(p: int, eta: float) -> float:
    """u at which D of order p turns round, or pi/2 where it never does."""
    if eta <= 1 or p <= eta or p < 2:
        return np.pi / 2
    return np.arctan2(np.sqrt((p - eta) * (p + eta)), np.sqrt((eta - 1) * (eta + 1)))


@_jit
def _solve(t: float, p: int, eta: float, lo: float, hi: float, rising: bool, u: float) -> float:
    """u in [lo, hi] with D(u) = t: Newton from the guess u, halving the bracket where Newton leaves it."""
    for _ in range(100):
        d, slope, size = _turn(u, p, eta)
        f = d - t
        if abs(f) <= ROUNDING * size:
            break
        if (f > 0) == rising:
            hi = u
        else:
            lo = u
        new = u - f / slope
        if not lo < new < hi:
            new = (lo + hi) / 2
        if new == u:
            break
        u = new
    return u


@_jit
def _root(t: float, p: int, eta: float, a: float, b: float, da: float, db: float, turns_at_a: bool) -> float:
    """Root of D = t on the monotone piece [a, b], guessed from a parabola with its apex at one end."""
    if turns_at_a:
        guess = a + (b - a) * np.sqrt((t - da) / (db - da))
    else:
        guess = b - (b - a) * np.sqrt((db - t) / (db - da))
    return _solve(t, p, eta, a, b, db > da, guess)


# --- phase function -----------------------------------------------------------------------------------------


@_jit
def _phase(theta: Array, eta: float, apart: bool, absorption: float, orders: int) -> Array:
    density = np.zeros(theta.size)
    disc = min(1.0, eta * eta)  # b^2 = disc sin^2 u
    for p in range(1, orders):
        top = _extremum(p, eta)
        for piece in range(2):
            a, b = (0.0, top) if piece == 0 else (top, np.pi / 2)
            if not b > a:
                continue
            da, db = _turn(a, p, eta)[0], _turn(b, p, eta)[0]
            lo, hi = min(da, db), max(da, db)
            for i in range(theta.size):
                s = theta[i] if p % 2 == 1 else np.pi - theta[i]
                sin_theta = np.sin(min(theta[i], np.pi - theta[i]))
                for sign in (1, -1):
                    if sign == -1 and sin_theta == 0:
                        continue  # +s and -s are the same angle
                    turns = np.ceil((lo - sign * s) / (2 * np.pi))
                    while sign * s + 2 * np.pi * turns <= hi:
                        t = sign * s + 2 * np.pi * turns
                        turns += 1
                        if t == 0 and piece == 0:  # the central ray: sin(2u)/sin(theta) -> 2/|D'|
                            slope = _turn(0.0, p, eta)[1]
                            density[i] += 4 * disc * _energy(0.0, p, eta, apart, absorption) / slope**2
                            continue
                        u = _root(t, p, eta, a, b, da, db, piece == 1)
                        flux = 2 * disc * np.sin(2 * u) * _energy(u, p, eta, apart, absorption)
                        if flux > 0:
                            density[i] += flux / (sin_theta * abs(_turn(u, p, eta)[1]))
    return density


def phase_function(
    theta: ArrayLike, eta: float, fresnel: str = "un", absorption: float = 0.0, orders: int = 101
) -> Array:
    """Near-field phase function of the sphere, normalised to 4 pi (its density in cos_theta is half of it).

    Every ray of every order that leaves at theta is found as a root on a monotone piece of the deviation.

    Parameters
    ----------
    theta : array_like of float64
        Deflection in [0, pi] [rad].
    eta : float
        Relative refractive index, > 0 [1].
    fresnel : {"un", "sp"}
        Reflectance averaged at each hit, or polarisations kept apart.
    absorption : float
        Absorption coefficient inside times R, >= 0 [1]. The result is divided by the albedo.
    orders : int
        Orders 0 .. orders - 1 are summed, >= 1. What is left out is not made up for: at eta 1.33, 1e-7 of
        the energy beyond 101 orders; it falls with the cube of their number, the time grows with its square.

    Returns
    -------
    ndarray of float64, shape of theta
        P(theta) [1]. It is infinite at a rainbow and, with more than a few orders, at exactly 0 and pi, where
        off-axis rays are focused (glory). At eta = 1 all light is an atom: infinite at theta = 0, else 0.

    Raises
    ------
    UsageError
        An argument is out of its domain.

    References
    ----------
    Zhou, Li & Stamnes 2003, Applied Optics 42(21), 4295: the sum over orders. Roots and limits: derived here.
    """
    angles, shape = _array("theta", theta, 0.0, np.pi)
    apart = _check(eta, fresnel, absorption)
    if isinstance(orders, bool) or not isinstance(orders, int | np.integer) or orders < 1:
        raise UsageError(f"orders must be a whole number of at least 1, not {orders!r}")
    if eta == 1:
        return np.where(angles == 0, np.inf if orders > 1 else 0.0, 0.0).reshape(shape)
    rs, rp = fresnel_reflectance(np.sin(angles / 2), eta)  # p = 0: theta_i = (pi - theta)/2, and P_0 is R
    density = (rs + rp) / 2 + _phase(angles, float(eta), apart, float(absorption), int(orders))
    return (density / _moments(float(eta), apart, float(absorption)).albedo).reshape(shape)


def rainbow_angles(eta: float, orders: ArrayLike) -> Array:
    """Deflection at which each order has its rainbow, an integrable infinity of the phase function.

    Parameters
    ----------
    eta : float
        Relative refractive index, > 0 [1].
    orders : array_like of int
        Numbers of chords p, >= 0; the primary bow is p = 2.

    Returns
    -------
    ndarray of float64, shape of orders
        Folded deflection in [0, pi] [rad]; nan where the deviation has no extremum: p < 2, p <= eta or
        eta <= 1.

    Raises
    ------
    UsageError
        An argument is out of its domain.

    Notes
    -----
    cos^2 theta_i = (eta^2 - 1)/(p^2 - 1), from d(deviation)/d(theta_i) = 0.
    """
    _check(eta, "un", 0.0)
    p = np.asarray(orders)
    if not np.issubdtype(p.dtype, np.integer) or np.any(p < 0):
        raise UsageError("orders must be whole numbers of at least 0")
    out = np.full(p.shape, np.nan)
    for index, order in np.ndenumerate(p):
        top = _extremum(int(order), float(eta))
        if top < np.pi / 2:
            turn = _turn(top, int(order), float(eta))[0] + np.pi * (1 - order)
            out[index] = abs((turn + np.pi) % (2 * np.pi) - np.pi)
    return out


# --- statistics ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SphereStatistics:
    """Averages over the light that leaves the sphere, weighted by energy; lengths in R.

    Attributes
    ----------
    albedo : float
        Energy that leaves over energy that met the sphere [1].
    mean_cosine, mean_z, mean_r, mean_path_length : float
        g [1], and the means of z, r and the length inside the material [R].
    atom_forward, atom_backward : float
        Share deflected by exactly 0 or pi [1]: none, except that all of it is forward at eta = 1.
    order_energy : (32,) float64
        Energy that leaves after p = 0 .. 31 chords, over the energy that met the sphere [1].
    legendre : (17,) float64
        Means of the Legendre polynomials P_0 .. P_16 of cos_theta [1].
    """

    albedo: float
    mean_cosine: float
    mean_z: float
    mean_r: float
    mean_path_length: float
    atom_forward: float
    atom_backward: float
    order_energy: Array
    legendre: Array


class _Moments(NamedTuple):
    albedo: float
    mean_z: float
    mean_path_length: float
    order_energy: Array
    legendre: Array


def _moments(eta: float, apart: bool, absorption: float) -> _Moments:
    """All means but that of r: Gauss quadrature over u of geometric series summed over the orders."""
    half = np.diff(_PANELS)[:, None] / 2
    u = (_PANELS[:-1, None] + half * (1 + _NODES)).ravel()
    measure = (half * _WEIGHTS).ravel() * min(1.0, eta * eta) * np.sin(2 * u)  # d(b^2)
    ti, tt, ci, ct = (np.array(a) for a in zip(*(_ray(v, eta) for v in u), strict=True))
    r1, r2, t1, t2 = _fresnel(ci, ct, eta, apart)
    decay = np.exp(-2 * absorption * ct)
    reflect, transmit = np.stack([r1, r2]), np.stack([t1, t2])
    entering, ratio = transmit**2 * decay, reflect * decay
    lost = transmit - reflect * np.expm1(-2 * absorption * ct)  # 1 - ratio, without cancellation

    def mean(integrand: Array) -> float:
        return float((integrand.mean(axis=0) * measure).sum())

    def wave(m: int) -> Array:  # sum over the orders of energy times exp(-i m p (pi - 2 theta_t))
        step = np.exp(-1j * m * (np.pi - 2 * tt))
        return reflect + entering * step / (1 - ratio * step)

    energy = reflect + entering / lost
    harmonics = [mean(energy)]
    harmonics += [mean((wave(m) * np.exp(1j * m * (np.pi - 2 * ti))).real) for m in range(1, LEGENDRE_ORDERS)]
    z = mean((wave(1) * np.exp(1j * (np.pi - ti))).real + ci * energy)
    length = mean(2 * ct * entering / lost**2)
    orders = [mean(reflect)] + [mean(entering * ratio ** (p - 1)) for p in range(1, LISTED_ORDERS)]

    # P_n(cos x) = sum_k a_k a_(n-k) cos((n - 2k) x), a_k = (2k)!/(2^k k!)^2
    a = np.cumprod([1.0] + [(2 * k - 1) / (2 * k) for k in range(1, LEGENDRE_ORDERS)])
    legendre = np.array(
        [sum(a[k] * a[n - k] * harmonics[abs(n - 2 * k)] for k in range(n + 1)) for n in range(LEGENDRE_ORDERS)]
    )
    if eta < 1:  # b > eta: all is reflected, and cos_theta = 2 b^2 - 1
        gap = 1 - eta * eta
        cosine = 1 - gap * (1 - _NODES)
        legendre += gap / 2 * (legval(cosine, np.eye(LEGENDRE_ORDERS)) * _WEIGHTS).sum(axis=1)
        orders[0] += gap
    albedo = float(legendre[0])
    return _Moments(albedo, z / albedo, length / albedo, np.array(orders), legendre / albedo)


@_jit
def _sum_r(eta: float, apart: bool, absorption: float, nodes: int) -> float:
    """Mean of energy times r over b^2: the middle rule, whose end terms vanish; it leaves out < 4e-12.

    r is the modulus of the y component, sin(theta_i + deviation) - sin(theta_i).
    """
    h, total = np.pi / 2 / nodes, 0.0
    for k in range(nodes):
        u = (k + 0.5) * h
        ti, tt, ci, ct = _ray(u, eta)
        r1, r2, t1, t2 = _fresnel(ci, ct, eta, apart)
        decay = np.exp(-2 * absorption * ct)
        w1, w2 = t1 * t1 * decay / 2, t2 * t2 * decay / 2
        step = np.exp(-1j * (np.pi - 2 * tt))
        at, height = np.exp(1j * (np.pi - ti)), np.sin(ti)
        measure, per_ray = np.sin(2 * u), 0.0
        while (w1 / t1 + w2 / t2) * measure > 1e-12:
            at *= step
            per_ray += (w1 + w2) * abs(at.imag - height)
            w1 *= r1 * decay
            w2 *= r2 * decay
        total += per_ray * measure
    return total * h * min(1.0, eta * eta)


def sphere_statistics(eta: float, fresnel: str = "un", absorption: float = 0.0) -> SphereStatistics:
    """Averages over all light that leaves the sphere, to about 1e-12 (mean_r 1e-10).

    Parameters
    ----------
    eta : float
        Relative refractive index, > 0 [1].
    fresnel : {"un", "sp"}
        Reflectance averaged at each hit, or polarisations kept apart.
    absorption : float
        Absorption coefficient inside times R, >= 0 [1].

    Returns
    -------
    SphereStatistics

    Raises
    ------
    UsageError
        An argument is out of its domain.

    Notes
    -----
    At a given entry point the energy, every harmonic of the deviation, z and the path length are geometric
    series in the order; they are summed exactly and integrated over the entry points by Gauss's rule. r, a
    modulus, is summed order by order.

    Examples
    --------
    >>> round(sphere_statistics(1.33).mean_cosine, 6)
    0.766749
    """
    apart = _check(eta, fresnel, absorption)
    m = _moments(float(eta), apart, float(absorption))
    r = 0.0 if eta == 1 else _sum_r(float(eta), apart, float(absorption), MEAN_R_NODES) / m.albedo
    atom = 1.0 if eta == 1 else 0.0
    return SphereStatistics(
        m.albedo, float(m.legendre[1]), m.mean_z, r, m.mean_path_length, atom, 0.0, m.order_energy, m.legendre
    )


# --- masses -------------------------------------------------------------------------------------------------


@_jit
def _integral(a: float, b: float, p: int, eta: float, apart: bool, absorption: float) -> float:
    """Energy of order p from the rays a <= u <= b, a short interval."""
    total = 0.0
    for k in range(_NODES.size):
        u = (a + b) / 2 + (b - a) / 2 * _NODES[k]
        total += _WEIGHTS[k] * np.sin(2 * u) * _energy(u, p, eta, apart, absorption)
    return total * (b - a) / 2 * min(1.0, eta * eta)


@_jit
def _cumulative(p: int, eta: float, apart: bool, absorption: float) -> Array:
    """Energy of order p from the rays below each panel edge."""
    out = np.zeros(_PANELS.size)
    for k in range(_PANELS.size - 1):
        out[k + 1] = out[k] + _integral(_PANELS[k], _PANELS[k + 1], p, eta, apart, absorption)
    return out


@_jit
def _energy_below(u: float, sums: Array, p: int, eta: float, apart: bool, absorption: float) -> float:
    k = max(int(np.searchsorted(_PANELS, u, side="right")) - 1, 0)
    return sums[k] + _integral(_PANELS[k], u, p, eta, apart, absorption)


@_jit
def _low_orders(cosines: Array, eta: float, apart: bool, absorption: float) -> Array:
    """Energy of the orders up to EXACT_ORDERS in each cell: roots at the cell edges, Gauss between them."""
    n = cosines.size - 1
    mass = np.zeros(n)
    sums = _cumulative(0, eta, apart, absorption)
    last = 0.0
    for j in range(n + 1):  # p = 0: cos_theta = 2 b^2 - 1
        b2 = (1 + cosines[j]) / 2
        if eta >= 1:
            u, total = (np.pi - np.arccos(cosines[j])) / 2, 0.0
        else:
            u, total = np.arcsin(min(1.0, np.sqrt(b2) / eta)), max(0.0, b2 - eta * eta)
        total += _energy_below(u, sums, 0, eta, apart, absorption)
        if j > 0:
            mass[j - 1] += total - last
        last = total

    for p in range(1, EXACT_ORDERS + 1):
        sums = _cumulative(p, eta, apart, absorption)
        # D folded to [0, pi] is theta for odd p and pi - theta for even p
        edges = np.arccos(cosines)[::-1] if p % 2 == 1 else np.arccos(-cosines)
        top = _extremum(p, eta)
        for piece in range(2):
            a, b = (0.0, top) if piece == 0 else (top, np.pi / 2)
            if not b > a:
                continue
            da, db = _turn(a, p, eta)[0], _turn(b, p, eta)[0]
            lo, hi = min(da, db), max(da, db)
            at = lo
            below = _energy_below(a if da < db else b, sums, p, eta, apart, absorption)
            for half in range(int(np.floor(lo / np.pi)), int(np.floor(hi / np.pi)) + 1):
                for step in range(n):
                    if half % 2 == 0:
                        j, end = step, half * np.pi + edges[step + 1]
                    else:
                        j = n - 1 - step
                        end = (half + 1) * np.pi - edges[j]
                    if end <= at:
                        continue
                    end = min(end, hi)
                    if end == hi:
                        u = b if da < db else a
                    else:
                        u = _root(end, p, eta, a, b, da, db, piece == 1)
                    reached = _energy_below(u, sums, p, eta, apart, absorption)
                    mass[n - 1 - j if p % 2 == 1 else j] += abs(reached - below)
                    below, at = reached, end
                    if at == hi:
                        break
    return mass


@_jit
def _spread(weight: Array, start: Array, stop: Array, cosines: Array) -> Array:
    """Weights shared out over cells, each evenly over its own interval of cos_theta."""
    n = cosines.size - 1
    mass = np.zeros(n)
    for i in range(weight.size):
        lo, hi = min(start[i], stop[i]), max(start[i], stop[i])
        j = min(np.searchsorted(cosines, lo, side="right") - 1, n - 1)
        while j > 0 and cosines[j + 1] == cosines[j]:
            j -= 1  # an atom at 1 takes nothing
        if hi <= cosines[j + 1]:
            mass[j] += weight[i]
            continue
        while j < n and cosines[j] < hi:
            mass[j] += weight[i] * (min(hi, cosines[j + 1]) - max(lo, cosines[j])) / (hi - lo)
            j += 1
    return mass


def deflection_masses(cos_theta_edges: ArrayLike, eta: float, fresnel: str = "un", absorption: float = 0.0) -> Array:
    """Probability that light which leaves the sphere does so in each cell of cos_theta.

    Parameters
    ----------
    cos_theta_edges : (n + 1,) array_like of float64
        Cell edges in [-1, 1], ascending; a cell of zero width is an atom.
    eta : float
        Relative refractive index, > 0 [1].
    fresnel : {"un", "sp"}
        Reflectance averaged at each hit, or polarisations kept apart.
    absorption : float
        Absorption coefficient inside times R, >= 0 [1].

    Returns
    -------
    (n,) float64
        Mass of each cell [1]; they sum to 1 where the edges span [-1, 1]. Atoms hold 0, except at eta = 1,
        where all of it lies in the last cell that ends at 1.

    Raises
    ------
    UsageError
        An argument is out of its domain.

    Notes
    -----
    Orders 0 to 12 are exact: edges are carried back to entry points by root finding, the energy between them
    integrated by Gauss's rule. The rest, under 1e-4 of the energy at eta 1.33, comes from intervals of entry
    points, each order of an interval spread evenly over the cos_theta it covers. Time and memory grow as
    the sphere keeps its light (eta > 4, eta < 0.2).
    """
    edges, shape = _array("cos_theta_edges", cos_theta_edges, -1.0, 1.0)
    if len(shape) != 1 or edges.size < 2 or np.any(np.diff(edges) < 0):
        raise UsageError("cos_theta_edges must be an ascending row of at least two numbers")
    apart = _check(eta, fresnel, absorption)
    if eta == 1:
        mass = np.zeros(edges.size - 1)
        mass[-1] = edges[-1] == 1
        return mass
    padded = np.concatenate([[-1.0], edges, [1.0]])
    mass = _low_orders(padded, float(eta), apart, float(absorption))
    tail = _list_events(float(eta), apart, float(absorption), TAIL_INTERVALS, EXACT_ORDERS + 1)[0]
    mass += _spread(tail[0], tail[1], tail[2], padded)
    return (mass / mass.sum())[1:-1]


# --- events -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SphereEvents:
    """The lossless sphere as a list of n events, each an interval of entry points and an order.

    Attributes
    ----------
    weight : (n,) float64
        Energy [1]; sums to 1 - residual.
    cos_theta_from, cos_theta_to : (n,) float64
        cos_theta at the interval's ends, monotone between them; `from` is the end nearer the axis.
    r, z : (n,) float64
        Offset across and along d_in, at the interval's middle as all below [R].
    phi_delta : (n,) float64
        Azimuth of the offset less that of d_out about d_in, exactly 0 or pi; 0 where r or sin(theta) is 0
        [rad].
    path_length : (n,) float64
        Length inside the material [R].
    entry_b2 : (n,) float64
        Impact parameter squared [R^2].
    entry_azimuth : (n,) float64
        Azimuth of d_out about d_in from the entry point's side: 0 towards it, pi away from it [rad].
    order : (n,) float64
        Number of chords.
    residual : float
        Energy of the orders not listed [1]. They are high ones, near grazing: the mean path length over the
        list is short by about 1000 times the residual.
    """

    weight: Array
    cos_theta_from: Array
    cos_theta_to: Array
    r: Array
    z: Array
    phi_delta: Array
    path_length: Array
    entry_b2: Array
    entry_azimuth: Array
    order: Array
    residual: float


@_jit
def _events(
    edges: Array, eta: float, apart: bool, absorption: float, first: int, floor: float
) -> tuple[Array, int, float]:
    """Rows of SphereEvents, order >= first and weight >= floor, of rays that can enter; count; energy left.

    The parts of an interval split by a rainbow or a fold keep the energies of its middle: the sum is exact.
    """
    out = np.empty((10, 4 * edges.size + 64))
    count, residual = 0, 0.0
    disc = min(1.0, eta * eta)
    for k in range(edges.size - 1):
        left, right = edges[k], edges[k + 1]
        ti0, tt0, _, _ = _ray(left, eta)
        ti1, tt1, _, _ = _ray(right, eta)
        _, _, ci, ct = _ray((left + right) / 2, eta)
        r1, r2, t1, t2 = _fresnel(ci, ct, eta, apart)
        decay = np.exp(-2 * absorption * ct)
        energy = disc * np.sin(right - left) * np.sin(right + left)
        w1, w2 = r1 / 2, r2 / 2
        p = 0
        while p == 0 or (w1 + w2) * energy >= floor:
            if p >= first and w1 + w2 > 0:
                top = min(max(_extremum(p, eta), left), right)
                for piece in range(2):
                    a, b = (left, top) if piece == 0 else (top, right)
                    if not b > a:
                        continue
                    da = 2 * (p * tt0 - ti0) if a == left else _turn(a, p, eta)[0]
                    db = 2 * (p * tt1 - ti1) if b == right else _turn(b, p, eta)[0]
                    # stop where theta folds back, at multiples of pi between da and db, then at the end
                    low, high = np.floor(min(da, db) / np.pi) + 1, np.ceil(max(da, db) / np.pi) - 1
                    folds = max(0, int(high - low) + 1)
                    for step in range(folds + 1):
                        if step == folds:
                            end, d_end = b, db
                        else:
                            d_end = np.pi * (low + step if db > da else high - step)
                            guess = a + (b - a) * (d_end - da) / (db - da)
                            end = _solve(d_end, p, eta, a, b, db > da, guess)
                        if end > a:
                            if count == out.shape[1]:
                                bigger = np.empty((10, 2 * count))
                                for row in range(10):
                                    for i in range(count):
                                        bigger[row, i] = out[row, i]
                                out = bigger
                            middle = (a + end) / 2
                            ti, tt, ci, ct = _ray(middle, eta)
                            d = 2 * (p * tt - ti)
                            flip = 1.0 if p % 2 == 1 else -1.0
                            z = flip * np.cos(d + ti) + np.cos(ti)
                            r = abs(flip * np.sin(d + ti) - np.sin(ti))
                            if p == 0:
                                r = z = 0.0  # it leaves where it came: no rounding
                            aside = flip * np.sin(d)  # > 0: d_out leans to the entry point's side
                            share = disc * np.sin(end - a) * np.sin(end + a)
                            out[0, count] = (w1 + w2) * share
                            out[1, count] = flip * np.cos(da)
                            out[2, count] = flip * np.cos(d_end)
                            out[3, count] = r
                            out[4, count] = z
                            out[5, count] = np.pi if z < 0 and r > 0 and aside != 0 else 0.0
                            out[6, count] = 2 * p * ct
                            out[7, count] = disc * np.sin(middle) ** 2
                            out[8, count] = np.pi if aside < 0 else 0.0
                            out[9, count] = p
                            count += 1
                        a, da = end, d_end
            p += 1
            if p == 1:
                w1, w2 = t1 * t1 * decay / 2, t2 * t2 * decay / 2
            else:
                w1 *= r1 * decay
                w2 *= r2 * decay
        residual += (w1 / t1 + w2 / t2) * energy
    return out, count, residual


def _list_events(eta: float, apart: bool, absorption: float, intervals: int, first: int = 0) -> tuple[Array, float]:
    """`_events` with the floor that leaves out at most 5e-10 of the energy."""
    edges = np.linspace(0, np.pi / 2, intervals + 1)
    middle = (edges[1:] + edges[:-1]) / 2
    sines = np.sin(middle)
    larger, smaller = np.cos(middle), np.sqrt(1 - (sines * min(eta, 1 / eta)) ** 2)
    ci, ct = (larger, smaller) if eta >= 1 else (smaller, larger)
    _, _, t1, t2 = _fresnel(ci, ct, eta, apart)
    # below the floor, the tail of an interval holds at most floor/T
    floor = 5e-10 / (1 / np.minimum(t1, t2)).sum()
    rows, count, residual = _events(edges, eta, apart, absorption, first, floor)
    return rows[:, :count], residual


def sphere_events(eta: float, fresnel: str = "un", intervals: int = 65536) -> SphereEvents:
    """The lossless sphere as a deterministic list of events, for tabulating without random numbers.

    Parameters
    ----------
    eta : float
        Relative refractive index, > 0 [1]. The list has 1 million events (80 MB) at 1.33, 3.5 million at 3,
        and grows as the sphere keeps its light.
    fresnel : {"un", "sp"}
        Reflectance averaged at each hit, or polarisations kept apart.
    intervals : int
        Intervals of entry points that let light in, >= 1, even in the larger of theta_i and theta_t. They are
        split where the deviation turns round (rainbow) or folds (cos_theta = +-1).

    Returns
    -------
    SphereEvents
        residual is below 1e-9.

    Raises
    ------
    UsageError
        An argument is out of its domain.
    """
    apart = _check(eta, fresnel, 0.0)
    if isinstance(intervals, bool) or not isinstance(intervals, int | np.integer) or intervals < 1:
        raise UsageError(f"intervals must be a whole number of at least 1, not {intervals!r}")
    rows, residual = _list_events(float(eta), apart, 0.0, int(intervals))
    if eta < 1:  # b > eta: reflected as a whole; even steps of theta_i
        t = np.linspace(np.arcsin(eta), np.pi / 2, int(intervals) // 4 + 2)
        total = np.zeros((10, t.size - 1))
        total[0] = np.sin(np.diff(t)) * np.sin(t[1:] + t[:-1])
        total[1], total[2] = -np.cos(2 * t[:-1]), -np.cos(2 * t[1:])
        total[7] = np.sin((t[1:] + t[:-1]) / 2) ** 2
        rows = np.concatenate([rows, total], axis=1)
    weight, start, stop, r, z, phi, length, b2, azimuth, order = rows
    return SphereEvents(weight, start, stop, r, z, phi, length, b2, azimuth, order, float(residual))


class SpherePath(NamedTuple):
    """Where light leaves the sphere and whereto, in its plane of incidence; +y is the side of the entry point [1]."""

    along: Array  # part of d_out along d_in, which is cos_theta
    aside: Array  # and along y
    exit_along: Array  # parts of the outward normal where it leaves
    exit_aside: Array


def sphere_path(entry_b2: ArrayLike, order: ArrayLike, eta: float) -> SpherePath:
    """Return where light leaves the sphere and whereto, of n entry points and orders.

    Parameters
    ----------
    entry_b2 : (n,) array_like of float64
        Impact parameter squared, in [0, 1] [R^2].
    order : (n,) array_like of float64
        Number of chords; light with entry_b2 > eta^2 has none.
    eta : float
        Relative refractive index, > 0 [1].

    Returns
    -------
    SpherePath

    Raises
    ------
    UsageError
        An argument is out of its domain.
    """
    b2, _ = _array("entry_b2", entry_b2, 0.0, 1.0)
    p, _ = _array("order", order, 0.0, np.inf)
    _check(eta, "un", 0.0)
    b = np.sqrt(b2)
    # arctan2 keeps the digits at grazing that arcsin loses
    ti, tt = np.arctan2(b, np.sqrt(1 - b2)), np.arctan2(b, np.sqrt(np.maximum(eta * eta - b2, 0.0)))
    turn = 2 * (p * tt - ti)
    flip = np.where(p % 2 == 1, 1.0, -1.0)
    return SpherePath(flip * np.cos(turn), flip * np.sin(turn), flip * np.cos(turn + ti), flip * np.sin(turn + ti))


# --- Fresnel and theorems -----------------------------------------------------------------------------------


def fresnel_reflectance(cos_theta_i: ArrayLike, eta: float) -> tuple[Array, Array]:
    """Reflectances (R_s, R_p) of a flat face, for light that comes from outside.

    Parameters
    ----------
    cos_theta_i : array_like of float64
        Cosine of the angle of incidence, in [0, 1] [1].
    eta : float
        Index of the far side over the index of the near side, > 0 [1]; 1/eta for light from inside.

    Returns
    -------
    R_s, R_p : ndarray of float64, shape of cos_theta_i
        1 at grazing and beyond the critical angle, 0 everywhere at eta = 1 [1].

    Raises
    ------
    UsageError
        An argument is out of its domain.
    """
    ci, shape = _array("cos_theta_i", cos_theta_i, 0.0, 1.0)
    _check(eta, "un", 0.0)
    if eta == 1:
        return np.zeros(shape), np.zeros(shape)
    ct = np.sqrt(np.maximum(0.0, (eta - 1) * (eta + 1) + ci * ci)) / eta
    ci = np.where(ct == 0, 1.0, ci)  # total reflection: R is 1 whatever ci, and 0/0 where that is 0 too
    rs, rp, _, _ = _fresnel(ci, ct, float(eta), True)
    return rs.reshape(shape), rp.reshape(shape)


def henyey_greenstein(g: float, edges: Array) -> Array:
    """Return the mass of a Henyey-Greenstein lobe in each cell of cos theta.

    Parameters
    ----------
    g : float
        Mean cosine, in (-1, 1) [1].
    edges : (n + 1,) float64
        Cells of cos theta, ascending in [-1, 1].

    Returns
    -------
    (n,) float64
        Henyey & Greenstein 1941, integrated in closed form.
    """
    if abs(g) < 1e-9:
        return 0.5 * np.diff(edges)
    # 1/sqrt(1 + g^2 - 2 g mu), written so that mu = 1 and g near 1 keep their digits
    inverse = 1.0 / np.sqrt((1.0 - g) ** 2 + 2.0 * g * (1.0 - edges))
    return (1.0 - g * g) / (2.0 * g) * np.diff(inverse)


@dataclass(frozen=True)
class ConvexTheorems:
    """What holds for every convex grain, whatever its shape (Cauchy; Dirac's mean chord).

    Attributes
    ----------
    hit_probability : float
        beta = S/(4 pi R^2) [1].
    mean_chord_inside : float
        4V/S, of straight lines that meet the grain [length of the inputs].
    mean_chord_bounding : float
        4R/3, of all lines that meet the bounding sphere.
    """

    hit_probability: float
    mean_chord_inside: float
    mean_chord_bounding: float

    def hit_chord(self, missed_chord: float) -> float:
        """Mean bounding-sphere chord of rays that hit, from lambda_delta, that of rays that miss.

        From beta * hit + (1 - beta) * missed = 4R/3.
        """
        missed = (1 - self.hit_probability) * missed_chord
        return (self.mean_chord_bounding - missed) / self.hit_probability


def convex_theorems(area: float, volume: float, bounding_radius: float = 1.0) -> ConvexTheorems:
    """Exact averages of a convex grain.

    Parameters
    ----------
    area, volume : float
        Surface and volume of the grain, > 0 [length^2, length^3].
    bounding_radius : float
        Radius of its bounding sphere, > 0 [length].

    Returns
    -------
    ConvexTheorems

    Raises
    ------
    UsageError
        No convex body has these measures: not positive, a larger surface than the bounding sphere's, or more
        volume than the surface can hold (36 pi V^2 > S^3).
    """
    _measures(area, volume, bounding_radius)
    beta = area / (4 * np.pi * bounding_radius**2)
    if beta > 1 + 1e-9 or 36 * np.pi * volume**2 > area**3 * (1 + 1e-9):
        raise UsageError(f"no convex grain has area {area:g} and volume {volume:g} within radius {bounding_radius:g}")
    return ConvexTheorems(float(min(beta, 1.0)), 4 * volume / area, 4 * bounding_radius / 3)


def path_length_bound(area: float, volume: float, eta: float) -> float:
    """Largest mean path length inside a lossless convex grain lit isotropically, eta^2 4V/S.

    In equilibrium the radiance inside is eta^2 times that outside, on every path that light can reach from
    outside. For eta <= 1 it can reach all of them, and the bound is the mean itself; for eta > 1 the paths
    that total reflection traps stay dark, and it is an upper bound.

    Parameters
    ----------
    area, volume : float
        Surface and volume of the grain, > 0 [length^2, length^3].
    eta : float
        Relative refractive index, > 0 [1].

    Returns
    -------
    float
        Bound, per ray that meets the grain [length].

    Raises
    ------
    UsageError
        An argument is out of its domain.
    """
    _check(eta, "un", 0.0)
    _measures(area, volume)
    return eta * eta * 4 * volume / area


# --- arguments ----------------------------------------------------------------------------------------------


def _measures(*values: float) -> None:
    if not all(np.isfinite(v) and v > 0 for v in values):
        raise UsageError("area, volume and radius must be positive numbers")


def _check(eta: float, fresnel: str, absorption: float) -> bool:
    """Refuse what cannot be meant; True if the polarisations are kept apart."""
    try:
        values = float(eta), float(absorption)
    except (TypeError, ValueError):
        raise UsageError(f"eta and absorption must be numbers, not {eta!r} and {absorption!r}") from None
    if not (np.isfinite(values[0]) and values[0] > 0):
        raise UsageError(f"eta must be a positive number, not {eta!r}")
    if not ETA[0] <= values[0] <= ETA[1]:
        raise UsageError(
            f"a sphere of eta {eta:g} keeps light for too many orders to sum them: eta must be "
            f"{ETA[0]:g} to {ETA[1]:g}, or the sphere traced (tsdf-build sphere --traced)"
        )
    if not (np.isfinite(values[1]) and values[1] >= 0):
        raise UsageError(f"absorption must be a number of at least 0, not {absorption!r}")
    if fresnel not in ("un", "sp"):
        raise UsageError(f"fresnel must be 'un' or 'sp', not {fresnel!r}")
    return fresnel == "sp"


def _array(name: str, values: ArrayLike, lo: float, hi: float) -> tuple[Array, tuple[int, ...]]:
    """A flat contiguous copy of the values, all in [lo, hi], and their shape."""
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise UsageError(f"{name} must be numbers") from None
    if not np.all((array >= lo) & (array <= hi)):
        raise UsageError(f"{name} must lie in [{lo:g}, {hi:g}]")
    return array.ravel(), array.shape
