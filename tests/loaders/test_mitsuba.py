"""Mitsuba 3 with our plugins against our own renderer, which is the arbiter: pixel by pixel, and what must be exact."""

import importlib
import itertools
import math
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

from tsdf.data import format as tsdf_format
from tsdf.errors import FormatError, SceneError, UsageError
from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.make import scatterometer
from tsdf.make.scatterometer import Effort
from tsdf.picture import image, render, world
from tsdf.scene.deep import absorption_of_colour
from tsdf.scene.medium import Component, volume_parameters
from tsdf.scene.scene import (
    Absorption,
    Box,
    Camera,
    ConstantLight,
    EnvironmentLight,
    GrainSpec,
    MediumSpec,
    Mesh,
    Rectangle,
    Scene,
    Sphere,
    SunLight,
    SurfaceSpec,
)
from tsdf.scene.sizes import convert

dr = pytest.importorskip("drjit")
mi = pytest.importorskip("mitsuba", reason='Mitsuba 3 is missing: pip install "tsdf-toolkit[mitsuba]"')
L = importlib.import_module("tsdf.loaders.mitsuba")

SIDE = 16  # pixels
SUN = (0.36, -0.48, 0.8)
FLOOR = 15.0  # half its side
BOX = Box((-6.0, -5.0, -4.0), (6.0, 5.0, 4.0))
CAMERA = Camera((3.0, -30.0, 7.0), (0.0, 0.0, 0.0), SIDE, SIDE, fov_deg=30.0)
OUTLINE = ((-6.0, -6.0), (6.0, -6.0), (6.0, 0.0), (0.0, 0.0), (0.0, 6.0), (-6.0, 6.0))
COLOURED = (0.02, 0.05, 0.2)


def works(variant: str) -> bool:
    try:
        L.set_variant(variant)
    except UsageError:
        return False
    return True


@pytest.fixture(params=["llvm_ad_rgb", "scalar_rgb"])
def variant(request):
    """Set each variant in turn."""
    if not works(request.param):
        pytest.skip(f"{request.param} does not work here: LLVM 17 or newer is missing")
    return request.param


@pytest.fixture
def llvm():
    """Set the vectorised variant."""
    if not works("llvm_ad_rgb"):
        pytest.skip("llvm_ad_rgb does not work here: LLVM 17 or newer is missing")


@pytest.fixture(scope="module")
def ball():
    """Return the table of the exact sphere."""
    return scatterometer.exact_sphere(load_grain("sphere"), Optics(1.33), Effort(cells=128, joint=0, memory=2))


@pytest.fixture(scope="module")
def crystal():
    """Return the table of a traced grain with atoms, which many rays miss."""
    shape = load_grain("cube")
    build = scatterometer.Build.start(shape, Optics(1.5), Effort(100_000, cells=64, joint=0))
    build.run(shape)
    return build.table()


@pytest.fixture(scope="module")
def concave(tmp_path_factory) -> Path:
    """Return an extruded L, a face of which sees another."""
    import trimesh

    path = tmp_path_factory.mktemp("mitsuba") / "concave.ply"
    corners = [(x, y, z) for z in (-4.0, 4.0) for x, y in OUTLINE]
    top = [(0, 1, 2), (0, 2, 3), (0, 3, 5), (3, 4, 5)]
    faces = [(c, b, a) for a, b, c in top] + [(a + 6, b + 6, c + 6) for a, b, c in top]
    for i in range(6):
        j = (i + 1) % 6
        faces += [(i, j, j + 6), (i, j + 6, i + 6)]
    trimesh.Trimesh(corners, faces, process=False).export(path)
    return path


def boundary(shape) -> dict:
    """Return the Mitsuba shape of one of ours."""
    if isinstance(shape, Mesh):
        return {"type": "ply", "filename": str(shape.file), "face_normals": True}
    half = [0.5 * (b - a) for a, b in zip(shape.low, shape.high, strict=True)]
    middle = [0.5 * (b + a) for a, b in zip(shape.low, shape.high, strict=True)]
    return {"type": "cube", "to_world": mi.ScalarTransform4f().translate(middle).scale(half)}


