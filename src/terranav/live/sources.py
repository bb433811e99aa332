"""Which of several sources of one quantity is heard, and whether a sensor hangs."""

from __future__ import annotations

import math
from dataclasses import dataclass

FEWEST = 10  # equal readings before a sensor is said to hang


@dataclass(slots=True)
class Choice:
    """Hears one source at a time: the first of the best rank, until it is silent.

    Attributes
    ----------
    silent_s : float
        After so long another is heard [s].
    """

    silent_s: float
    name: str = ""
    rank: int = 0
    last_s: float = -math.inf

    def hears(self, name: str, time_s: float, rank: int = 0) -> bool:
        """Whether a source is the one to hear now; a smaller rank is better."""
        if name != self.name and time_s - self.last_s <= self.silent_s and rank >= self.rank:
            return False
        if name != self.name or time_s > self.last_s:
            self.last_s = time_s
        self.name, self.rank = name, rank
        return True


@dataclass(slots=True)
class Hang:
    """Tells a sensor that repeats itself while something else shows that its reading must change.

    Attributes
    ----------
    after_s : float
        How long it repeats itself [s].
    change : float
        By how much the other quantity (a distance, a height, an angle) changes meanwhile.
    """

    after_s: float
    change: float
    value: tuple[float, ...] = ()
    since_s: float = 0.0
    count: int = 0
    gauge: float = math.nan
    moved: float = 0.0

    def hangs(self, value: tuple[float, ...], time_s: float, gauge: float) -> bool:
        """Hear a reading and the other quantity; whether the sensor hangs."""
        if value != self.value:
            self.value, self.since_s, self.count, self.gauge, self.moved = value, time_s, 1, gauge, 0.0
            return False
        self.count += 1
        if math.isfinite(gauge):
            if not math.isfinite(self.gauge):
                self.gauge = gauge
            self.moved = max(self.moved, abs(gauge - self.gauge))
        return self.count >= FEWEST and time_s - self.since_s >= self.after_s and self.moved > self.change


def turned(before_deg: float, heading_deg: float) -> float:
    """A heading carried on from one before without the leap at north [deg]."""
    if not math.isfinite(before_deg):
        return heading_deg
    return before_deg + (heading_deg - before_deg + 180.0) % 360.0 - 180.0
