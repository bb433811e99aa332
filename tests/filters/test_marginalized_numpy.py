"""Every step of the navigator against the same step in plain numpy."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
from benchmarks.marginalized_numpy import Plain, plain_step

from terranav.core.ins_grade import InsGrade
from terranav.core.records import Epoch, Measurement, Prior
from terranav.experiment.stream import states
from terranav.filters._normals import standard_normal
from terranav.filters.marginalized import Marginalized
from terranav.maps.fields import gaussian_map
from terranav.maps.map import Map
from tests.filters.test_marginalized import INS, track

SCHULER = InsGrade(300.0, 0.3, 1.0, 0.01, attitude_sigma_deg=0.02, gyro_bias_sigma_deg_per_h=0.1)
STRAPDOWN = replace(SCHULER, accel_bias_sigma_ug=100.0, gyro_walk_deg_per_sqrt_h=0.02)


def flown(chart: Map, count: int, level: str) -> list[Epoch]:
    epochs = track([chart], 1, count=count).epochs
    if level != "strapdown":
        return epochs
    return [
        replace(epoch, velocity_mps=(30.0, 40.0, -0.1 * (k % 5)), attitude_deg=(2.0 * (k % 7), -1.0, 53.0 + k % 9))
        for k, epoch in enumerate(epochs)
    ]


def holed(chart: Map) -> Map:
    """Voids under the track, and its edge not far from it."""
    values = np.array(chart.values)
    values[np.random.default_rng(5).random(values.shape) < 0.01] = np.nan
    values[:, : values.shape[1] // 2 - 4] = np.nan
    return replace(chart, values=values)


@pytest.mark.parametrize("odd", [1003, 2500])
@pytest.mark.parametrize("level", ["position", "schuler", "strapdown"])
@pytest.mark.parametrize("voids", [False, True])
def test_a_step_is_that_of_plain_numpy(level: str, voids: bool, odd: int) -> None:
    hills = gaussian_map(np.random.default_rng(2), std=120.0, correlation_m=900.0, cells=257, cell_m=100.0, sigma=1.0)
    ins = {"position": INS, "schuler": SCHULER, "strapdown": STRAPDOWN}[level]
    filter_ = Marginalized((holed(hills) if voids else hills,), ins, particles=odd, least_particles=odd)
    epochs, rng = flown(hills, 60, level), np.random.default_rng(3)
    epochs[30] = replace(epochs[30], measurements=(Measurement("terrain", 4000.0, 4.0),))  # an outlier
    state, resampled, ran, known, used = filter_.init(Prior.from_ins(ins), rng), 0, 0, [1.0], 0
    for epoch in epochs:
        before, again = state, deepcopy(rng)
        state = filter_.step(state, epoch, rng)
        used += state.innovations[0].known > 0.5
        if used < 10:  # at first the velocities are but functions of the positions
            continue
        known.append(state.innovations[0].known)
        plain = plain_step(filter_, Plain.of(before), epoch, again, standard_normal)
        assert state.cloud is not None
        sigma = np.sqrt(np.diag(plain.cov))
        np.testing.assert_allclose(state.mean / sigma, plain.mean / sigma, rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(state.cov / np.outer(sigma, sigma), plain.cov / np.outer(sigma, sigma), atol=1e-9)
        np.testing.assert_allclose(state.cloud.rows.T / sigma, plain.rows / sigma, rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(state.cloud.weight, plain.weight, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(state.cloud.bad[0], plain.bad, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(
            state.cloud.common / np.outer(sigma, sigma), plain.common / np.outer(sigma, sigma), atol=1e-9
        )
        np.testing.assert_allclose(state.scale[0], plain.scale, rtol=1e-9)
        np.testing.assert_allclose(state.walk.probability, plain.walk, rtol=1e-9)
        assert state.walk.idle == (plain.bank is None)
        assert state.cloud.spacing_m == pytest.approx(plain.spacing_m, rel=1e-9)
        resampled += np.ptp(plain.weight) == 0.0
        ran += plain.bank is not None
    assert resampled >= 3
    assert ran >= 10
    assert (min(known) < 0.9) == voids


def test_the_stream_draws_from_the_given_generator_alone() -> None:
    """A step takes its numbers from the generator that it is given, and from nothing else."""
    hills = gaussian_map(np.random.default_rng(2), std=120.0, correlation_m=900.0, cells=257, cell_m=100.0, sigma=1.0)
    filter_, epochs = Marginalized((hills,), INS, least_particles=500), flown(hills, 20, "position")
    ends = []
    for seed in (1, 1, 2):
        *_, state = states(filter_, Prior.from_ins(INS), epochs, np.random.default_rng(seed))
        ends.append(state.mean)
    np.testing.assert_array_equal(ends[0], ends[1])
    assert np.abs(ends[0] - ends[2]).max() > 0.0
