"""The one gate that every output goes through: what may leave, how old it may be, how sure it claims to be.

`offer` makes an Offer of a fix, or says why it is held; encoders take Offers only. Its numbers are finite and in the
ranges of the messages, its sigma is above nought, and it is no older than its limit.

Fixes that follow one another err alike: the error of a position from a map changes over many seconds. A filter that
takes each for new evidence becomes surer than it may. With errors whose correlation falls off as exp(-t / tau), fixes
every T seconds tell as much as independent ones with (1 + r) / (1 - r) times the variance, r = exp(-T / tau): the
effective number of observations of a first-order process. `Pace` limits the rate and gives that factor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from terranav.core.earth import shifted
from terranav.live.records import Fix

#: an encoder's floats have 32 bits: below and above these a sigma would become nought or infinite [m]
LEAST_SIGMA_M, MOST_SIGMA_M = 1.0, 1e5
#: a measurement may seem so much younger than now, by the error of the clocks [s]
AHEAD_S = 0.1
_MOST_ALT_M, _MOST_SPEED_MPS = 1e5, 1e4
_MOST_US = 1 << 62


@dataclass(frozen=True, slots=True)
class Offer:
    """A fix that may leave.

    Attributes
    ----------
    stamp_us, boot_us : int, int or None
        Time of the measurement on the host's and the vehicle's clock [us].
    age_us : int
        From the measurement to now [us], >= 0.
    lat_deg, lon_deg, alt_m : float
    sigma_m : (north, east)
        1-sigma, between LEAST_SIGMA_M and MOST_SIGMA_M [m].
    velocity_mps, attitude_deg : as of Fix
    status : str
    protection_m : float or None
        Finite, or None where no integrity monitor watches.
    """

    stamp_us: int
    boot_us: int | None
    age_us: int
    lat_deg: float
    lon_deg: float
    alt_m: float
    sigma_m: tuple[float, float]
    velocity_mps: tuple[float, float, float] | None
    attitude_deg: tuple[float, float, float] | None
    status: str
    protection_m: float | None

    @property
    def horizontal_m(self) -> float:
        """The larger of the two sigmas [m]: what a message with one accuracy claims."""
        return max(self.sigma_m)

    def widened(self, variance_factor: float) -> Offer:
        """The same with a larger claimed variance; the factor is at least 1."""
        scale = math.sqrt(max(variance_factor, 1.0))
        north, east = (min(sigma * scale, MOST_SIGMA_M) for sigma in self.sigma_m)
        return replace(self, sigma_m=(north, east))

    def carried(self, by_us: int, max_age_s: float) -> Offer | None:
        """The same moved on by its velocity, as if measured so much later and sent with the same delay.

        None where no velocity is known, or where the measurement is too old by then. The sigma grows by 1 m/s: what a
        slow navigator's velocity is good for.
        """
        later_s = by_us * 1e-6
        if self.velocity_mps is None or later_s < 0.0 or self.age_us * 1e-6 + later_s > max_age_s:
            return None
        north, east, down = (speed * later_s for speed in self.velocity_mps)
        lat, lon = shifted(self.lat_deg, self.lon_deg, north, east)
        sigmas = (math.hypot(self.sigma_m[0], later_s), math.hypot(self.sigma_m[1], later_s))
        boot_us = None if self.boot_us is None else self.boot_us + by_us
        moved = replace(self, stamp_us=self.stamp_us + by_us, boot_us=boot_us, lat_deg=lat, lon_deg=lon, sigma_m=sigmas)
        moved = replace(moved, alt_m=self.alt_m - down)
        return moved if not _impossible(moved) else None


def offer(fix: Fix, now_us: int, max_age_s: float) -> Offer | str:
    """What of a fix may leave now, or why it is held.

    Parameters
    ----------
    fix : Fix
    now_us : int
        The host's time [us since 1970].
    max_age_s : float
        The oldest measurement that may leave [s].

    Returns
    -------
    Offer, or a short reason as a str
    """
    if not (fix.usable and fix.estimate.usable):
        return "not usable"
    age_s = (now_us - fix.stamp_us) * 1e-6
    if not age_s <= max_age_s:
        return "too old"
    if age_s < -AHEAD_S:
        return "measured after now"
    protection = float(fix.estimate.protection_m)
    made = Offer(
        fix.stamp_us,
        fix.boot_us,
        max(0, now_us - fix.stamp_us),
        fix.lat_deg,
        fix.lon_deg,
        fix.alt_m,
        fix.sigma_m,
        fix.velocity_mps,
        fix.attitude_deg,
        str(fix.estimate.status),
        protection if math.isfinite(protection) else None,
    )
    impossible = _impossible(made)
    if impossible:
        return impossible
    north, east = (max(sigma, LEAST_SIGMA_M) for sigma in made.sigma_m)
    return replace(made, sigma_m=(north, east))


def _impossible(made: Offer) -> str:
    """What is wrong with the numbers; empty when nothing is."""
    numbers = [made.lat_deg, made.lon_deg, made.alt_m, *made.sigma_m, *(made.velocity_mps or ())]
    if not all(math.isfinite(number) for number in [*numbers, *(made.attitude_deg or ())]):
        return "not finite"
    if abs(made.lat_deg) > 90.0 or abs(made.lon_deg) > 180.0 or abs(made.alt_m) > _MOST_ALT_M:
        return "no position on earth"
    if not all(0.0 < sigma <= MOST_SIGMA_M for sigma in made.sigma_m):
        return "no accuracy"
    if any(abs(speed) > _MOST_SPEED_MPS for speed in made.velocity_mps or ()):
        return "impossible velocity"
    if any(abs(angle) > 720.0 for angle in made.attitude_deg or ()):
        return "impossible attitude"
    if not 0 <= made.stamp_us < _MOST_US or (made.boot_us is not None and not 0 <= made.boot_us < _MOST_US):
        return "impossible time"
    return ""


@dataclass
class Pace:
    """How often one output sends, and how much wider each fix must claim to be for that.

    Parameters
    ----------
    rate_hz : float
        At most so many a second, by the times of the measurements.
    correlation_s : float
        Over this time the error of the fixes changes (tau above) [s]; 0 takes each for new evidence.
    """

    rate_hz: float
    correlation_s: float
    last_us: int = -(1 << 62)
    next_us: float = -math.inf

    def due(self, stamp_us: int) -> bool:
        """Whether a fix of this time may be sent; also one that is a little early, and any after the time was set."""
        return stamp_us >= self.next_us - 0.05e6 / self.rate_hz or stamp_us < self.last_us - 5_000_000

    def taken(self, stamp_us: int) -> float:
        """Note that a fix of this time is sent, and return the factor for its variance."""
        apart_s, period_us = (stamp_us - self.last_us) * 1e-6, 1e6 / self.rate_hz
        self.last_us = stamp_us
        # in step with the ones before, so that early ones do not add up
        in_step = abs(stamp_us - self.next_us) < period_us
        self.next_us = (self.next_us if in_step else stamp_us) + period_us
        if self.correlation_s <= 0.0 or not 0.0 < apart_s < 20.0 * self.correlation_s:
            return 1.0
        return 1.0 / math.tanh(0.5 * apart_s / self.correlation_s)
