"""``--absorption``: an absorption coefficient with its unit.

Two conventions are about: per length, as scenes and Mitsuba have it (`absorption`), and times the bounding radius R, as
tables have it (`absorption_times_radius`), which needs no length. A number says which it is by its unit.
"""

import math
from collections.abc import Sequence

from tsdf.cli.common import plain
from tsdf.errors import UsageError

METRES = {"nm": 1e-9, "um": 1e-6, "mm": 1e-3, "cm": 1e-2, "m": 1.0, "km": 1e3}
FORM = "X/R (coefficient times bounding radius), X/unit (per scene unit) or X/mm (nm, um, mm, cm, m, km)"


def times_radius(
    text: str | None, radius: float | None, unit: float | None, colours: bool = False
) -> tuple[float, ...]:
    """Return the absorption coefficient times the bounding radius that an option states [1], one or one per colour.

    Parameters
    ----------
    text : str or None
        A number or, with `colours`, three, and behind a slash the unit: R, unit, or one of `METRES`. Without it, R.
    radius : float or None
        Bounding radius R [scene unit].
    unit : float or None
        Length of the scene unit [m].
    colours : bool
        Whether three numbers are taken: red, green, blue.

    Raises
    ------
    UsageError
        For what is no such text, and a unit whose length is not known.
    """
    if text is None:
        return (0.0,)
    numbers_text, slash, name = (part.strip() for part in text.partition("/"))
    try:
        numbers = tuple(float(word) for word in numbers_text.split(","))
    except ValueError:
        numbers = ()
    counts = (1, 3) if colours else (1,)
    known = ("R", "unit", *METRES) if slash else ("",)
    if len(numbers) not in counts or not all(0.0 <= x < math.inf for x in numbers) or name not in known:
        several = ", X one finite number >= 0" + (" or three (R,G,B)" if colours else "")
        raise UsageError(f"--absorption is {FORM}{several}, not {plain(text)!r}")
    if name in ("", "R"):
        return numbers
    if radius is None or (name in METRES and unit is None):
        length = "" if name == "unit" else " and --unit, the length of that unit in metres"
        raise UsageError(f"--absorption {plain(text)} needs --radius, the bounding radius in scene units{length}")
    by = radius if name == "unit" else radius * (unit or 1.0) / METRES[name]
    products = tuple(x * by for x in numbers)
    if not all(math.isfinite(x) for x in products):
        raise UsageError(f"--absorption {plain(text)} times the bounding radius is out of the range of numbers")
    return products


def conventions(products: Sequence[float], radius: float | None, unit: float | None) -> str:
    """Return an absorption coefficient, one number or one per colour, in every convention that the lengths allow.

    Parameters
    ----------
    products : sequence of float
        sigma_a R [1].
    radius : float or None
        Bounding radius R [scene unit].
    unit : float or None
        Length of the scene unit [m].
    """
    by = {"R": 1.0} | ({} if radius is None else {"unit": 1.0 / radius})
    by |= {} if radius is None or unit is None else {"m": 1.0 / (radius * unit)}
    different = products if len(set(products)) > 1 else products[:1]
    return " = ".join(f"{', '.join(f'{x * factor:.4g}' for x in different)} / {name}" for name, factor in by.items())
