"""Back-pointers of a Viterbi search: an immutable record that costs little to extend and pickles flat."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

BLOCK = 256  # epochs: the newest block is copied whenever one is added, the full ones are shared


@dataclass(frozen=True, slots=True)
class Origins:
    """Where the best path into each cell came from at one epoch.

    Attributes
    ----------
    south, west : int
        Lattice indices of the first cell of the grid.
    pointers : (m, rows, cols) uint8, m >= 0
        One layer for each time the 3 x 3 step was applied, numbered as in `kernels.viterbi`.
    """

    south: int
    west: int
    pointers: NDArray[np.uint8]

    def before(self, row: int, col: int) -> tuple[int, int]:
        """Lattice indices, at the epoch before, of the path that leads to (row, col) now."""
        for layer in self.pointers[::-1]:
            k = int(layer[row - self.south, col - self.west])
            row, col = row + k // 3 - 1, col + k % 3 - 1
        return row, col


@dataclass(frozen=True, slots=True)
class History:
    """The latest epochs' origins, oldest first; older ones than `limit_bytes` can hold are given up block by block."""

    limit_bytes: float
    blocks: tuple[tuple[Origins, ...], ...] = ()
    newest: tuple[Origins, ...] = ()
    held_bytes: int = 0
    given_up: int = 0  # epochs

    def extended(self, origins: Origins) -> History:
        """With one more epoch."""
        held = self.held_bytes + origins.pointers.nbytes
        blocks, newest, given_up = self.blocks, (*self.newest, origins), self.given_up
        if len(newest) == BLOCK:
            blocks, newest = (*blocks, newest), ()
        while held > self.limit_bytes and (blocks or newest):
            oldest = blocks[0] if blocks else newest
            blocks, newest = (blocks[1:], newest) if blocks else ((), ())
            held -= sum(one.pointers.nbytes for one in oldest)
            given_up += len(oldest)
        return History(self.limit_bytes, blocks, newest, held, given_up)

    def path(self, row: int, col: int) -> NDArray[np.int64]:
        """(epochs, 2) lattice indices of the path that ends in (row, col), oldest first (papers/000 eq. 15)."""
        places = [(row, col)]
        for block in (self.newest, *self.blocks[::-1]):
            for origins in block[::-1]:
                places.append(origins.before(*places[-1]))
        # the oldest pointer leads to the epoch before all that are held: the start when nothing was given up
        return np.array(places[-2::-1] if len(places) > 1 else places)
