"""The vehicle's clock and the host's: one time that only moves on, whatever either of them does.

Readings are timed by the sender's clock. What the host's stamps are for is to say when on the host's clock a reading
was measured, and how long a silence lasted. With the least delay of a message taken for none, the host is ahead of the
sender by

    offset = min(host - sender), leaking upward by the most that two crystals drift apart.

The sender's clock may start again (a reboot; 32 bits of milliseconds run out after 49.7 days); the host's may be set.
Each shows while the other goes on as before:

- sender and host both moved on by about as much, or the sender by little: all is well, whatever the host says;
- the host's stamps then lie another way from the sender's, and stay so: the host's clock was set. A link that delivers
  late what it held back looks alike at first, but catches up; until it is known which, readings keep their old age;
- the sender's clock says something else altogether, thrice in a row: it started again. Once is damage.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

PERIOD_MS_S = 2.0**32 * 1e-3  # of time_boot_ms
DAY_S = 86400.0

LATE_S = 5.0  # what comes later than this behind the newest is no late message
STEP_S = 10.0  # the sender's clock moves on by so much in a silence that the host's stamps do not tell
_DRIFT = 1e-4  # two crystals, 50 ppm each
_AHEAD_S, _BEHIND_S = 1.0, 10.0  # the host is back or ahead by more: it was set
_SURE_S = 2.0  # and so for as long
_SURE = 3  # messages in a row
_UNKNOWN_PAUSE_S = 60.0  # taken for a restart of which no clock tells how long it took


@dataclass(frozen=True, slots=True)
class Tick:
    """What the clock makes of one message: the time it is of [s], None to drop it, and what happened."""

    time_s: float | None
    event: str = ""  # 'restart', 'jump', 'host step'
    amount_s: float = 0.0


@dataclass(slots=True)
class SenderClock:
    """Time of one sender [s], from its start as first heard; only `tick` changes it.

    Attributes
    ----------
    period_s : float
        After which the sender's clock starts again from 0.
    shift_s : float
        time = sender's clock, unwrapped, plus this.
    newest_s : float
        The latest time heard.
    offset_s : float
        Host's clock less time, of a message that came without delay.
    """

    period_s: float = PERIOD_MS_S
    shift_s: float = 0.0
    newest_s: float = -math.inf
    offset_s: float = math.nan
    _host_s: float = 0.0
    _strange: int = 0
    _strange_at: tuple[float, float] = (0.0, 0.0)
    _set_since: tuple[float, float] = (math.nan, math.nan)  # time, offset

    @property
    def running(self) -> bool:
        """Whether anything was heard."""
        return math.isfinite(self.newest_s)

    def tick(self, clock_s: float, host_s: float) -> Tick:
        """Hear a message: its sender's clock and the host's stamp [s]."""
        if not self.running:
            self.newest_s, self.offset_s, self._host_s = clock_s, host_s - clock_s, host_s
            return Tick(clock_s)
        time_s = self._unwrapped(clock_s)
        ahead, passed = time_s - self.newest_s, host_s - self._host_s
        if not -LATE_S <= ahead <= max(STEP_S, passed + STEP_S):
            return self._strangely(clock_s, time_s, host_s)
        self._strange = 0
        if ahead <= 0.0:  # late; its stamp still bounds the offset
            off = host_s - time_s - self.offset_s
            self.offset_s += off if -_AHEAD_S < off < 0.0 else 0.0
            return Tick(time_s)
        self.offset_s += _DRIFT * ahead
        self.newest_s, self._host_s = time_s, host_s
        moved = self._host_moved(time_s, host_s)
        return Tick(time_s, "host step", moved) if moved else Tick(time_s)

    def host_us(self, time_s: float) -> int:
        """Host's stamp of a time [us since 1970]."""
        return round((time_s + self.offset_s) * 1e6)

    def time_of(self, host_s: float) -> float:
        """The time of a message without a clock, by when it came in [s]; never ahead of what can have been measured."""
        moved_s, other_s = self._set_since
        offset = self.offset_s if math.isnan(moved_s) else other_s
        return min(max(host_s - offset, self.newest_s - LATE_S), self.newest_s + STEP_S)

    def boot_us(self, time_s: float) -> int:
        """The sender's own clock at a time [us]."""
        return round((time_s - self.shift_s) * 1e6)

    def _unwrapped(self, clock_s: float) -> float:
        """The time nearest to the newest that the sender's clock can mean."""
        ahead = clock_s + self.shift_s - self.newest_s
        turns = math.floor(ahead / self.period_s + 0.5)
        if turns == 0:
            return clock_s + self.shift_s
        time_s = clock_s + self.shift_s - turns * self.period_s
        # a clock that runs out comes back near to where it would have been; anything else is a start
        if abs(time_s - self.newest_s) > 0.01 * self.period_s:
            return clock_s + self.shift_s
        return time_s

    def _strangely(self, clock_s: float, time_s: float, host_s: float) -> Tick:
        """A message of another time: dropped, until several agree that the sender's clock started again."""
        before_clock, before_host = self._strange_at
        agrees = self._strange and -LATE_S <= clock_s - before_clock <= max(STEP_S, host_s - before_host + STEP_S)
        self._strange = self._strange + 1 if agrees else 1
        self._strange_at = clock_s, host_s
        if self._strange < _SURE:
            return Tick(None)
        ahead, passed = time_s - self.newest_s, host_s - self._host_s
        self._strange = 0
        if ahead > 0.0:
            event, pause = "jump", ahead if ahead < DAY_S else _UNKNOWN_PAUSE_S
        else:
            event, pause = "restart", passed if 0.0 < passed < DAY_S else _UNKNOWN_PAUSE_S
        self.newest_s += pause
        self.shift_s = self.newest_s - clock_s
        self.offset_s, self._host_s = host_s - self.newest_s, host_s
        self._set_since = (math.nan, math.nan)
        return Tick(self.newest_s, event, ahead)

    def _host_moved(self, time_s: float, host_s: float) -> float:
        """Follow the host's clock; by how much it was set, when that is sure, else 0 [s]."""
        now = host_s - time_s
        off = now - self.offset_s
        if -_AHEAD_S <= off <= _BEHIND_S:
            self.offset_s = min(self.offset_s, now)
            self._set_since = (math.nan, math.nan)
            return 0.0
        since, offset = self._set_since
        if off > 0.0:
            if math.isnan(since) or abs(now - offset) > 1.0:
                self._set_since = (time_s, now)
                return 0.0
            if time_s - since < _SURE_S:
                return 0.0
        self.offset_s = now
        self._set_since = (math.nan, math.nan)
        return off
