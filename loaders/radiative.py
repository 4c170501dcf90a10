"""Single scattering for radiative transfer programs: TARTES, SNICAR, DISORT, Eradiate, and phase functions as text.

Each takes what it can of the same spectrum. What goes straight on by diffraction is in TARTES' and SNICAR's numbers,
whose extinction efficiency is 2, and not in the others', where it would only be cut off again. The numbers themselves
are `tsdf.study.spectra`'s; netCDF files are of version 3 (`scipy.io`), which every reader of them reads.

[1] Libois et al. 2013, doi:10.5194/tc-7-1803-2013; Picard & Libois 2024 (TARTES 2)
[2] Flanner et al. 2021, doi:10.5194/gmd-14-7673-2021 (SNICAR-ADv3)
"""

import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tsdf.data.phase import parted, phase_text
from tsdf.errors import UsageError
from tsdf.files import replacing
from tsdf.scene.sizes import InWords
from tsdf.study.spectra import Family, Spectrum, moments_of, wavelength_heads

ICE_DENSITY = 917.0  # [kg/m^3] that TARTES takes
BANDS_NM = 205.0 + 10.0 * np.arange(480)  # [nm] of SNICAR
REFERENCE_N = 1.3  # at which TARTES wants B and g
FORWARD_CELLS = 1e-4  # [1] width in cos theta over which an atom is spread where a reader wants densities
NARROW = 1e-9  # [1] angles nearer in cos theta are one


@dataclass(frozen=True, eq=False)
class Request:
    """What is written: tables of one grain, what it does to light by wavelength, its sizes in metres, and notes.

    orders: highest Legendre moment, where moments are written.
    """

    family: Family
    found: Spectrum
    words: InWords
    notes: tuple[str, ...]
    orders: int = 128

    def known(self, what: str) -> None:
        """Refuse a spectrum whose absorption is not known.

        Raises
        ------
        UsageError
        """
        unknown = np.isnan(self.found.absorption_times_radius)
        if unknown.any():
            c = self.found.constants
            raise UsageError(
                f"{what} needs k, and that of {c.material} is not known at {c.wavelength_nm[unknown][0]:g} nm: give a "
                "file of constants that has it, or other wavelengths"
            )


def projected_area_per_mass(words: InWords) -> float:
    """Return the mean shadow of grains over their mass [m^2/kg].

    Raises
    ------
    UsageError
        If the density of the material is not known.
    """
    solid = words.sizes.material_density
    if solid is None:
        raise UsageError("mass needs the density of the material, which is not known: say --material-density [kg/m3]")
    return 0.75 / (words.sizes.effective_radius * words.radius * solid)


def tartes(request: Request) -> str:
    """Return a Python program that gives TARTES [1] this snow and prints its albedo.

    TARTES takes one g and one B, those of n = 1.3 without absorption, with diffraction; its specific surface area
    is 3 over density and effective radius, which is the true one of convex grains alone.
    """
    request.known("TARTES")
    found, words = request.found, request.words
    c = found.constants
    eta = request.family.eta
    at = np.array([min(max(REFERENCE_N, eta[0]), eta[-1]) if len(eta) > 1 else eta[0]])
    weights = request.family.weights(at)[0]
    g = float(weights @ [table.mean_cosine() for table in request.family.tables])
    b = float(weights @ [table.absorption_enhancement.value for table in request.family.tables])
    area = 3.0 / (ICE_DENSITY * words.sizes.effective_radius * words.radius)
    density = words.density
    lines = [f"# {note}" for note in request.notes]
    lines += [
        f"# g and B at n = {at[0]:.5g}, where TARTES wants those of 1.3; g with diffraction, (1 + {g:.5f}) / 2",
        "import numpy as np",
        "import tartes",
        "",
        f"wavelength = np.array({_list(c.wavelength_nm * 1e-9)})  # [m]",
        f"refrac_index = (np.array({_list(c.n)}), np.array({_list(c.k)}))",
        "snow = dict(",
        f"    SSA={area:.9g},  # [m2/kg] 3 / (917 effective radius)",
        f"    density={300.0 if density is None else density:.9g},  # [kg/m3], which does not matter to a half-space",
        '    shape_parameterization="constant",',
        f"    g0={0.5 * (1.0 + g):.9g},",
        f"    B0={b:.9g},",
        "    refrac_index=refrac_index,",
        ")",
        "",
        'if __name__ == "__main__":',
        "    for nm, albedo in zip(1e9 * wavelength, np.atleast_1d(tartes.albedo(wavelength, **snow))):",
        '        print(f"{nm:g} {albedo:.5f}")',
    ]
    return "\n".join(lines) + "\n"