def theirs(shape, interior, lights, integrator, side=SIDE, extra=()) -> object:
    """Return a Mitsuba scene of one medium under lights."""
    look = mi.ScalarTransform4f().look_at(list(CAMERA.position), list(CAMERA.target), [0, 0, 1])
    film = {"type": "hdrfilm", "width": side, "height": side, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    scene = {
        "type": "scene",
        "integrator": integrator,
        "sensor": {"type": "perspective", "fov": CAMERA.fov_deg, "to_world": look, "film": film},
        "grains": boundary(shape) | {"bsdf": {"type": "null"}, "interior": interior},
    }
    for i, item in enumerate((*lights, *extra)):
        scene[f"item_{i}"] = item
    return mi.load_dict(scene)


def pictures(scene, spp: int, seeds: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean of several renders and its variance, from how they differ."""
    taken = np.array([np.array(mi.render(scene, spp=spp, seed=s))[..., :3] for s in range(seeds)], dtype=float)
    return taken.mean(axis=0), taken.var(axis=0, ddof=1) / seeds


def scores(scene, ours, spp: int, seeds: int = 24) -> np.ndarray:
    """Return Student's t of each pixel's green, turned into a normal deviate, Mitsuba less ours."""
    from scipy import stats

    mean, variance = pictures(scene, spp, seeds)
    own = ours.variance[..., 1]
    both = variance[..., 1] + own
    lit = both > 0.0
    t = (mean[..., 1] - ours.rgb[..., 1])[lit] / np.sqrt(both[lit])
    freedom = (seeds - 1) * (both[lit] / np.maximum(variance[..., 1][lit], 1e-300)) ** 2
    return stats.norm.isf(stats.t.sf(np.abs(t), freedom)) * np.sign(t)


def sidak(count: int, level: float = 1e-3) -> float:
    """Return the largest |z| that noise reaches among so many pixels, but for a share `level` of cases."""
    from scipy import stats

    return float(stats.norm.isf(0.5 * (1.0 - (1.0 - level) ** (1.0 / count))))


def ours(shape, table, lights, fraction=0.5, absorption=(0.0,), level="teleport", spp=256, surfaces=()):
    kind = "grey" if len(absorption) == 1 else "rgb"
    grain = GrainSpec(table, absorption=Absorption(kind, absorption))
    scene = Scene(CAMERA, lights, (MediumSpec(shape, fraction, 1.0, (grain,)),), surfaces)
    return render.render(world.build(scene, level), spp=spp, threads=2)


CONSTANT = {"type": "constant"}
ONE = (ConstantLight((1.0, 1.0, 1.0)),)


@pytest.mark.slow
@pytest.mark.parametrize("body", ["box", "concave"])
def test_furnace_is_exactly_one(body, variant, crystal, concave):
    """A constant 1 around grains that take nothing is 1 in every sample: no weight is lost or made, whatever the number
    of jumps and boundaries, and nothing of it is drawn, so there is no noise to hide behind."""
    shape = BOX if body == "box" else Mesh(concave)
    interior = L.granular(crystal, 0.5, 1.0)
    llvm = variant != "scalar_rgb"
    scene = theirs(shape, interior, [CONSTANT], {"type": "tpt", "count": True}, side=32 if llvm else 6)
    picture = np.array(mi.render(scene, spp=64 if llvm else 4))
    assert picture[..., 3].mean() > 0.5  # grains met
    assert np.abs(picture[..., :3] - 1.0).max() <= 1e-5


@pytest.mark.slow
def test_absorbing_furnace_is_not_one(llvm, ball):
    """The control of the furnace: grains that take something are darker than 1."""
    scene = theirs(BOX, L.granular(ball, 0.5, 1.0, 0.05), [CONSTANT], {"type": "tpt"})
    assert np.array(mi.render(scene, spp=16)).min() < 0.99


@pytest.mark.slow
@pytest.mark.parametrize("body", ["box", "concave"])
@pytest.mark.parametrize("absorption", [(0.05,), COLOURED])
@pytest.mark.parametrize("grain", ["ball", "crystal"])
def test_tpt_is_our_renderer_under_constant_light(body, absorption, grain, llvm, concave, request):
    """Pixel by pixel, within noise, and a packing fraction 20 % lower is seen. (Without absorption see the furnace.)"""
    table = request.getfixturevalue(grain)
    shape = BOX if body == "box" else Mesh(concave)
    arbiter = ours(shape, table, ONE, absorption=absorption, spp=4096)
    sigma = absorption[0] if len(absorption) == 1 else absorption
    for fraction in (0.5, 0.4):
        scene = theirs(shape, L.granular(table, fraction, 1.0, sigma), [CONSTANT], {"type": "tpt"})
        z = scores(scene, arbiter, 128)
        consistent = np.abs(z).max() < sidak(z.size) and abs(z.sum()) / math.sqrt(z.size) < 4.0
        assert consistent == (fraction == 0.5), (fraction, np.abs(z).max(), z.sum() / math.sqrt(z.size))


def sun(strength: float = 3.0, degrees: float = 0.2) -> tuple[SunLight]:
    return (SunLight(SUN, (strength,) * 3, degrees),)


def directional(strength: float = 3.0) -> dict:
    return {"type": "directional", "direction": [-x for x in SUN], "irradiance": strength}


@pytest.mark.slow
@pytest.mark.parametrize("body", ["box", "concave"])
@pytest.mark.parametrize("absorption", [(0.0,), COLOURED])
def test_tpt_is_our_renderer_under_a_sun(body, absorption, llvm, ball, concave):
    """A directional light against a sun of 0.2 degrees, with a diffuse floor that grains and sun light; the control is
    a packing fraction 20 % lower."""
    shape = BOX if body == "box" else Mesh(concave)
    floor = SurfaceSpec(Rectangle((0.0, 0.0, -5.0), (FLOOR, 0.0, 0.0), (0.0, FLOOR, 0.0)), (0.5, 0.5, 0.5), "floor")
    plane = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0.0, 0.0, -5.0]).scale(FLOOR),
        "bsdf": {"type": "diffuse", "reflectance": 0.5},
    }
    arbiter = ours(shape, ball, sun(), absorption=absorption, spp=2048, surfaces=(floor,))
    sigma = absorption[0] if len(absorption) == 1 else absorption
    for fraction in (0.5, 0.4):
        scene = theirs(shape, L.granular(ball, fraction, 1.0, sigma), [directional()], {"type": "tpt"}, extra=[plane])
        z = scores(scene, arbiter, 256)
        consistent = np.abs(z).max() < sidak(z.size) and abs(z.sum()) / math.sqrt(z.size) < 4.0
        assert consistent == (fraction == 0.5), (fraction, np.abs(z).max(), z.sum() / math.sqrt(z.size))


@pytest.mark.slow
def test_tpt_in_scalar_rgb(ball):
    """The scalar variant takes the same paths as the vectorised one: here by the mean of a tiny picture."""
    if not works("scalar_rgb"):
        pytest.skip("scalar_rgb is missing")
    arbiter = ours(BOX, ball, sun(), absorption=(0.05,), spp=256)
    scene = theirs(BOX, L.granular(ball, 0.5, 1.0, 0.05), [directional()], {"type": "tpt"}, side=4)
    mean, variance = pictures(scene, 4, 8)
    both = math.sqrt(variance[..., 1].sum() / 256 + arbiter.variance[..., 1].sum() / arbiter.rgb[..., 1].size ** 2)
    assert abs(mean[..., 1].mean() - arbiter.rgb[..., 1].mean()) < 4.0 * both


@pytest.mark.slow
def test_area_light_is_environment(llvm, ball):
    """A sphere that shines inward all around is a constant light: from grains its light is found, from the floor it is
    drawn as well, and both must add up to the same."""
    shell = {"type": "sphere", "radius": 60.0, "flip_normals": True, "emitter": {"type": "area", "radiance": 1.0}}
    plane = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0.0, 0.0, -5.0]).scale(15.0),
        "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.5}},
    }
    interior = L.granular(ball, 0.5, 1.0, 0.05)
    a, va = pictures(theirs(BOX, interior, [shell], {"type": "tpt"}, extra=[plane]), 64, 12)
    b, vb = pictures(theirs(BOX, interior, [CONSTANT], {"type": "tpt"}, extra=[plane]), 64, 12)
    z = (a - b)[..., 1].sum() / math.sqrt((va + vb)[..., 1].sum())
    assert abs(z) < 4.0


@pytest.mark.slow
def test_mixture_and_file_in_xml(llvm, ball, crystal, tmp_path):
    """A mixture named in XML is the same as ours; the control is the wrong shares."""
    for name, table in (("ball", ball), ("crystal", crystal)):
        tsdf_format.write(table, tmp_path / f"{name}.tsdf.exr")
    grains = tuple(
        GrainSpec(t, f, absorption=Absorption("grey", (a,))) for t, f, a in ((ball, 3.0, 0.3), (crystal, 1.0, 0.01))
    )
    scene = Scene(CAMERA, ONE, (MediumSpec(BOX, 0.5, 1.0, grains),))
    arbiter = render.render(world.build(scene, "teleport"), spp=1024, threads=2)
    for fraction in ("3;1", "1;3"):
        xml = f"""<scene version="3.0.0"><integrator type="tpt"/><emitter type="constant"/>
        <sensor type="perspective"><float name="fov" value="30"/><transform name="to_world">
        <lookat origin="3,-30,7" target="0,0,0" up="0,0,1"/></transform><film type="hdrfilm">
        <integer name="width" value="{SIDE}"/><integer name="height" value="{SIDE}"/><rfilter type="box"/>
        <string name="pixel_format" value="rgb"/></film></sensor>
        <shape type="cube"><transform name="to_world"><scale x="6" y="5" z="4"/></transform><bsdf type="null"/>
        <medium name="interior" type="granular"><string name="file"
        value="{tmp_path}/ball.tsdf.exr;{tmp_path}/crystal.tsdf.exr"/><string name="fraction" value="{fraction}"/>
        <string name="absorption" value="0.3;0.01"/><float name="packing_fraction" value="0.5"/>
        <float name="grain_radius" value="1"/></medium></shape></scene>"""
        z = scores(mi.load_string(xml), arbiter, 64)
        assert (np.abs(z).max() < sidak(z.size) and abs(z.sum()) / math.sqrt(z.size) < 4.0) == (fraction == "3;1")


@pytest.mark.slow
def test_sizes_densities_and_colours_in_any_word(llvm, ball, crystal):
    """What is said in others' words is the medium that `sizes` and `deep` say, in Python and by plugin parameters."""
    facts = convert([(crystal, 1.0)], {"radius": 0.5, "packing_fraction": 0.4}).facts()
    words = {"effective_radius": facts["effective_radius"], "solid_fraction": facts["solid_fraction"]}
    colour = [0.9, 0.5, 0.2]
    absorption = [x / 0.5 for x in absorption_of_colour(crystal, colour)]
    mine = L.granular(crystal, 0.4, 0.5, absorption)
    for word in ("albedo", "deep_colour"):
        theirs = L.granular(crystal, **words, **{word: colour})
        assert (theirs["packing_fraction"], theirs["grain_radius"]) == pytest.approx((0.4, 0.5))
        found = [float(x) for x in theirs["absorption"].split()]
        assert found == pytest.approx(absorption, rel=1e-6)
    assert theirs["file"] == mine["file"]
    stock = L.medium(crystal, deep_colour=colour, grain_radius=0.5, solid_fraction=facts["solid_fraction"])
    assert stock["scale"] == pytest.approx(L.medium(crystal, 0.4, 0.5, absorption)["scale"])
    plugin = mi.load_dict({"type": "granular", "file": mine["file"], "albedo": "0.9 0.5 0.2", **words})
    assert plugin.bulk.radius == pytest.approx(0.5) and plugin.bulk.packing_fraction == pytest.approx(0.4)
    assert plugin.bulk.sigma_a[0] == pytest.approx(absorption, rel=1e-6)
    mixture = L.granular([L.Grain(crystal, 1.0, 0.0, colour), L.Grain(ball, 2.0, 0.3)], 0.4, 0.5)
    assert [float(x) for x in mixture["absorption"].split(";")[0].split()] == pytest.approx(absorption, rel=1e-6)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"grain_radius": 1.0}, "how much of space is filled is missing"),
        ({"packing_fraction": 0.5}, "how large grains are is missing: give grain_radius"),
        ({"packing_fraction": 0.5, "grain_radius": 1.0, "sieve": 1.0}, "radius and sieve each say the size"),
        ({"packing_fraction": 0.5, "effective_raduis": 1.0, "grain_radius": 1}, "did you mean 'effective_radius'?"),
        ({"solid_fraction": 0.9, "grain_radius": 1.0}, "would take a packing fraction of 2"),
        ({"packing_fraction": 0.5, "grain_radius": 1.0, "albedo": 1.0}, "without any absorption it is 1"),
        ({"packing_fraction": 0.5, "grain_radius": 1.0, "albedo": 0.5, "absorption": 1.0}, "give one"),
    ],
)
def test_words_that_cannot_be_meant(words, message, crystal):
    with pytest.raises(UsageError) as caught:
        L.medium(crystal, **words)
    assert message in str(caught.value) and "\n" not in str(caught.value)


