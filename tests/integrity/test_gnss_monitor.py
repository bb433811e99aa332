"""The GNSS monitor: honest receivers are left alone, false ones are flagged, and what it cannot know it says."""

from __future__ import annotations

import math
import pickle
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from terranav.core.earth import shift
from terranav.core.errors import ConfigError
from terranav.core.ins_grade import InsGrade
from terranav.core.records import Epoch, Estimate, Prior, Status
from terranav.ins.drift import draw_drift
from terranav.ins.error_state import ErrorModel
from terranav.integrity import gnss_bank
from terranav.integrity.gnss import LOOKS_PER_H, GnssMonitor, GnssReading, GnssState, GnssStatus, GnssVerdict

INS = InsGrade(position_sigma_m=300.0, velocity_sigma_mps=0.5, position_walk_m_per_sqrt_s=1.0)
MAP_SIGMA_M, GNSS_SIGMA_M, SPEED_MPS = 15.0, 2.0, 60.0
BEGINS = 200  # epoch from which on GNSS is false

FloatArray = NDArray[np.float64]
Told = list[GnssVerdict]


@dataclass(frozen=True)
class World:
    """What a monitor sees of a flight due north, and the honest positions of GNSS (n, 2) [deg]."""

    epochs: tuple[Epoch, ...]
    estimates: tuple[Estimate, ...]
    lat: FloatArray
    lon: FloatArray


def alike(rng: np.random.Generator, n: int, sigma: float, memory_s: float) -> FloatArray:
    """(n, 2) errors that stay alike for a while."""
    kept, steps, out = math.exp(-1.0 / memory_s), rng.standard_normal((n, 2)), np.empty((n, 2))
    out[0] = steps[0]
    for i in range(1, n):
        out[i] = kept * out[i - 1] + math.sqrt(1.0 - kept * kept) * steps[i]
    return sigma * out


