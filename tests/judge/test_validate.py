"""validate: every check fires on the fault it is for, and on nothing else.

The golden tables in `golden/checks` are one fault each; negative controls come from a tracer whose reflectance is
wrong on purpose. Sound tables, exact and traced, must pass: a false alarm is as bad as a missed fault.
"""

import json
import re
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from tsdf.data import format as tsdf_format
from tsdf.data.table import Table, thawed
from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.judge.court import CODES
from tsdf.judge.physics import reference, zhou_curve
from tsdf.judge.validate import judge, validate
from tsdf.make import assemble
from tsdf.make.scatterometer import Effort, exact_sphere
from tsdf.make.tally import Tally
from tsdf.make.tracer import Tracer
from tsdf.reference_data import make_checks

CHECKS = make_checks.CHECKS
FAULTS = sorted(path.name.removesuffix(".json") for path in CHECKS.glob("*.json"))


def traced(
    name="sphere", eta=1.333, paths=1 << 15, cells=64, fresnel="un", joint=4, seed=3, scale=1.0, memory=0
) -> Table:
    """Return a freshly traced table; `scale` is a fault of the tracer's reflectance."""
    grain = load_grain(name)
    tally = Tally(joint, memory)
    Tracer(grain, eta, fresnel, seed, reflectance_scale=scale).trace(np.arange(paths), tally)
    shape = {key: getattr(grain, key) for key in ("kind", "name", "bounding_radius", "area", "volume", "convex")}
    shape |= {"parameters": {}, "bodies": grain.bodies, "faces": len(grain.faces), "mesh_sha256": None, "notes": []}
    made = {"command": "", "method": "traced", "seed": seed, "paths": paths, "max_bounces": 100_000}
    return assemble.traced_table(tally, cells, shape, Optics(eta, fresnel), made, memory)


def errors(table: Table) -> set[str]:
    return {finding.code for finding in judge(table)[0] if finding.severity == "error"}


def base(name: str) -> Table:
    return tsdf_format.read(CHECKS / f"{name}.tsdf.exr")


# --- the golden files ---------------------------------------------------------------


@pytest.mark.parametrize("name", make_checks.BASES)
def test_sound_tables_pass(name):
    report = validate(CHECKS / f"{name}.tsdf.exr")
    assert report.findings == ()
    assert report.ok and report.table is not None and report.checks > 50
    assert report.parts == ("structure", "statistics", "physics")


@pytest.mark.slow
@pytest.mark.parametrize("name", FAULTS)
def test_each_fault_is_found(name):
    path = CHECKS / f"{name}.tsdf.exr"
    report = validate(path)
    assert name.partition("-")[0] in {finding.code for finding in report.findings}
    assert make_checks.expected(path) == json.loads(path.with_name(f"{name}.json").read_text())
    assert report.ok == (CODES[name.partition("-")[0]][0] == "warning")
    for finding in report.findings:
        assert finding.severity == CODES[finding.code][0]
        assert finding.pointer and "\n" not in finding.message
        assert re.search(r"\d", finding.message)


def test_the_codes_are_a_closed_set():
    """Each code has a golden file, each golden file a code, and SPEC.md lists them all as they are."""
    assert {name.partition("-")[0] for name in FAULTS} == set(CODES)
    assert not set(CODES) & set(tsdf_format.CODES)
    annex = resources.files("tsdf.schema").joinpath("SPEC.md").read_text("utf-8").partition("## Annex A")[2]
    assert dict(re.findall(r"^\| `([A-Z_]+)` \| (\w+ \| .*?) \|$", annex, re.M)) == {
        code: f"{severity} | {rule}" for code, (severity, rule) in CODES.items()
    }


@pytest.mark.slow
def test_golden_files_are_what_their_script_makes():
    made = make_checks.checks()
    assert set(made) == set(FAULTS)
    for name, data in made.items():
        assert (CHECKS / f"{name}.tsdf.exr").read_bytes() == data, name


@pytest.mark.slow
def test_no_number_of_a_sound_table_is_near_its_limit_by_accident():
    """Every scalar statistic of the exact sphere, 2 % off, is an error."""
    table = base("sphere")
    for name in ("hit_probability", "albedo", "mean_cosine", "mean_z", "mean_r", "mean_path_length"):
        header = thawed(table.header)
        header["statistics"][name] *= 0.98
        assert errors(Table(header, table.pixels)), name


# --- structure ----------------------------------------------------------------------


