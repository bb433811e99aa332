"""How noisy readings really are: a discrete distribution over factors of the told variance.

The factor is a hidden Markov chain over octaves. A reading's likelihood under each is the one that its prediction gives
it, the spread of the position included (Mehra, IEEE Trans. Automatic Control 17, 1972, calls it the Bayesian
approach); so a cloud over kilometres, which fits nothing well, teaches nothing about the noise.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

SCALES = 2.0 ** np.arange(-2.0, 5.0)  # of the variance: from half the told sigma to 4 times
OCTAVES_SIGMA = 1.0  # told variances are trusted to about a factor of two
SWITCH = 0.005  # chance a reading of a step to either side (`kernels.reading.learned`)


def told() -> FloatArray:
    """Probability of each of SCALES before any reading."""
    middle = -0.5 * math.log(2.0) * OCTAVES_SIGMA**2  # where the expected factor is 1
    density = np.exp(-0.5 * ((np.log2(SCALES) - middle) / OCTAVES_SIGMA) ** 2)
    return np.asarray(density / density.sum())


def certain() -> FloatArray:
    """Probability of each of SCALES where the noise is as told."""
    return np.asarray(SCALES == 1.0, dtype=np.float64)


def expected(probability: FloatArray) -> float:
    """Expected factor of the variance."""
    return float(probability @ SCALES)
