"""The GNSS monitor: is the satellite position to be believed? It is compared with the map, and with the INS.

The INS is free of GNSS and never aligned by the GNSS under test; the map-aided estimate says what its error is. So does
GNSS: indicated minus GNSS. Three comparisons, each a squared distance in sigmas (chi-square of 2 when all is well):

map     the two errors against each other, wherever the estimate is usable. It is absolute: it sees a pull of any speed,
        and one that began before the monitor did. Its covariance is `map_factor`^2 times that of the
        estimate, plus that of GNSS.
INS     GNSS against predictions of the INS from several times ago (`terranav.integrity.gnss_bank`). It sees fast what
        begins now, on flat ground too; a pull as slow as the INS drifts is beyond it. Velocities likewise, if told.
since   where the map says nothing, GNSS against the latest usable fix (before one, the prior) carried on by the INS.

Errors of map, INS and GNSS stay alike from one epoch to the next, so a rate per epoch would mean nothing. The limit is
set for a rate of false alarms per hour: a chi-square of 2 exceeds x with probability exp(-x/2), and an hour holds as
many independent looks as were counted on simulated flights, LOOKS_PER_H; hence x = 2 ln(LOOKS_PER_H / rate). An alarm
is raised when a limit is passed for `hold_s` by two readings or more. The INS is allowed `ins_factor` times its grade.

'suspect' is half of a limit, or a limit passed for less than `hold_s`: the bank learns nothing from such readings, so a
slow pull is not taken for drift. 'unknown' is said where a GNSS that is farther off than `limit_m` could pass.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terranav.core.checks import finite
from terranav.core.earth import offset_of
from terranav.core.frozen import changed
from terranav.core.ins_grade import InsGrade
from terranav.core.records import Epoch, Estimate, Prior
from terranav.ins.error_state import POSITION, VELOCITY, ErrorModel
from terranav.integrity import gnss_bank
from terranav.integrity.gnss_bank import GROUNDED
from terranav.integrity.gnss_records import ALARMS, GnssReading, GnssState, GnssStatus, GnssVerdict
from terranav.integrity.words import bearing, lasting, metres

__all__ = ["ALARMS", "GnssMonitor", "GnssReading", "GnssState", "GnssStatus", "GnssVerdict"]

FloatArray = NDArray[np.float64]

LOOKS_PER_H = 360.0
SUSPECT = 0.5  # of a limit
GNSS_MEMORY_S = 60.0  # how long errors of GNSS stay alike
WALK_S = 1.0  # an INS velocity is its position walk's rate over so long
GAP_MEMORY = 0.1
GAPS = 3.0  # so many usual gaps without a position are an outage
FROZEN_READINGS, FROZEN_S, MOVING_MPS = 4, 3.0, 2.0
REJOIN = 10.0  # so many times `calm_s` of agreement with the map outweigh the INS
LATEST_S = 1.0  # a reading may be so far from its epoch in time


@dataclass(frozen=True, slots=True)
class Finding:
    """One comparison: its squared distance, and its name, how far off GNSS is and how far it may be, in words."""

    squared: float = 0.0
    text: str = ""


@dataclass(frozen=True)
class GnssMonitor:
    """Compares GNSS with the map-aided position and with the INS (see the head of the module).

    Attributes
    ----------
    ins : InsGrade
        What is known of the INS, which is free of GNSS.
    false_alarms_per_h : float
        Rate for which the limits are set, in (0, 1] [1/h].
    ins_factor : float
        How many times worse than told the INS may be, >= 1.
    map_factor : float
        How many times larger than told the errors of the map-aided estimate may be, >= 1.
    horizons_s : tuple of float
        Ages of the predictions, increasing; empty: the map alone is asked [s].
    hold_s : float
        How long a limit must be passed before it is an alarm, >= 0 [s].
    calm_s : float
        How long nothing must be suspect before an alarm ends, > 0 [s].
    outage_s : float
        So long without a position is called jammed, but never less than three usual gaps, > 0 [s].
    worst_sigma_m : float
        A position that is told to be worse is none, > 0 [m].
    limit_m : float
        'unknown' where GNSS could be farther off without an alarm, > 0 [m].
    timing_s : float
        1-sigma of the time between what GNSS and what the INS says, >= 0 [s].

    Raises
    ------
    ConfigError
        For a setting out of its range.
    """

    ins: InsGrade
    false_alarms_per_h: float = 1e-3
    ins_factor: float = 1.5
    map_factor: float = 1.2
    horizons_s: tuple[float, ...] = (10.0, 60.0, 300.0)
    hold_s: float = 2.0
    calm_s: float = 30.0
    outage_s: float = 5.0
    worst_sigma_m: float = 50.0
    limit_m: float = 300.0
    timing_s: float = 0.1

    def __post_init__(self) -> None:
        finite("gnss monitor false_alarms_per_h", self.false_alarms_per_h, above=0.0, maximum=1.0)
        for key in ("ins_factor", "map_factor"):
            finite(f"gnss monitor {key}", getattr(self, key), minimum=1.0)
        for key in ("calm_s", "outage_s", "worst_sigma_m", "limit_m"):
            finite(f"gnss monitor {key}", getattr(self, key), above=0.0)
        for key in ("hold_s", "timing_s"):
            finite(f"gnss monitor {key}", getattr(self, key), minimum=0.0)
        for before, after in zip((0.0, *self.horizons_s), self.horizons_s):
            finite("gnss monitor horizons_s", after, above=before)

    @property
    def limit(self) -> float:
        """Squared distance that is an alarm."""
        return 2.0 * math.log(LOOKS_PER_H / self.false_alarms_per_h)

    def init(self) -> GnssState:
        """State before the first epoch."""
        return GnssState()

    def verdict(self, state: GnssState) -> GnssVerdict:
        """What is said at the latest epoch."""
        return state.verdict

    def step(
        self, state: GnssState, time_s: float, gnss: GnssReading | None, epoch: Epoch, estimate: Estimate
    ) -> GnssState:
        """State after one more call.

        Parameters
        ----------
        state : GnssState
        time_s : float
            Now, on the clock of the epochs; a call that is not later than the one before changes nothing.
        gnss : GnssReading or None
            What came in since the last call, None for nothing.
        epoch : Epoch
            The latest of the INS.
        estimate : Estimate
            The map-aided one at that epoch.
        """
        if not time_s > state.time_s or not math.isfinite(time_s):
            return state
        state = self._passed(state, time_s, epoch)
        state = self._grounded(state, estimate)
        heard = gnss if gnss is not None and self._new(state, gnss, time_s) else None
        if heard is None:
            return self._silent(state, gnss)
        state = _heard(state, heard)
        assert state.bank is not None
        error_m, error_mps = _ins_error(epoch, state.velocity_mps, heard)
        variance = heard.sigma_m**2 + (self.timing_s * _speed(state)) ** 2
        of_map = self._by_map(estimate, error_m, variance)
        found = [of_map, self._by_ins(state, of_map, error_m, variance), self._by_velocity(state, heard, error_mps)]
        found.append(self._frozen(state))
        state = self._judged(state, found, of_map)
        state = self._learned(state, error_m, variance)
        return self._said(state, estimate, found, error_m, variance)

    def _passed(self, state: GnssState, time_s: float, epoch: Epoch) -> GnssState:
        """The bank at the time of an epoch."""
        if state.epoch is None or state.model is None or state.bank is None:
            model = ErrorModel(self.ins, (), ErrorModel.level_for(self.ins, epoch))
            prior = Prior.from_ins(self.ins)
            bank = gnss_bank.started(model, prior, len(self.horizons_s), epoch.time_s, self.ins_factor)
            velocity = None if epoch.velocity_mps is None else (epoch.velocity_mps[0], epoch.velocity_mps[1])
            state = changed(state, epoch=epoch, model=model, bank=bank, velocity_mps=velocity)
            return changed(state, first_s=time_s, time_s=time_s)
        if epoch.time_s <= state.epoch.time_s:
            return changed(state, time_s=time_s)
        bank = gnss_bank.passed(state.bank, state.model.transition(state.epoch, epoch), self.ins_factor)
        velocity = _velocity(state.epoch, epoch)
        return changed(state, epoch=epoch, bank=bank, time_s=time_s, velocity_mps=velocity)

    def _grounded(self, state: GnssState, estimate: Estimate) -> GnssState:
        """What the map says now, if it says something usable."""
        if not estimate.usable or state.bank is None:
            return state
        cov = self.map_factor**2 * estimate.cov_m2
        bank = gnss_bank.grounded(state.bank, estimate.ins_error_m, cov, estimate.time_s)
        return changed(state, bank=bank, grounded=True)

    def _new(self, state: GnssState, gnss: GnssReading, time_s: float) -> bool:
        """Whether a reading is a position, is new, and is of now."""
        numbers = (gnss.time_s, gnss.lat_deg, gnss.lon_deg, gnss.sigma_m)
        if not gnss.fix or not all(map(math.isfinite, numbers)) or not 0.0 < gnss.sigma_m <= self.worst_sigma_m:
            return False
        if abs(gnss.lat_deg) > 90.0 or abs(gnss.lon_deg) > 360.0 or abs(time_s - gnss.time_s) > LATEST_S:
            return False
        return state.reading is None or gnss.time_s > state.reading.time_s

    def _silent(self, state: GnssState, gnss: GnssReading | None) -> GnssState:
        """No position at this call: jammed if that lasts."""
        last_s = state.first_s if state.reading is None else state.reading.time_s
        usual = GAPS * state.gap_s if math.isfinite(state.gap_s) else 0.0
        away_s = state.time_s - last_s
        if away_s < max(self.outage_s, usual):
            return state
        why = f"no GNSS position for {lasting(away_s)}"
        if gnss is not None and gnss.fix and math.isfinite(gnss.sigma_m) and gnss.sigma_m > self.worst_sigma_m:
            why += f": its sigma is {metres(gnss.sigma_m)} (limit {metres(self.worst_sigma_m)})"
        elif gnss is not None and not gnss.fix:
            why += ": the receiver has no fix"
        before = state.verdict
        since_s = before.since_s if before.status is GnssStatus.JAMMED else state.time_s
        verdict = GnssVerdict(GnssStatus.JAMMED, since_s, reasons=(why,))
        return changed(state, verdict=verdict, over=0, over_s=math.nan, calm_s=math.nan, agreed_s=math.nan)

    def _by_map(self, estimate: Estimate, error_m: FloatArray, variance: float) -> Finding:
        """GNSS against the map-aided estimate."""
        if not estimate.usable:
            return Finding()
        away, cov = estimate.ins_error_m - error_m, self.map_factor**2 * estimate.cov_m2
        return Finding(float(gnss_bank.squared(away, cov, variance)), "map")

    def _by_ins(self, state: GnssState, of_map: Finding, error_m: FloatArray, variance: float) -> Finding:
        """GNSS against each prediction of the INS; the map's own is left to the map where that has just spoken."""
        assert state.bank is not None
        tests = gnss_bank.position_tests(state.bank, error_m, variance)
        tests[GROUNDED] *= not of_map.text
        worst = int(np.argmax(tests)) if self.horizons_s else GROUNDED
        squared = float(tests[worst])
        return Finding(squared, self._told(state, worst, error_m, variance) if self._odd(squared) else "")

    def _odd(self, squared: float) -> bool:
        """Whether a squared distance is suspect."""
        return squared >= SUSPECT * self.limit

    def _told(self, state: GnssState, row: int, error_m: FloatArray, variance: float) -> str:
        """How far GNSS went away from a prediction of the INS, and how far it may go."""
        assert state.bank is not None
        away, cov = error_m - state.bank.mean[row, POSITION], state.bank.cov[row, POSITION, POSITION]
        reach = gnss_bank.reach_m(away, cov, variance, self.limit)
        age = lasting(max(state.time_s - float(state.bank.since_s[row]), 0.0))
        moved = f"{metres(math.hypot(*away.tolist()))} (the INS allows {metres(reach)})"
        if row != GROUNDED:
            return f"GNSS went {moved} away from the INS within {age}"
        since = f"the latest fix of the map, {age} ago" if state.grounded else "the start of the INS"
        return f"GNSS is {moved} from where the INS is since {since}"

    def _by_velocity(self, state: GnssState, heard: GnssReading, error_mps: FloatArray | None) -> Finding:
        """The velocity of GNSS against that of the INS and what is known of its error."""
        assert state.bank is not None
        if error_mps is None or not self.horizons_s or not math.isfinite(heard.velocity_sigma_mps):
            return Finding()
        walk = self.ins_factor**2 * self.ins.position_walk_m_per_sqrt_s**2 / WALK_S
        tests = gnss_bank.velocity_tests(state.bank, error_mps, heard.velocity_sigma_mps**2 + walk)
        worst = int(np.argmax(tests))
        off = math.hypot(*(error_mps - state.bank.mean[worst, VELOCITY]).tolist())
        return Finding(float(tests[worst]), f"the velocity of GNSS is {off:.1f} m/s from that of the INS")

    def _frozen(self, state: GnssState) -> Finding:
        """The very same position again and again although the vehicle moves."""
        lasted = state.time_s - state.same_s
        if state.same < FROZEN_READINGS or lasted < FROZEN_S or _speed(state) < MOVING_MPS:
            return Finding()
        return Finding(
            2.0 * self.limit, f"GNSS repeats the same position for {lasting(lasted)} while the vehicle moves"
        )

    def _judged(self, state: GnssState, found: list[Finding], of_map: Finding) -> GnssState:
        """How long the findings have been beyond their limits, or calm."""
        highest, now = max(one.squared for one in found), state.time_s
        calm = not self._odd(highest)
        agreed = bool(of_map.text) and not self._odd(of_map.squared)
        over = highest >= self.limit
        return changed(
            state,
            over=state.over + 1 if over else 0,
            over_s=(state.over_s if state.over else now) if over else math.nan,
            calm_s=_from(state.calm_s, now, calm),
            agreed_s=_from(state.agreed_s, now, agreed),
        )

    def _learned(self, state: GnssState, error_m: FloatArray, variance: float) -> GnssState:
        """The bank after a reading above suspicion; anew where map and GNSS agree and the INS is what is odd."""
        assert state.bank is not None
        now, bank = state.time_s, state.bank
        if math.isfinite(state.calm_s) and state.verdict.status is not GnssStatus.SPOOFED:
            alike = 1.0 + 2.0 * GNSS_MEMORY_S / (now - state.followed_s)  # readings within that time err alike
            bank = gnss_bank.followed(bank, error_m, alike * variance, now)
            return changed(state, bank=gnss_bank.renewed(bank, self.horizons_s, now), followed_s=now)
        if now - state.agreed_s >= REJOIN * self.calm_s and state.same < FROZEN_READINGS:
            return changed(state, bank=gnss_bank.restarted(bank, error_m, variance, now), followed_s=now)
        return state

    def _said(
        self, state: GnssState, estimate: Estimate, found: list[Finding], error_m: FloatArray, variance: float
    ) -> GnssState:
        """The verdict after a reading."""
        assert state.bank is not None
        if estimate.usable:
            mean, cov = estimate.ins_error_m, self.map_factor**2 * estimate.cov_m2
        else:
            mean, cov = state.bank.mean[GROUNDED, POSITION], state.bank.cov[GROUNDED, POSITION, POSITION]
        away = mean - error_m  # GNSS from the position: errors are indicated minus true
        difference = math.hypot(*away.tolist())
        threshold = gnss_bank.reach_m(away, cov, variance, self.limit)
        farthest = gnss_bank.reach_m(np.zeros(2), cov, variance, self.limit)
        status = self._status(state, farthest)
        if status in (GnssStatus.SPOOFED, GnssStatus.SUSPECT):
            reasons = self._against(found, away, threshold, estimate)
            if not reasons:
                reasons = state.verdict.reasons
        else:
            reasons = (self._for(state, estimate, difference, threshold, farthest),)
        before = state.verdict
        since_s = before.since_s if before.status is status and math.isfinite(before.since_s) else state.time_s
        return changed(state, verdict=GnssVerdict(status, since_s, difference, threshold, reasons))

    def _status(self, state: GnssState, farthest_m: float) -> GnssStatus:
        """Of all that was found."""
        now = state.time_s
        if state.over >= 2 and now - state.over_s >= self.hold_s:
            return GnssStatus.SPOOFED
        if state.verdict.status is GnssStatus.SPOOFED and not now - state.calm_s >= self.calm_s:
            return GnssStatus.SPOOFED
        if not math.isfinite(state.calm_s):
            return GnssStatus.SUSPECT
        return GnssStatus.UNKNOWN if farthest_m > self.limit_m else GnssStatus.CONSISTENT

    def _against(
        self, found: list[Finding], away: FloatArray, threshold_m: float, estimate: Estimate
    ) -> tuple[str, ...]:
        """What speaks against GNSS, the worst first."""
        odd = sorted((one for one in found if self._odd(one.squared)), key=lambda one: -one.squared)
        length = math.hypot(*away.tolist())
        by_map = f"GNSS is {metres(length)} {bearing(away)} of the map-aided position (limit {metres(threshold_m)})"
        texts = [by_map if one.text == "map" else one.text for one in odd]
        return (*texts, *([] if estimate.usable else ["the map offers no fix here"]))

    def _for(
        self, state: GnssState, estimate: Estimate, difference_m: float, threshold_m: float, farthest_m: float
    ) -> str:
        """What GNSS agrees with, and how far off it could be."""
        if estimate.usable:
            return f"GNSS and map-aided position are {metres(difference_m)} apart (limit {metres(threshold_m)})"
        assert state.bank is not None
        age = lasting(max(state.time_s - float(state.bank.since_s[GROUNDED]), 0.0))
        since = f"the latest fix of the map, {age} ago" if state.grounded else "the start of the INS"
        why = f" ({estimate.reasons[0]})" if estimate.reasons else ""
        return f"the map offers no fix here{why}; by the INS since {since}, GNSS is within {metres(farthest_m)}"