def test_broken_structure_ends_it(tmp_path):
    path = tmp_path / "a.tsdf.exr"
    report = validate(path)
    assert [f.code for f in report.findings] == ["FILE_UNREADABLE"]
    assert (report.ok, report.parts, report.checks, report.table) == (False, ("structure",), 0, None)
    path.write_bytes((CHECKS / "cube.tsdf.exr").read_bytes()[:-100])
    assert not validate(path).ok


def test_a_newer_minor_version_is_a_warning_of_the_structure():
    golden = Path(str(resources.files("tsdf.reference_data"))) / "golden/valid"
    report = validate(golden / "newer_minor.tsdf.exr", structure_only=True)
    assert report.ok and report.table is not None and report.parts == ("structure",)
    assert [(f.code, f.severity) for f in report.findings] == [("VERSION_MINOR", "warning")]


# --- sound tables, negative controls ------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    "made",
    [
        {"seed": 1},
        {"seed": 2, "fresnel": "sp"},
        {"paths": 1 << 10, "cells": 8, "joint": 1},
        {"eta": 0.75},
        {"eta": 1.0},
        {"name": "hexprism", "eta": 1.31},
        {"name": "hexprism", "eta": 0.8},
        {"name": "tetrahedron", "eta": 1.31, "cells": 128, "paths": 1 << 12},
        {"name": "snow", "eta": 1.31, "paths": 1 << 13},
        {"name": "cube", "eta": 1.0},
        {"name": "cube", "eta": 1.0000001},
        {"memory": 8},
        {"memory": 1, "fresnel": "sp"},
        {"memory": 8, "eta": 0.75},
        {"memory": 8, "eta": 1.0},
        {"memory": 32, "paths": 1 << 10, "cells": 8},
        {"memory": 4, "paths": 1 << 10, "cells": 512, "name": "tetrahedron", "eta": 1.31},
        {"memory": 4, "name": "cube", "eta": 1.31},
        {"memory": 8, "name": "snow", "eta": 1.31, "paths": 1 << 13},
    ],
    ids=str,
)
def test_honest_noisy_tables_pass(made):
    assert errors(traced(**made)) == set()


@pytest.mark.slow
@pytest.mark.parametrize(("eta", "fresnel"), [(1.31, "un"), (1.5, "sp"), (3.0, "un"), (0.75, "sp"), (1.0, "un")])
@pytest.mark.parametrize("memory", [1, 32])
def test_records_by_entry_of_exact_spheres_pass(eta, fresnel, memory):
    assert errors(exact_sphere(load_grain("sphere"), Optics(eta, fresnel), Effort(cells=62, memory=memory))) == set()


@pytest.mark.slow
def test_records_by_entry_of_another_grain_fail():
    """Those of another eta, of another solid, or of fewer hits, below an otherwise sound table."""
    first = next(b["first_row"] for b in traced(memory=32).header["blocks"] if b["name"] == "memory_hit")

    def grafted(onto: Table, graft: Table) -> set[str]:
        return errors(Table(onto.header, np.concatenate((onto.pixels[:first], graft.pixels[first:]))))

    sphere, cube = traced(memory=32), traced(name="cube", eta=1.333, memory=32)
    assert grafted(sphere, traced(memory=32, seed=4)) == set()
    assert grafted(sphere, traced(memory=32, eta=1.38)) == {"PHYSICS_SPHERE_MEMORY"}
    assert grafted(sphere, cube) == {"STATISTICS_MEMORY_HIT", "STATISTICS_MEMORY", "PHYSICS_SPHERE_MEMORY"}
    assert grafted(cube, traced(name="octahedron", eta=1.333, memory=32)) == {
        "STATISTICS_MEMORY_HIT",
        "STATISTICS_MEMORY",
    }


@pytest.mark.slow
@pytest.mark.parametrize("scale", [0.98, 1.02])
def test_a_tracer_with_two_percent_too_much_or_little_reflectance_fails(scale):
    """2e5 paths know <z> to 2e-4 R, and 2 % of the reflectance moves it by 2.6e-3."""
    assert "PHYSICS_SPHERE_STATISTICS" in errors(traced(paths=200_000, scale=scale))


