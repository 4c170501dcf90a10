"""Scatterometer: how a table is made; a grain, its optics and an effort in, a `Table` out.

Paths are numbered, and all counts are integers that add up in any order, so the same request gives the same bytes for
any number of threads, interrupted and resumed or not, in one piece or in parts merged afterwards. What counts is only
which paths are done; the counts go to a part file beside the output every few seconds, and it serves whatever request
they can answer. Whether a target is met is judged at numbers of paths that follow from the counts alone. `crew` has the
threads.
"""

import json
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from tsdf import archive, files
from tsdf.data.table import Table
from tsdf.errors import GrainError, TSDFError, UsageError
from tsdf.grain.grains import Grain
from tsdf.grain.optics import Optics
from tsdf.make import assemble, statistics
from tsdf.make import tally as T
from tsdf.make.crew import Crew, Round
from tsdf.make.effort import DEFAULT_CELLS, MAX_JOINT, MAX_PATHS, Effort
from tsdf.make.exact import exact_table
from tsdf.make.origin import canonical_command, extent_header, grain_header, known_header, printable
from tsdf.make.pace import ROUND_S, Pace, Progress
from tsdf.make.spans import CHUNK_MIN, Spans, beginning, chunks, joined, size, without
from tsdf.make.tally import Tally
from tsdf.make.tracer import ahead

MAX_LEAK = 1e-4  # share of the light that may be lost or cut off before a grain is refused
SAVE_S = 5.0  # [s] the least between two saves of a part file
REASONABLE = 10**10  # paths that a target may take; a day of two processors
PART_VERSION = 3
PART_LIMIT = 1 << 28  # bytes of a part file; with all the records there can be it has 2e8
GRAIN = {"kind", "name", "parameters", "notes"}  # what is asked of a grain that a part file describes


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


