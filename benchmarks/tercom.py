"""The correlation surface of 48 readings on 201 x 201 errors: MAD and MSD, with and without the mean removed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from benchmarks.lattice import AXIS, GEOGRAPHIC, OWN, SIDE, SIZE, _blended, _slices
from benchmarks.limits import fetch_ns, multiply_add_ns
from benchmarks.timing import Limit, Peer, Row, least_ns
from terranav.kernels.tercom import correlation_surface
from terranav.maps.frame import LocalFrame

FloatArray = NDArray[np.float64]

POINTS = 48


@dataclass(frozen=True)
class Case:
    """One way to compare."""

    start: LocalFrame
    absolute: bool
    remove_mean: bool


def rows() -> list[Row]:
    rng = np.random.default_rng(1)
    values = rng.normal(500.0, 100.0, (SIDE, SIDE)).astype(np.float32)
    readings = np.stack([rng.normal(500.0, 100.0, POINTS), rng.uniform(0.5, 2.0, POINTS)], axis=1)
    cases = [
        Case(start, absolute, mean)
        for start in (OWN, GEOGRAPHIC)
        for mean in (False, True)
        for absolute in (False, True)
    ]
    return [_row(values, readings, case) for case in cases]


def _row(values: NDArray[np.float32], readings: FloatArray, case: Case) -> Row:
    profile = [_moved(case.start, 0.7 * k, 0.6 * k) for k in range(POINTS)]
    frames = np.array([(frame.row, frame.col) for frame in profile])
    score, valid = np.empty((SIZE, SIZE)), np.empty((SIZE, SIZE))
    ours = partial(
        correlation_surface, values, frames, readings, (AXIS, AXIS), case.absolute, case.remove_mean, score, valid
    )
    theirs = partial(_numpy, values, profile, readings, case)
    ours()
    np.testing.assert_allclose(score, theirs(), rtol=1e-9)
    least = least_ns({"ours": ours, "numpy": theirs}, POINTS * SIZE * SIZE, repeats=6)
    own = case.start is OWN
    work = f"TERCOM {'MAD' if case.absolute else 'MSD'}{', mean removed' if case.remove_mean else ''}"
    where = "map's own cells" if own else "map in degrees"
    return Row(
        f"{work}, 48 x 201 x 201, {where}",
        "cell and point",
        least["ours"],
        (
            Peer(
                "numpy, a loop over points",
                least["numpy"],
                12.0 if own else 0.0,
                9.0 if own and case.remove_mean else 0.0,
            ),
        ),
        _limit(own, case.remove_mean),
    )


def _limit(own: bool, remove_mean: bool) -> Limit:
    """Conversions of four neighbours to float64, four multiply-adds, one to add up; for a mean to remove three more."""
    sums = 5 + (3 if remove_mean else 0)
    if own:
        return Limit(f"4 conversions, {sums} sums", (4 + sums) * multiply_add_ns(), 1.2)
    return Limit(f"2 fetches, {sums} sums", 2 * fetch_ns(SIDE, SIZE / 4) + sums * multiply_add_ns(), 1.2)


def _moved(frame: LocalFrame, rows_: float, cols_: float) -> LocalFrame:
    """The frame at a place some cells on."""
    return LocalFrame(frame.row + np.eye(6)[0] * rows_, frame.col + np.eye(6)[0] * cols_)


def _numpy(values: NDArray[np.float32], profile: list[LocalFrame], readings: FloatArray, case: Case) -> FloatArray:
    """A loop over the points, with the sampling of `benchmarks.lattice`."""
    sample = _slices if case.start is OWN else _blended
    weights, total = readings[:, 1], np.zeros((SIZE, SIZE))
    kept, centre = [], np.zeros((SIZE, SIZE))
    for frame, (value, weight) in zip(profile, readings, strict=True):
        difference = value - sample(values, frame)
        if case.remove_mean:
            kept.append(difference)
            centre += weight * difference
        else:
            total += weight * (np.abs(difference) if case.absolute else difference * difference)
    centre /= weights.sum()
    for difference, weight in zip(kept, weights):
        away = difference - centre
        total += weight * (np.abs(away) if case.absolute else away * away)
    return np.asarray(total / weights.sum())
