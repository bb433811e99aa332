"""The recursion of a second-order Gauss-Markov field, along the columns of each row and down the rows, in one pass."""

from __future__ import annotations

from terranav.kernels.jit import jit


@jit
def continue_field(white, across, down, start, out):
    """Write further rows of a field that is filtered along both axes.

    Each filter is y[k] = s1 + b0 e[k], s1 <- a1 y[k] + b1 e[k] + s2, s2 <- a2 y[k] (direct form II transposed).

    Parameters
    ----------
    white : (n, cols + 2) float64
        Standard normal; the last two of a row start its filter.
    across, down : (7,) float64
        a1, a2, b0, b1 and the start's lower triangle l11, l21, l22, for the filter along a row and down the columns.
    start : (2, cols) float64, read and written
        State of the filters down the columns.
    out : (n, cols) float64, written
    """
    a1, a2, b0, b1 = across[0], across[1], across[2], across[3]
    c1, c2, d0, d1 = down[0], down[1], down[2], down[3]
    cols = out.shape[1]
    s_first, s_second = start[0], start[1]
    for i in range(out.shape[0]):
        noise, line = white[i], out[i]
        s1 = across[4] * noise[cols]
        s2 = across[5] * noise[cols] + across[6] * noise[cols + 1]
        for j in range(cols):
            e = noise[j]
            y = s1 + b0 * e
            s1 = a1 * y + b1 * e + s2
            s2 = a2 * y
            line[j] = y
        for j in range(cols):
            e = line[j]
            y = s_first[j] + d0 * e
            s_first[j] = c1 * y + d1 * e + s_second[j]
            s_second[j] = c2 * y
            line[j] = y