@dataclass(eq=False)
class Build:
    """A table in the making: what was asked for, the paths done and their counts.

    Parameters
    ----------
    grain : mapping
        As in the header, so that a table can be finished without the mesh.
    optics : Optics
    effort : Effort
        Resolved.
    tally : Tally
        Holds as many records as the effort asks for, or more.
    done : list of (int, int)
        The paths that are in `tally`.
    judgement : int
        Number of paths at which it is judged next whether the target is met.
    """

    grain: dict[str, Any]
    optics: Optics
    effort: Effort
    tally: Tally
    done: Spans = field(default_factory=list)
    judgement: int = CHUNK_MIN
    _judged: tuple[int, statistics.TableErrors] | None = None  # at so many paths
    _latest: tuple[int, statistics.TableError] | None = None
    _sought: Future[dict[str, float]] | None = None  # of the grain's header, what takes a search

    @classmethod
    def start(cls, grain: Grain, optics: Optics, effort: Effort) -> "Build":
        """Return a build of which nothing is done yet."""
        if grain.kind != "sphere" and optics.fresnel != "un":
            raise UsageError(
                "polarisations can only be kept apart for the exact sphere, where each path stays in one plane: "
                "use --fresnel un for meshes"
            )
        effort = effort.resolved()
        ahead(grain)
        beside = ThreadPoolExecutor(1)
        sought = beside.submit(extent_header, grain)
        beside.shutdown(wait=False)
        tally = Tally(joint=effort.joint, memory=effort.memory)
        return cls(known_header(grain), optics, effort, tally, _sought=sought)

    def _find(self) -> None:
        """Wait for what of the grain's header is sought while the first paths are traced."""
        if self._sought is not None:
            self.grain = self.grain | self._sought.result()
            self._sought = None

    @property
    def origin(self) -> dict[str, Any]:
        """What decides what the paths are; they serve every request of the same origin."""
        return {
            "part_version": PART_VERSION,
            "software": files.software(),
            "grain": self.grain,
            "optics": asdict(self.optics),
            "seed": self.effort.seed,
            "max_bounces": self.effort.max_bounces,
        }

    @property
    def paths(self) -> int:
        """Number of paths done."""
        return size(self.done)

    def take(self, stored: "Build", name: str = "the part file") -> None:
        """Go on from the paths of another build, of which this one asks perhaps for other cells, paths or target.

        Raises
        ------
        TSDFError
            If they cannot answer this request; the message says what they can.
        """
        mine, other = self.origin, stored.origin
        both = mine["grain"].keys() & other["grain"].keys()  # what is sought of one may be found of the other already
        for origin in (mine, other):
            origin["grain"] = {key: origin["grain"][key] for key in both}
        differing = [key.replace("_", "-") for key in mine if mine[key] != other[key]]
        for kind in ("joint", "memory"):
            if getattr(self.effort, kind) > getattr(stored.tally, kind):
                differing.append(f"--{kind} {getattr(self.effort, kind)}")
        if differing:
            raise TSDFError(
                f"{name} holds {stored.paths} paths of another build (they differ in {', '.join(differing)}): it "
                "serves its own grain, optics, --seed and --max-bounces, with any --paths, --cells or --target-error, "
                f"--joint up to {stored.tally.joint} and --memory up to {stored.tally.memory}; to start anew, delete "
                "it or choose another --out"
            )
        self.tally, self.done = stored.tally, stored.done
        same = (self.effort.target_error, self.effort.cells) == (stored.effort.target_error, stored.effort.cells)
        self.judgement = stored.judgement if same else 0

    def error(self) -> statistics.TableError | None:
        """Return the error of the table that would be made now, with the cells it would have."""
        if not self.tally.scalars[:, T.SCATTERED].any():
            return None
        if self._latest is None or self._latest[0] != self.paths:
            errors, target = self._errors(), self.effort.target_error
            self._latest = self.paths, (errors.fewest(target) if target is not None else None) or errors.best()
            self._judged = None  # 25 MB
        return self._latest[1]

    def _errors(self) -> statistics.TableErrors:
        """Return the errors of the tables that would be made now."""
        if self._judged is None or self._judged[0] != self.paths:
            self._judged = self.paths, statistics.TableErrors(self.tally, self.effort.cells)
        return self._judged[1]

    def _judge(self, progress: Progress) -> bool:
        """Tell whether the target is met, and if not, choose when to ask again: never so late that much is wasted.

        Raises
        ------
        UsageError
            If more paths cannot help, or unreasonably many would be needed.
        """
        target, paths = self.effort.target_error, self.paths
        assert target is not None
        following = next(last for _, last in chunks(None) if last > paths)
        self.judgement = following
        if not self.tally.scalars[:, T.SCATTERED].all():
            return False
        errors = self._errors()
        if errors.meets(target):  # with how few cells is found out when the threads have stopped
            progress.total = self.judgement = paths
            return True
        progress.error = errors.rough()
        least, needed = (times * paths for times in errors.needed(target))
        sure = progress.error.sampling_noise < 0.5 * target
        if math.isinf(least) or (sure and least > REASONABLE):
            finest = errors(self.effort.cells or statistics.MAX_CELLS)
            more = "allow more --cells, or give" if self.effort.cells else "give"
            raise UsageError(
                f"--target-error {target:g} is out of reach"
                + (f" of {REASONABLE:.0e} paths" if math.isfinite(least) else "")
                + f": {finest.cells} cells of theta alone cost {finest.cell_width:.2g} of total variation; {more} a "
                "larger --target-error, or --paths"
            )
        progress.total = int(max(needed, following))
        # halfway to where the target should be met, and not above four times as far, for what is seen early may mislead
        halfway = min(paths + 0.5 * (needed - paths), 4.0 * paths)
        self.judgement = next(last for _, last in chunks(None) if last > paths and last >= halfway)
        return False

    def run(
        self,
        grain: Grain,
        threads: int = 1,
        part: tuple[int, int] = (1, 1),
        part_file: Path | None = None,
        report: Callable[[Progress], None] | None = None,
        reflectance_scale: float = 1.0,
        max_seconds: float = math.inf,
    ) -> None:
        """Trace the paths that are not done, saving the counts to `part_file` every few seconds and at the end.

        An interrupt lets the threads finish what they are at, for a second at most, and saves it.

        Parameters
        ----------
        threads : int
            Threads that trace.
        part : (int, int)
            Only chunks i, i + n, ... of n parts, counting from 1.
        report : callable
            Called ten times a second, and at the end.
        reflectance_scale : float
            Makes a wrong tracer, to test the tests, see `tracer.Tracer`.
        max_seconds : float
            Stop when so much time has passed, with what is done by then; if nothing is, after the first few paths.

        Raises
        ------
        GrainError
            If the grain loses more than MAX_LEAK of the light, told once enough paths are done to be sure.
        UsageError
            If the target is out of reach.
        """
        progress, leave, tracing, ended = Progress(self.paths), *(threading.Event() for _ in range(3))
        outcome: list[BaseException] = []

        def work() -> None:
            try:
                self._work(grain, threads, part, part_file, progress, report is not None, reflectance_scale,
                           time.monotonic() + max_seconds, leave, tracing)  # fmt: skip
            except BaseException as error:
                outcome.append(error)
            finally:
                ended.set()

        # in a thread of its own, so that no signal finds counts half added or a file half written
        worker = threading.Thread(target=work, daemon=True)
        try:
            worker.start()
            while not ended.wait(0.1):  # not Thread.join, which after an interrupt takes the thread for ended (3.11)
                if report is not None:
                    report(progress)
            if report is not None:
                report(progress)
        except BaseException:
            leave.set()
            if tracing.is_set():  # else it compiles, and has nothing that could be lost
                ended.wait()
            if outcome:
                raise outcome[0] from None
            raise
        if outcome and "start new thread" in str(outcome[0]):
            raise MemoryError from outcome[0]
        if outcome:
            raise outcome[0]

    def _wanted(self, part: tuple[int, int]) -> Spans:
        """Return the paths that are to be done before anything is judged."""
        paths = self.effort.paths
        if part != (1, 1):
            return [span for k, span in enumerate(chunks(paths)) if k % part[1] == part[0] - 1]
        if paths is None:
            paths = self.judgement
        return [(0, max([paths, *(last for _, last in self.done)]))]

    def _work(
        self, grain: Grain, threads: int, part: tuple[int, int], part_file: Path | None, progress: Progress,
        tell: bool, reflectance_scale: float, deadline: float, leave: threading.Event, tracing: threading.Event,
    ) -> None:  # fmt: skip
        """Trace in rounds of about ROUND_S, two of them under way, until all is done, met, too late or left."""
        target = self.effort.target_error
        if target is None:
            progress.total = size(self._wanted(part))
        if self._complete(part, part_file, progress, deadline):
            progress.error = self.error() if tell and not progress.error else progress.error
            if part_file is not None:
                self.save(part_file)
            return
        effort, tally = self.effort, self.tally
        crew = Crew(grain, self.optics, effort.seed, effort.max_bounces, tally.joint, tally.memory, threads,
                    reflectance_scale)  # fmt: skip
        tracing.set()
        under_way: deque[Round] = deque()
        pace, ahead, before = Pace(deadline, CHUNK_MIN * max(1, threads // 2)), self.done, time.monotonic()
        saved = before
        with crew:
            while True:
                while len(under_way) < 2 and not leave.is_set():
                    running = sum(size(one.pieces.values()) for one in under_way)
                    spans = beginning(self._left(part, ahead), pace.next(running))
                    if not spans:
                        break
                    under_way.append(crew.start(spans))
                    ahead = joined([*ahead, *spans])
                if not under_way:
                    break
                under_way[0].wait(leave)
                finished = crew.dismiss(under_way, ROUND_S) if leave.is_set() else [under_way.popleft()]
                if leave.is_set() and target is not None:  # what was traced ahead would be judged, too, and too late
                    finished = [one for one in finished if max(one.pieces.values())[1] <= self.judgement]
                for one in finished:
                    spans, rays = crew.gather(one, tally)
                    self.done = joined([*self.done, *spans])
                    progress.rays += rays
                progress.paths, now = self.paths, time.monotonic()
                if leave.is_set():
                    break
                pace.learn(size(spans), now - before)
                before = now
                if target is not None and self.done == self._wanted(part):
                    if self._judge_and_save(progress, part_file):
                        break
                elif tell and target is None:
                    progress.error = self.error()
                self.check_leaks()
                if part_file is not None and now - saved > SAVE_S:
                    self.save(part_file, whole=self._whole(part))
                    saved = time.monotonic()
        if target is not None and self.judgement == self.paths:  # it is met
            progress.error = self.error()
        if part_file is not None and (self.done or not leave.is_set()):
            self.save(part_file, whole=not leave.is_set() or self._whole(part))

    def _complete(self, part: tuple[int, int], part_file: Path | None, progress: Progress, deadline: float) -> bool:
        """Return whether nothing is to be traced: all is done, and meets the target, or it is too late for more."""
        if self.done and deadline <= time.monotonic():
            return True
        return self._whole(part) and (self.effort.target_error is None or self._judge_and_save(progress, part_file))

    def _whole(self, part: tuple[int, int]) -> bool:
        """Return whether no path is missing."""
        return without(self._wanted(part), self.done) == []

    def _left(self, part: tuple[int, int], ahead: Spans) -> Spans:
        """Return which paths are wanted beside those `ahead`; more than the target needs while it is judged."""
        wanted = self._wanted(part)
        if self.effort.target_error is not None and wanted == ahead:
            wanted = [(0, next(last for _, last in chunks(None) if last > self.judgement))]
        return without(wanted, ahead)

    def _judge_and_save(self, progress: Progress, part_file: Path | None) -> bool:
        """Tell whether the target is met; what is done is safe even if it is out of reach."""
        try:
            return self._judge(progress)
        except UsageError:
            if part_file is not None:
                self.save(part_file)
            raise

    def check_leaks(self) -> None:
        """Refuse a grain whose tracing loses too much light.

        Raises
        ------
        GrainError
            If the light that was lost at the surface or cut off by the bounce limit is more than MAX_LEAK of what was
            launched by four standard errors, of rare whole paths.
        """
        sums = self.tally.scalars.astype(object).sum(axis=0)
        launched, lost, cut = sums[T.LAUNCHED], sums[T.LOST], sums[T.TRUNCATED]
        limit = MAX_LEAK * launched + 4.0 * math.sqrt(MAX_LEAK * launched / T.UNIT) * T.UNIT
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

    def falls_short(self, part: tuple[int, int] = (1, 1)) -> str | None:
        """Return what is not as asked for, None if nothing is: paths that are missing, a target that is not met."""
        target, paths = self.effort.target_error, self.paths
        if target is None and (missing := size(without(self._wanted(part), self.done))):
            return f"{paths} of {paths + missing} paths are done"
        error = self.error() if target is not None else None
        if error is not None and target is not None and error.total_variation > target:
            return f"the target error {target:g} is not met after {paths} paths, {error.total_variation:.3g} is"
        return None

    def table(self, as_it_got: bool = False) -> Table:
        """Return the finished table.

        Parameters
        ----------
        as_it_got : bool
            Whether fewer paths than asked for, or a target that is not met, will do.

        Raises
        ------
        TSDFError
            If paths are missing, or no light at all was scattered.
        """
        paths = self.paths
        missing = without([(0, max([self.effort.paths or 0, *(last for _, last in self.done)]))], self.done)
        if not paths or self.done[0] != (0, paths) or (missing and not as_it_got):
            what = f"{size(missing)} paths of {size(missing) + paths} are missing" if missing else "no paths are done"
            raise TSDFError(f"{what}: go on with --resume, or give all the parts to tsdf-merge, whole")
        self.check_leaks()
        error = self.error()
        if error is None:
            raise TSDFError(f"none of {paths} paths was scattered by the grain: trace more (--paths), or look at it")
        if not as_it_got and (short := self.falls_short()):
            raise TSDFError(f"{short}: go on with --resume, or with --max-seconds 0 for the table as good as it got")
        made = replace(self.effort, paths=paths, target_error=None, cells=error.cells)
        provenance = {
            "method": "traced",
            "command": canonical_command(self.grain, self.optics, made, traced=True),
            "seed": made.seed,
            "paths": paths,
            "max_bounces": made.max_bounces,
        }
        self._find()
        tally = self.tally.narrowed(made.joint, made.memory)
        return assemble.traced_table(tally, error.cells, self.grain, self.optics, provenance, made.memory)

    def save(self, path: Path, whole: bool = True) -> None:
        """Write the part file, atomically.

        Parameters
        ----------
        whole : bool
            Whether a table may be made of it without the mesh: then what is still sought is waited for, of a huge mesh
            some seconds.

        Raises
        ------
        TSDFError
            If it cannot be written; the file that stood there is left as it was.
        """
        if whole:
            self._find()
        request = json.dumps({**self.origin, "effort": asdict(self.effort), "judgement": self.judgement})
        kept: dict[str, np.ndarray] = {
            archive.PART: np.frombuffer(request.encode(), dtype=np.uint8),
            "done": np.array(self.done, dtype=np.int64).reshape(-1, 2),
            "records_kept": np.array([self.tally.joint, self.tally.memory], dtype=np.int64),
        }
        archive.write(path, kept | self.tally.arrays())

    @classmethod
    def load(cls, path: Path) -> "Build":
        """Read a part file.

        Raises
        ------
        TSDFError
            If it is missing, damaged, or of another version of this software.
        """
        try:
            arrays = archive.read(path, PART_LIMIT)
            request = json.loads(arrays.pop(archive.PART).tobytes())
            if (request["part_version"], request["software"]) != (PART_VERSION, files.software()):
                made = printable(str(request["software"]))[:100]
                raise TSDFError(f"{path}: made by another version ({made}): build it again")
            joint, memory, spans = _kept_and_done(arrays.pop("records_kept"), arrays.pop("done"))
            effort, judgement = request["effort"], request["judgement"]
            whole = [judgement, *(value for key, value in effort.items() if key != "target_error")]
            if any(type(value) is not int for value in whole if value is not None) or not 0 <= judgement <= MAX_PATHS:
                raise ValueError("effort")
            if effort["joint"] > joint or effort["memory"] > memory or not request["grain"].keys() >= GRAIN:
                raise ValueError("effort")
            build = cls(
                request["grain"], Optics(**request["optics"]), Effort(**effort), Tally(joint, memory), spans, judgement,
            )  # fmt: skip
            mine = build.tally.arrays()
            if mine.keys() != arrays.keys():
                raise ValueError("arrays")
            for name, values in mine.items():
                if arrays[name].shape != values.shape or arrays[name].dtype != values.dtype:
                    raise ValueError(name)
                values[...] = arrays[name]
            build.tally.check(build._launched())
        except FileNotFoundError:
            raise TSDFError(f"{path}: no such file") from None
        except OSError as error:
            raise TSDFError(f"{path}: {error.strerror or error}") from None
        except (TSDFError, MemoryError) as error:
            if isinstance(error, UsageError):
                raise TSDFError(f"{path}: {error}") from None
            raise
        except Exception as error:  # whatever a damaged header leads to
            reason = "not a whole part file of tsdf-build --chunk or of an interrupted build"
            raise TSDFError(f"{path}: {reason}: give another, or build this part again") from error
        return build

    def _launched(self) -> np.ndarray:
        """Return how many of the paths done each replicate has, (REPLICATES,) int64."""
        numbers = np.arange(T.REPLICATES)
        return sum(
            ((last - numbers + T.REPLICATES - 1) // T.REPLICATES - (first - numbers + T.REPLICATES - 1) // T.REPLICATES
             for first, last in self.done), np.zeros(T.REPLICATES, np.int64)
        )  # fmt: skip


def _kept_and_done(kept: np.ndarray, done: np.ndarray) -> tuple[int, int, Spans]:
    """Return how many records of either kind a part file keeps, and which paths are done; ValueError if that cannot
    be."""
    if kept.shape != (2,) or done.ndim != 2 or done.shape[1] != 2 or {kept.dtype, done.dtype} != {np.dtype(np.int64)}:
        raise ValueError("done")
    joint, memory = (int(k) for k in kept)
    if not (0 <= joint <= MAX_JOINT and 0 <= memory <= MAX_JOINT):
        raise ValueError("records_kept")
    spans = [(int(first), int(last)) for first, last in done]
    if joined(spans) != spans or any(not 0 <= first < last <= MAX_PATHS for first, last in spans):
        raise ValueError("done")
    return joint, memory, spans


def merge(paths: list[Path]) -> Build:
    """Return the build that part files add up to.

    Raises
    ------
    TSDFError
        If they are of different requests or share paths.
    """
    whole = Build.load(paths[0])
    for path in paths[1:]:
        other = Build.load(path)
        mine, its = ({**build.origin, **asdict(build.effort)} for build in (whole, other))
        if its != mine:
            differing = ", ".join(key.replace("_", "-") for key in mine if mine[key] != its[key])
            raise TSDFError(f"{path}: a part of another build than {paths[0]} (they differ in {differing})")
        shared = size(other.done) - size(without(other.done, whole.done))
        if shared:
            raise TSDFError(f"{path}: {shared} of its paths are in another part already: give each part once")
        whole.tally.add(other.tally)
        whole.done = joined([*whole.done, *other.done])
    return whole
