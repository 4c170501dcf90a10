"""Exports for radiative transfer programs: each through its own reader, where that is installed."""

import json
import math
import warnings
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from scipy.io import netcdf_file

import tsdf
from tsdf.cli import export as cli
from tsdf.data.phase import moments
from tsdf.data.table import Table
from tsdf.reference_data.make_checks import CHECKS

CUBE = CHECKS / "cube.tsdf.exr"


@pytest.fixture(scope="module")
def cube() -> Table:
    return tsdf.read(CUBE)


def run(*arguments: object, file: object = CUBE) -> Result:
    return CliRunner().invoke(cli.main, [str(a) for a in (file, *arguments)])


def written(*arguments: object, file: object = CUBE) -> str:
    result = run(*arguments, file=file)
    assert result.exit_code == 0, result.output
    return result.stdout


def test_tartes_runs_and_is_near_its_theory(cube: Table, tmp_path: Path) -> None:
    """The program runs as it is; where little is absorbed its albedo is the asymptotic one of our B and g, and a tenth
    more B is not."""
    tartes = pytest.importorskip("tartes")
    from tsdf.study import slabs, spectra, streams
    from tsdf.study.spectra import Family

    out = tmp_path / "snow.py"
    run("--to", "tartes", "--effective-radius", "2e-4", "--wavelength-nm", "500:1000:100", "--out", out)
    made: dict[str, object] = {"__name__": "snow"}
    exec(compile(out.read_text(), str(out), "exec"), made)
    snow = made["snow"]
    assert isinstance(snow, dict)
    albedo = tartes.albedo(made["wavelength"], **snow)
    from tsdf.grain.constants import constants_over

    constants = spectra.Constants.of(constants_over("ice", np.arange(500.0, 1001.0, 100.0)))
    radius = 2e-4 / tsdf.read(CUBE).effective_radius.value
    found = spectra.spectrum(Family((cube,)), constants, radius)
    x = found.absorption_times_radius * cube.statistics["mean_path_length"]
    ours, other = (
        streams.asymptotic(np.full(6, math.inf), by * x, np.full(6, cube.mean_cosine()), None).reflectance
        for by in (1.0, 1.1)
    )
    assert np.abs(albedo - ours).max() < 0.004
    assert np.abs(albedo - other).max() > 0.008
    assert slabs.Request().level == "volume"


def test_snicar(cube: Table, tmp_path: Path) -> None:
    """480 bands by xarray; extinction is twice the shadow over the mass, albedo and g are those with diffraction."""
    xarray = pytest.importorskip("xarray")
    out = tmp_path / "cube.nc"
    written("--to", "snicar", "--ssa", 20, "--out", out)
    data = xarray.load_dataset(out, engine="scipy")
    assert set(data) >= {"ss_alb", "asm_prm", "ext_cff_mss"} and data.sizes["wvl"] == 480
    assert float(data["wvl"][0]) == pytest.approx(0.205e-6) and float(data["wvl"][-1]) == pytest.approx(4.995e-6)
    noise = 4.0 * cube.projected_area.error / cube.projected_area.value
    assert data["ext_cff_mss"].values == pytest.approx(np.full(480, 2.0 * 20.0 / 4.0), rel=noise)  # convex: S = 4 A
    g = cube.mean_cosine()
    blue = int(np.argmin(np.abs(data["wvl"].values - 0.405e-6)))
    assert float(data["ss_alb"][blue]) == pytest.approx(1.0, abs=1e-5)
    assert float(data["asm_prm"][blue]) == pytest.approx(0.5 * (1.0 + g), abs=1e-5)
    assert ((data["ss_alb"] >= 0.5 - 1e-6) & (data["ss_alb"] <= 1.0)).all()
    with netcdf_file(out, "r", mmap=False) as file:  # as any reader of NetCDF 3
        assert file.variables["asm_prm"].shape == (480,)
    again = tmp_path / "again.nc"
    written("--to", "snicar", "--ssa", 20, "--out", again)
    assert again.read_bytes() == out.read_bytes()


