"""plots: pictures show what the table holds, at the true edges, and the same table gives the same bytes."""

import json
import math
import subprocess
import sys

import numpy as np
import pytest

import tsdf
from tsdf.data import format as tsdf_format
from tsdf.data.table import Table, thawed
from tsdf.errors import TSDFError, UsageError
from tsdf.reference_data.make_checks import CHECKS
from tsdf.study import plots


@pytest.fixture(scope="module")
def tables():
    return {name: tsdf_format.read(CHECKS / f"{name}.tsdf.exr") for name in ("sphere", "cube", "cube_identity")}


def axes_of(figure, title):
    return next(axes for axes in figure.axes if title in axes.get_title())


@pytest.mark.slow
@pytest.mark.parametrize(("draw", "suffix"), [(plots.plot_table, "pdf"), (plots.plot_validation, "png")])
def test_same_table_same_bytes(tables, tmp_path, draw, suffix):
    first, second = tmp_path / f"a.{suffix}", tmp_path / f"b.{suffix}"
    plots.save(draw(tables["cube_identity"]), first)
    plots.save(draw(tables["cube_identity"]), second)
    assert first.read_bytes() == second.read_bytes()
    assert first.read_bytes().startswith(b"\x89PNG" if suffix == "png" else b"%PDF")
    assert sorted(p.name for p in tmp_path.iterdir()) == [first.name, second.name]


def test_columns_stand_at_their_edges_with_their_densities(tables):
    table = tables["sphere"]
    image = axes_of(plots.plot_table(table), r"p(r\,").collections[0]
    corners = image.get_coordinates()
    np.testing.assert_allclose(corners[0, :, 0], table.cos_theta_edges[1:-1])
    np.testing.assert_allclose(corners[:, 0, 1], table.edges("p_r"))
    density = table.p_r[:, 1:-1] / np.diff(table.edges("p_r"))[:, None]
    np.testing.assert_allclose(np.ma.filled(image.get_array(), 0.0), density, rtol=1e-6)
    steps = axes_of(plots.plot_table(table), "p_\\theta").patches[0].get_data()
    np.testing.assert_allclose(steps.values, table.p_theta[1:-1] / np.diff(table.cos_theta_edges)[1:-1])


def test_few_long_paths_do_not_set_the_axis():
    """One light path in ten thousand of the quartz grain is hundreds of R long; what the picture leaves out it says."""
    table = tsdf.library("quartz")
    axes = axes_of(plots.plot_table(table), r"p(l\,")
    low, high = axes.get_ylim()
    share = table.p_l @ table.p_theta
    longer = 100.0 * float(share[table.edges("p_l")[:-1] >= high].sum())
    assert low == 0.0 and high < 20.0 and 0.1 < longer <= 1.0
    assert f"{longer:.2g} % is longer" in axes.get_title()


def test_atoms_are_marked(tables):
    figure = plots.plot_table(tables["cube"])
    text = [t.get_text() for axes in figure.axes for t in axes.texts]
    share = 100 * tables["cube"].statistics["atom_forward"]
    assert f"atom {share:.3g} %" in text
    ticks = [label.get_text() for label in axes_of(figure, r"p(z\,").get_xticklabels()]
    assert ticks.count("atom") == 2  # corners send light exactly back
    assert len(axes_of(figure, r"p(z\,").collections) == 3


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cube", "cube_identity", "sphere"])
def test_the_legend_covers_nothing(tables, name):
    """It stands clear of the axes and of the labels of atoms, and has a line for each curve."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure = plots.plot_validation(tables[name])
    FigureCanvasAgg(figure).draw()
    (legend,) = figure.legends
    box = legend.get_window_extent()
    texts = [text for axes in figure.axes for text in axes.texts if text.get_text()]
    assert (len(texts) > 0) == name.startswith("cube")
    for artist in (*figure.axes, *texts):
        assert not box.overlaps(artist.get_tightbbox())
    assert figure.bbox.containsx(box.x0) and figure.bbox.containsx(box.x1) and box.y0 >= 0.0
    assert len(legend.get_texts()) == len(figure.axes[0].get_legend_handles_labels()[0]) >= 3


@pytest.mark.slow
def test_a_table_that_is_all_atom(tables):
    for draw in (plots.plot_table, plots.plot_validation):
        assert draw(tables["cube_identity"]).axes


@pytest.mark.slow
def test_the_validation_of_a_sphere_is_figure_8(tables):
    axes = plots.plot_validation(tables["sphere"]).axes[0]
    assert (axes.get_xlim(), axes.get_ylim()) == ((0.0, 180.0), (0.01, 100.0))
    labels = axes.get_legend_handles_labels()[1]
    assert "GOMsphere" in labels and "N = 2, orders 0 and 1" in labels and any("Monte Carlo" in x for x in labels)
    header = thawed(tables["sphere"].header)
    header["optics"] |= {"eta": 1.5, "fresnel": "un"}
    labels = plots.plot_validation(Table(header, tables["sphere"].pixels)).axes[0].get_legend_handles_labels()[1]
    assert "exact geometrical optics" in labels and not any("Monte Carlo" in x for x in labels)


def test_names_are_shown_literally(tables, tmp_path):
    """Mathematics, escapes and other scripts in a grain's name neither fail nor change the title."""
    header = thawed(tables["cube"].header)
    header["grain"]["name"] = "$\\frac{\u5b57 \x1b[2J" + "x" * 100
    figure = plots.plot_validation(Table(header, tables["cube"].pixels))
    plots.save(figure, tmp_path / "a.png")
    assert "\x1b" not in figure.get_suptitle()


