"""Makes ``golden/checks/``: run ``python -m tsdf.reference_data.make_checks``; the same bytes every time.

Sound tables, `BASES`, are stored there; each of the other files is one of them with one thing changed, and breaks a
rule of annex A of SPEC.md. Digests are right throughout. ``--bases`` makes the sound tables anew, which is only
needed when what they hold has changed: their last bits may depend on the machine, the other files' do not.
"""

import copy
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tsdf.data import format as tsdf_format
from tsdf.data.table import thawed
from tsdf.reference_data.make_golden import Header, file

CHECKS = Path(__file__).parent / "golden" / "checks"
BASES = ("sphere", "cube", "cube_identity", "sphere_memory", "cube_memory")


def bases() -> None:
    """Build the sound tables with this library."""
    from tsdf.grain.grains import load_grain
    from tsdf.grain.optics import Optics
    from tsdf.make import assemble
    from tsdf.make.exact import exact_table
    from tsdf.make.tally import Tally
    from tsdf.make.tracer import Tracer

    def grain_of(name: str) -> tuple[Any, Header]:
        g = load_grain(name)
        shape = {"kind": g.kind, "name": g.name, "parameters": dict(g.parameters), "bodies": int(g.bodies)}
        shape |= {"bounding_radius": float(g.bounding_radius), "area": float(g.area), "volume": float(g.volume)}
        shape |= {"convex": bool(g.convex), "faces": len(g.faces), "mesh_sha256": g.mesh_hash, "notes": []}
        return g, shape

    made = {"command": "python -m tsdf.reference_data.make_checks --bases"}
    exact = {**made, "method": "exact", "seed": None, "paths": 0, "max_bounces": None}
    sphere = grain_of("sphere")[1]
    tables = {"sphere": exact_table(40, None, 4, sphere, Optics(1.333, "sp"), exact)}
    tables["sphere_memory"] = exact_table(16, None, 0, sphere, Optics(1.31), exact, memory=16)
    for name, eta, cells, joint, memory, paths in (
        ("cube", 1.31, 16, 8, 0, 1 << 17),
        ("cube_identity", 1.0, 8, 0, 0, 1 << 16),
        ("cube_memory", 1.31, 16, 0, 32, 1 << 17),
    ):
        grain, shape = grain_of("cube")
        tally = Tally(joint, memory)
        Tracer(grain, eta, seed=1).trace(np.arange(paths), tally)
        traced = {**made, "method": "traced", "seed": 1, "paths": paths, "max_bounces": 100_000}
        tables[name] = assemble.traced_table(tally, cells, shape, Optics(eta), traced, memory)
    CHECKS.mkdir(parents=True, exist_ok=True)
    for name, table in tables.items():
        tsdf_format.write(table, CHECKS / f"{name}.tsdf.exr")


class Change:
    """A copy of a sound table, to be changed."""

    def __init__(self, base: str) -> None:
        table = tsdf_format.read(CHECKS / f"{base}.tsdf.exr")
        self.header: Header = copy.deepcopy(thawed(table.header))
        del self.header["pixels_sha256"]  # `file` computes it
        self.pixels = np.array(table.pixels)
        self.place = {block["name"]: slice(block["first_row"], block["first_row"] + block["rows"])
                      for block in self.header["blocks"]}  # fmt: skip

    def block(self, name: str) -> np.ndarray:
        """Return a block to write to."""
        return self.pixels[self.place[name]]

    def drop(self, share: float) -> None:
        """Let a share of the light that met the grain get lost, on the books."""
        ledger = self.header["energy_ledger"]
        met = ledger["launched"] - ledger["unscattered"]
        lost = round(share * met)
        ledger["scattered"], ledger["lost"] = met - lost, lost
        self.header["statistics"]["albedo"] = 1.0 - lost / met


