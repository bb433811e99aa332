"""Tracks and worlds: geometry, the criteria, and the statistics of what is drawn."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from terranav.core.earth import offset_m
from terranav.core.kinds import KINDS
from terranav.experiment.studies.sources import MapSource
from terranav.experiment.studies.tracks import (
    CONVERGED_SHARE,
    INS,
    LEAST_SLOPE,
    SENSOR_SIGMA_M,
    SETTLED_READINGS,
    Leg,
    Track,
    World,
    drawn_tracks,
    settled_index,
    track_bound,
)
from terranav.experiment.studies.world import flown

SAMPLE = MapSource()


@pytest.fixture(scope="module")
def tracks() -> tuple[Track, ...]:
    return drawn_tracks(SAMPLE, 3, 0).tracks


def test_a_leg_is_flown_at_its_speed_and_turns_as_told() -> None:
    for turn in (0.0, 60.0, -90.0):
        leg = Leg(36.5, -84.3, 30.0, turn, 50.0)
        lat, lon = leg.positions_deg()
        north, east = offset_m(lat[:-1], lon[:-1], lat[1:], lon[1:])
        np.testing.assert_allclose(np.hypot(north, east), 100.0, rtol=2e-3)
        course = np.unwrap(np.arctan2(east, north))
        per_step = math.radians(turn) / len(course)
        np.testing.assert_allclose(course[0], math.radians(30.0) + 0.5 * per_step, atol=3e-3)
        np.testing.assert_allclose(course[-1] - course[0], math.radians(turn) - per_step, atol=5e-3)


def test_tracks_meet_their_criteria_and_depend_on_the_seed_alone(tracks: tuple[Track, ...]) -> None:
    assert len(tracks) == 3
    assert drawn_tracks(SAMPLE, 2, 0).tracks == tracks[:2]
    assert drawn_tracks(SAMPLE, 1, 1).tracks[0].leg != tracks[0].leg
    for track in tracks:
        lat, lon = track.leg.positions_deg()
        slopes = np.array(track.chart.gradient(lat, lon))
        assert np.sqrt(np.mean(np.sum(slopes**2, axis=0))) >= LEAST_SLOPE
        first = settled_index(track_bound(track))
        assert first is not None
        assert first >= SETTLED_READINGS
        low = track_bound(track).drms_m[first:] / math.sqrt(2.0)
        assert (low <= CONVERGED_SHARE * INS.position_sigma_m).all()


def test_no_track_comes_near_a_void(tracks: tuple[Track, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    chart = SAMPLE.open()
    row, col = chart.cells(*(axis[100] for axis in tracks[0].leg.positions_deg()))
    values = chart.values.copy()
    values[round(float(row)) + 10, round(float(col)) - 10] = np.nan  # 1.1 km away
    holed = replace(chart, values=values)
    monkeypatch.setattr("terranav.experiment.studies.sources._opened", lambda source: holed)
    assert tracks[0].leg not in [track.leg for track in drawn_tracks(SAMPLE, 50, 0).tracks]


def test_the_world_is_as_told(tracks: tuple[Track, ...]) -> None:
    track = tracks[0]
    exact = track.true_recording().columns["terrain_m"]
    flights = [flown(track, World(blur_cells=0.0), np.random.default_rng(seed)) for seed in range(400)]
    errors = np.array([flight.rec.columns["terrain_m"] - exact for flight in flights])
    kind, chart = KINDS["terrain"], track.chart
    told = kind.bias_sigma**2 + chart.sigma**2 + SENSOR_SIGMA_M**2 + kind.bias_walk**2 * track.leg.time_s
    np.testing.assert_allclose(np.var(errors) / told.mean(), 1.0, atol=0.15)  # 400 biases: sigma 0.07
    unbiased = errors - np.array([flight.bias for flight in flights])
    lag = np.mean(unbiased[:, 1:] * unbiased[:, :-1])  # the patch alone is correlated
    step = track.leg.speed_mps * track.leg.interval_s
    np.testing.assert_allclose(lag, chart.sigma**2 * math.exp(-step / chart.error_length_m), rtol=0.1)
    np.testing.assert_allclose(np.var(unbiased), chart.sigma**2 + SENSOR_SIGMA_M**2, rtol=0.05)
    starts = np.array([flight.rec.ins_error_m()[0] for flight in flights])
    np.testing.assert_allclose(starts.std(), INS.position_sigma_m, rtol=0.1)
    assert all(flight.rec.ins == INS for flight in flights)


def test_worlds_that_are_compared_have_the_same_draws(tracks: tuple[Track, ...]) -> None:
    def values(world: World) -> np.ndarray:
        return flown(tracks[0], world, np.random.default_rng(5)).rec.columns["terrain_m"]

    plain = values(World(bias_sigma=0.0))
    np.testing.assert_allclose(values(World(bias_sigma=0.0, bias=30.0)), plain + 30.0, atol=1e-9)
    gross = values(World(bias_sigma=0.0, gross_share=0.05, gross_size=200.0)) - plain
    assert set(np.abs(np.round(gross, 6)).tolist()) == {0.0, 200.0}
    assert 0 < np.count_nonzero(gross) < 30


def test_the_same_relief_as_a_seabed_is_read_as_depth(tracks: tuple[Track, ...]) -> None:
    seabed = replace(tracks[0], kind="bathymetry")
    assert seabed.chart.values.max() < 0.0
    rec = seabed.true_recording()
    np.testing.assert_allclose(rec.columns["depth_m"], -seabed.chart.sample(rec.lat_deg, rec.lon_deg))
    slopes = np.array(tracks[0].chart.gradient(rec.lat_deg, rec.lon_deg))
    np.testing.assert_allclose(np.array(seabed.chart.gradient(rec.lat_deg, rec.lon_deg)), slopes, atol=1e-5)
