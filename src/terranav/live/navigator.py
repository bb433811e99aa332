"""The navigator of the live engine: the loop of `experiment.stream` an epoch at a time, its state plain data."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import median
from typing import Any

import numpy as np
from numpy.random import Generator

from terranav.core.earth import offset_of, shifted
from terranav.core.errors import ConfigError, DataError
from terranav.core.records import Epoch, Estimate, Measurement, Prior, Status
from terranav.experiment.datums import DatumGuard, allows_offset
from terranav.experiment.registry import make_estimator
from terranav.experiment.run import needs_maps, rng_of
from terranav.experiment.stream import states
from terranav.live.settings import LiveSettings
from terranav.live.track import Break, Track
from terranav.maps.datum import Shift, agreed_datum, between, stated_datum
from terranav.maps.map import Map
from terranav.sensors.ready import ReadyState, made_ready

_MEASURED = ("terrain", "bathymetry")  # the kinds of which live messages hold readings
_NEIGHBOURS, _FEWEST_NEIGHBOURS = 5, 3
_ODD_SIGMAS, _STEEPEST = 4.0, 1.0  # a reading is odd beyond; a slope of 45 degrees
_LONGEST_S = 30.0  # a vehicle that stands still is not thought to hear nothing
_GEOID_M = 200.0  # the geoid's height is looked up anew after so far; it slopes by less than 0.14 m per km


@dataclass(slots=True)
class Memory:
    """All that changes from epoch to epoch.

    Attributes
    ----------
    rng : Generator
    prior : Prior
        Of the next start.
    state : state of the estimator, None before the first epoch since a start
    ready : ReadyState
    epoch : Epoch or None
        The latest, made ready.
    estimate : Estimate or None
    began_s : float
        Time of the first epoch.
    starts : int
        How many times the estimator was started.
    geoid : (lat, lon, added), optional
        What is added to altitudes here.
    used : Epoch or None
        The latest whose readings were used.
    spared, odd : int
        Epochs whose readings were too near to those before; readings that lay apart from those around them.
    recent : tuple of (kind, lat, lon, value)
        The latest readings, used or not.
    """

    rng: Generator
    prior: Prior
    ready: ReadyState
    state: Any = None
    epoch: Epoch | None = None
    estimate: Estimate | None = None
    began_s: float = math.nan
    starts: int = 0
    geoid: tuple[float, float, float] | None = None
    used: Epoch | None = None
    spared: int = 0
    odd: int = 0
    recent: tuple[tuple[str, float, float, float], ...] = ()


class Navigator:
    """Steps an estimator; what it is made of does not change, what does is its `memory`.

    Raises
    ------
    ConfigError
        No map of a kind that live messages hold readings of, or settings that the estimator does not take.
    DataError
        Vertical datums that cannot be brought together.
    """

    def __init__(self, settings: LiveSettings, maps: Sequence[Map]) -> None:
        self.maps = tuple(maps)
        self.settings = settings
        kinds = {chart.kind for chart in self.maps}
        self.answering = tuple(chart for chart in self.maps if chart.kind in _MEASURED)
        if needs_maps(settings.estimator) and not kinds & set(_MEASURED):
            raise ConfigError(
                f"the maps are of kind {', '.join(sorted(kinds)) or 'none'}, expected terrain or bathymetry: "
                "live messages hold readings of no other"
            )
        self.grade = settings.grade
        self.spacing_m = settings.spacing_cells * min((chart.cell_m for chart in self.maps), default=0.0)
        self.estimator = make_estimator(settings.estimator, self.maps, self.grade, **settings.estimator_settings)
        self.shift, self.doubt = self._levelled()
        ready = ReadyState(alt_sigma_m=settings.sigma_of("baro_altitude_m"))
        self.memory = Memory(rng_of(settings.estimator, settings.seed), Prior.from_ins(self.grade), ready)

    def _levelled(self) -> tuple[Shift | None, str]:
        """What brings altitudes to the datum of the terrain map, and what that leaves out."""
        told = self.settings
        own = [chart for chart in self.maps if chart.kind == "terrain"]
        source = stated_datum(told.alt_datum, "alt_datum")
        target = agreed_datum((chart.name, chart.datum) for chart in own)
        if source is None or target is None:
            return None, ""
        guard = DatumGuard(told.geoid, allows_offset(told.estimator, told.estimator_settings))
        what = f"the vehicle's altitudes count from {source}, but the map {own[0].name} from {target}"
        try:
            found = between(source, target, guard.find)
        except DataError as problem:
            raise DataError(f"{what}: {problem}") from None
        if not found.bounded and not guard.allows_offset:
            raise DataError(f"{what}: {found.doubt}, and this estimator does not allow for it")
        return found if found.geoids else None, f"{what}: {found.doubt}" if found.doubt else ""

    def step(self, raw: Epoch) -> Estimate:
        """The estimate after one more epoch."""
        memory = self.memory
        memory.ready, epoch = made_ready(memory.ready, raw)
        if self.shift is not None:
            added = self._geoid_m(self.shift, epoch)
            epoch = replace(epoch, measurements=tuple(_raised(one, added) for one in epoch.measurements))
        epoch = self._spaced(self._even(epoch))
        if memory.state is None:
            memory.starts += 1
            memory.began_s = epoch.time_s if math.isnan(memory.began_s) else memory.began_s
        (memory.state,) = states(self.estimator, memory.prior, (epoch,), memory.rng, resume=memory.state)
        memory.epoch, memory.estimate = epoch, self.estimator.estimate(memory.state)
        return memory.estimate

    def _even(self, epoch: Epoch) -> Epoch:
        """The epoch without readings that the ground between them and their neighbours cannot explain.

        What counts is the median of the latest few readings, so that a step of the ground is believed after three. A
        sensor that reads seldom sees other ground each time, and nothing of it is odd.
        """
        memory, kept = self.memory, []
        for reading in epoch.measurements:
            near = [one for one in memory.recent if one[0] == reading.kind]
            memory.recent = (*memory.recent, (reading.kind, epoch.lat_deg, epoch.lon_deg, reading.value))[-_NEIGHBOURS:]
            if len(near) >= _FEWEST_NEIGHBOURS:
                away_m = max(math.hypot(*offset_of(lat, lon, epoch.lat_deg, epoch.lon_deg)) for _, lat, lon, _ in near)
                apart = abs(reading.value - median(value for _, _, _, value in near))
                if apart > _ODD_SIGMAS * reading.sigma + _STEEPEST * away_m:
                    memory.odd += 1
                    continue
            kept.append(reading)
        return epoch if len(kept) == len(epoch.measurements) else replace(epoch, measurements=tuple(kept))

    def _spaced(self, epoch: Epoch) -> Epoch:
        """The epoch without its readings where the vehicle has hardly moved since the last that were used."""
        memory, used = self.memory, self.memory.used
        if not epoch.measurements:
            return epoch
        if used is not None and epoch.time_s - used.time_s < _LONGEST_S:
            moved_m = math.hypot(*offset_of(used.lat_deg, used.lon_deg, epoch.lat_deg, epoch.lon_deg))
            if moved_m < self.spacing_m:
                memory.spared += 1
                return replace(epoch, measurements=())
        memory.used = epoch
        return epoch

    def _geoid_m(self, shift: Shift, epoch: Epoch) -> float:
        """What to add to altitudes here, looked up every few hundred metres [m]."""
        known = self.memory.geoid
        if known is None or math.hypot(*offset_of(*known[:2], epoch.lat_deg, epoch.lon_deg)) > _GEOID_M:
            added = float(shift.heights(epoch.lat_deg, epoch.lon_deg))
            known = self.memory.geoid = (epoch.lat_deg, epoch.lon_deg, added)
        return known[2]

    def restart(self, track: Track, broken: Break) -> None:
        """Start anew where the track broke: at the corrected position, as uncertain as the break makes it."""
        memory = self.memory
        estimate = memory.estimate
        spread = np.eye(2) * broken.spread_m**2 / 3.0  # anything within that, each as likely
        if estimate is None or memory.state is None:  # it has not started since the last break
            memory.prior = replace(memory.prior, cov_m2=memory.prior.cov_m2 + spread)
            return
        known = estimate.status in (Status.CONVERGED, Status.DEGRADED)
        cov = np.array(estimate.cov_m2)
        if known:
            last = track.nodes[-1]
            north, east = -estimate.ins_error_m
            track.moved(*shifted(last.lat_deg, last.lon_deg, float(north), float(east)))
        else:
            elapsed = track.newest_s - memory.began_s
            grown = self.grade.position_sigma_m**2 + self.grade.position_growth_m2(0.0, max(elapsed, 0.0))
            cov = np.eye(2) * max(grown, float(np.linalg.eigvalsh(cov)[-1]))
        memory.prior = Prior(np.zeros(2), cov + spread)
        memory.state = None
        memory.ready = replace(memory.ready, barometer=None)
        memory.used = None


def _raised(reading: Measurement, added_m: float) -> Measurement:
    """A terrain height above another datum; any other reading as it is."""
    return replace(reading, value=reading.value + added_m) if reading.kind == "terrain" else reading
