"""A lost estimator begins anew from a place that was found anywhere on the map."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from terranav.core.earth import offset_of, shift
from terranav.core.errors import StateError
from terranav.core.ins_grade import InsGrade
from terranav.core.recording import Recording
from terranav.core.records import Prior, Status
from terranav.filters.marginalized import Marginalized
from terranav.ins.drift import add_drift
from terranav.maps.fields import plane_map
from terranav.maps.map import Map
from terranav.maps.sample_dem import sample_map
from terranav.planning.locate import LocateSettings, Track, locate

TOLD = InsGrade(300.0, 0.3, 0.3)
FAR_M = (6000.0, -5000.0)  # where the INS is, against what it is told to be off at most
LOST_S, MINUTES_S = 300, 180.0


@cache
def flight() -> tuple[Map, Recording]:
    """Seven minutes over the hills, 8 km off from the start."""
    chart, n = sample_map(), 420
    along = 50.0 * np.arange(n)
    lat, lon = shift(36.50, -84.38, 0.75 * along + 400.0 * np.sin(along / 2000.0), 0.55 * along)
    noise = np.random.default_rng(8).normal(0.0, 5.0, n)
    columns = {"time_s": np.arange(n, dtype=np.float64), "lat_deg": lat, "lon_deg": lon, "alt_m": np.full(n, 2500.0)}
    true = Recording({**columns, "terrain_m": chart.sample(lat, lon) + 12.0 + noise}, sigma={"terrain_m": 5.0})
    rec = add_drift(true, TOLD, 2)
    far = shift(rec.lat_deg, rec.lon_deg, *FAR_M)
    return chart, rec.with_columns(lat_deg=np.asarray(far[0]), lon_deg=np.asarray(far[1]))


def test_a_lost_navigator_goes_on_from_the_place_found() -> None:
    chart, rec = flight()
    epochs, rng = list(rec.epochs()), np.random.default_rng(1)
    navigator = Marginalized((chart,), TOLD)
    state = navigator.init(Prior.from_ins(TOLD), rng)
    for epoch in epochs[:LOST_S]:
        state = navigator.step(state, epoch, rng)
    before, error = navigator.estimate(state), rec.ins_error_m()
    assert before.status is not Status.CONVERGED
    assert np.hypot(*(before.ins_error_m - error[LOST_S - 1])) > 3000.0

    latest = epochs[LOST_S - 1]
    recent = [epoch for epoch in epochs[:LOST_S] if epoch.time_s > latest.time_s - MINUTES_S]
    found = locate(Track.of(recent, "terrain"), chart, LocateSettings(heading_deg=2.0, scale=0.02))
    assert found.verdict == "found"
    prior = found.prior(latest.lat_deg, latest.lon_deg)
    off = prior.mean_m - error[LOST_S - 1]
    assert off @ np.linalg.solve(prior.cov_m2, off) < 9.21  # the 99 % ellipse

    state = navigator.restarted(state, prior, rng)
    errors = []
    for epoch in epochs[LOST_S:]:
        state = navigator.step(state, epoch, rng)
        errors.append(navigator.estimate(state).ins_error_m)
    after = np.hypot(*(np.array(errors) - error[LOST_S:]).T)
    assert after.max() < 2.0 * chart.cell_m
    assert navigator.estimate(state).status is Status.CONVERGED


def test_the_prior_is_the_error_of_the_ins_and_the_spread_of_the_place() -> None:
    chart, rec = flight()
    epochs = list(rec.epochs())[:200]
    found = locate(Track.of(epochs, "terrain"), chart, LocateSettings(scale=0.02))
    best, last = found.candidates[0], epochs[-1]
    prior = found.prior(last.lat_deg, last.lon_deg)
    np.testing.assert_allclose(prior.mean_m, offset_of(best.lat_deg, best.lon_deg, last.lat_deg, last.lon_deg))
    np.testing.assert_array_equal(prior.cov_m2, best.cov_m2)
    assert best.sigma_m == pytest.approx(float(np.sqrt(np.linalg.eigvalsh(best.cov_m2)[-1])))


def test_an_ambiguous_place_gives_no_prior() -> None:
    chart = plane_map(0.0, 0.0, cells=121, cell_m=60.0, sigma=1.0)
    along = 50.0 * np.arange(60, dtype=np.float64)
    track = Track(along, 0.5 * along, np.random.default_rng(1).normal(0.0, 2.0, 60), 2.0)
    found = locate(track, chart, LocateSettings(most_places=500))
    with pytest.raises(StateError, match="that is not searched to the end: search stopped: more than 500"):
        found.prior(*chart.centre_deg)