# ------------------------------------------------------------------------------------------- stock volpath


def mean_cosine(values: str) -> float:
    """Return the mean cosine of a tabulated phase function as Mitsuba draws from it, from its file alone."""
    v = np.array([float(x) for x in values.split(",")])
    x = np.linspace(-1.0, 1.0, len(v))
    h = x[1] - x[0]
    a, b = v[:-1], v[1:]
    return float((h * (x[:-1] * (a + b) / 2 + h * (a / 6 + b / 3))).sum() / (h * (a + b) / 2).sum())


@pytest.mark.parametrize("grain", ["ball", "crystal"])
@pytest.mark.parametrize("absorption", [0.0, 0.3])
def test_stock_medium_keeps_the_mean_cosine(grain, absorption, llvm, request):
    """Values at uniform cosines have the table's mean cosine within 1e-3, and Mitsuba's own samples, in its own sign of
    cosines, too; read backwards they do not."""
    table = request.getfixturevalue(grain)
    stock = L.medium(table, 0.5, 1.0, absorption)
    parameters = volume_parameters([Component(table)], 0.5, [absorption])
    assert mean_cosine(stock["phase"]["values"]) == pytest.approx(parameters.g, abs=1e-6)
    assert stock["sigma_t"] == pytest.approx(parameters.sigma_t)
    assert stock["albedo"] == pytest.approx(parameters.albedo)
    phase, n = mi.load_dict(stock["phase"]), 1_000_000
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, n)
    mei = mi.MediumInteraction3f()
    mei.wi = mi.Vector3f(0.0, 0.0, 1.0)  # where it came from: it travels along -z
    mei.sh_frame = mi.Frame3f(mei.wi)
    wo, _, _ = phase.sample(mi.PhaseFunctionContext(sampler), mei, sampler.next_1d(), sampler.next_2d())
    cosine = -np.array(wo.z, dtype=float)
    assert abs(cosine.mean() - parameters.g) < 4.0 * cosine.std() / math.sqrt(n) + 1e-5
    assert abs(-cosine.mean() - parameters.g) > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("absorption", [0.0, 0.02])
