"""Windows of a grid that stays in files: blocks kept up to a number of bytes, and the next ones read ahead."""

from __future__ import annotations

import math
import os
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from terranav.maps.georeference import Window

Float32Array = NDArray[np.float32]
T = TypeVar("T")

BLOCK = 512  # cells: side of what is read at a time
BLOCKS_AHEAD = 2  # how far ahead windows are made ready


class Kept(Generic[T]):
    """Things by key, those not used for longest dropped beyond a number of bytes; for any number of threads.

    Parameters
    ----------
    most_bytes : int
    """

    def __init__(self, most_bytes: int) -> None:
        self.most_bytes, self.bytes = most_bytes, 0
        self._ready: OrderedDict[Hashable, tuple[T, int]] = OrderedDict()
        self._coming: dict[Hashable, Future[T]] = {}
        self._lock = threading.Lock()

    def __contains__(self, key: Hashable) -> bool:
        with self._lock:
            return key in self._ready or key in self._coming

    def get(self, key: Hashable, size: int, make: Callable[[], T]) -> T:
        """What is kept; else what another thread is making; else what `make` makes, of `size` bytes."""
        with self._lock:
            if key in self._ready:
                self._ready.move_to_end(key)
                return self._ready[key][0]
            coming = self._coming.get(key)
            if coming is None:
                mine: Future[T] = Future()
                self._coming[key] = mine
                self._room(size)
        if coming is not None:
            return coming.result()
        try:
            made = make()
        except BaseException as error:
            with self._lock:
                del self._coming[key]
                self.bytes -= size
            mine.set_exception(error)
            raise
        with self._lock:
            del self._coming[key]
            self._ready[key] = made, size
        mine.set_result(made)
        return made

    def _room(self, size: int) -> None:
        """Take bytes, and drop what is oldest while they are too many."""
        self.bytes += size
        while self.bytes > self.most_bytes and self._ready:
            self.bytes -= self._ready.popitem(last=False)[1][1]