def world(seed: int = 0, *, n: int = 600, usable: bool = True, factor: float = 1.0, east: float = 1.0) -> World:
    """Epochs a second apart; the map-aided estimate errs alike for some 20 s; `east` = -1 mirrors everything."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(n, dtype=np.float64)
    worse = InsGrade(factor * 300.0, factor * 0.5, factor * 1.0)
    error_m, speed_mps = draw_drift(time_s, worse, rng)
    off_m, gnss_m = alike(rng, n, MAP_SIGMA_M, 20.0), alike(rng, n, GNSS_SIGMA_M, 60.0)
    for one in (error_m, speed_mps, off_m, gnss_m):
        one[:, 1] *= east
    lat, lon = shift(0.0, 10.0, SPEED_MPS * time_s, np.zeros(n))
    ins_lat, ins_lon = shift(lat, lon, *error_m.T)
    velocity = np.array([SPEED_MPS, 0.0]) + speed_mps
    epochs = tuple(
        Epoch(
            float(t), float(ins_lat[i]), float(ins_lon[i]), 900.0, (float(velocity[i, 0]), float(velocity[i, 1]), 0.0)
        )
        for i, t in enumerate(time_s)
    )
    cov = MAP_SIGMA_M**2 * np.eye(2)
    status, reasons = (Status.CONVERGED, ()) if usable else (Status.SEARCHING, ("still searching",))
    estimates = tuple(
        replace(Estimate.at(epoch, error_m[i] + off_m[i], cov, status), usable=usable, reasons=reasons)
        for i, epoch in enumerate(epochs)
    )
    return World(epochs, estimates, *shift(lat, lon, *gnss_m.T))


def heard(seen: World, north_m: Any = 0.0, east_m: Any = 0.0, **fields: Any) -> list[GnssReading | None]:
    """The readings of GNSS, off by so much from BEGINS on."""
    begun = np.arange(len(seen.epochs)) >= BEGINS
    lat, lon = shift(seen.lat, seen.lon, np.where(begun, north_m, 0.0), np.where(begun, east_m, 0.0))
    times = [epoch.time_s for epoch in seen.epochs]
    return [GnssReading(*row, **fields) for row in zip(times, lat.tolist(), lon.tolist(), strict=True)]


def pulled(seen: World, speed_mps: float) -> list[GnssReading | None]:
    """Pulled away to the east."""
    return heard(seen, east_m=speed_mps * (np.arange(len(seen.epochs)) - BEGINS))


def states(seen: World, readings: Sequence[GnssReading | None], monitor: GnssMonitor | None = None) -> list[GnssState]:
    monitor = monitor or GnssMonitor(INS)
    state, found = monitor.init(), []
    for epoch, estimate, reading in zip(seen.epochs, seen.estimates, readings, strict=True):
        state = monitor.step(state, epoch.time_s, reading, epoch, estimate)
        found.append(state)
    return found


def told(seen: World, readings: Sequence[GnssReading | None], monitor: GnssMonitor | None = None) -> Told:
    return [state.verdict for state in states(seen, readings, monitor)]


def first(verdicts: Told, status: GnssStatus) -> int:
    """The first epoch of a status; the test fails where there is none."""
    return next(i for i, one in enumerate(verdicts) if one.status is status)


@pytest.mark.parametrize("seed", range(6))
def test_an_honest_gnss_is_consistent(seed: int) -> None:
    """With an INS 1.5 times worse than told, too."""
    seen = world(seed, factor=1.5 if seed % 2 else 1.0)
    verdicts = told(seen, heard(seen))
    assert {one.status for one in verdicts} == {GnssStatus.CONSISTENT}
    assert all(0.0 <= one.difference_m < one.threshold_m < 200.0 for one in verdicts)
    assert verdicts[-1].since_s == 0.0


@pytest.mark.parametrize(
    ("speed", "usable"), [(0.5, True), *[(v, known) for v in (1.0, 2.0, 5.0, 20.0) for known in (True, False)]]
)
def test_a_pull_is_flagged_before_300_m(speed: float, usable: bool) -> None:
    """With the map, and by the INS alone where there is no fix: that drifts by some 0.5 m/s itself."""
    seen = world(3, usable=usable, n=BEGINS + 650)
    verdicts = told(seen, pulled(seen, speed))
    at = first(verdicts, GnssStatus.SPOOFED)
    assert 0.0 < speed * (at - BEGINS) < 300.0
    assert GnssStatus.SUSPECT in {one.status for one in verdicts[BEGINS:at]}
    assert not {one.status for one in verdicts[:BEGINS]} & {GnssStatus.SUSPECT, GnssStatus.SPOOFED}
    assert all(one.status is GnssStatus.SPOOFED for one in verdicts[at : at + 60])
    assert any("GNSS" in reason for reason in verdicts[at].reasons)


def test_the_map_alone_flags_what_the_ins_cannot_see() -> None:
    """A drift of GNSS that an INS of 5 m/s would allow, since the very start."""
    seen = world(4)
    off = 1.5 * np.arange(len(seen.epochs))
    lat, lon = shift(seen.lat, seen.lon, 0.0, off)
    readings: list[GnssReading | None] = [
        GnssReading(epoch.time_s, a, o) for epoch, a, o in zip(seen.epochs, lat.tolist(), lon.tolist(), strict=True)
    ]
    poor = InsGrade(position_sigma_m=3000.0, velocity_sigma_mps=5.0, position_walk_m_per_sqrt_s=5.0)
    verdicts = told(seen, readings, GnssMonitor(poor))
    at = first(verdicts, GnssStatus.SPOOFED)
    assert off[at] < 200.0
    assert "east of the map-aided position" in verdicts[at].reasons[0]
    alone = told(seen, readings, GnssMonitor(INS, horizons_s=()))
    assert off[first(alone, GnssStatus.SPOOFED)] < 200.0


def test_without_a_fix_what_gnss_could_hide_is_said() -> None:
    seen = world(5, usable=False)
    verdicts = told(seen, heard(seen))
    assert {one.status for one in verdicts} == {GnssStatus.UNKNOWN}
    assert "the map offers no fix here (still searching)" in verdicts[-1].reasons[0]
    assert "since the start of the INS" in verdicts[-1].reasons[0]
    assert verdicts[-1].since_s == 0.0
    seen = world(5, usable=False, n=1400)
    lost = World(seen.epochs, (*world(5, n=1400).estimates[:300], *seen.estimates[300:]), seen.lat, seen.lon)
    verdicts = told(lost, heard(lost))
    assert verdicts[310].status is GnssStatus.CONSISTENT  # the INS vouches for a while
    assert "since the latest fix of the map" in verdicts[310].reasons[0]
    assert verdicts[-1].status is GnssStatus.UNKNOWN
    limits = [one.threshold_m for one in verdicts[300:]]
    assert limits[-1] > 2.0 * limits[0]


def test_a_jump_is_flagged_after_the_hold_and_ends_when_gnss_comes_back() -> None:
    seen = world(6)
    off = np.where(np.arange(600) < 300, 150.0, 0.0)
    verdicts = told(seen, heard(seen, north_m=off))
    assert [one.status for one in verdicts[BEGINS : BEGINS + 3]] == [*[GnssStatus.SUSPECT] * 2, GnssStatus.SPOOFED]
    assert all(one.status is GnssStatus.SPOOFED for one in verdicts[BEGINS + 2 : 330])
    back = first(verdicts[330:], GnssStatus.CONSISTENT) + 330
    assert back <= 345
    assert all(one.status is GnssStatus.CONSISTENT for one in verdicts[back:])
    assert verdicts[-1].since_s == seen.epochs[back].time_s


def test_one_outlier_is_no_alarm() -> None:
    seen = world(7)
    verdicts = told(seen, heard(seen, north_m=np.where(np.arange(600) == BEGINS, 5000.0, 0.0)))
    assert verdicts[BEGINS].status is GnssStatus.SUSPECT
    assert GnssStatus.SPOOFED not in {one.status for one in verdicts}
    assert verdicts[BEGINS + 1].status is GnssStatus.CONSISTENT


def test_a_frozen_gnss_is_told_by_its_repetition() -> None:
    seen = world(8, usable=False)
    readings = heard(seen)
    last = readings[BEGINS]
    assert last is not None
    frozen = [*readings[:BEGINS], *[replace(last, time_s=epoch.time_s) for epoch in seen.epochs[BEGINS:]]]
    verdicts = told(seen, frozen)
    at = first(verdicts, GnssStatus.SPOOFED)
    assert at - BEGINS <= 6
    assert any("repeats the same position" in reason for one in verdicts[at : at + 3] for reason in one.reasons)


@pytest.mark.parametrize(
    ("fields", "why"),
    [(None, "no GNSS position"), ({"fix": False}, "has no fix"), ({"sigma_m": 400.0}, "its sigma is 400 m")],
)
def test_jamming_is_flagged_within_the_outage_and_ends_with_it(fields: dict[str, Any] | None, why: str) -> None:
    seen = world(9)
    readings = heard(seen)
    for i in range(BEGINS, BEGINS + 100):
        reading = readings[i]
        assert reading is not None
        readings[i] = None if fields is None else replace(reading, **fields)
    verdicts = told(seen, readings)
    assert first(verdicts, GnssStatus.JAMMED) - BEGINS <= 5
    assert why in verdicts[BEGINS + 50].reasons[0]
    assert verdicts[BEGINS + 99].since_s == verdicts[BEGINS + 50].since_s
    assert {one.status for one in verdicts[BEGINS + 100 :]} == {GnssStatus.CONSISTENT}


def test_a_receiver_that_comes_back_elsewhere_is_not_believed() -> None:
    """Jammed and then spoofed, on flat ground: the INS remembers."""
    seen = world(10, usable=False)
    readings = heard(seen, east_m=500.0)
    readings[BEGINS : BEGINS + 60] = [None] * 60
    verdicts = told(seen, readings)
    assert verdicts[BEGINS + 59].status is GnssStatus.JAMMED
    assert first(verdicts, GnssStatus.SPOOFED) <= BEGINS + 63


def test_a_gnss_that_was_never_heard() -> None:
    seen = world(11, n=20)
    verdicts = told(seen, [None] * 20)
    assert verdicts[0].status is GnssStatus.UNKNOWN
    assert verdicts[0].reasons == ("no GNSS heard yet",)
    assert verdicts[-1].status is GnssStatus.JAMMED


def test_a_velocity_that_does_not_go_with_the_ins() -> None:
    """The position is held back so that it looks honest; the velocity tells."""
    seen = world(12)
    readings = [
        replace(one, velocity_mps=(SPEED_MPS, 8.0 * (i >= BEGINS)))
        for i, one in enumerate(heard(seen))
        if one is not None
    ]
    verdicts = told(seen, readings, GnssMonitor(INS, ins_factor=1.0))
    at = first(verdicts, GnssStatus.SPOOFED)
    assert BEGINS < at <= BEGINS + 3
    assert "velocity of GNSS" in verdicts[at].reasons[0]


def test_the_ins_is_started_anew_where_map_and_gnss_agree_for_long() -> None:
    """An INS far worse than told is no spoofer for ever."""
    seen = world(13, factor=12.0, n=1500)
    verdicts = told(seen, heard(seen), GnssMonitor(INS, calm_s=10.0))
    assert GnssStatus.SPOOFED in {one.status for one in verdicts}  # it is told so badly that this is an alarm
    assert GnssStatus.CONSISTENT in {one.status for one in verdicts[first(verdicts, GnssStatus.SPOOFED) :]}


def test_a_checkpoint_goes_on_to_the_same_bits() -> None:
    seen, monitor = world(14), GnssMonitor(INS)
    readings = pulled(seen, 2.0)
    whole = states(seen, readings, monitor)
    state: GnssState = pickle.loads(pickle.dumps(whole[BEGINS + 10]))
    for i in range(BEGINS + 11, 600):
        state = monitor.step(state, seen.epochs[i].time_s, readings[i], seen.epochs[i], seen.estimates[i])
    assert state.bank is not None
    ours, theirs = state.bank, whole[-1].bank
    assert theirs is not None
    for here, there in zip((ours.mean, ours.cov, ours.since_s), (theirs.mean, theirs.cov, theirs.since_s), strict=True):
        assert here.tobytes() == there.tobytes()
    assert repr(state.verdict) == repr(whole[-1].verdict)
    assert monitor.verdict(state).status is GnssStatus.SPOOFED


def test_steps_leave_the_old_state_alone() -> None:
    seen, monitor = world(15, n=60), GnssMonitor(INS)
    before = states(seen, heard(seen), monitor)[-2]
    kept = pickle.dumps(before)
    after = monitor.step(before, 59.0, heard(seen)[59], seen.epochs[59], seen.estimates[59])
    assert after is not before
    assert pickle.dumps(before) == kept


def test_a_mirrored_world_gives_mirrored_verdicts() -> None:
    one, other = world(16), world(16, east=-1.0)
    here = told(one, heard(one, east_m=2.0 * (np.arange(600) - BEGINS)))
    there = told(other, heard(other, east_m=-2.0 * (np.arange(600) - BEGINS)))
    assert [v.status for v in here] == [v.status for v in there]
    np.testing.assert_allclose([v.difference_m for v in here], [v.difference_m for v in there], rtol=1e-6, atol=1e-6)


BAD: list[dict[str, Any]] = [
    {"lat_deg": math.nan}, {"lon_deg": math.inf}, {"lat_deg": 91.0}, {"lon_deg": -1e9}, {"sigma_m": 0.0},
    {"sigma_m": -1.0}, {"sigma_m": math.nan}, {"time_s": math.nan}, {"time_s": 1e9}, {"time_s": -1e9},
]  # fmt: skip


@pytest.mark.parametrize("fields", BAD, ids=str)
def test_a_broken_reading_is_none(fields: dict[str, Any]) -> None:
    seen = world(17, n=60)
    readings = heard(seen)
    broken = [replace(one, **fields) if one is not None and one.time_s == 40.0 else one for one in readings]
    missing = [None if one is not None and one.time_s == 40.0 else one for one in readings]
    assert repr(told(seen, broken)) == repr(told(seen, missing))


def test_a_call_out_of_time_changes_nothing() -> None:
    seen, monitor = world(18, n=60), GnssMonitor(INS)
    state = states(seen, heard(seen), monitor)[-1]
    for time_s in (59.0, 10.0, math.nan, -math.inf):
        assert monitor.step(state, time_s, heard(seen)[20], seen.epochs[20], seen.estimates[20]) is state


def test_a_reading_later_than_its_epoch_is_moved_with_the_vehicle() -> None:
    seen = world(19, n=100)
    lat, lon = shift(seen.lat, seen.lon, 0.4 * SPEED_MPS, np.zeros(100))
    monitor, state, later = GnssMonitor(INS), GnssMonitor(INS).init(), []
    for i, epoch in enumerate(seen.epochs):
        reading = GnssReading(epoch.time_s + 0.4, float(lat[i]), float(lon[i]))
        state = monitor.step(state, epoch.time_s + 0.4, reading, epoch, seen.estimates[i])
        later.append(state.verdict.difference_m)
    punctual = [one.difference_m for one in told(seen, heard(seen))]
    np.testing.assert_allclose(later, punctual, atol=1.0)


def test_a_reading_that_is_told_again_counts_once() -> None:
    """A glitch that ten calls repeat is still one reading."""
    seen, monitor = world(20, n=BEGINS + 20), GnssMonitor(INS)
    readings = heard(seen, north_m=5000.0)
    state = monitor.init()
    for i in range(BEGINS + 1):
        state = monitor.step(state, seen.epochs[i].time_s, readings[i], seen.epochs[i], seen.estimates[i])
    for k in range(1, 10):
        now = seen.epochs[BEGINS].time_s + 0.1 * k
        state = monitor.step(state, now, readings[BEGINS], seen.epochs[BEGINS], seen.estimates[BEGINS])
    assert state.over == 1
    assert state.verdict.status is GnssStatus.SUSPECT


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"false_alarms_per_h": 0.0}, "false_alarms_per_h is 0.0"),
        ({"ins_factor": 0.5}, "ins_factor is 0.5"),
        ({"map_factor": math.nan}, "map_factor is nan"),
        ({"hold_s": -1.0}, "hold_s is -1.0"),
        ({"outage_s": "soon"}, "outage_s is 'soon'"),
        ({"horizons_s": (60.0, 10.0)}, "horizons_s is 10.0, expected a finite number and > 60"),
    ],
)
def test_settings_are_checked(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        GnssMonitor(INS, **settings)


def test_the_limit_follows_the_rate() -> None:
    """A chi-square of two degrees of freedom exceeds it with the probability that the rate asks of a look."""
    for rate in (1e-4, 1e-3, 1e-1):
        assert math.exp(-0.5 * GnssMonitor(INS, false_alarms_per_h=rate).limit) * LOOKS_PER_H == pytest.approx(rate)


def test_the_bank_is_a_kalman_filter_and_its_copies_are_predictions() -> None:
    """Against textbook matrices; the row of the map never holds a position of GNSS."""
    model = ErrorModel(INS, (), "position")
    bank = gnss_bank.started(model, Prior.from_ins(INS), 1, 0.0, 1.0)
    x, p = np.zeros(4), model.initial_covariance(300.0**2 * np.eye(2))
    h, rng = np.eye(2, 4), np.random.default_rng(1)
    kept: tuple[FloatArray, FloatArray] | None = None
    for i in range(1, 31):
        before, after = (Epoch(float(k), 0.0, 0.0, 0.0) for k in (i - 1, i))
        step = model.transition(before, after)
        bank = gnss_bank.passed(bank, step, 1.0)
        x, p = step.phi @ x, step.phi @ p @ step.phi.T + step.q
        z = rng.normal(0.0, 50.0, 2)
        s = h @ p @ h.T + 9.0 * np.eye(2)
        d = z - bank.mean[:, :2]
        expected = [a @ np.linalg.inv(c[:2, :2] + 9.0 * np.eye(2)) @ a for a, c in zip(d, bank.cov, strict=True)]
        np.testing.assert_allclose(gnss_bank.position_tests(bank, z, 9.0), expected, rtol=1e-9)
        gain = p @ h.T @ np.linalg.inv(s)
        x, p = x + gain @ (z - h @ x), (np.eye(4) - gain @ h) @ p
        bank = gnss_bank.followed(bank, z, 9.0, float(i))
        np.testing.assert_allclose(bank.mean[0], x, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(bank.cov[0], p, rtol=1e-6, atol=1e-9)
        bank = gnss_bank.renewed(bank, (10.0,), float(i))
        if i == 10:
            kept = bank.mean[3].copy(), bank.cov[3].copy()
        elif kept is not None and i <= 20:
            kept = step.phi @ kept[0], step.phi @ kept[1] @ step.phi.T + step.q
        assert (bank.mean[1] == 0.0).all()
    assert kept is not None
    assert bank.since_s.tolist() == [30.0, 0.0, 20.0, 30.0]
    np.testing.assert_allclose(gnss_bank.reach_m(np.zeros(2), 4.0 * np.eye(2), 5.0, 9.0), 9.0)
    np.testing.assert_allclose(gnss_bank.reach_m(np.array([0.0, 2.0]), np.diag([0.0, 4.0]), 5.0, 9.0), 9.0)


def test_predictions_of_the_ins_are_as_wide_as_they_should_be() -> None:
    """Over 300 drifts the squared distance of an old prediction is chi-square of 2: mean 2, above 9.2 in 1 %."""
    model, time_s = ErrorModel(INS, (), "position"), np.arange(0.0, 121.0, 5.0)
    found = []
    for seed in range(300):
        rng = np.random.default_rng([seed, 5])
        error_m, _ = draw_drift(time_s, INS, rng)
        bank = gnss_bank.started(model, Prior.from_ins(INS), 1, 0.0, 1.0)
        for i, now in enumerate(time_s.tolist()):
            if i:
                before, after = (Epoch(float(t), 0.0, 0.0, 0.0) for t in time_s[i - 1 : i + 1])
                bank = gnss_bank.passed(bank, model.transition(before, after), 1.0)
            z = error_m[i] + rng.normal(0.0, 3.0, 2)
            if now == 120.0:
                found.append(gnss_bank.position_tests(bank, z, 9.0))
            bank = gnss_bank.renewed(gnss_bank.followed(bank, z, 9.0, now), (40.0,), now)
    tests = np.array(found)
    np.testing.assert_allclose(tests.mean(axis=0), 2.0, atol=0.45)  # 4 sigmas of the mean of 300
    assert (tests > 9.21).mean() < 0.03
