"""The barometer, set to the indicated altitude over its first seconds and left alone afterwards.

What a log's reader does with a whole flight (`terranav.io.logs.assembly`) is done here as the readings come. Each
source of pressure has an offset of its own.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from statistics import median
from typing import NamedTuple

from terranav.io.logs.assembly import SETTING_S
from terranav.live.sources import Hang

KEPT_S = 2.0
CLIMBED_M = 3.0  # what a barometer that does not hang must notice
_NEAR_S = 0.5  # a reading belongs to an epoch so near


class _Reading(NamedTuple):
    time_s: float
    altitude_m: float
    indicated_m: float


@dataclass(slots=True)
class Barometer:
    """Hears pressure altitudes, gives altitudes.

    Attributes
    ----------
    hang : Hang
    offset_m : dict
        By source; what is added to it, once it is set [m].
    """

    hang: Hang
    offset_m: dict[str, float] = field(default_factory=dict)
    _setting: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    _latest: deque[_Reading] = field(default_factory=deque)

    def hear(self, time_s: float, source: str, altitude_m: float, indicated_m: float) -> str:
        """Hear a reading beside the altitude indicated at its time: 'setting', 'hangs' or 'heard'."""
        offset = self.offset_m.get(source)
        if offset is None:
            seen = self._setting.setdefault(source, [])
            seen.append((time_s, indicated_m - altitude_m))
            if len(seen) > 1 and time_s - seen[0][0] >= SETTING_S:
                self.offset_m[source] = median(value for _, value in seen)
                del self._setting[source]
            return "setting"
        if self.hang.hangs((altitude_m,), time_s, indicated_m):
            return "hangs"
        if not self._latest or time_s > self._latest[-1].time_s:
            self._latest.append(_Reading(time_s, altitude_m + offset, indicated_m))
            while time_s - self._latest[0].time_s > KEPT_S:
                self._latest.popleft()
        return "heard"

    def at(self, time_s: float, indicated_m: float) -> float | None:
        """The altitude at a time: the nearest reading, carried on by the change of the indicated one; None for none."""
        near = min(self._latest, key=lambda one: abs(one.time_s - time_s), default=None)
        if near is None or abs(near.time_s - time_s) > _NEAR_S:
            return None
        return near.altitude_m + indicated_m - near.indicated_m

    def forget(self) -> None:
        """Forget the latest readings, but not how it is set."""
        self._latest.clear()
