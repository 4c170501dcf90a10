"""Parameters for renderers that know homogeneous media but no tables, and tables as plain arrays.

All renderers here get the level volume-hg: point scatterers with Henyey-Greenstein lobes. What that costs stands in
each text, as `notes` says it. Coefficients are in 1/scene unit and of linear sRGB; the medium's boundary is
index-matched, for a heap of grains has no surface of its own. The numbers themselves are from `tsdf.scene.medium`.

[1] Kulla & Conty 2017, Revisiting physically based shading at Imageworks (SIGGRAPH course), albedo inversion
[2] OpenPBR 1.1, section on the translucent base; MaterialX 1.39, physically based shading nodes
"""

import csv
import io
import json
import math
import os
import re
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from tsdf.data.blocks import CONDITIONALS
from tsdf.data.table import thawed
from tsdf.files import replacing
from tsdf.loaders.pointmedium import MOST_BOUNCES, PointMedium, bounces, lost
from tsdf.picture import image
from tsdf.scene.scene import Absorption
from tsdf.walk.lights import LUMINANCE

SLAB = 40.0  # [R] thickness at which levels are measured
LEVELS = ("volume-hg", "volume", "teleport")


def level_errors(
    medium: PointMedium, thickness: float, samples: int = 20_000, seed: int = 0
) -> dict[str, tuple[float, float]]:
    """Return the reflectance of a slab under a perpendicular beam by level, and its standard error, by rendering it.

    The slab lies in the scene as `thickness` [scene unit] says; luminance of the colour counts.
    """
    from tsdf.picture import render, world
    from tsdf.scene import scene

    camera = scene.Camera((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 1, 1, up=(0.0, 1.0, 0.0))
    grains = (scene.GrainSpec(medium.table, absorption=Absorption("rgb", medium.absorption)),)
    body = scene.MediumSpec(scene.Slab(-thickness, 0.0), medium.packing_fraction, medium.radius, grains, name="slab")
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        sky = Path(folder) / "sky.exr"
        image.write_exr(sky, np.array([[[1.0] * 3], [[0.0] * 3]]))
        made = scene.Scene(camera, (scene.EnvironmentLight(sky),), (body,), name="slab")
        for level in LEVELS:
            built = world.build(made, level)
            beam = world.beam(built, (0.0, 0.0, medium.radius), (0.0, 0.0, -1.0))
            picture = render.measure(built, beam, spp=samples, seed=seed)
            error = np.sqrt(picture.variance[0, 0])
            found[level] = float(np.dot(LUMINANCE, picture.rgb[0, 0])), float(np.dot(LUMINANCE, error))
    return found


def notes(medium: PointMedium, lobes: int, measured: dict[str, tuple[float, float]] | None = None) -> list[str]:
    """Return what a reader of the parameters has to know, one line each: level, errors, unit."""
    header = medium.table.header
    fits = header["fits"]
    one, two = fits["henyey_greenstein"]["total_variation"], fits["two_lobe"]["total_variation"]
    own = one if lobes == 1 else two
    said = [
        f"{header['grain']['name']}, eta {header['optics']['eta']:g}, packing fraction {medium.packing_fraction:g}, "
        f"bounding radius {medium.radius:g} scene units; by tsdf-export",
        "level volume-hg: point scatterers, " + ("one Henyey-Greenstein lobe" if lobes == 1 else "two lobes"),
        f"error of the phase function: total variation {own:.2g} to the table"
        + (f" (two lobes would leave {two:.2g})" if lobes == 1 and two < one else ""),
    ]
    if any(medium.absorption):
        absorption = medium.absorption if len(set(medium.absorption)) > 1 else medium.absorption[:1]
        both = (", ".join(f"{a * by:.4g}" for a in absorption) for by in (1.0, medium.radius))
        said.append("the grains' material absorbs {} / scene unit, which is {} / R".format(*both))
    if measured is None:
        said.append("error of point scatterers: not measured (option --measure); docs/export.md lists some")
    else:
        (hg, hg_error), (teleport, teleport_error) = measured["volume-hg"], measured["teleport"]
        values = ", ".join(f"{level} {r:.4f} +- {e:.1g}" for level, (r, e) in measured.items())
        said.append(f"reflectance of a slab of {SLAB:g} R by level: {values}")
        said.append(
            f"error of point scatterers: reflects {hg - teleport:+.4f} +- {math.hypot(hg_error, teleport_error):.1g} "
            "against level teleport there"
        )
    return said


@dataclass(frozen=True, eq=False)
class Request:
    """All that a target's text is made of."""

    medium: PointMedium
    lobes: int | None = None  # Henyey-Greenstein lobes, where the target can mix; None: as many as are needed
    kept: float = 0.99  # share of the light to keep [1]
    thickness: float = math.inf  # of the body [scene unit]
    measured: dict[str, tuple[float, float]] | None = None
    said: tuple[str, ...] = ()  # more to say of the grains, one line each: sizes in others' words

    @property
    def name(self) -> str:
        """Name of the grain as an identifier."""
        word = re.sub(r"[^0-9A-Za-z]+", "_", self.medium.table.header["grain"]["name"]).strip("_")
        return word if word[:1].isalpha() else f"grain_{word}".rstrip("_")

    def notes(self, lobes: int = 1) -> list[str]:
        return [*notes(self.medium, lobes, self.measured), *self.said]

    @cached_property
    def bounces(self) -> int:
        """Number of scatterings to follow."""
        return bounces(self.medium, self.kept, self.thickness)

    def depth(self) -> list[str]:
        """Return what is to be said of the number of bounces."""
        n = self.bounces
        body = "a deep body" if math.isinf(self.thickness) else f"a slab {self.thickness:g} thick"
        said = [f"bounces to keep {100.0 * self.kept:g} % of the light that leaves {body}: about {n}"]
        if n > MOST_BOUNCES:
            share = lost(self.medium, MOST_BOUNCES, self.thickness)
            said.append(f"{MOST_BOUNCES} bounces lose about {100.0 * share:.2g} % of it")
        return said


def _number(value: float) -> str:
    return f"{value:.9g}"


def _triple(values: Sequence[float] | np.ndarray, separator: str = " ") -> str:
    return separator.join(_number(float(v)) for v in values)


def pbrt(request: Request) -> str:
    """Return a pbrt-v4 medium, which has one lobe."""
    m = request.medium
    n = request.bounces
    lines = [f"# {note}" for note in request.notes() + request.depth()]
    lines += [
        f'# Integrator "volpath" "integer maxdepth" [ {n} ]   # the default is 5, which is dark',
        f'MakeNamedMedium "{request.name}" "string type" "homogeneous"',
        f'  "rgb sigma_a" [ {_triple(m.sigma_a)} ]',
        f'  "rgb sigma_s" [ {_triple(m.sigma_s)} ]',
        f'  "float g" [ {_number(m.g)} ]',
        f'# MediumInterface "{request.name}" ""',
        '# Material "interface"',
    ]
    return "\n".join(lines) + "\n"


def blender(request: Request) -> str:
    """Return Python for Blender that makes a material of Volume Scatter and Volume Absorption nodes.

    One lobe unless two are asked for: Cycles can mix two, but under lights that it also samples, skies and areas, the
    mix came out too bright (4.5; docs/blender.md).
    """
    m = request.medium
    lobes = m.lobes(request.lobes or 1)
    n = min(request.bounces, MOST_BOUNCES)
    most_s, most_a = float(m.sigma_s.max()), float(m.sigma_a.max())
    # Absorption is density times one minus the colour
    nodes = [("ShaderNodeVolumeScatter", share * most_s, m.sigma_s / most_s, g) for share, g in lobes if most_s > 0.0]
    rows = [f'    ("{kind}", {_number(d)}, ({_triple(c, ", ")}), {_number(g)}),' for kind, d, c, g in nodes]
    if most_a > 0.0:
        colour = _triple(1.0 - m.sigma_a / most_a, ", ")
        rows.append(f'    ("ShaderNodeVolumeAbsorption", {_number(most_a)}, ({colour}), None),')
    remarks = request.notes(len(lobes)) + request.depth()
    if len(lobes) == 2:
        remarks.append("two lobes come out too bright in Cycles 4.5 under sampled skies and areas, see docs/blender.md")
    said = "\n".join(f"# {note}" for note in remarks)
    return (
        f"{said}\n"
        "# Density is per unit of the object: apply the object's scale. Give the object no surface shader.\n"
        "import bpy\n\n"
        "VOLUMES = [  # node, density, colour, anisotropy\n" + "\n".join(rows) + "\n]\n"
        f"BOUNCES = {n}\n\n"
        f'material = bpy.data.materials.new("{request.name}")\n'
        "material.use_nodes = True\n"
        "nodes, links = material.node_tree.nodes, material.node_tree.links\n"
        "nodes.clear()\n"
        'output = nodes.new("ShaderNodeOutputMaterial")\n'
        "volume = None\n"
        "for kind, density, colour, anisotropy in VOLUMES:\n"
        "    node = nodes.new(kind)\n"
        '    node.inputs["Color"].default_value = (*colour, 1.0)\n'
        '    node.inputs["Density"].default_value = density\n'
        "    if anisotropy is not None:\n"
        '        node.inputs["Anisotropy"].default_value = anisotropy\n'
        "    if volume is None:\n"
        "        volume = node.outputs[0]\n"
        "    else:\n"
        '        both = nodes.new("ShaderNodeAddShader")\n'
        "        links.new(volume, both.inputs[0])\n"
        "        links.new(node.outputs[0], both.inputs[1])\n"
        "        volume = both.outputs[0]\n"
        'links.new(volume, output.inputs["Volume"])\n'
        "cycles = bpy.context.scene.cycles\n"
        "cycles.volume_bounces = max(cycles.volume_bounces, BOUNCES)\n"
        "cycles.max_bounces = max(cycles.max_bounces, BOUNCES)\n"
    )


def _document(said: Sequence[str], body: Sequence[str]) -> str:
    """Return a MaterialX document; a comment may not hold two hyphens."""
    comments = [f"  <!-- {note.replace('--', '- -')} -->" for note in said]
    head = ['<?xml version="1.0"?>', '<materialx version="1.39" colorspace="lin_rec709">']
    return "\n".join([*head, *comments, *body, "</materialx>"]) + "\n"


def _node(kind: str, name: str, of: str, *inputs: tuple[str, str, str]) -> list[str]:
    """Return a node with inputs of name, type and value; a value that begins with @ is the name of a node."""
    rows = [
        f"    <input name={quoteattr(n)} type={quoteattr(t)} "
        + (f"nodename={quoteattr(v[1:])} />" if v.startswith("@") else f"value={quoteattr(v)} />")
        for n, t, v in inputs
    ]
    return [f"  <{kind} name={quoteattr(name)} type={quoteattr(of)}>", *rows, f"  </{kind}>"]


def openpbr(request: Request) -> str:
    """Return a MaterialX document of two OpenPBR surfaces [2]: the medium itself, and a surface of its colour.

    transmission_color is what is left of a beam after transmission_depth, so that extinction is -ln(colour) / depth,
    and transmission_scatter / depth is scattering.
    """
    m, name = request.medium, request.name
    depth = 1.0 / float(m.sigma_t.max())
    shared = (("base_weight", "float", "0"), ("specular_weight", "float", "0"))
    body = _node(
        "open_pbr_surface", f"{name}_volume", "surfaceshader",
        *shared,
        ("transmission_weight", "float", "1"),
        ("transmission_color", "color3", _triple(np.exp(-m.sigma_t * depth), ", ")),
        ("transmission_depth", "float", _number(depth)),
        ("transmission_scatter", "color3", _triple(m.sigma_s * depth, ", ")),
        ("transmission_scatter_anisotropy", "float", _number(m.g)),
    )  # fmt: skip
    longest = float((1.0 / m.sigma_t).max())
    body += _node(
        "open_pbr_surface", f"{name}_subsurface", "surfaceshader",
        *shared,
        ("subsurface_weight", "float", "1"),
        ("subsurface_color", "color3", _triple(m.colour(), ", ")),
        ("subsurface_radius", "float", _number(longest)),
        ("subsurface_radius_scale", "color3", _triple(1.0 / m.sigma_t / longest, ", ")),
        ("subsurface_scatter_anisotropy", "float", _number(m.g)),
    )  # fmt: skip
    for kind in ("volume", "subsurface"):
        body += _node(
            "surfacematerial", f"{name}_{kind}_material", "material",
            ("surfaceshader", "surfaceshader", f"@{name}_{kind}"),
        )  # fmt: skip
    said = request.notes() + request.depth()
    said.append("take _volume where the renderer traces inside closed meshes, _subsurface where it does not")
    return _document(said, body)


def materialx(request: Request) -> str:
    """Return a MaterialX document of a volume of one anisotropic VDF or of a mix of two [2]."""
    m, name = request.medium, request.name
    lobes = m.lobes(request.lobes)
    body: list[str] = []
    for number, (_, g) in enumerate(lobes, 1):
        body += _node(
            "anisotropic_vdf", f"{name}_lobe{number}", "VDF",
            ("absorption", "vector3", _triple(m.sigma_a, ", ")),
            ("scattering", "vector3", _triple(m.sigma_s, ", ")),
            ("anisotropy", "float", _number(g)),
        )  # fmt: skip
    whole = f"{name}_lobe1"
    if len(lobes) == 2:
        whole = f"{name}_lobes"
        body += _node(
            "mix", whole, "VDF",
            ("fg", "VDF", f"@{name}_lobe1"), ("bg", "VDF", f"@{name}_lobe2"), ("mix", "float", _number(lobes[0][0])),
        )  # fmt: skip
    body += _node("volume", f"{name}_volume", "volumeshader", ("vdf", "VDF", f"@{whole}"))
    body += _node(
        "volumematerial", f"{name}_material", "material", ("volumeshader", "volumeshader", f"@{name}_volume")
    )  # fmt: skip
    return _document(request.notes(len(lobes)) + request.depth(), body)


def arnold(request: Request) -> str:
    """Return an Arnold standard_volume, which has one lobe, as .ass text."""
    m = request.medium
    density = float(m.sigma_t.max())
    n = request.bounces
    lines = [f"# {note}" for note in request.notes() + request.depth()]
    lines += [
        f"# options: GI_volume_depth {n}, GI_total_depth {n}; polymesh: step_size > 0 makes it a volume",
        "standard_volume",
        "{",
        f" name {request.name}",
        f" density {_number(density)}",
        " scatter 1",
        f" scatter_color {_triple(m.sigma_s / m.sigma_t)}",
        f" scatter_anisotropy {_number(m.g)}",
        f" transparent {_triple(np.exp(-m.sigma_t / density))}",
        " transparent_depth 1",
        ' emission_mode "none"',
        "}",
    ]
    return "\n".join(lines) + "\n"


def karma(request: Request) -> str:
    """Return the parameters of the Karma Volume node (kma_volume), which mixes two lobes."""
    m = request.medium
    lobes = m.lobes(request.lobes)
    n = request.bounces
    lines = [f"# {note}" for note in request.notes(len(lobes)) + request.depth()]
    lines += [
        f"# Render settings: volume limit {n}",
        "[Karma Volume]",
        f"Absorption = {_triple(m.sigma_a)}",
        f"Scattering = {_triple(m.sigma_s)}",
        f"Anisotropy = {_number(lobes[0][1])}",
    ]
    if len(lobes) == 2:
        lines += [f"Secondary Anisotropy = {_number(lobes[1][1])}", f"Secondary Mix = {_number(lobes[1][0])}"]
    return "\n".join(lines) + "\n"


def facts(medium: PointMedium) -> dict[str, float | list[float]]:
    """Return the medium as plain numbers."""
    lobes = medium.lobes(2)
    return {
        "packing_fraction": medium.packing_fraction,
        "radius": medium.radius,
        "absorption": list(medium.absorption),
        "absorption_times_radius": [a * medium.radius for a in medium.absorption],
        "sigma_t": medium.sigma_t.tolist(),
        "sigma_s": medium.sigma_s.tolist(),
        "sigma_a": medium.sigma_a.tolist(),
        "g": medium.g,
        "two_lobe_weight": lobes[0][0],
        "two_lobe_g": [g for _, g in lobes],
    }


def csv_text(request: Request) -> str:
    """Return statistics, medium and masses as CSV: quantity, column's cell of cos theta, row's cell, value."""
    table, text = request.medium.table, io.StringIO()
    text.writelines(f"# {note}\n" for note in request.notes())
    sheet = csv.writer(text, lineterminator="\n")
    sheet.writerow(["quantity", "cos_theta_low", "cos_theta_high", "low", "high", "value"])
    for group, values in (("statistics", thawed(table.statistics)), ("medium", facts(request.medium))):
        for name, value in values.items():
            numbers = {f"[{i}]": v for i, v in enumerate(value)} if isinstance(value, list) else {"": value}
            for index, number in numbers.items():
                sheet.writerow([f"{group}.{name}{index}", "", "", "", "", number])
    columns = table.cos_theta_edges.tolist()
    cells = list(pairwise(columns))
    for cell, mass in zip(cells, table.p_theta.tolist(), strict=True):
        sheet.writerow(["p_theta", *cell, "", "", mass])
    for name in CONDITIONALS:
        edges = table.edges(name).tolist()
        for (low, high), row in zip(pairwise(edges), table.block(name).astype(float).tolist(), strict=True):
            sheet.writerows([name, *cell, low, high, mass] for cell, mass in zip(cells, row, strict=True))
    return text.getvalue()


def write_npz(request: Request, path: str | os.PathLike[str]) -> None:
    """Write all blocks of the table by name, edges, header and medium as NumPy arrays; nothing in it is pickled.

    Texts (`header`, `medium`: JSON; `notes`: lines) are arrays of text. The same request gives the same bytes.

    Raises
    ------
    TSDFError
        If the file cannot be written.
    """
    table = request.medium.table
    arrays = {block["name"]: table.block(block["name"]) for block in table.header["blocks"]}
    arrays |= {f"{name}_edges": table.edges(name) for name in CONDITIONALS}
    arrays |= {
        "cos_theta_edges": table.cos_theta_edges,
        "header": np.array(json.dumps(thawed(table.header), sort_keys=True)),
        "medium": np.array(json.dumps(facts(request.medium))),
        "notes": np.array(request.notes()),
    }
    with replacing(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, **arrays)


TEXTS: dict[str, Callable[[Request], str]] = {
    "pbrt": pbrt,
    "blender": blender,
    "openpbr": openpbr,
    "materialx": materialx,
    "arnold": arnold,
    "karma": karma,
    "csv": csv_text,
}