@pytest.mark.parametrize(("stated", "held"), [("sp", "un"), ("un", "sp")])
def test_the_wrong_fresnel_convention_fails(stated, held):
    table = traced(paths=100_000, fresnel=held)
    assert errors(table) == set()
    header = thawed(table.header)
    header["optics"]["fresnel"] = stated
    findings = [f for f in judge(Table(header, table.pixels))[0] if f.code == "PHYSICS_SPHERE_P_THETA"]
    assert findings and f"convention '{held}'" in findings[0].message


def test_smooth_mixing_of_p_theta_fails():
    """2 % of an isotropic lobe mixed into p_theta is seen, whatever its header says."""
    table = traced(paths=100_000)
    pixels = np.array(table.pixels)
    pixels[0] = 0.98 * pixels[0] + 0.02 * 0.5 * np.diff(table.cos_theta_edges)
    assert "PHYSICS_SPHERE_P_THETA" in errors(Table(table.header, pixels))
    exact = base("sphere")
    pixels = np.array(exact.pixels)
    pixels[0] = (1 - 1e-5) * pixels[0] + 1e-5 * 0.5 * np.diff(exact.cos_theta_edges)
    assert "PHYSICS_SPHERE_P_THETA" in errors(Table(exact.header, pixels))


def test_records_of_neighbouring_columns_fail():
    """Records shifted by three columns of 64 stay near, but lie where a sphere sends no light."""
    table = traced(joint=8)
    pixels = np.array(table.pixels)
    first = next(b["first_row"] for b in table.header["blocks"] if b["name"] == "joint_r")
    pixels[first:, 1:-1] = np.roll(pixels[first:, 1:-1], 3, axis=1)
    found = errors(Table(table.header, pixels))
    assert {"STATISTICS_RECORDS", "STATISTICS_RECORD_SUPPORT"} <= found


def test_zhou_curve_is_the_published_one():
    """The table's cells follow GOMsphere within 0.4 % away from rainbows."""
    columns, curve, mine = zhou_curve(base("sphere"))
    assert len(columns) > 15
    np.testing.assert_allclose(mine, curve, rtol=4e-3)
    circles = reference("zhou2003_fig8_montecarlo.csv")
    assert len(circles["theta_deg"]) == 17


def test_a_mirror_is_valid_and_cannot_be_listed(tmp_path):
    """A sphere of eta 1e9 reflects everything, the same in all directions; by quadrature it is refused in one line."""
    from tsdf.errors import UsageError
    from tsdf.grain.grains import load_grain
    from tsdf.grain.optics import Optics
    from tsdf.make import scatterometer

    sphere, effort = load_grain("sphere"), scatterometer.Effort(20_000, cells=16, memory=8)
    with pytest.raises(UsageError, match="--traced"):
        scatterometer.exact_sphere(sphere, Optics(1e9), effort)
    build = scatterometer.Build.start(sphere, Optics(1e9), effort)
    build.run(sphere)
    table = build.table()
    assert abs(table.mean_cosine()) < 1e-3
    assert judge(table)[0] == ()


@pytest.mark.parametrize("eta", [1.0 + 1e-6, 1.0 - 1e-6, 1.0 + 1e-5])
def test_a_sphere_that_hardly_deflects_is_sound(eta):
    """What is deflected by less than 1e-5 rad counts as an atom where paths are traced: nearly all light, or some of
    it. The same light under an index that would deflect ten times as far is an error, and so are lost moments."""
    table = traced(eta=eta, memory=8)
    assert errors(table) == set()
    header = thawed(table.header)
    header["optics"]["eta"] = 1.0 + 10.0 * (eta - 1.0)
    assert "PHYSICS_SPHERE_P_THETA" in errors(Table(header, table.pixels))
    header = thawed(table.header)
    header["statistics"]["legendre_moments"][16] -= 1e-4
    assert {"PHYSICS_SPHERE_STATISTICS", "STATISTICS_LEGENDRE"} & errors(Table(header, table.pixels))


@pytest.mark.slow
def test_records_need_not_show_what_is_rare():
    """A share 4e-4 of the light enters a sphere of eta 0.02: no record may be of it. Records that all have moved 0.1 R
    are an error."""
    table = exact_sphere(load_grain("sphere"), Optics(0.02), Effort(cells=32, memory=8))
    assert errors(table) == set()
    pixels = table.pixels.copy()
    (block,) = (block for block in table.header["blocks"] if block["name"] == "memory_r")
    pixels[block["first_row"] : block["first_row"] + block["rows"]] += 0.1
    assert "STATISTICS_MEMORY" in errors(Table(table.header, pixels))