def test_stock_volpath_is_our_volume_level(absorption, llvm, ball):
    """Stock ``volpath`` with our medium against our level `volume`, under a sun and a sky; the control forgets the
    advance in the grain, as sigma_t = 1 / lambda_beta does."""
    lights = (*sun(), *ONE)
    arbiter = ours(BOX, ball, lights, absorption=(absorption,), level="volume", spp=2048)
    stock = L.medium(ball, 0.5, 1.0, absorption)
    wrong = stock | {"sigma_t": 0.75}
    for interior in (stock, wrong):
        integrator = {"type": "volpath", "max_depth": -1, "rr_depth": 1_000_000}
        z = scores(theirs(BOX, interior, [directional(), CONSTANT], integrator), arbiter, 128)
        consistent = np.abs(z).max() < sidak(z.size) and abs(z.sum()) / math.sqrt(z.size) < 4.0
        assert consistent == (interior is stock), (np.abs(z).max(), z.sum() / math.sqrt(z.size))


@pytest.mark.slow
def test_granular_in_stock_volpath(llvm, ball):
    """Where the integrator knows no grains, ``granular`` is the medium of point scatterers: the same scene renders."""
    interior = L.granular(ball, 0.5, 1.0)
    scene = theirs(BOX, interior, [CONSTANT], {"type": "volpath", "max_depth": 1000, "rr_depth": 1000})
    mean, variance = pictures(scene, 16, 8)
    assert abs(mean.mean() - 1.0) < 4.0 * math.sqrt(variance[..., 1].sum()) / SIDE**2


