"""Spans: runs of path numbers, which are to be traced and which are done."""

from collections.abc import Iterable, Iterator

from tsdf.make.effort import MAX_PATHS

CHUNK_MIN, CHUNK_MAX = 1 << 13, 1 << 20
Spans = list[tuple[int, int]]  # first and last + 1 path number of each, ascending, none touching the next


def chunks(paths: int | None) -> Iterator[tuple[int, int]]:
    """Yield the first and last + 1 path number of each chunk: an eighth of what is done, within limits, forever
    unless the number of paths is given."""
    end = MAX_PATHS if paths is None else paths
    first = 0
    while first < end:
        size = min(max(first // 8 // CHUNK_MIN * CHUNK_MIN, CHUNK_MIN), CHUNK_MAX)
        yield first, min(first + size, end)
        first += size


def joined(spans: Iterable[tuple[int, int]]) -> Spans:
    """Return spans in order, those that touch as one."""
    whole: Spans = []
    for first, last in sorted(spans):
        if whole and first <= whole[-1][1]:
            whole[-1] = (whole[-1][0], max(last, whole[-1][1]))
        else:
            whole.append((first, last))
    return whole


def without(spans: Spans, done: Spans) -> Spans:
    """Return what of `spans` is not in `done`."""
    left, k = [], 0
    for first, last in spans:
        while k < len(done) and done[k][1] <= first:
            k += 1
        for begin, end in done[k:]:
            if begin >= last:
                break
            if begin > first:
                left.append((first, begin))
            first = max(first, end)
        if first < last:
            left.append((first, last))
    return left


def beginning(spans: Spans, paths: int) -> Spans:
    """Return the first so many paths of `spans`."""
    found = []
    for first, last in spans:
        if paths <= 0:
            break
        found.append((first, min(last, first + paths)))
        paths -= last - first
    return found


def size(spans: Iterable[tuple[int, int]]) -> int:
    """Return how many paths there are."""
    return sum(last - first for first, last in spans)