def disort(request: Request) -> str:
    """Return albedo, Legendre moments and extinction by wavelength as JSON, in the names of PythonicDISORT.

    `leg_coeffs` (w, N + 1) are moments without the factor 2 l + 1, as DISORT's PMOM; `f` the share delta-M cuts off if
    all moments below the last are used. Light that diffraction sends straight on is not in them.
    """
    found = request.found
    lossless = np.isnan(found.albedo)
    whole, atom = moments_of(request.family, found, request.orders)
    albedo = np.where(lossless, 1.0, found.albedo)
    facts: dict[str, object] = {
        "notes": list(request.notes),
        "wavelength_nm": found.constants.wavelength_nm.tolist(),
        "omega": albedo.tolist(),
        "omega_error": [None if math.isnan(e) else float(e) for e in found.error("albedo")],
        "leg_coeffs": np.round(whole, 9).tolist(),
        "f": parted(whole, atom, "delta-m").straight.tolist(),
        "atom": atom.tolist(),
    }
    if request.words.sizes.material_density is not None:
        facts["extinction_m2_per_kg"] = projected_area_per_mass(request.words)
    if lossless.any():
        facts["notes"] = [*request.notes, "omega is 1 where k is not known"]
    return json.dumps(facts) + "\n"


def phase(request: Request) -> str:
    """Return phase functions by wavelength as text, mean over the sphere 1."""
    found = request.found
    edges, masses = request.family.masses(found)
    heads = wavelength_heads(found.constants) if found.constants.material else ["p"]
    return phase_text(edges, masses, heads, request.notes)


def write_snicar(request: Request, path: str | os.PathLike[str]) -> None:
    """Write the netCDF file of one grain size that SNICAR [2] reads: its 480 bands, with diffraction, Q_ext = 2.

    Raises
    ------
    UsageError
        If the spectrum is not that of `BANDS_NM`, or absorption or mass are not known.
    """
    request.known("SNICAR")
    found = request.found
    if not np.array_equal(found.constants.wavelength_nm, BANDS_NM):
        raise UsageError("SNICAR's 480 bands are 205:4995:10 nm: leave --wavelength-nm out")
    extinction = 2.0 * projected_area_per_mass(request.words)
    g = np.where(found.albedo > 0.0, found.g_far, 1.0)
    columns = {
        "wvl": (BANDS_NM * 1e-9, "m", "wavelength"),
        "ss_alb": (found.albedo_far, "1", "single-scattering albedo, with diffraction"),
        "asm_prm": (g, "1", "asymmetry parameter, with diffraction"),
        "ext_cff_mss": (np.full(480, extinction), "m2 kg-1", "mass extinction coefficient, Q_ext = 2"),
        "ss_alb_error": (found.error("albedo_far"), "1", "its error"),
        "asm_prm_error": (np.nan_to_num(found.error("g_far")), "1", "its error"),
    }
    with replacing(path) as temporary:
        _netcdf(temporary, {"wvl": 480}, {name: (("wvl",), *rest) for name, rest in columns.items()}, request.notes)