def test_disort(cube: Table) -> None:
    """What is written is the table's, and solves as PythonicDISORT takes it."""
    pydisort = pytest.importorskip("PythonicDISORT").pydisort
    facts = json.loads(written("--to", "disort", "--absorption", "0.1/R", "--orders", 64))
    own = moments(cube, 64, 0.1)
    assert facts["omega"] == pytest.approx([cube.single_scattering_albedo(0.1).value], abs=1e-6)
    assert facts["leg_coeffs"][0] == pytest.approx(own.moments.tolist(), abs=1e-8)
    assert facts["f"] == pytest.approx([own.moments[-1]], abs=1e-8)
    assert facts["atom"] == pytest.approx([cube.deflection_masses(0.1)[-1]])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        solved = pydisort(4.0, facts["omega"][0], 64, np.array(facts["leg_coeffs"]), 0.6, 1.0 / 0.6, 0.0, NLeg=64,
                          only_flux=True, f_arr=facts["f"][0])  # fmt: skip
    assert 0.05 < float(solved[1](0.0)) < 0.6
    lossless = json.loads(written("--to", "disort"))
    assert lossless["omega"] == pytest.approx([1.0], abs=1e-12)
    assert lossless["leg_coeffs"][0][1] == pytest.approx(cube.mean_cosine(), abs=5e-3)
    ice = json.loads(written("--to", "disort", "--material", "ice", "--wavelength-nm", "500,1500", "--ssa", 20))
    assert ice["omega"][0] > 0.9999 > ice["omega"][1] and ice["extinction_m2_per_kg"] == pytest.approx(5.0, rel=1e-3)


def test_eradiate(cube: Table, tmp_path: Path) -> None:
    """Variables of particle_dataset_v1; integrals over cos theta are those of the table, atoms included."""
    out = tmp_path / "cube.nc"
    written("--to", "eradiate", "--effective-radius", "2e-4", "--wavelength-nm", "500,2000", "--out", out)
    with netcdf_file(out, "r", mmap=False) as file:
        data = {name: variable[:].copy() for name, variable in file.variables.items()}
        units = {name: variable.units.decode() for name, variable in file.variables.items()}
    assert data["phase"].shape == (2, len(data["mu"]), 1, 1) and units["w"] == "nm" and units["sigma_t"] == "km^-1"
    assert (np.diff(data["mu"]) > 0.0).all() and data["mu"][[0, -1]] == pytest.approx([-1.0, 1.0])
    p = 2.0 * math.pi * data["phase"][:, :, 0, 0]
    assert (p >= 0.0).all()
    assert np.trapezoid(p, data["mu"], axis=1) == pytest.approx(np.ones(2), abs=1e-9)
    whole = moments(cube, 1).moments[1]
    assert np.trapezoid(p * data["mu"], data["mu"], axis=1)[0] == pytest.approx(whole, abs=5e-3)
    near = data["mu"] >= 1.0 - 1.0001e-4
    assert np.trapezoid(p[0, near], data["mu"][near]) == pytest.approx(cube.deflection_masses()[-1], abs=2e-3)


def test_eradiate_with_fine_cells() -> None:
    """However many cells lie within the ramp of an atom, the atom is whole and each cell keeps its mean."""
    from tsdf.loaders.radiative import FORWARD_CELLS, _linear

    theta = np.linspace(np.pi, 0.0, 257)
    edges = np.concatenate([[-1.0, -1.0], np.cos(theta)[1:-1], [1.0, 1.0]])
    assert np.sum(edges > 1.0 - FORWARD_CELLS) > 2  # or nothing is tried
    masses = np.where(np.arange(258) % 3 == 0, 1.0, 1e-4) * np.diff(edges) + 1e-9  # rough, as beside rainbows
    masses[[0, -1]] = 0.0
    masses *= 0.66 / masses.sum()
    masses[[0, -1]] = 0.1, 0.24
    mu, p = _linear(edges, masses[None])
    assert (p >= 0.0).all() and (np.diff(mu) > 0.0).all()
    below = np.concatenate([[0.0], np.cumsum(0.25 * (p[0, 1:] + p[0, :-1]) * np.diff(mu))])
    at = np.flatnonzero(np.abs(edges) <= 1.0 - FORWARD_CELLS)
    assert np.interp(edges[at], mu, below) == pytest.approx(np.cumsum(masses)[at - 1], abs=1e-9)