# ------------------------------------------------------------------------------------------------ bad input


def python(code: str, **environment) -> subprocess.CompletedProcess:
    """Run code in a fresh interpreter that prints errors of the toolkit as one line."""
    wrapped = (
        "import sys\nfrom tsdf.errors import TSDFError\ntry:\n"
        + textwrap.indent(textwrap.dedent(code), "    ")
        + "\nexcept TSDFError as error:\n    print(error)\n"
    )
    return subprocess.run(
        [sys.executable, "-c", wrapped], capture_output=True, text=True, env={**os.environ, **environment}, check=False
    )


def only_line(done: subprocess.CompletedProcess) -> str:
    assert done.returncode == 0, done.stderr[-500:]
    (line,) = done.stdout.splitlines()
    return line


def test_missing_wheel():
    line = only_line(python("sys.modules['mitsuba'] = None\nimport tsdf.loaders.mitsuba"))
    assert 'pip install "tsdf-toolkit[mitsuba]"' in line


def test_old_wheel():
    line = only_line(python("import mitsuba\nmitsuba.__version__ = '3.4.0'\nimport tsdf.loaders.mitsuba"))
    assert "3.4.0 is too old" in line


def test_no_variant():
    line = only_line(python("import tsdf.loaders.mitsuba as L\nL.register()"))
    assert "no variant" in line
    assert "set_variant" in line


