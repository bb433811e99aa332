"""Terrain ahead over a whole flight: the look-ahead of planning.cue at many of its epochs."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terranav.core.earth import offset_m
from terranav.core.errors import DataError
from terranav.core.recording import VELOCITY, Recording
from terranav.core.records import Estimate, Status
from terranav.experiment.result import Result
from terranav.maps.map import Map
from terranav.planning.cue import Cue, CueSettings
from terranav.planning.cue import cue as look_ahead

FloatArray = NDArray[np.float64]

MOST_CUES = 600  # of a timeline; a longer flight is looked at less often


@dataclass(frozen=True)
class Span:
    """Neighbouring epochs with the same state."""

    from_s: float
    to_s: float
    state: str
    nearest_s: float  # shortest time to the ground coming too near, NaN where none
    peak: float


class Flight:
    """A flown recording that can be looked ahead from at every epoch."""

    def __init__(self, rec: Recording, result: Result, chart: Map, settings: CueSettings) -> None:
        self._rec, self._result, self._chart, self._settings = rec, result, chart, settings
        self._velocity = _velocity(rec)

    def cue(self, row: int, *, evade: bool = True) -> Cue:
        """The cue at one epoch."""
        north, east, down = self._velocity[row].tolist()
        return look_ahead(self._estimate(row), (north, east, down), self._chart, self._settings, evade=evade)

    def rows(self, most: int = MOST_CUES) -> range:
        """Epochs at which a timeline looks ahead."""
        return range(0, len(self._rec), max(1, math.ceil(len(self._rec) / most)))

    def timeline(self) -> list[Span]:
        """What the look-ahead said over the whole flight."""
        spans: list[Span] = []
        for row in self.rows():
            time_s, found = float(self._rec.time_s[row]), self.cue(row, evade=False)
            here = Span(time_s, time_s, str(found.state), found.time_to_s, found.peak)
            if spans and spans[-1].state == here.state:
                before = spans.pop()
                nearest, peak = _least(before.nearest_s, here.nearest_s), -_least(-before.peak, -here.peak)
                here = Span(before.from_s, time_s, here.state, nearest, peak)
            spans.append(here)
        return spans

    def _estimate(self, row: int) -> Estimate:
        result = self._result
        return Estimate(
            float(result.time_s[row]),
            float(result.lat_deg[row]),
            float(result.lon_deg[row]),
            float(result.alt_m[row]),
            result.ins_error_m[row],
            result.cov_m2[row],
            Status(str(result.status[row])),
        )


def _least(one: float, other: float) -> float:
    """The smaller number, NaN only where both are."""
    return min((value for value in (one, other) if not math.isnan(value)), default=math.nan)


def _velocity(rec: Recording) -> FloatArray:
    """(n, 3) north, east, down: as indicated, where a reading is missing from the indicated positions [m/s]."""
    told = np.full((len(rec), 3), np.nan)
    for axis, key in enumerate(VELOCITY):
        if key in rec.columns:
            told[:, axis] = rec.columns[key]
    if np.isfinite(told).all():
        return told
    if len(rec) < 2:
        raise DataError(f"{rec.name}: one epoch without {', '.join(VELOCITY)}, expected a velocity or two epochs")
    north, east = offset_m(rec.lat_deg[0], rec.lon_deg[0], rec.lat_deg, rec.lon_deg)
    rates = np.gradient(np.stack([north, east, -rec.alt_m], axis=1), rec.time_s, axis=0)
    return np.where(np.isfinite(told), told, rates)