def _from(before: float, now: float, holds: bool) -> float:
    """Time from which on something holds, NaN where it does not."""
    if not holds:
        return math.nan
    return before if math.isfinite(before) else now


def _velocity(before: Epoch, epoch: Epoch) -> tuple[float, float]:
    """North and east, as told, else from two positions of the INS [m/s]."""
    if epoch.velocity_mps is not None:
        return epoch.velocity_mps[0], epoch.velocity_mps[1]
    north, east = offset_of(before.lat_deg, before.lon_deg, epoch.lat_deg, epoch.lon_deg)
    dt = epoch.time_s - before.time_s
    return north / dt, east / dt


def _speed(state: GnssState) -> float:
    """Ground speed as the INS has it, 0 where it has none [m/s]."""
    return 0.0 if state.velocity_mps is None else math.hypot(*state.velocity_mps)


def _heard(state: GnssState, heard: GnssReading) -> GnssState:
    """The state with a reading: the usual gap, and whether the position repeats itself."""
    before, gap, same, same_s = state.reading, state.gap_s, 1, heard.time_s
    if before is not None:
        step = heard.time_s - before.time_s
        if not (math.isfinite(gap) and step > GAPS * gap):  # an outage is no usual gap
            gap = gap + GAP_MEMORY * (step - gap) if math.isfinite(gap) else step
        if (before.lat_deg, before.lon_deg) == (heard.lat_deg, heard.lon_deg):
            same, same_s = state.same + 1, state.same_s
    return changed(state, reading=heard, gap_s=gap, same=same, same_s=same_s)


def _ins_error(
    epoch: Epoch, velocity_mps: tuple[float, float] | None, heard: GnssReading
) -> tuple[FloatArray, FloatArray | None]:
    """Position error (2,) [m] and, where both tell a velocity, velocity error (2,) [m/s] of the INS as GNSS has it."""
    north, east = offset_of(heard.lat_deg, heard.lon_deg, epoch.lat_deg, epoch.lon_deg)
    if velocity_mps is None:
        return np.array((north, east)), None
    later, (vn, ve) = heard.time_s - epoch.time_s, velocity_mps
    error_m = np.array((north + vn * later, east + ve * later))
    if epoch.velocity_mps is None or heard.velocity_mps is None or not all(map(math.isfinite, heard.velocity_mps)):
        return error_m, None
    return error_m, np.array((vn - heard.velocity_mps[0], ve - heard.velocity_mps[1]))
