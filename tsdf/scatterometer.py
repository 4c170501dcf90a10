"""How a table is made: a grain, its optics and an effort in, a `Table` out.

Paths are numbered and traced in chunks whose limits depend on nothing but the numbers, and all counts are integers
that add up in any order, so the same request gives the same bytes for any number of threads, interrupted and resumed
or not, in one piece or in parts merged afterwards. After each chunk the counts go to a part file beside the output.
"""

import io
import json
import math
import shlex
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tsdf import estimate
from tsdf import tally as T
from tsdf.errors import GrainError, TSDFError, UsageError
from tsdf.exact import exact_table
from tsdf.files import replacing
from tsdf.grains import Grain
from tsdf.optics import Optics
from tsdf.table import Table
from tsdf.tally import Tally
from tsdf.tracer import MAX_BOUNCES, Tracer, in_order

DEFAULT_PATHS = 4_000_000
DEFAULT_CELLS = 256
MIN_PATHS = 16 * T.REPLICATES  # fewer give no honest standard error
MAX_PATHS = 1 << 36  # 6.9e10: 2^30 in each replicate, whose energy times path length stays below 2^63
MAX_JOINT = 1024
MAX_LEAK = 1e-4  # share of the light that may be lost or cut off before a grain is refused
CHUNK_MIN, CHUNK_MAX = 1 << 13, 1 << 20
PART_VERSION = 2


@dataclass(frozen=True)
class Effort:
    """How much to trace and what to keep.

    Parameters
    ----------
    paths : int, optional
        Number of paths, MIN_PATHS .. MAX_PATHS; DEFAULT_PATHS unless there is a target.
    target_error : float, optional
        Stop when the estimated total variation of p_theta is this small; in (0, 1).
    cells : int, optional
        Cells of theta, MIN_CELLS .. MAX_CELLS; DEFAULT_CELLS, or with a target the fewest that meet it.
    joint : int
        Joint records per cell of theta, 0 .. MAX_JOINT.
    seed : int
        0 .. 2^63 - 1.
    max_bounces : int
        Hits after which a path is cut off.
    memory : int
        Records per cell of entry_b2, 0 .. MAX_JOINT; there are as many cells as columns.

    Raises
    ------
    UsageError
        If a value is out of range.
    """

    paths: int | None = None
    target_error: float | None = None
    cells: int | None = None
    joint: int = 0
    seed: int = 0
    max_bounces: int = MAX_BOUNCES
    memory: int = 0

    def __post_init__(self) -> None:
        if self.paths is not None and not (MIN_PATHS <= self.paths <= MAX_PATHS):
            raise UsageError(
                f"the number of paths must be {MIN_PATHS} to {MAX_PATHS:.2g}, got {self.paths:.6g}: errors are told "
                f"from {T.REPLICATES} independent samples, and counts must stay exact"
            )
        if self.target_error is not None and not (0.0 < self.target_error < 1.0):
            raise UsageError(f"the target error is a total variation between 0 and 1, got {self.target_error:g}")
        if self.paths is not None and self.target_error is not None:
            raise UsageError("give a number of paths or a target error, not both")
        if self.cells is not None and not (estimate.MIN_CELLS <= self.cells <= estimate.MAX_CELLS):
            raise UsageError(
                f"the cells of theta must be {estimate.MIN_CELLS} to {estimate.MAX_CELLS}, got {self.cells}"
            )
        if not (0 <= self.joint <= MAX_JOINT):
            raise UsageError(f"the joint records per cell must be 0 to {MAX_JOINT}, got {self.joint}")
        if not (0 <= self.memory <= MAX_JOINT):
            raise UsageError(f"the records per cell of entry must be 0 to {MAX_JOINT}, got {self.memory}")
        if not (0 <= self.seed < 1 << 63):
            raise UsageError(f"the seed must be 0 to 2^63 - 1, got {self.seed}")
        if not (1 <= self.max_bounces <= 10**9):
            raise UsageError(f"the bounce limit must be 1 to 1e9, got {self.max_bounces}")

    def resolved(self) -> "Effort":
        """Return the effort with its defaults filled in."""
        values = asdict(self)
        if self.target_error is None:
            values["paths"] = self.paths or DEFAULT_PATHS
            values["cells"] = self.cells or DEFAULT_CELLS
        return Effort(**values)


