"""Values as a raster stores them turned into what a map holds, in one pass and without the interpreter's lock.

A thread that reads ahead of a filter takes that lock from it each time numpy hands it back; one pass is one time.
"""

from __future__ import annotations

import numpy as np

from terranav.kernels.jit import jit


@jit
def converted(raw, scale, offset, factor, void, near):
    """(raw * scale + offset) * factor as float32 (rows, cols); NaN where raw is within `near` of `void` or NaN."""
    rows, cols = raw.shape
    out = np.empty((rows, cols), np.float32)
    for i in range(rows):
        for j in range(cols):
            value = np.float64(raw[i, j])
            if abs(value - void) <= near:
                out[i, j] = np.nan
            else:
                out[i, j] = np.float32((value * scale + offset) * factor)
    return out
