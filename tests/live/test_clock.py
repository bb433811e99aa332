"""The vehicle's clock: rollover, restarts, steps of the host's clock, links that hold back, single damage."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from terranav.live.clock import DAY_S, PERIOD_MS_S, SenderClock, Tick

HOST_S = 1_700_000_000.0


def run(clock: SenderClock, times: list[tuple[float, float]]) -> list[Tick]:
    return [clock.tick(sender, host) for sender, host in times]


def steady(start_s: float, seconds: float, host_s: float, step_s: float = 0.1) -> list[tuple[float, float]]:
    return [(start_s + i * step_s, host_s + i * step_s) for i in range(round(seconds / step_s))]


def test_the_sender_times_and_the_host_says_when_that_was() -> None:
    clock = SenderClock()
    jitter = [0.05, 0.02, 0.3, 0.0, 0.08]
    ticks = [clock.tick(100.0 + i, HOST_S + i + late) for i, late in enumerate(jitter)]
    assert [tick.time_s for tick in ticks] == [100.0, 101.0, 102.0, 103.0, 104.0]
    assert not any(tick.event for tick in ticks)
    # by the message that came without delay, give or take what crystals drift
    assert clock.host_us(104.0) * 1e-6 == pytest.approx(HOST_S + 4.0, abs=2e-3)
    assert clock.boot_us(104.0) == 104_000_000


def test_a_clock_of_32_bits_runs_on() -> None:
    clock = SenderClock()
    before = steady(PERIOD_MS_S - 1.0, 1.0, HOST_S)
    after = [((start + 0.0) % PERIOD_MS_S, host) for start, host in steady(PERIOD_MS_S, 1.0, HOST_S + 1.0)]
    ticks = run(clock, before + after)
    assert not any(tick.event for tick in ticks)
    steps = [b.time_s - a.time_s for a, b in pairwise(ticks) if a.time_s is not None and b.time_s is not None]
    assert len(steps) == len(ticks) - 1
    assert steps == pytest.approx([0.1] * len(steps), abs=1e-3)


@pytest.mark.parametrize("up_s", [500.0, 30 * DAY_S, 49 * DAY_S])
def test_a_restart_starts_anew_and_time_goes_on(up_s: float) -> None:
    clock = SenderClock()
    run(clock, steady(up_s, 10.0, HOST_S))
    newest = clock.newest_s
    ticks = run(clock, steady(2.0, 2.0, HOST_S + 14.9))
    assert [tick.time_s is None for tick in ticks[:2]] == [True, True]  # once or twice could be damage
    assert ticks[2].event == "restart"
    assert ticks[2].amount_s < 0.0
    assert ticks[2].time_s is not None
    assert ticks[2].time_s - newest == pytest.approx(5.2, abs=0.05)  # as long as it took by the host's clock
    assert not any(tick.event for tick in ticks[3:])
    assert clock.boot_us(clock.newest_s) == pytest.approx(3_900_000, abs=2)


def test_one_wild_stamp_is_damage() -> None:
    clock = SenderClock()
    run(clock, steady(100.0, 5.0, HOST_S))
    newest = clock.newest_s
    for wild in (3_000_000.0, 7.0, 104.0 + 3600.0):
        assert clock.tick(wild, HOST_S + 5.0).time_s is None
    assert clock.newest_s == newest
    assert clock.tick(105.0, HOST_S + 5.0) == Tick(105.0)


@pytest.mark.parametrize("step_s", [3600.0, -3600.0, -30.0, 30.0])
def test_the_host_is_set_and_the_sender_bridges_it(step_s: float) -> None:
    clock = SenderClock()
    run(clock, steady(100.0, 10.0, HOST_S))
    ticks = run(clock, steady(110.0, 10.0, HOST_S + 10.0 + step_s))
    assert [tick.time_s for tick in ticks] == pytest.approx([110.0 + 0.1 * i for i in range(100)])
    events = [tick for tick in ticks if tick.event]
    assert [tick.event for tick in events] == ["host step"]
    assert events[0].amount_s == pytest.approx(step_s, abs=0.1)
    assert clock.host_us(119.9) * 1e-6 == pytest.approx(HOST_S + 19.9 + step_s, abs=5e-3)


def test_a_link_that_held_back_an_hour_is_no_step_and_its_readings_are_old() -> None:
    clock = SenderClock()
    run(clock, steady(100.0, 10.0, HOST_S))
    late = [(110.0 + 0.1 * i, HOST_S + 3610.0 + 0.001 * i) for i in range(36000)]  # an hour of messages within 36 s
    ticks = run(clock, late)
    assert not any(tick.event for tick in ticks)
    assert clock.host_us(110.0) * 1e-6 == pytest.approx(HOST_S + 10.0, abs=1.0)


def test_late_messages_keep_their_time() -> None:
    clock = SenderClock()
    run(clock, steady(100.0, 5.0, HOST_S))
    newest = clock.newest_s
    assert clock.tick(newest - 2.0, HOST_S + 5.0) == Tick(newest - 2.0)
    assert clock.newest_s == newest


def test_messages_without_a_clock_are_timed_by_when_they_came() -> None:
    clock = SenderClock()
    run(clock, steady(100.0, 5.0, HOST_S))
    assert clock.time_of(HOST_S + 5.5) == pytest.approx(105.5, abs=1e-3)
    assert clock.time_of(HOST_S + 5000.0) <= clock.newest_s + 10.0
    assert clock.time_of(HOST_S - 5000.0) >= clock.newest_s - 5.0


@given(st.lists(st.tuples(st.floats(0.0, PERIOD_MS_S), st.floats(0.0, 4e9)), min_size=1, max_size=60))
def test_whatever_comes_time_is_finite_and_only_moves_on(times: list[tuple[float, float]]) -> None:
    clock, newest = SenderClock(), -math.inf
    for sender, host in times:
        tick = clock.tick(sender, host)
        assert tick.time_s is None or math.isfinite(tick.time_s)
        assert clock.newest_s >= newest
        assert math.isfinite(clock.offset_s)
        assert math.isfinite(clock.time_of(host))
        newest = clock.newest_s