def test_unknown_variant():
    line = only_line(python("import tsdf.loaders.mitsuba as L\nL.set_variant('llvm_rgb')"))
    assert "llvm_ad_rgb" in line


@pytest.mark.slow
@pytest.mark.parametrize("library", ["missing", "not-llvm", "too-old"])
def test_no_working_llvm(library, tmp_path):
    """A library that is not there, is another or is too old ends in one line, not in the end of the process."""
    path = tmp_path / "libLLVM.so"
    if library == "not-llvm":
        path.write_bytes(b"nothing")
    if library == "too-old":
        old = [p for n in (14, 15, 16) for p in Path("/usr/lib").glob(f"*/libLLVM-{n}.so*")]
        if not old:
            pytest.skip("there is no LLVM older than 17 here")
        path.symlink_to(old[-1])
    done = python("import tsdf.loaders.mitsuba as L\nL.set_variant('llvm_ad_rgb')", DRJIT_LIBLLVM_PATH=str(path))
    assert "DRJIT_LIBLLVM_PATH" in only_line(done)


def test_newer_table(variant):
    newer = sorted((Path(__file__).parents[2] / "reference_data" / "golden").rglob("*VERSION_MAJOR*.exr"))
    assert newer
    with pytest.raises(FormatError, match="VERSION"):
        L.medium(newer[0], 0.5, 1.0)


