"""A second-order Gauss-Markov field of 5000 x 5000 cells, as numbers and as a map."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from benchmarks.limits import byte_ns
from benchmarks.timing import Limit, Peer, Row, least_ns
from terranav.kernels.random import normals
from terranav.maps.gauss_markov import GaussMarkov, _recursion, gauss_markov_field, gauss_markov_map

FloatArray = NDArray[np.float64]
SIDE = 5000
DOWN, ACROSS = GaussMarkov(1.0, 0.01), GaussMarkov(20.0, 0.01)


def rows() -> list[Row]:
    _same_statistics()
    rng = np.random.default_rng(1)
    noise = np.empty(20_000)

    def noise_alone() -> None:
        for _ in range(SIDE * SIDE // noise.size):
            normals(np.uint64(1), noise)

    least = least_ns(
        {
            "field": lambda: gauss_markov_field(rng, SIDE, SIDE, (DOWN, ACROSS), 1.0),
            "map": lambda: gauss_markov_map(rng, shape=(SIDE, SIDE)),
            "scipy": lambda: _scipy_field(rng, SIDE),
            "noise": noise_alone,
        },
        SIDE * SIDE,
        repeats=5,
    )
    wide, narrow = (least["noise"] + width * byte_ns(width * SIDE * SIDE) for width in (8, 4))
    peer = Peer("scipy lfilter", least["scipy"], 9.0)
    return [
        Row("Gauss-Markov field, 5000 x 5000", "cell", least["field"], (peer,), Limit("its noise, writing", wide, 2.0)),
        Row("Gauss-Markov map, 5000 x 5000", "cell", least["map"], (peer,), Limit("its noise, writing", narrow, 2.0)),
    ]


def _scipy_field(rng: np.random.Generator, side: int) -> FloatArray:
    """The same covariance: white noise filtered along both axes, each filter started in its stationary distribution."""
    down, across = _recursion(DOWN, 1.0), _recursion(ACROSS, 1.0)
    field = rng.standard_normal((side + 2, side + 2))
    field = _filtered(field[:, :side], across, field[:, side:], 1)
    return _filtered(field[:side], down, field[side:].T, 0)


def _filtered(white: FloatArray, numbers: FloatArray, seeds: FloatArray, axis: int) -> FloatArray:
    a1, a2, b0, b1, l11, l21, l22 = numbers
    start = np.stack([l11 * seeds[:, 0], l21 * seeds[:, 0] + l22 * seeds[:, 1]], axis=axis)
    return np.asarray(lfilter([b0, b1], [1.0, -a1, -a2], white, axis=axis, zi=start)[0])


def _same_statistics() -> None:
    """No two generators give the same numbers: both must have the covariance that the theory states."""
    rng, lags = np.random.default_rng(0), [(0, 0), (40, 0), (0, 40), (60, 90)]
    theory = [float(ACROSS.autocorrelation(i) * DOWN.autocorrelation(j)) for i, j in lags]
    made: tuple[Callable[[], FloatArray], ...] = (
        lambda: gauss_markov_field(rng, 400, 400, (DOWN, ACROSS), 1.0),
        lambda: _scipy_field(rng, 400),
    )
    for make in made:
        fields = [make() for _ in range(60)]
        found = np.array([[np.mean(f[i:, j:] * f[: 400 - i, : 400 - j]) for i, j in lags] for f in fields])
        error = found.std(axis=0, ddof=1) / np.sqrt(len(fields))
        if not (np.abs(found.mean(axis=0) - theory) < 4.0 * error).all():
            raise AssertionError("the covariance is not that of the theory")