def test_eradiate_reads_it(tmp_path: Path) -> None:
    """Its own converter and interpolation, where it is installed."""
    pytest.importorskip("eradiate")
    import xarray
    from eradiate import unit_registry as ureg
    from eradiate.data.convert import aer_v1_to_aer_core_v2
    from eradiate.radprops import ParticleProperties

    out = tmp_path / "cube.nc"
    written("--to", "eradiate", "--effective-radius", "2e-4", "--wavelength-nm", "500,600", "--out", out)
    properties = ParticleProperties(aer_v1_to_aer_core_v2(xarray.load_dataset(out)))
    assert float(properties.eval_ssa(500.0 * ureg.nm).m[0]) == pytest.approx(1.0, abs=1e-4)


def test_tables_have_a_density_and_a_size_of_their_own(tmp_path: Path) -> None:
    """Nobody who names no material means ice; any word for the size serves an absorption per length."""
    glass, out = tmp_path / "glass.tsdf.exr", tmp_path / "g.json"
    effort = tsdf.Effort(cells=32)
    tsdf.write(tsdf.build("sphere", tsdf.Optics(1.5, material="glass", wavelength_nm=550.0, k=0.0), effort), glass)
    per_kg = [
        json.loads(written("--to", "disort", "--radius", 2e-4, *extra, file=glass))["extinction_m2_per_kg"]
        for extra in ((), ("--material", "glass", "--wavelength-nm", "550"), ("--material-density", 917))
    ]
    assert per_kg == pytest.approx([0.75 / (2e-4 * 2510.0), 0.75 / (2e-4 * 2510.0), 0.75 / (2e-4 * 917.0)])
    by = ("--to", "disort", "--unit", 1e-3, "--absorption", "0.1/mm", "--out", out)
    assert run(*by, "--effective-radius", 2, file=glass).exit_code == 0
    assert "absorption 0.2 / R, R 0.002 m" in json.loads(out.read_text())["notes"][0]
    dark = json.loads(written("--to", "disort", "--absorption", "1e300/R"))
    assert dark["omega_error"][0] < 0.01 and len(dark["notes"]) == 2  # no wavelength, so nothing about k


def test_phase_functions_need_nothing() -> None:
    """Neither size nor material; a grain of no table gives one, too."""
    text = written("--to", "phase")
    rows = np.loadtxt(text.splitlines()[6:] if text.splitlines()[5].startswith("theta") else text.splitlines()[5:])
    assert rows.ndim == 2 and rows.shape[1] == 4 and "straight on" in text


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--to", "snicar", "--ssa", 20), "say with --out"),
        (("--to", "snicar", "--ssa", 20, "--out", "x.nc", "--wavelength-nm", "500"), "its own 480 bands"),
        (("--to", "tartes", "--absorption", "1/R"), "takes --material"),
        (("--to", "disort", "--absorption", "1/R", "--material", "ice"), "give one"),
        (("--to", "tartes", "--material", "quartz", "--wavelength-nm", "500"), "k, and that of quartz is not known"),
        (("--to", "tartes", "--wavelength-nm", "100"), "200 to 5000 nm"),
        (("--to", "tartes", "--radius", 1e-3, "--ssa", 20), "each say how large"),
        (("--to", "disort", "--lobes", 2), "--lobes is not for"),
        (("--to", "phase", "--kept", 0.5), "--kept is not for"), (("--to", "tartes", "--measure"), "--measure is not"),
        (("--to", "phase", "--colour-thickness", 2), "--colour-thickness is not for"),
        (("--to", "phase", "--orders", 2), "--orders is not for"), (("--to", "pbrt", "--quiet"), "--quiet is not for"),
        (("--to", "pbrt", "--set", "bevel=0"), "--set is not for"),
        (("--to", "phase", "--set", "bevel=0"), "--set shapes a GRAIN"),
        (("--to", "phase", "--threads", 0), "--threads"),
        (("--to", "disort", "--absorption", "1/R", "--wavelength-nm", "500"), "for one table and no wavelengths"),
        (("--to", "pbrt", "--radius", 1, "--packing", 0.5, "--colour-thickness", 2), "give --deep-colour too"),
        (("--to", "pbrt", "--radius", 1e40, "--packing", 0.5), "from 1e-30 to 1e30"),
        (("--to", "pbrt", "--wavelength-nm", "500"), "--wavelength-nm is not for"),
        (("--to", "tartes", "--material", "cheese"), "unknown material 'cheese'"),
    ],
)  # fmt: skip
def test_what_cannot_be_meant(arguments: tuple[object, ...], said: str) -> None:
    result = run(*arguments)
    assert result.exit_code == 2 and said in result.output and result.output.count("\n") == 1, result.output
    assert not Path("x.nc").exists()
