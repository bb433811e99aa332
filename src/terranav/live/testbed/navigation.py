"""The vehicle's own navigation: its INS, its GNSS receiver, its barometer, and the filter that joins them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from numpy.random import Generator

from terranav.core.earth import offset_of, shifted
from terranav.live.testbed.aircraft import AircraftState
from terranav.live.testbed.fusion import Fix, Fusion
from terranav.live.testbed.inertial import Indicated, Inertial
from terranav.live.testbed.senses import GNSS_EVERY, RATE_HZ, Gnss, GnssReading, pressure_errors
from terranav.live.testbed.settings import FlightSettings

_GNSS_FUSED_S, _GNSS_GOOD_M = 1.0, 15.0
_HEIGHT_S = 20.0  # over which the barometer's offset from GNSS is averaged
_DEAD_S = 5.0  # without anything: reckoning dead


@dataclass(frozen=True, slots=True)
class Known:
    """What the vehicle knows at a tick.

    Attributes
    ----------
    ins : Indicated
        What its INS says, which nothing corrects.
    own : Indicated
        What its filter makes of everything.
    alt_m : float
        Its height above mean sea level: the barometer, held to GNSS while there is any [m].
    pressure_alt_m : float
        What the barometer reads [m].
    gnss : GnssReading or None
    gnss_fresh : bool
        Whether the receiver spoke at this tick.
    """

    ins: Indicated
    own: Indicated
    alt_m: float
    pressure_alt_m: float
    gnss: GnssReading | None
    gnss_fresh: bool


class Navigation:
    """All of it.

    Parameters
    ----------
    settings : FlightSettings
    ticks : int
    ins, gnss, barometer : Generator
        Of their errors.
    """

    def __init__(
        self, settings: FlightSettings, ticks: int, *, ins: Generator, gnss: Generator, barometer: Generator
    ) -> None:
        self.inertial = Inertial(settings.grade, ins)
        self._receiver = Gnss(settings, ticks, gnss)
        self._pressure = pressure_errors(settings, ticks, barometer)
        self._fusion = Fusion(settings.grade)
        self._without: Fusion | None = None  # the same filter without fixes, from the first fix on
        self._offset_m = settings.barometer.bias_m
        self._gnss: GnssReading | None = None
        self._time_s = self._aided_s = 0.0
        self._gnss_used_s = -math.inf
        self.used = self.rejected = self.resets = 0

    @property
    def reckons_dead(self) -> bool:
        """Whether neither GNSS nor a fix was used for five seconds."""
        return self._time_s - self._aided_s > _DEAD_S

    def step(self, tick: int, truth: AircraftState) -> Known:
        """Go on to a tick of the true flight."""
        self._time_s = tick / RATE_HZ
        ins = self.inertial.follow(self._time_s, truth)
        for fusion in self._filters:
            fusion.predict(self._time_s, ins.lat_deg, ins.lon_deg, ins.velocity_mps)
        pressure_alt = truth.alt_m + float(self._pressure[tick])
        fresh = tick % GNSS_EVERY == 0
        if fresh:
            self._gnss = self._receiver.read(tick, truth)
            if self._gnss is not None:
                self._fuse_gnss(self._gnss, pressure_alt)
        own = self._corrected(self._fusion, ins)
        return Known(ins, own, pressure_alt - self._offset_m, pressure_alt, self._gnss, fresh)

    def fuse(self, fix: Fix) -> bool:
        """Give a fix from outside to the filter; False where it is not used."""
        if self._without is None:
            self._without = self._fusion.copy()
        before = self._fusion.rejected, self._fusion.resets
        taken = self._fusion.take(fix)
        self.rejected += self._fusion.rejected - before[0]
        self.resets += self._fusion.resets - before[1]
        self.used += taken
        if taken:
            self._aided_s = self._time_s
        return taken

    def errors_m(self, known: Known, truth: AircraftState) -> tuple[float, float]:
        """How far its own position is off, and how far it would be without the fixes [m]."""
        place = truth.lat_deg, truth.lon_deg
        own = math.hypot(*offset_of(*place, known.own.lat_deg, known.own.lon_deg))
        if self._without is None:
            return own, own
        other = self._corrected(self._without, known.ins)
        return own, math.hypot(*offset_of(*place, other.lat_deg, other.lon_deg))

    @property
    def _filters(self) -> list[Fusion]:
        return [self._fusion] if self._without is None else [self._fusion, self._without]

    def _fuse_gnss(self, gnss: GnssReading, pressure_alt_m: float) -> None:
        """GNSS into the filters once a second, its height into the barometer's offset."""
        if gnss.sigma_m > _GNSS_GOOD_M or self._time_s - self._gnss_used_s < _GNSS_FUSED_S:
            return
        first = self._gnss_used_s == -math.inf
        self._gnss_used_s = self._aided_s = self._time_s
        share = 1.0 if first else _GNSS_FUSED_S / _HEIGHT_S
        self._offset_m += share * (pressure_alt_m - gnss.alt_m - self._offset_m)
        sigma, v = gnss.sigma_m, gnss.velocity_mps
        fix = Fix(0.0, gnss.lat_deg, gnss.lon_deg, (sigma, sigma), (v[0], v[1]), gnss.velocity_sigma_mps)
        for fusion in self._filters:
            fusion.take(fix)

    @staticmethod
    def _corrected(fusion: Fusion, ins: Indicated) -> Indicated:
        """What the INS says, less what the filter says it is wrong by."""
        north, east, v_north, v_east = fusion.mean[:4].tolist()
        lat, lon = shifted(ins.lat_deg, ins.lon_deg, -north, -east)
        v, (roll, pitch, heading) = ins.velocity_mps, ins.attitude_deg
        heading = (heading + math.degrees(float(fusion.mean[6]))) % 360.0  # an indicated heading is true less psi
        return Indicated(lat, lon, (v[0] - v_north, v[1] - v_east, v[2]), (roll, pitch, heading))