def chunks(paths: int | None) -> Iterator[tuple[int, int]]:
    """Yield the first and last + 1 path number of each chunk: an eighth of what is done, within limits, forever
    unless the number of paths is given."""
    end = MAX_PATHS if paths is None else paths
    first = 0
    while first < end:
        size = min(max(first // 8 // CHUNK_MIN * CHUNK_MIN, CHUNK_MIN), CHUNK_MAX)
        yield first, min(first + size, end)
        first += size


def grain_header(grain: Grain) -> dict[str, Any]:
    """Return the header's account of a grain."""
    return {
        "kind": grain.kind,
        "name": grain.name,
        "parameters": dict(grain.parameters),
        "bounding_radius": float(grain.bounding_radius),
        "area": float(grain.area),
        "volume": float(grain.volume),
        "convex": bool(grain.convex),
        "bodies": max(1, int(grain.bodies)),
        "faces": len(grain.faces),
        "mesh_sha256": grain.mesh_hash or None,
        "notes": list(grain.notes),
    }


def canonical_command(grain: Mapping[str, Any], optics: Optics, effort: Effort, traced: bool) -> str:
    """Return the command that makes the same table: no paths of this machine, no threads, no chunks."""
    words = ["tsdf-build", shlex.quote(grain["name"])]
    words += ["--repair"] if any(note.startswith("repair") for note in grain["notes"]) else []
    words += [f"--set {key}={value}" for key, value in grain["parameters"].items()]
    if optics.material is not None:
        words += [f"--material {optics.material}", f"--wavelength-nm {optics.wavelength_nm!r}"]
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


def exact_sphere(grain: Grain, optics: Optics, effort: Effort) -> Table:
    """Return the table of the exact sphere, by quadrature.

    Raises
    ------
    UsageError
        If the target error is out of reach of any number of cells.
    """
    header = grain_header(grain)
    cells = effort.cells or (None if effort.target_error is not None else DEFAULT_CELLS)
    provenance = {
        "method": "exact",
        "command": canonical_command(header, optics, effort, traced=False),
        "seed": None,
        "paths": 0,
        "max_bounces": None,
    }
    return exact_table(cells, effort.target_error, effort.joint, header, optics, provenance, effort.memory)


@dataclass
class Progress:
    """How far a build has come."""

    paths: int = 0
    rays: int = 0
    total: int | None = None
    error: float | None = None
    cells: int | None = None

    def at(self, error: estimate.TableError | None) -> "Progress":
        """Take note of the error reached and return self."""
        self.error, self.cells = (error.total_variation, error.cells) if error else (None, None)
        return self


@dataclass(eq=False)
class Build:
    """A table in the making: what was asked for, the chunks done and their counts.

    Parameters
    ----------
    grain : mapping
        As in the header, so that a table can be finished without the mesh.
    optics : Optics
    effort : Effort
        Resolved.
    done : set of int
        Numbers of the chunks whose paths are in `tally`.
    """

    grain: dict[str, Any]
    optics: Optics
    effort: Effort
    tally: Tally
    done: set[int] = field(default_factory=set)

    @classmethod
    def start(cls, grain: Grain, optics: Optics, effort: Effort) -> "Build":
        """Return a build of which nothing is done yet."""
        if grain.kind != "sphere" and optics.fresnel != "un":
            raise UsageError(
                "polarisations can only be kept apart for the exact sphere, where each path stays in one plane: "
                "use --fresnel un for meshes"
            )
        effort = effort.resolved()
        return cls(grain_header(grain), optics, effort, Tally(joint=effort.joint, memory=effort.memory))

    @property
    def request(self) -> dict[str, Any]:
        """What decides the result: equal requests give equal tables."""
        return {
            "part_version": PART_VERSION,
            "software": estimate.software(),
            "grain": self.grain,
            "optics": asdict(self.optics),
            "effort": asdict(self.effort),
        }

    @property
    def paths(self) -> int:
        """Number of paths done."""
        return sum(last - first for k, (first, last) in self._numbered() if k in self.done)

    def _numbered(self) -> Iterator[tuple[int, tuple[int, int]]]:
        last = max(self.done, default=-1)
        for k, limits in enumerate(chunks(self.effort.paths)):
            if self.effort.paths is None and k > last:
                return
            yield k, limits

    def error(self) -> estimate.TableError | None:
        """Return the error of the table that would be made now; with a target and no fixed cells, at its best."""
        if not self.tally.scalars[:, T.SCATTERED].all():
            return None
        if self.effort.cells is not None:
            return estimate.table_error(self.tally, self.effort.cells)
        assert self.effort.target_error is not None
        found = estimate.smallest_enough(self.tally, self.effort.target_error)
        if found is not None:
            return found
        errors = (estimate.table_error(self.tally, cells) for cells in estimate.candidate_cells()[::4])
        return min(errors, key=lambda error: error.total_variation)

    def met(self, error: estimate.TableError | None) -> bool:
        """Tell whether the target is met, or refuse one that never can be.

        Raises
        ------
        UsageError
            If the cells alone cost more than the target and more paths cannot help.
        """
        target = self.effort.target_error
        if target is None or error is None:
            return False
        if error.total_variation <= target:
            return True
        finest = estimate.table_error(self.tally, self.effort.cells or estimate.MAX_CELLS)
        if finest.cell_width > 1.5 * target and finest.sampling_noise < 0.5 * target:
            raise UsageError(
                f"--target-error {target:g} is out of reach: {finest.cells} cells of theta alone cost "
                f"{finest.cell_width:.2g} of total variation; "
                + ("allow more --cells" if self.effort.cells else "give a larger --target-error, or --paths")
            )
        return False

    def run(
        self,
        grain: Grain,
        threads: int = 1,
        part: tuple[int, int] = (1, 1),
        part_file: Path | None = None,
        report: Callable[[Progress], None] | None = None,
        reflectance_scale: float = 1.0,
    ) -> None:
        """Trace the chunks that are not done, saving the counts to `part_file` after each.

        Parameters
        ----------
        threads : int
            Threads that share each chunk.
        part : (int, int)
            Only chunks i, i + n, ... of n parts, counting from 1.
        report : callable
            Called after each chunk.
        reflectance_scale : float
            Makes a wrong tracer, to test the tests, see `tracer.Tracer`.

        Raises
        ------
        GrainError
            If the grain loses more than MAX_LEAK of the light, told once enough paths are done to be sure.
        """
        tracers = [
            Tracer(
                grain,
                self.optics.eta,
                self.optics.fresnel,
                self.effort.seed,
                self.effort.max_bounces,
                reflectance_scale=reflectance_scale,
            )
            for _ in range(threads)
        ]
        tallies = [Tally(joint=self.effort.joint, memory=self.effort.memory) for _ in range(threads)]
        tracers[0].trace(in_order(0, T.REPLICATES), tallies[0])  # compiles what is not compiled yet
        tallies[0].clear()
        stop = threading.Event()
        numbered = enumerate(chunks(self.effort.paths)) if self.effort.paths is not None else ()
        mine = sum(last - first for k, (first, last) in numbered if k % part[1] == part[0] - 1)
        progress = Progress(self.paths, 0, mine or None)
        if part_file is not None and mine == 0 and self.effort.paths is not None:
            self.save(part_file)  # more parts than chunks: this one is empty, but there
        error = self.error() if self.done else None
        if report is not None:
            report(progress.at(error))
        if self.met(error):
            return
        with ThreadPoolExecutor(threads) as pool:
            try:
                for k, (first, last) in enumerate(chunks(self.effort.paths)):
                    if k in self.done or k % part[1] != part[0] - 1:
                        continue
                    shares = np.array_split(in_order(first, last), threads)
                    jobs = [
                        pool.submit(tracer.trace, share, tally, stop)
                        for tracer, share, tally in zip(tracers, shares, tallies, strict=True)
                    ]
                    progress.rays += sum(job.result() for job in jobs)
                    for tally in tallies:
                        self.tally.add(tally)
                        tally.clear()
                    self.done.add(k)
                    if part_file is not None:
                        self.save(part_file)
                    progress.paths += last - first
                    error = self.error() if report is not None or self.effort.target_error is not None else None
                    if report is not None:
                        report(progress.at(error))
                    self.check_leaks(doubt=4.0)
                    if self.met(error):
                        return
            except BaseException:
                stop.set()
                raise
        if self.effort.target_error is not None:
            raise TSDFError(
                f"--target-error {self.effort.target_error:g} was not met after {MAX_PATHS:.2g} paths: give more"
            )

    def check_leaks(self, doubt: float = 0.0) -> None:
        """Refuse a grain whose tracing loses too much light.

        Parameters
        ----------
        doubt : float
            Standard errors, of rare whole paths, by which it must be too much.

        Raises
        ------
        GrainError
            If more than MAX_LEAK of the light launched was lost at the surface or cut off by the bounce limit.
        """
        sums = self.tally.scalars.astype(object).sum(axis=0)
        launched, lost, cut = sums[T.LAUNCHED], sums[T.LOST], sums[T.TRUNCATED]
        limit = MAX_LEAK * launched + doubt * math.sqrt(MAX_LEAK * launched / T.UNIT) * T.UNIT
        if lost > limit:
            raise GrainError(
                f"{self.grain['name']}: {lost / launched:.2g} of the light was lost at the surface, more than "
                f"{MAX_LEAK:g}: the mesh leaks or intersects itself; mend it, or try --repair"
            )
        if cut > limit:
            raise GrainError(
                f"{self.grain['name']}: {cut / launched:.2g} of the light was still inside after "
                f"{self.effort.max_bounces} bounces, more than {MAX_LEAK:g}: raise --max-bounces"
            )

    def table(self) -> Table:
        """Return the finished table.

        Raises
        ------
        TSDFError
            If chunks are missing.
        """
        if self.effort.paths is not None:
            missing = [k for k, _ in enumerate(chunks(self.effort.paths)) if k not in self.done]
            if missing:
                raise TSDFError(
                    f"{len(missing)} of {len(missing) + len(self.done)} chunks are missing: give all the parts"
                )
        self.check_leaks()
        error = self.error()
        if error is None or (self.effort.target_error is not None and not self.met(error)):
            raise TSDFError("the target error is not met yet: go on with --resume")
        provenance = {
            "method": "traced",
            "command": canonical_command(self.grain, self.optics, self.effort, traced=True),
            "seed": self.effort.seed,
            "paths": self.paths,
            "max_bounces": self.effort.max_bounces,
        }
        return estimate.traced_table(self.tally, error.cells, self.grain, self.optics, provenance, self.effort.memory)

    def save(self, path: Path) -> None:
        """Write the part file, atomically.

        Raises
        ------
        TSDFError
            If it cannot be written; the file that stood there is left as it was.
        """
        request = np.frombuffer(json.dumps(self.request).encode(), dtype=np.uint8)
        arrays: dict[str, Any] = {
            "request": request,
            "done": np.array(sorted(self.done), dtype=np.int64),
            **self.tally.arrays(),
        }
        with replacing(path) as temporary, temporary.open("wb") as file:
            np.savez(file, **arrays)

    @classmethod
    def load(cls, path: Path) -> "Build":
        """Read a part file.

        Raises
        ------
        TSDFError
            If it is missing, damaged, or of another version of this software.
        """
        try:
            with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as stored:
                arrays = {name: stored[name] for name in stored.files}
            request = json.loads(arrays.pop("request").tobytes())
            build = cls(
                request["grain"],
                Optics(**request["optics"]),
                Effort(**request["effort"]),
                Tally(joint=request["effort"]["joint"], memory=request["effort"]["memory"]),
                {int(k) for k in arrays.pop("done")},
            )
            if request != json.loads(json.dumps(build.request)):
                raise TSDFError(f"{path}: made by another version ({request.get('software')}): build it again")
            for name, mine in build.tally.arrays().items():
                if arrays[name].shape != mine.shape or arrays[name].dtype != mine.dtype:
                    raise ValueError(name)
                mine[...] = arrays[name]
        except FileNotFoundError:
            raise TSDFError(f"{path}: no such file") from None
        except OSError as error:
            raise TSDFError(f"{path}: {error.strerror or error}") from None
        except TSDFError:
            raise
        except Exception as error:  # whatever zip, npy and json readers make of a damaged file
            reason = "not a whole part file of tsdf-build --chunk or of an interrupted build"
            raise TSDFError(f"{path}: {reason}: give another, or build this part again") from error
        return build


def merge(paths: list[Path]) -> Build:
    """Return the build that part files add up to.

    Raises
    ------
    TSDFError
        If they are of different requests or share chunks.
    """
    whole = Build.load(paths[0])
    for path in paths[1:]:
        other = Build.load(path)
        if other.request != whole.request:
            differing = ", ".join(key for key in whole.request if whole.request[key] != other.request[key])
            raise TSDFError(f"{path}: a part of another build than {paths[0]} (they differ in {differing})")
        shared = other.done & whole.done
        if shared:
            raise TSDFError(f"{path}: {len(shared)} of its chunks are in another part already: give each part once")
        whole.tally.add(other.tally)
        whole.done |= other.done
    return whole