def write_eradiate(request: Request, path: str | os.PathLike[str]) -> None:
    """Write an Eradiate particle dataset (particle_dataset_v1, Aer v1): geometrical optics, extinction 1 per km.

    Phase functions are linear between angles there, so an atom straight on or back becomes a ramp of 1e-4 in cos theta.

    Raises
    ------
    UsageError
        If absorption is not known.
    """
    request.known("Eradiate")
    found = request.found
    edges, masses = request.family.masses(found)
    mu, density = _linear(edges, masses)
    w = len(found.albedo)
    with replacing(path) as temporary:
        _netcdf(
            temporary,
            {"w": w, "mu": len(mu), "i": 1, "j": 1},
            {
                "w": (("w",), found.constants.wavelength_nm, "nm", "wavelength"),
                "mu": (("mu",), mu, "dimensionless", "scattering_angle_cosine"),
                "i": (("i",), np.zeros(1), "dimensionless", "row"),
                "j": (("j",), np.zeros(1), "dimensionless", "column"),
                "sigma_t": (("w",), np.ones(w), "km^-1", "air_volume_extinction_coefficient"),
                "albedo": (("w",), found.albedo, "dimensionless", "single_scattering_albedo"),
                "phase": (
                    ("w", "mu", "i", "j"), density[:, :, None, None] / (4.0 * math.pi), "steradian^-1",
                    "scattering_phase_matrix",
                ),
            },
            request.notes,
        )  # fmt: skip


def _linear(edges: np.ndarray, masses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return angles' cosines (m,) and densities (w, m) linear between them, mean over the sphere 1, with the atoms.

    Each cell keeps its mean: values at its ends are between its neighbours' means, and at most twice either of them, in
    its middle is what is then left. An atom is a ramp over `FORWARD_CELLS`, however many cells lie there.
    """
    inner = edges[1:-1]
    width = np.diff(inner)
    wide = width > NARROW
    low, high = inner[:-1][wide], inner[1:][wide]
    mean = 2.0 * masses[:, 1:-1][:, wide] / width[wide]
    between = np.minimum(0.5 * (mean[:, 1:] + mean[:, :-1]), 2.0 * np.minimum(mean[:, 1:], mean[:, :-1]))
    ends = np.concatenate([mean[:, :1], between, mean[:, -1:]], axis=1)
    middle = 2.0 * mean - 0.5 * (ends[:, 1:] + ends[:, :-1])
    mu, values = [], []
    for k in range(len(low)):
        mu += [low[k], 0.5 * (low[k] + high[k])]
        values += [ends[:, k], middle[:, k]]
    cosines, density = np.array([*mu, 1.0]), np.stack([*values, ends[:, -1]], axis=1)
    for atom, side in ((masses[:, -1], 1.0), (masses[:, 0], -1.0)):
        at = side * (1.0 - FORWARD_CELLS)
        there = np.stack([np.interp(at, cosines, row) for row in density])
        place = int(np.searchsorted(cosines, at))
        if not np.any(np.abs(cosines - at) < NARROW):
            cosines, density = np.insert(cosines, place, at), np.insert(density, place, there, axis=1)
        ramp = np.maximum((side * cosines - 1.0) / FORWARD_CELLS + 1.0, 0.0)
        density = density + 4.0 / FORWARD_CELLS * atom[:, None] * ramp
    whole = 0.5 * ((density[:, 1:] + density[:, :-1]) * np.diff(cosines)).sum(axis=1) / 2.0
    return cosines, density / np.maximum(whole, 1e-300)[:, None]


def _netcdf(
    path: object, dimensions: dict[str, int], variables: dict[str, tuple[tuple[str, ...], np.ndarray, str, str]],
    notes: Sequence[str],
) -> None:  # fmt: skip
    """Write float64 variables: dimensions, values, units and name of each."""
    from scipy.io import netcdf_file

    with netcdf_file(os.fspath(path), "w", version=2) as file:  # type: ignore[call-overload]
        file.history = "\n".join(notes).encode("utf-8")
        for name, size in dimensions.items():
            file.createDimension(name, size)
        for name, (of, values, units, long_name) in variables.items():
            variable = file.createVariable(name, "f8", of)
            variable[:] = values
            variable.units, variable.standard_name = units.encode(), long_name.encode()


def _list(values: np.ndarray) -> str:
    return "[" + ", ".join(f"{value:.9g}" for value in values) + "]"


TEXTS = {"tartes": tartes, "disort": disort, "phase": phase}
FILES = {"snicar": write_snicar, "eradiate": write_eradiate}
