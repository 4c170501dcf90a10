"""Phase functions for those who know them by angle or by Legendre moments: what a table's deflections are, read so.

Deflections are uniform in cos theta within a cell, and the two atoms, straight on and straight back, are exactly that.
So moments of any order are exact sums over the cells; of an atom straight on each is its share, however high the order,
which no finite number of moments can hold: it is kept apart, or cut off as delta-M does (`Forward`).
"""

import io
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tsdf.data.table import Table
from tsdf.errors import UsageError

MOST_ORDERS = 1024  # of a Legendre moment
Forward = Literal["kept", "apart", "delta-m"]
FORWARDS: tuple[Forward, ...] = ("kept", "apart", "delta-m")


class Moments(NamedTuple):
    """Legendre moments of a phase function, of which a share that goes straight on is left out.

    moments (..., N + 1): of what is left, the first is 1. straight (...): share of the light that goes straight on.
    """

    moments: np.ndarray
    straight: np.ndarray


def legendre(edges: ArrayLike, masses: ArrayLike, orders: int) -> np.ndarray:
    """Return the means of P_0 .. P_orders over distributions of cos theta, (..., orders + 1) float64.

    Parameters
    ----------
    edges : (columns + 1,) float64
        Of cos theta, ascending from -1 to 1; cells of no width are atoms.
    masses : (..., columns) float64
        Of each cell, in which deflections are uniform.
    orders : int
        Highest order, 0 to `MOST_ORDERS`.

    Raises
    ------
    UsageError
        For an order out of range.
    """
    if not 0 <= orders <= MOST_ORDERS:
        raise UsageError(f"Legendre moments are of orders 0 to {MOST_ORDERS}, not {orders}")
    x, mass = np.asarray(edges, np.float64), np.asarray(masses, np.float64)
    width = np.diff(x)
    wide = width > 0.0
    before, here = np.zeros_like(x), np.ones_like(x)  # P_{n-1}, P_n at the edges
    means = np.zeros((*mass.shape[:-1], orders + 1))
    for n in range(orders + 1):
        after = ((2 * n + 1) * x * here - n * before) / (n + 1)
        # the integral of P_n is (P_{n+1} - P_{n-1}) / (2 n + 1); that of P_0 is P_1
        whole = np.diff(after - before) / (2 * n + 1)
        means[..., n] = mass @ np.where(wide, whole / np.where(wide, width, 1.0), here[1:])
        before, here = here, after
    return means


def moments(
    table: Table, orders: int = 128, absorption_times_radius: float = 0.0, forward: Forward = "kept"
) -> Moments:
    """Return the Legendre moments of a table's deflections.

    Parameters
    ----------
    table : Table
    orders : int
        Highest order, up to `MOST_ORDERS`.
    absorption_times_radius : float
        sigma_a R [1], >= 0.
    forward : {"kept", "apart", "delta-m"}
        What goes straight on: among the rest, apart from it as an atom, or as much as delta-M cuts off (Wiscombe 1977,
        doi:10.1175/1520-0469(1977)034<1408:TDMRYA>2.0.CO;2): the moment of order `orders`, which then is 0.
    """
    masses = table.deflection_masses(absorption_times_radius)
    return parted(legendre(table.cos_theta_edges, masses, orders), masses[..., -1], forward)


def parted(whole: np.ndarray, atom: ArrayLike, forward: Forward) -> Moments:
    """Return moments (..., N + 1) less what goes straight on, of which `atom` (...) is the share of the atom."""
    straight = np.zeros(whole.shape[:-1])
    if forward == "apart":
        straight = np.asarray(atom, np.float64) + straight
    elif forward == "delta-m":
        straight = np.clip(whole[..., -1], 0.0, 1.0)
    rest = 1.0 - straight[..., None]
    left = np.divide(whole - straight[..., None], rest, out=np.zeros_like(whole), where=rest > 0.0)
    left[..., 0] = 1.0
    return Moments(left, straight)


def phase_text(edges: np.ndarray, masses: np.ndarray, heads: Sequence[str], notes: Sequence[str] = ()) -> str:
    """Return phase functions as lines of an angle [deg] and a value for each, whose mean over the sphere is 1.

    Each line is the middle of a cell of theta, ascending; the mean over all directions is 1 together with the atoms,
    which are in comments, for they have no density. Two columns of cell edges let sums be exact.

    Parameters
    ----------
    edges, masses
        As of `legendre`, masses (phase functions, columns), atoms first and last.
    heads : sequence of str
        Name of each phase function.
    """
    theta = np.degrees(np.arccos(np.clip(edges, -1.0, 1.0)))[1:-1][::-1]
    density = 2.0 * masses[:, 1:-1] / np.diff(edges)[1:-1]
    text = io.StringIO()
    for line in (
        *notes,
        "phase function, mean over the sphere 1 together with the atoms, uniform in cos theta within a cell",
        "straight on (theta 0): " + " ".join(f"{mass:.8g}" for mass in masses[:, -1]),
        "straight back (theta 180): " + " ".join(f"{mass:.8g}" for mass in masses[:, 0]),
    ):
        text.write(f"# {line}\n")
    text.write(" ".join(("theta_deg", "low_deg", "high_deg", *heads)) + "\n")
    for low, high, values in zip(theta[:-1], theta[1:], density[:, ::-1].T, strict=True):
        numbers = " ".join(f"{value:.7g}" for value in values)
        text.write(f"{0.5 * (low + high):.6f} {low:.6f} {high:.6f} {numbers}\n")
    return text.getvalue()


def far_field(albedo: ArrayLike, g: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return albedo and mean cosine with diffraction: as much light again is scattered, all of it straight on.

    Q_ext is 2: w_far = (1 + w) / 2 and g_far = (1 + w g) / (1 + w); g where w is 0 does not matter.
    """
    w = np.asarray(albedo, np.float64)
    scattered = w * np.where(w > 0.0, np.asarray(g, np.float64), 0.0)
    return 0.5 * (1.0 + w), (1.0 + scattered) / (1.0 + w)