class Windows(Generic[T]):
    """Windows of whole blocks, as far as the grid goes.

    Which window serves is a matter of the cells asked for alone: answers do not depend on what was asked before.

    Parameters
    ----------
    read : function of a window
        Its values.
    made : function of a window and its values
        What is kept of it.
    shape : rows and columns, either None where windows may go beyond
    most_bytes : int
        That blocks and windows may take together.

    Attributes
    ----------
    waited_s, read_s : float
        Seconds that callers waited for a window, and seconds that reading took, ahead of the callers or not.
    """

    def __init__(
        self,
        read: Callable[[Window], Float32Array],
        made: Callable[[Window, Float32Array], T],
        shape: tuple[int | None, int | None],
        most_bytes: int,
    ) -> None:
        self._read, self._made, self._shape = read, made, shape
        self._blocks: Kept[Float32Array] = Kept(most_bytes // 2)
        self._whole: Kept[T] = Kept(most_bytes // 2)
        self._here = threading.local()
        self._asked: set[Window] = set()  # of the thread that reads ahead
        self._ahead: tuple[int, ThreadPoolExecutor] | None = None
        self._lock = threading.Lock()
        self.waited_s = self.read_s = 0.0

    @property
    def bytes(self) -> int:
        """Bytes that are taken now."""
        return self._blocks.bytes + self._whole.bytes

    @property
    def most_cells(self) -> int:
        """The largest window [cells]."""
        return self._whole.most_bytes // 4

    def fits(self, cells: Window) -> bool:
        """Whether the window around cells may be as large as it is."""
        return _count(self._aligned(cells)) <= self.most_cells

    def cut(self, cells: Window) -> Window:
        """The middle of cells, the longer side cut down, so that its window fits."""
        sides = [past - first for first, past in cells]
        shorter = max(min(*sides, math.isqrt(self.most_cells) - 2 * BLOCK), 1)
        most = max(self.most_cells // (shorter + 2 * BLOCK) - 2 * BLOCK, 1)
        middles = [(first + past) // 2 for first, past in cells]
        halves = [max(min(side, most) // 2, 1) for side in sides]
        (row, col), (down, across) = middles, halves
        return (row - down, row + down), (col - across, col + across)

    @staticmethod
    def slack(cells: Window) -> int:
        """How many cells the ends of cells can move by with the same window around them."""
        ends = [(first % BLOCK, (past - 1) % BLOCK) for first, past in cells]
        return min(min(end, BLOCK - 1 - end) for pair in ends for end in pair)

    def get(self, cells: Window, *, ahead: bool = True) -> T:
        """The smallest window of whole blocks around cells.

        What the same window will be a block and two farther on, in the direction in which this thread's last ones
        moved, is then read ahead.
        """
        window, here = self._aligned(cells), self._here
        if here.__dict__.get("window") != window:
            start = time.perf_counter()
            here.found = self._kept(window)
            here.window = window
            self.waited_s += time.perf_counter() - start
        if ahead:
            self._look_ahead(cells, window)
        found: T = here.found
        return found

    def _kept(self, window: Window) -> T:
        return self._whole.get(window, 4 * _count(window), lambda: self._made(window, self._assembled(window)))

    def _look_ahead(self, cells: Window, window: Window) -> None:
        """Read what is likely to be asked for next in another thread."""
        (top, bottom), (left, right), here = *cells, self._here
        row, col = 0.5 * (top + bottom), 0.5 * (left + right)
        was_row, was_col = here.__dict__.setdefault("middle", (row, col))
        far = math.hypot(row - was_row, col - was_col)
        if far >= BLOCK / 16.0:
            here.middle = row, col
            here.direction = (row - was_row) / far, (col - was_col) / far
        down, across = here.__dict__.get("direction", (0.0, 0.0))
        for cells_on in range(BLOCK, (BLOCKS_AHEAD + 1) * BLOCK, BLOCK):
            d, a = round(cells_on * down), round(cells_on * across)
            coming = self._aligned(((top + d, bottom + d), (left + a, right + a)))
            fits = 0 < 2 * _count(coming) <= self.most_cells
            if coming != window and fits and coming not in self._asked and coming not in self._whole:
                pool = self._pool()
                self._asked.add(coming)
                pool.submit(self._made_ready, coming)

    def _made_ready(self, window: Window) -> None:
        """Keep a window, in the thread that reads ahead; what is wrong with it is told when it is asked for."""
        try:
            self._kept(window)
        finally:
            self._asked.discard(window)

    def _pool(self) -> ThreadPoolExecutor:
        """One thread that reads ahead, of this process."""
        with self._lock:
            if self._ahead is None or self._ahead[0] != os.getpid():
                self._asked.clear()
                self._ahead = os.getpid(), ThreadPoolExecutor(1, thread_name_prefix="terranav-map")
            return self._ahead[1]

    def _aligned(self, cells: Window) -> Window:
        """The smallest window of whole blocks around cells, cut off at the edges of the grid."""
        found = []
        for (first, past), size in zip(cells, self._shape, strict=True):
            low, high = first // BLOCK * BLOCK, -(-past // BLOCK) * BLOCK
            found.append((low, high) if size is None else (max(low, 0), min(high, size)))
        return found[0], found[1]

    def _assembled(self, window: Window) -> Float32Array:
        """A window out of its blocks."""
        (top, bottom), (left, right) = window
        if bottom - top <= BLOCK >= right - left:  # windows begin and end with blocks, or with the grid
            out = np.ascontiguousarray(self._block(top // BLOCK, left // BLOCK)[: bottom - top, : right - left])
            out.setflags(write=False)
            return out
        out = np.empty((bottom - top, right - left), np.float32)
        for i in range(top // BLOCK, -(-bottom // BLOCK)):
            for j in range(left // BLOCK, -(-right // BLOCK)):
                block = self._block(i, j)
                rows = max(top, i * BLOCK), min(bottom, (i + 1) * BLOCK)
                cols = max(left, j * BLOCK), min(right, (j + 1) * BLOCK)
                out[rows[0] - top : rows[1] - top, cols[0] - left : cols[1] - left] = block[
                    rows[0] - i * BLOCK : rows[1] - i * BLOCK, cols[0] - j * BLOCK : cols[1] - j * BLOCK
                ]
        out.setflags(write=False)
        return out

    def _block(self, i: int, j: int) -> Float32Array:
        def read() -> Float32Array:
            start = time.perf_counter()
            found = self._read(((i * BLOCK, (i + 1) * BLOCK), (j * BLOCK, (j + 1) * BLOCK)))
            self.read_s += time.perf_counter() - start
            found.setflags(write=False)
            return found

        return self._blocks.get((i, j), 4 * BLOCK * BLOCK, read)


def _count(window: Window) -> int:
    (top, bottom), (left, right) = window
    return max(bottom - top, 0) * max(right - left, 0)