def checks() -> dict[str, bytes]:
    """Return the files by name, CODE or CODE-variant."""
    made: dict[str, bytes] = {}

    def edit(name: str, base: str, change: Callable[[Change], Any]) -> None:
        changed = Change(base)
        change(changed)
        made[name] = file(changed.header, changed.pixels)

    def put(path: str, value: Any) -> Callable[[Change], None]:
        """Set the value at a path into the header, or pass the old one through a function."""

        def change(c: Change) -> None:
            *parents, key = path.split("/")
            place: Any = c.header
            for step in parents:
                place = place[int(step) if isinstance(place, list) else step]
            at: Any = int(key) if isinstance(place, list) else key
            place[at] = value(place[at]) if callable(value) else value

        return change

    def two_percent(value: float) -> float:
        return 1.02 * value

    edit("STATISTICS_METHOD-no_paths", "cube", put("provenance/paths", 0))
    edit("STATISTICS_METHOD-exact_cube", "cube", put("provenance/method", "exact"))

    def absorb(c: Change) -> None:
        c.header["energy_ledger"]["scattered"] -= 1
        c.header["energy_ledger"]["absorbed"] += 1

    edit("STATISTICS_LOSSLESS", "cube", absorb)
    edit("STATISTICS_LEDGER", "cube", put("statistics/hit_probability", lambda hit: hit + 1e-6))
    edit("STATISTICS_DROPPED", "cube", lambda c: c.drop(1e-5))
    edit("STATISTICS_DROPPED_MUCH", "cube", lambda c: c.drop(1e-3))
    edit("STATISTICS_STANDARD_ERRORS-zero", "cube", put("standard_errors/mean_z", 0.0))
    edit("STATISTICS_STANDARD_ERRORS-large", "cube", put("standard_errors/mean_z", 0.5))
    edit("STATISTICS_STANDARD_ERRORS-exact", "sphere", put("standard_errors/mean_z", 0.5))
    edit("STATISTICS_TABLE_ERROR-sum", "cube", put("table_error/total_variation", two_percent))
    edit("STATISTICS_TABLE_ERROR-noise", "cube", lambda c: c.header["table_error"].update(
        sampling_noise=0.0, total_variation=c.header["table_error"]["cell_width"]))  # fmt: skip
    edit("STATISTICS_ATOMS", "cube", put("statistics/atom_forward", two_percent))
    edit("STATISTICS_MEANS-cosine", "sphere", put("statistics/mean_cosine", two_percent))
    edit("STATISTICS_MEANS-path_length", "cube", put("statistics/mean_path_length", lambda length: 0.99 * length))
    edit("STATISTICS_LEGENDRE", "cube", put("statistics/legendre_moments/3", lambda moment: moment + 0.1))
    edit("STATISTICS_FACTORISATION", "cube", put("factorisation_error/mean_offset", 1.0))
    edit("STATISTICS_FITS", "cube", put("fits/henyey_greenstein/total_variation", two_percent))

    def shuffle(c: Change) -> None:
        for name in c.place:
            if name.startswith("joint_"):
                c.block(name)[:, 1:-1] = c.block(name)[:, -2:0:-1].copy()  # the atoms keep theirs

    def stretch(c: Change) -> None:
        c.block("joint_l")[0, 20] += 0.5

    def turn(c: Change) -> None:
        for name in ("joint_phi_delta", "joint_entry_azimuth"):
            inner = c.block(name)[:, 1:-1]
            inner[:] = np.where(inner > 0.0, inner - np.float32(math.pi), inner + np.float32(math.pi))

    edit("STATISTICS_RECORDS", "cube", shuffle)
    edit("STATISTICS_RECORD_SUPPORT", "sphere", stretch)
    edit("PHYSICS_RECIPROCITY", "cube", turn)

    def scale(block: str, factor: float) -> Callable[[Change], None]:
        def change(c: Change) -> None:
            c.block(block)[...] *= np.float32(factor)

        return change

    def lean(c: Change) -> None:
        azimuth, phi_delta = (c.block(f"memory_{name}")[5, 9:10] for name in ("entry_azimuth", "phi_delta"))
        less = 0.25 if azimuth > 1.0 else -0.25
        azimuth -= less
        phi_delta += less

    edit("STATISTICS_MEMORY_HIT", "cube_memory", scale("memory_hit", 0.98))
    edit("STATISTICS_MEMORY-cosine", "cube_memory", scale("memory_cos_theta", 0.5))
    edit("STATISTICS_MEMORY-path_length", "sphere_memory", scale("memory_l", 1.25))
    edit("PHYSICS_SPHERE_MEMORY", "sphere_memory", lean)

    def brighten(column: int, factor: float) -> Callable[[Change], None]:
        def change(c: Change) -> None:
            row = c.block("p_theta")[0]
            more = (factor - 1.0) * row[column]
            row[column] += more
            row[-2] -= more

        return change

    def tilt(c: Change) -> None:
        phi = c.block("p_phi")
        phi[8] += 0.02 * phi[0]
        phi[0] *= 0.98

    def forget(c: Change) -> None:
        # the same p_z whatever the deflection: its mean over all light stays
        p_theta, p_z = c.block("p_theta")[0], c.block("p_z")
        p_z[...] = np.where(p_theta > 0.0, (p_z @ p_theta)[:, None], 0.0)

    edit("PHYSICS_SPHERE_STATISTICS", "sphere", put("statistics/mean_r", two_percent))
    edit("PHYSICS_SPHERE_P_THETA", "sphere", brighten(35, 1.001))
    edit("PHYSICS_SPHERE_P_THETA-convention", "sphere", put("optics/fresnel", "un"))
    edit("PHYSICS_SPHERE_PLANE", "sphere", tilt)
    edit("PHYSICS_SPHERE_CONDITIONALS", "sphere", forget)
    edit("PHYSICS_ZHOU_CURVE", "sphere", brighten(35, 1.02))
    edit("PHYSICS_ZHOU_MONTE_CARLO", "sphere", brighten(34, 1.2))
    edit("PHYSICS_HIT_PROBABILITY", "cube", put("grain/area", two_percent))
    edit("PHYSICS_CHORD", "cube", put("statistics/mean_miss_chord", 0.0))
    edit("PHYSICS_PATH_LENGTH", "cube", put("grain/volume", lambda volume: 0.9 * volume))
    edit("PHYSICS_PATH_LENGTH-short", "cube", put("grain/volume", two_percent))
    edit("PHYSICS_PATH_LENGTH-identity", "cube_identity", put("grain/volume", two_percent))
    edit("PHYSICS_IDENTITY", "cube_identity", put("statistics/mean_z", two_percent))
    return made


def expected(path: Path) -> dict[str, Any]:
    """Return what stands beside a file: the findings, without their numbers."""
    from tsdf.judge.validate import validate

    findings = validate(path).findings
    return {"findings": [{"code": f.code, "severity": f.severity, "pointer": f.pointer} for f in findings]}


def main() -> None:
    """Write all files."""
    if "--bases" in sys.argv[1:]:
        bases()
    for name, data in checks().items():
        path = CHECKS / f"{name}.tsdf.exr"
        path.write_bytes(data)
        text = json.dumps(expected(path), indent=1) + "\n"
        path.with_name(f"{name}.json").write_text(text, "ascii")


if __name__ == "__main__":
    main()
