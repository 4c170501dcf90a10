"""Crew: threads that trace paths in rounds; while what one round counted is summed, they are at the next.

Each thread has a tracer of its own and a tally for each of two rounds, so nobody waits for anybody. How the paths are
shared out does not show in the sums.
"""

import contextlib
import threading
import time
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from queue import SimpleQueue

from tsdf.files import need_memory
from tsdf.grain.grains import Grain
from tsdf.grain.optics import Optics
from tsdf.make import tally as T
from tsdf.make.tally import Tally
from tsdf.make.tracer import Tracer, in_order

PIECE = 1024  # paths that are worth a thread
PIECES = 4  # of a round for each thread, so that one that is late holds up a quarter of its share
ADDED_TO = 4  # threads for each that adds up what they counted
THREAD_BYTES = 200_000_000  # of address space that a thread, its ray engine and its heap ask for, tallies apart


@dataclass
class Round:
    """Paths under way: pieces, (first, last + 1), and what becomes of them, counted in tallies of one side."""

    pieces: dict[Future[int], tuple[int, int]]
    side: int

    def wait(self, leave: threading.Event) -> None:
        """Wait until all pieces are done, or somebody wants to leave."""
        for piece in self.pieces:
            while not piece.done() and not leave.is_set():
                try:
                    piece.exception(0.05)
                except TimeoutError:
                    continue


class Crew:
    """Threads, their tracers and their tallies.

    Parameters
    ----------
    grain : Grain
    optics : Optics
    seed, max_bounces : int
    joint, memory : int
        Records that the tallies keep.
    threads : int
    reflectance_scale : float
        See `tracer.Tracer`.
    """

    def __init__(
        self, grain: Grain, optics: Optics, seed: int, max_bounces: int, joint: int, memory: int, threads: int,
        reflectance_scale: float = 1.0,
    ) -> None:  # fmt: skip
        self._sides = [[Tally(joint, memory) for _ in range(threads)] for _ in range(2)]
        first = self._sides[0][0]
        need_memory(threads * (THREAD_BYTES + 2 * sum(counts.nbytes for counts in first.arrays().values())))
        self._tracers = [
            Tracer(grain, optics.eta, optics.fresnel, seed, max_bounces, reflectance_scale=reflectance_scale)
            for _ in range(threads)
        ]
        self._tracers[0].trace(in_order(0, T.REPLICATES), first)  # compiles what is not compiled yet
        first.clear()
        self._idle: SimpleQueue[int] = SimpleQueue()
        for worker in range(threads):
            self._idle.put(worker)
        self._stop = threading.Event()
        self._pool = ThreadPoolExecutor(threads)
        self._adders = ThreadPoolExecutor(max(1, threads // ADDED_TO))
        self._side = 0

    def __enter__(self) -> "Crew":
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._pool.shutdown(wait=True, cancel_futures=True)
        self._adders.shutdown()

    def start(self, spans: Iterable[tuple[int, int]]) -> Round:
        """Begin a round of the paths numbered; of two rounds, one must be gathered before the next can start."""
        spans, side = list(spans), self._side
        share = max(-(-sum(last - first for first, last in spans) // (PIECES * len(self._tracers))), PIECE)
        pieces = [(at, min(at + share, last)) for first, last in spans for at in range(first, last, share)]
        self._side = 1 - side
        return Round({self._pool.submit(self._trace, *piece, side): piece for piece in pieces}, side)

    def _trace(self, first: int, last: int, side: int) -> int:
        worker = self._idle.get()
        try:
            return self._tracers[worker].trace(in_order(first, last), self._sides[side][worker], self._stop)
        finally:
            self._idle.put(worker)

    def gather(self, done: Round, total: Tally) -> tuple[list[tuple[int, int]], int]:
        """Add what a finished round counted to `total`; return which paths that were, and how many rays it took."""
        rays = sum(piece.result() for piece in done.pieces if not piece.cancelled())
        counted = [tally for tally in self._sides[done.side] if tally.scalars[:, T.LAUNCHED].any()]
        sums = counted
        while len(sums) > 1:
            list(self._adders.map(Tally.add, sums[::2], sums[1::2]))
            sums = sums[::2]
        for tally in sums:
            total.add(tally)
        list(self._adders.map(Tally.clear, counted))
        return [span for piece, span in done.pieces.items() if not piece.cancelled()], rays

    def dismiss(self, rounds: Iterable[Round], patience: float) -> list[Round]:
        """Start no more pieces of `rounds`, wait so many seconds for those under way, and return what is whole."""
        rounds = list(rounds)
        pieces = [piece for one in rounds for piece in one.pieces]
        running = [piece for piece in reversed(pieces) if not piece.cancel()]  # the last first: no gaps are left
        deadline = time.monotonic() + patience
        for piece in running:
            with contextlib.suppress(TimeoutError):
                piece.exception(max(0.0, deadline - time.monotonic()))
        whole = [one for one in rounds if all(piece.done() for piece in one.pieces)]
        if len(whole) < len(rounds):
            self._stop.set()  # what the others have counted is worthless
        return whole
