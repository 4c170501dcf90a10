"""Pictures of spectra: single scattering, and albedo of slabs beside what theories say of them; see `plots`."""

import textwrap
from typing import Any

import numpy as np

from tsdf.study.plots import BAND, STYLE
from tsdf.study.slabs import Albedo
from tsdf.study.spectra import Spectrum

BLUE, RED, GREY = "#0072b2", "#d55e00", "#555555"  # Okabe & Ito 2008


def plot_spectrum(found: Spectrum, name: str) -> Any:
    """Return a matplotlib Figure of co-albedo, asymmetry factors and absorption enhancement by wavelength."""
    import matplotlib
    from matplotlib.figure import Figure

    nm = found.constants.wavelength_nm
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(10.0, 3.4), layout="constrained")
        left, middle, right = figure.subplots(1, 3)
        _band(left, nm, 1.0 - found.albedo, found.error("albedo"), BLUE, "1 − albedo, geometrical")
        left.set_yscale("log")
        left.set_ylabel("single-scattering co-albedo")
        for values, error, colour, label in (
            (found.g, found.error("g"), BLUE, "geometrical"),
            (found.g_far, found.error("g_far"), RED, "with diffraction"),
        ):
            _band(middle, nm, values, error, colour, label)
        middle.set_ylabel("asymmetry factor g")
        middle.legend(frameon=False)
        _band(right, nm, found.enhancement, found.error("enhancement"), BLUE, "B")
        right.plot(nm, found.constants.n**2, color=GREY, ls=":", label="n²")
        right.set_ylabel("absorption enhancement B")
        right.legend(frameon=False)
        for axes in (left, middle, right):
            axes.set_xlabel("wavelength [nm]")
        figure.suptitle(f"{name}, {found.constants.material}, R = {found.radius:.3g} m", fontsize=9.5)
    return figure


def plot_albedo(found: Albedo, nm: np.ndarray, title: str) -> Any:
    """Return a matplotlib Figure of reflectance and transmittance by wavelength, theories beside them, and profiles."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        profiled = len(found.profile) > 0
        figure = Figure(figsize=(10.5 if profiled else 7.0, 3.8), layout="constrained")
        axes, below = (grid := figure.subplots(2, 2 if profiled else 1, height_ratios=(2.2, 1.0), squeeze=False))[:, 0]
        passed = bool((found.transmittance > 1e-4).any())
        _band(axes, nm, found.reflectance, found.reflectance_error, BLUE, "reflectance, paths")
        if passed:
            _band(axes, nm, found.transmittance, found.transmittance_error, RED, "transmittance, paths")
        for theory, style, label in (
            (found.theories.doubled, "-", "doubling"),
            (found.theories.two_streams, "--", "two streams"),
            (found.theories.asymptotic, ":", "asymptotic"),
        ):
            axes.plot(nm, theory.reflectance, color=GREY, ls=style, lw=1.0, label=label)
            if passed:
                axes.plot(nm, theory.transmittance, color=GREY, ls=style, lw=1.0)
            below.plot(nm, theory.reflectance - found.reflectance, color=GREY, ls=style, lw=1.0)
        error = np.hypot(found.reflectance_error, found.theories.between)
        below.fill_between(nm, -error, error, color=BLUE, alpha=BAND, lw=0.0)
        below.set_ylabel("theory − paths")
        axes.set_ylabel("share of the light")
        axes.set_ylim(0.0, None)
        axes.legend(frameon=False, fontsize=7.5)
        below.set_xlabel("wavelength [nm]")
        figure.suptitle("\n".join(textwrap.wrap(title, 95 if profiled else 70)), fontsize=8.5)
        if profiled:
            _profiles(figure, grid, found, nm)
    return figure


def _profiles(figure: Any, grid: Any, found: Albedo, nm: np.ndarray) -> None:
    """Draw absorption by depth and wavelength, per R, over what is absorbed in all."""
    for one in grid[:, 1]:
        one.remove()
    axes = figure.add_subplot(grid[0, 0].get_gridspec()[:, 1])
    density = np.log10(np.maximum(found.profile, 1e-12) / np.diff(found.edges)[:, None])
    middle = 0.5 * (found.edges[1:] + found.edges[:-1])
    least = max(float(density.min()), float(density.max()) - 5.0)
    shown = axes.pcolormesh(nm, middle, density, cmap="viridis", vmin=least, shading="nearest")
    axes.invert_yaxis()
    axes.set_xlabel("wavelength [nm]")
    axes.set_ylabel("depth [R]")
    figure.colorbar(shown, ax=axes, label="log10 of the share absorbed per R")


def _band(axes: Any, x: np.ndarray, y: np.ndarray, error: np.ndarray, colour: str, label: str) -> None:
    axes.fill_between(x, y - error, y + error, color=colour, alpha=BAND, lw=0.0)
    axes.plot(x, y, color=colour, lw=1.2, label=label)
