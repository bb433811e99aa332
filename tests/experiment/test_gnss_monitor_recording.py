"""The GNSS monitor over recordings, ways of being false, and a slice of its study."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from terranav.core.earth import offset_m, shift
from terranav.core.errors import ConfigError, DataError
from terranav.core.recording import Recording
from terranav.core.records import Estimate, Status
from terranav.experiment.gnss import estimates_of, monitor_recording, pulled
from terranav.experiment.montecarlo import Threads
from terranav.experiment.result import Result
from terranav.experiment.studies import monitor
from terranav.experiment.studies.monitor_report import upper_per_100_h
from terranav.experiment.studies.monitor_world import ATTACKS, Attack, Synthetic, gnss_error_m, wandering, worse
from terranav.experiment.studies.registry import study_named
from terranav.experiment.studies.runner import prepare_study, run_study
from terranav.experiment.studies.study import Setup
from terranav.experiment.studies.tracks import INS
from terranav.ins.drift import add_drift
from terranav.integrity.gnss import GnssMonitor, GnssStatus

FloatArray = NDArray[np.float64]


def flown(n: int = 300, seed: int = 1) -> tuple[Recording, Result]:
    """A recording with a drift, and estimates 10 m off that claim as much."""
    time_s = np.arange(n, dtype=np.float64)
    lat, lon = shift(45.0, 10.0, 50.0 * time_s, 20.0 * time_s)
    rec = Recording({"time_s": time_s, "lat_deg": lat, "lon_deg": lon, "alt_m": np.full(n, 900.0)}, name="made up")
    rec = add_drift(rec, INS, seed)
    off = np.array([6.0, -8.0])
    rows = zip(rec.epochs(), rec.ins_error_m(), strict=True)
    estimates = [
        replace(Estimate.at(epoch, error + off, 100.0 * np.eye(2), Status.CONVERGED), usable=True)
        for epoch, error in rows
    ]
    return rec, Result.from_estimates("made up", estimates, rec)


def test_a_recording_is_watched() -> None:
    rec, result = flown()
    watch = monitor_recording(rec, result, GnssMonitor(INS))
    assert watch.alarms == ()
    assert watch.share(GnssStatus.CONSISTENT) == 1.0
    np.testing.assert_allclose(watch.difference_m, 10.0, atol=0.1)
    assert (watch.threshold_m > 50.0).all()
    false = pulled(rec, 4.0, 100.0, 90.0)
    east = offset_m(*(rec.columns[key] for key in ("true_lat_deg", "true_lon_deg")),
                    *(false.columns[key] for key in ("true_lat_deg", "true_lon_deg")))[1]  # fmt: skip
    np.testing.assert_allclose(east, 4.0 * np.maximum(rec.time_s - 100.0, 0.0), atol=0.01)
    (alarm,) = monitor_recording(false, result, GnssMonitor(INS)).alarms
    assert alarm.status is GnssStatus.SPOOFED
    assert 100.0 < alarm.from_s < 100.0 + 300.0 / 4.0
    assert math.isnan(alarm.to_s)


def test_gaps_in_gnss_are_jamming_with_an_end() -> None:
    rec, result = flown()
    lat = rec.columns["true_lat_deg"].copy()
    lat[50:80] = np.nan
    (alarm,) = monitor_recording(rec.with_columns(true_lat_deg=lat), result, GnssMonitor(INS)).alarms
    assert (alarm.status, alarm.from_s, alarm.to_s) == (GnssStatus.JAMMED, 54.0, 80.0)


def test_what_does_not_go_together_is_one_line() -> None:
    rec, result = flown()
    blind = Recording({key: rec.columns[key] for key in ("time_s", "lat_deg", "lon_deg", "alt_m")}, name="blind")
    with pytest.raises(DataError, match="blind: has no GNSS to monitor"):
        monitor_recording(blind, result, GnssMonitor(INS))
    with pytest.raises(DataError, match="expected those of the recording"):
        monitor_recording(rec.between(0.0, 100.0), result, GnssMonitor(INS))
    with pytest.raises(ConfigError, match="gnss sigma_m is -1"):
        monitor_recording(rec, result, GnssMonitor(INS), sigma_m=-1.0)


def test_estimates_come_back_from_a_result() -> None:
    rec, result = flown(20)
    again = Result.from_estimates("made up", estimates_of(result), rec)
    for key in ("ins_error_m", "cov_m2", "status", "usable", "lat_deg"):
        np.testing.assert_array_equal(getattr(again, key), getattr(result, key))


@pytest.mark.parametrize("attack", ATTACKS, ids=lambda attack: attack.name)
def test_attacks_are_what_they_are_called(attack: Attack) -> None:
    rec, _ = flown()
    lat, lon = rec.columns["true_lat_deg"], rec.columns["true_lon_deg"]
    false = attack.positions(rec.time_s, lat, lon, slice(100, 200), math.radians(30.0))
    if attack.absent:
        assert np.isnan(false[0]).all()
        return
    north, east = offset_m(lat[100:200], lon[100:200], *false)
    off, elapsed = np.hypot(north, east), rec.time_s[100:200] - 100.0
    speed = math.hypot(50.0, 20.0)
    if attack.frozen:
        expected = speed * elapsed
        assert np.ptp(false[0]) == 0.0
    elif attack.late_s:
        expected = np.full(100, speed * attack.late_s)
    else:
        expected = attack.jump_m + attack.speed_mps * elapsed
        np.testing.assert_allclose(np.arctan2(east[1:], north[1:]), math.radians(30.0), atol=1e-3)
    np.testing.assert_allclose(off, expected, rtol=1e-3, atol=0.01)


def test_the_world_is_as_described() -> None:
    source = Synthetic(ground="rough")
    track = wandering(source, np.random.default_rng(3), 600.0)
    rec = track.true_recording()
    steps = np.hypot(*offset_m(rec.lat_deg[:-1], rec.lon_deg[:-1], rec.lat_deg[1:], rec.lon_deg[1:]))
    np.testing.assert_allclose(steps, track.leg.speed_mps, rtol=1e-3)
    assert np.isfinite(rec.columns["terrain_m"]).all()
    error = np.concatenate([gnss_error_m(np.arange(2000.0), np.random.default_rng(k)) for k in range(20)])
    assert np.std(error) == pytest.approx(math.hypot(2.0, 0.5), rel=0.05)
    assert worse(INS, 1.5).velocity_sigma_mps == 0.75
    assert worse(INS, 1.5).position_walk_m_per_sqrt_s == 1.5


def test_the_poisson_bound() -> None:
    assert upper_per_100_h(0.0, 100.0) == pytest.approx(-math.log(0.05))
    assert upper_per_100_h(2.0, 100.0) == pytest.approx(6.296, abs=1e-3)  # tables of the Poisson distribution
    assert upper_per_100_h(0.0, 0.0) == math.inf


def test_a_slice_of_the_study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two short flights over rough ground: the pulls are flagged, the honest receiver is not."""
    monkeypatch.delenv("TERRANAV_SHARED", raising=False)
    monkeypatch.setattr(monitor, "wandering", lambda source, rng: wandering(source, rng, 500.0))
    prepared = prepare_study(study_named("monitor"), Setup(only=("synthetic rough, INS x 1.5",)), 2)
    assert any("only the sample DEM is at hand" in note for note in prepared.plan.notes)
    result = run_study(prepared, tmp_path, executor=Threads(1))
    assert (result.runs, result.failed) == (2, 0)
    rows = {row["attack"]: row for row in result.report.figures if "before_300_m" in row}
    for name in ("2 m/s", "2 m/s, map alone", "5 m/s", "20 m/s"):
        assert rows[name]["flagged"] == 2
        assert 10.0 < rows[name]["median_m"][0] < 300.0
    sudden = {row["attack"]: row for row in result.report.figures if "within_60_s" in row}
    assert sudden["jump of 1000 m"]["median_s"][0] == 2.0
    assert sudden["no position"]["flagged"] == sudden["frozen"]["flagged"] == 2
    alarms = next(row for row in result.report.figures if "false_alarms" in row)
    assert alarms["false_alarms"] == 0.0
    assert alarms["hours"] == pytest.approx(1000.0 / 3600.0)
    assert [verdict.met for verdict in result.report.verdicts] == [True, True, False]  # so few hours prove nothing