def test_outputs_that_cannot_be(tables, tmp_path):
    for name in ("a.gif", "a", "png"):
        with pytest.raises(UsageError, match="a picture is"):
            plots.check_suffix(tmp_path / name)
    figure = plots.plot_validation(tables["cube"])
    with pytest.raises(TSDFError, match="cannot write"):
        plots.save(figure, tmp_path / "missing" / "a.png")
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(TSDFError, match="cannot write"):
        plots.save(figure, tmp_path / "folder.png")
    assert [p.name for p in tmp_path.iterdir()] == ["folder.png"]


@pytest.mark.slow
def test_no_global_state():
    """Importing plots imports no matplotlib; drawing keeps its settings."""
    script = (
        "import json, sys\n"
        "from tsdf.data import format as tsdf_format\n"
        "from tsdf.study import plots\n"
        "late = 'matplotlib' not in sys.modules\n"
        "import matplotlib\n"
        "before = dict(matplotlib.rcParams)\n"
        f"plots.plot_validation(tsdf_format.read({str(CHECKS / 'cube.tsdf.exr')!r}))\n"
        "print(json.dumps([late, before == dict(matplotlib.rcParams)]))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == [True, True]


@pytest.mark.parametrize("layers", [[4.0], [4.0, 40.0]])
def test_levels_stand_beside_each_other_where_there_is_one_place(layers: list[float]) -> None:
    """tsdf-accuracy with one --layer and --packing: no mark hides another, and explicit's error has a band."""
    levels = {"explicit": math.nan, "teleport-memory": 0.01, "teleport": 0.011, "volume": 0.012}
    number = {"value": 1.0, "error": 0.01, "deviation_error": 0.01, "fraction": 0.5}
    bulk = [
        {**number, "quantity": quantity, "level": level, "deviation": deviation, "layer": math.nan, "albedo": math.nan}
        for quantity in ("displacement", "time") for level, deviation in levels.items()
    ]  # fmt: skip
    slabs = [
        {**row, "quantity": "reflectance", "layer": layer, "angle_deg": angle, "albedo": 1.0}
        for row in bulk[:4] for layer in layers for angle in (0.0, 60.0)
    ]  # fmt: skip
    figure = plots.plot_accuracy(bulk + slabs, 0.5, "ball")
    for axes, places, angles in ((figure.axes[0], 1, 1), (figure.axes[1], len(layers), 2)):
        marks = [x for bars in axes.containers for x in bars.lines[0].get_xdata()]
        assert len(marks) == 3 * places * angles
        assert len(set(marks)) == (len(marks) if places == 1 else places)
        assert axes.get_xlim()[0] < min(marks) and max(marks) < axes.get_xlim()[1]
        assert np.ptp(axes.collections[0].get_paths()[0].vertices[:, 0]) > 0.0
    assert [tick.get_text() for tick in figure.axes[1].get_xticklabels()] == [f"{layer:g}" for layer in layers]