@pytest.mark.parametrize("make", ["medium", "granular"])
def test_values_out_of_range(make, variant, ball):
    """Each is refused before Mitsuba sees it."""
    of = getattr(L, make)
    with pytest.raises(UsageError, match="packing fraction"):
        of(ball, 0.8, 1.0)
    with pytest.raises(UsageError, match="radius"):
        of(ball, 0.5, 0.0)
    with pytest.raises(UsageError, match="absorption"):
        of(ball, 0.5, 1.0, (0.1, 0.2))
    with pytest.raises(UsageError, match="absorption"):
        of(ball, 0.5, 1.0, -1.0)
    named = [L.Grain(ball, "a")]
    for grains, packing, radius in ((ball, "x", 1.0), (ball, 0.5, [1, 2]), (named, 0.5, 1.0), (None, 0.5, 1.0)):
        with pytest.raises(UsageError, match=r"numbers|list of Grain"):
            of(grains, packing, radius)
    with pytest.raises(UsageError, match="metres_per_unit must be"):
        of(ball, 0.5, ssa=20.0, material_density=917.0, metres_per_unit=-1.0)


def refused(shapes: dict, match: str) -> None:
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "tpt"}, "light": CONSTANT, **shapes})
    sensor = mi.load_dict({"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}})
    with pytest.raises(RuntimeError) as caught:
        mi.render(scene, sensor=sensor, spp=1)
    error = caught.value
    while error.__cause__ is not None and not isinstance(error, SceneError):
        error = error.__cause__
    assert isinstance(error, SceneError)
    assert match in str(error)
    assert "\n" not in str(error)


@pytest.mark.slow
def test_open_boundary(llvm, ball):
    """A rectangle bounds nothing."""
    refused({"wall": {"type": "rectangle", "bsdf": {"type": "null"}, "interior": L.granular(ball, 0.5, 0.1)}}, "open")


@pytest.mark.slow
def test_overlapping_media(llvm, ball):
    move = mi.ScalarTransform4f().translate([1.0, 0.0, 0.0])
    body = {"type": "sphere", "bsdf": {"type": "null"}}
    other = body | {"to_world": move, "interior": L.granular(ball, 0.4, 0.1)}
    refused({"a": body | {"interior": L.granular(ball, 0.5, 0.1)}, "b": other}, "overlap")


def test_other_media_and_points_of_light(llvm, ball):
    body = {"type": "sphere", "bsdf": {"type": "null"}}
    refused({"a": body | {"interior": {"type": "homogeneous"}}}, "volpath")
    refused({"a": body | {"interior": L.granular(ball, 0.5, 0.1)}, "p": {"type": "point"}}, "area")


@pytest.mark.parametrize("unit", [1e-6, 1e-3, 1e-2, 1.0])
def test_coloured_media_load_in_every_unit(variant, unit, ball):
    """Grains of 2 mm in um, mm, cm and m, absorption in every order of colours, strong, weak and none: the stock medium
    loads, and says the extinction and the scattering of `volume_parameters` in each channel."""
    radius = 2e-3 / unit
    for colour in (*itertools.permutations((0.0, 20.0, 300.0)), (1e5, 1e5, 0.0), (0.0, 0.0, 1e-6), (5.0, 5.0, 5.0)):
        sigma_a = [a * unit for a in colour]
        made = mi.load_dict(L.medium(ball, 0.5, radius, sigma_a))
        inside = mi.MediumInteraction3f() if variant == "scalar_rgb" else dr.zeros(mi.MediumInteraction3f)
        scattering, _, extinction = made.get_scattering_coefficients(inside)
        channels = [volume_parameters([Component(ball, radius=radius)], 0.5, [a]) for a in sigma_a]
        assert np.array(extinction).ravel() == pytest.approx([c.sigma_t for c in channels], rel=1e-5)
        assert np.array(scattering).ravel() == pytest.approx([c.sigma_s for c in channels], rel=1e-5)


@pytest.mark.slow
def test_units_change_no_coloured_picture(variant, ball):
    """One ball of coloured grains in two units, 200 and 0.2 across, is one picture to float32; twice the absorption
    is another: the negative control."""

    def picture(unit, times=1.0):
        interior = L.medium(ball, 0.5, 1.0 / unit, [a * unit * times for a in (0.05, 0.005, 0.0)])
        look = mi.ScalarTransform4f().look_at([0, -800 / unit, 0], [0, 0, 0], [0, 0, 1])
        film = {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
        body = {"type": "sphere", "radius": 100.0 / unit, "bsdf": {"type": "null"}, "interior": interior}
        sensor = {"type": "perspective", "fov": 10, "to_world": look, "film": film}
        scene = {"type": "scene", "integrator": {"type": "volpath", "max_depth": 50}, "sensor": sensor}
        return np.array(mi.render(mi.load_dict(scene | {"light": CONSTANT, "body": body}), spp=64, seed=1)).mean((0, 1))

    one = picture(1.0)
    assert picture(1e3) == pytest.approx(one, rel=0.02)
    assert picture(1.0, 2.0) != pytest.approx(one, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("rotation_deg", [0.0, 70.0])
@pytest.mark.parametrize("target", [(1.0, 0.0, 0.2), (-0.6, 1.0, -0.3), (-1.0, -0.2, 0.0), (0.1, -1.0, 0.6)])
def test_environments_are_those_of_mitsuba(target, rotation_deg, tmp_path):
    """Random colours, 8 by 4, looked at by us and by Mitsuba's `envmap`, stood upright as docs/mitsuba.md says.

    Mitsuba interpolates between pixels, so only those are compared whose neighbours show the same colour. Negative
    control: the image mirrored left to right.
    """
    mi.set_variant("scalar_rgb")
    blocks = np.random.default_rng(4).random((4, 8, 3))
    pixels = np.repeat(np.repeat(blocks, 32, axis=0), 32, axis=1)
    look = mi.ScalarTransform4f().look_at([0, 0, 0], list(target), [0, 0, 1])
    upright = mi.ScalarTransform4f([[0, 0, -1, 0], [-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    turned = mi.ScalarTransform4f().rotate([0, 0, 1], rotation_deg)
    film = {"type": "hdrfilm", "width": 24, "height": 16, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    agree = {}
    for name, shown in (("as it is", pixels), ("mirrored", pixels[:, ::-1])):
        image.write_exr(tmp_path / "sky.exr", shown)
        sky = {"type": "envmap", "filename": str(tmp_path / "sky.exr"), "to_world": turned @ upright}
        sensor = {"type": "perspective", "fov": 90.0, "to_world": look, "film": film}
        scene = {"type": "scene", "integrator": {"type": "path"}, "sensor": sensor, "sky": sky}
        if name == "as it is":
            camera = Camera((0.0, 0.0, 0.0), target, 24, 16, fov_deg=90.0)
            speck = SurfaceSpec(Sphere(target, 0.1), (0.5, 0.5, 0.5))  # our cameras want something to see
            lights = (EnvironmentLight(tmp_path / "sky.exr", rotation_deg=rotation_deg),)
            own = render.render(world.build(Scene(camera, lights, (), (speck,)), "teleport"), spp=4).rgb
        other = np.array(mi.render(mi.load_dict(scene), spp=4))
        inner = own[1:-1, 1:-1]
        same = np.array([own[1 + i : 15 + i, 1 + j : 23 + j] == inner for i in (-1, 0, 1) for j in (-1, 0, 1)])
        even = same.all(axis=(0, 3))
        assert even.sum() > 60
        agree[name] = np.isclose(other[1:-1, 1:-1], inner, rtol=1e-4).all(axis=2)[even].mean()
    assert agree["as it is"] == 1.0
    assert agree["mirrored"] < 0.5
