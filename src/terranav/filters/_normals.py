"""Standard normal numbers for the filters, many at once."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from terranav.kernels.random import normals

FloatArray = NDArray[np.float64]


def drawn_key(rng: Generator) -> np.uint64:
    """One 64-bit key: all that an array of numbers takes from the generator, so its state says what comes next."""
    return np.uint64(rng.integers(0, 2**64 - 1, dtype=np.uint64, endpoint=True))


def standard_normal(rng: Generator, shape: tuple[int, ...]) -> FloatArray:
    """An array of independent standard normal numbers, `terranav.kernels.random.normals` of a key from `rng`."""
    out = np.empty(shape)
    normals(drawn_key(rng), out.reshape(-1))
    return out
