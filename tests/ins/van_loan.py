"""The integral of a linear model over a step by one matrix exponential: what the kernels' series is held against."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

FloatArray = NDArray[np.float64]


def discretised(f: FloatArray, noise: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
    """Transition and covariance over dt of dx/dt = f x + white noise of this spectral density.

    Van Loan, Computing integrals involving the matrix exponential, IEEE Trans. Automatic Control 23 (1978), 395-404.
    """
    n = len(f)
    block = np.zeros((2 * n, 2 * n))
    block[:n, :n], block[:n, n:], block[n:, n:] = -f, noise, f.T
    whole = expm(block * dt)
    phi = whole[n:, n:].T
    q = phi @ whole[:n, n:]
    return phi, 0.5 * (q + q.T)
