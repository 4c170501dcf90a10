"""Origin of a table: what its header says of the grain, and the command that makes it again."""

import shlex
from collections.abc import Mapping
from typing import Any

from tsdf.grain.grains import Grain
from tsdf.grain.optics import Optics
from tsdf.make.effort import Effort


def printable(text: str) -> str:
    """Return text from outside as one line that a header can hold; file names may have line breaks in them."""
    return text if text.isprintable() else ascii(text)[1:-1]


def grain_header(grain: Grain) -> dict[str, Any]:
    """Return the header's account of a grain."""
    return known_header(grain) | extent_header(grain)


def known_header(grain: Grain) -> dict[str, Any]:
    """Return what of it needs no search."""
    return {
        "kind": grain.kind,
        "name": printable(grain.name),
        "parameters": dict(grain.parameters),
        "bounding_radius": float(grain.bounding_radius),
        "area": float(grain.area),
        "volume": float(grain.volume),
        "convex": bool(grain.convex),
        "bodies": max(1, int(grain.bodies)),
        "faces": len(grain.faces),
        "mesh_sha256": grain.mesh_hash or None,
        "notes": [printable(note)[:1000] for note in grain.notes[:256]],
    }


def extent_header(grain: Grain) -> dict[str, float]:
    """Return how large a grain is across [R], to four decimals so that every machine finds the same."""
    if grain.kind == "sphere":
        return {"x_maximum_dimension": 2.0, "x_sieve": 2.0}
    from tsdf.grain.extent import maximum_dimension, sieve

    across = maximum_dimension(grain.vertices), sieve(grain.vertices)
    return {"x_maximum_dimension": round(across[0], 4), "x_sieve": round(across[1], 4)}


def canonical_command(grain: Mapping[str, Any], optics: Optics, effort: Effort, traced: bool) -> str:
    """Return the command that makes the same table: no paths of this machine, no threads, no chunks, no target."""
    words = ["tsdf-build", shlex.quote(grain["name"])]
    words += ["--repair-any"] if any(note.startswith("repair") for note in grain["notes"]) else []
    words += [f"--set {key}={value}" for key, value in grain["parameters"].items()]
    if optics.material is not None:
        words += [f"--material {shlex.quote(optics.material)}", f"--wavelength-nm {optics.wavelength_nm!r}"]
    else:
        words += [f"--eta {optics.eta!r}"]
    words += [f"--fresnel {optics.fresnel}"] if grain["kind"] == "sphere" else []
    words += ["--traced"] if traced and grain["kind"] == "sphere" else []
    if traced:
        words += [f"--paths {effort.paths}"] if effort.target_error is None else []
        words += [f"--seed {effort.seed}", f"--max-bounces {effort.max_bounces}"]
    words += [f"--target-error {effort.target_error!r}"] if effort.target_error is not None else []
    words += [f"--cells {effort.cells}"] if effort.cells is not None else []
    words += [f"--joint {effort.joint}"] if effort.joint else []
    words += [f"--memory {effort.memory}"] if effort.memory else []
    return " ".join(words)
