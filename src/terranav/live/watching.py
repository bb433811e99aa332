"""The GNSS monitor of a live run: each epoch of the engine, and what the receiver said, go to `integrity.gnss`.

The INS under it is the engine's own dead reckoning, which sees no GNSS of its own. By 'velocity' it is as free of GNSS
as the autopilot's velocity is: one that is fused with the GNSS under test follows a slow pull, and then the map alone
can see it. All of it is plain data that pickles into a checkpoint, a function of epochs and words alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from terranav.core.frozen import changed
from terranav.core.ins_grade import InsGrade
from terranav.core.judgement import largest_sigma_m
from terranav.core.records import Epoch, Estimate, Prior
from terranav.integrity.gnss import ALARMS, GnssMonitor, GnssReading, GnssState, GnssStatus, GnssVerdict
from terranav.live.book import Book
from terranav.live.heard import Gnss
from terranav.live.settings import LiveSettings

KEY = "gnss"
_FIX_3D = 3  # an autopilot takes no less
_LASTING_S = 3.0  # a status that is no alarm is remarked on once it has lasted
_SIGMA_M = 3.0  # of a receiver that tells none, per horizontal axis
_TOLD = {
    "velocity": (
        "warning",
        "GNSS is compared with the map and with the autopilot's velocity: where the autopilot fuses this GNSS its "
        "velocity follows a slow pull, which then the map alone can see; --by airspeed does not, nor --by position of "
        "a free inertial one",
    ),
    "position": ("info", "GNSS is compared with the map and with the vehicle's position, taken for free of GNSS"),
    "airspeed": ("info", "GNSS is compared with the map and with airspeed and heading"),
}


@dataclass(slots=True)
class Watching:
    """The monitor at work.

    Attributes
    ----------
    monitor : GnssMonitor
        Its INS is as uncertain as reckoning was at its latest start.
    state : GnssState
    began_s : float
        Time of the first epoch, from which times in the summary count; NaN before [s].
    alarms : int
        How many began.
    first_alarm : (status, time), optional
        The first of them [s].
    told : GnssStatus
        What the latest remark said.
    """

    monitor: GnssMonitor
    state: GnssState = field(default_factory=GnssState)
    began_s: float = math.nan
    alarms: int = 0
    first_alarm: tuple[str, float] | None = None
    told: GnssStatus = GnssStatus.UNKNOWN

    @classmethod
    def of(cls, grade: InsGrade) -> Watching:
        """Before the first epoch, with what is known of the reckoning."""
        return cls(GnssMonitor(grade))

    def introduce(self, settings: LiveSettings, book: Book) -> None:
        """Say what GNSS is compared with, and how far that is to be trusted."""
        level, text = _TOLD[settings.ins_source]
        if settings.ins is None:
            grade = settings.grade
            text += (
                f"; without --ins that is taken for good to {grade.velocity_sigma_mps:g} m/s and "
                f"{grade.position_walk_m_per_sqrt_s:g} m/sqrt(s), and a worse one raises false alarms"
            )
        book.say(level, "gnss monitor", text)

    def step(self, epoch: Epoch, estimate: Estimate, heard: tuple[float, Gnss] | None, book: Book) -> GnssVerdict:
        """What is said of GNSS at an epoch; a change is remarked on: an alarm at once, else once it lasts.

        Parameters
        ----------
        epoch : Epoch
            Of the engine's reckoning.
        estimate : Estimate
            The map-aided one of that epoch.
        heard : (time, Gnss) or None
            The receiver's latest word, however old [s].
        book : Book
        """
        if math.isnan(self.began_s):
            self.began_s = epoch.time_s
        if _sound(epoch, estimate):
            reading = None if heard is None else reading_of(*heard)
            try:
                self.state = self.monitor.step(self.state, epoch.time_s, reading, epoch, estimate)
            except (ArithmeticError, IndexError, ValueError, np.linalg.LinAlgError) as problem:
                why = f"{type(problem).__name__}: {' '.join(str(problem).split())}"
                book.begins("error", "gnss monitor fault", f"the GNSS monitor failed: {why}", lasting=False)
                self._anew(self.monitor)
        verdict = self.monitor.verdict(self.state)
        lasts = verdict.status in ALARMS or epoch.time_s - verdict.since_s >= _LASTING_S
        if verdict.status is not self.told and lasts:
            self._changed(verdict, epoch.time_s, book)
        return verdict

    def _changed(self, verdict: GnssVerdict, now_s: float, book: Book) -> None:
        """Remark on another status; an alarm stands until it is over."""
        before, self.told = self.told, verdict.status
        text = f"GNSS {verdict.status}: {'; '.join(verdict.reasons)}"
        if verdict.status in ALARMS:
            if before not in ALARMS:
                self.alarms += 1
                self.first_alarm = self.first_alarm or (str(verdict.status), now_s)
            book.standing.pop(KEY, None)  # one alarm gives way to the other
            book.begins("warning", KEY, text)
        elif before in ALARMS:
            book.ends(KEY, text)
        else:
            book.say("info", KEY, text)

    def restart(self, prior: Prior) -> None:
        """Reckoning starts anew from a prior: what the INS was known to be wrong by is void, an alarm is not."""
        ins = replace(self.monitor.ins, position_sigma_m=largest_sigma_m(prior.cov_m2))
        self._anew(replace(self.monitor, ins=ins))

    def _anew(self, monitor: GnssMonitor) -> None:
        """Forget the INS, keep the receiver and the verdict: it holds until the next reading, an alarm until calm."""
        old = self.state
        kept = {"reading": old.reading, "gap_s": old.gap_s, "same": old.same, "same_s": old.same_s}
        self.monitor, self.state = monitor, changed(monitor.init(), verdict=old.verdict, **kept)

    def facts(self) -> dict[str, Any]:
        """The latest verdict, and how many alarms there were; times count from the first epoch [s], [m]; plain JSON."""
        verdict, first = self.state.verdict, self.first_alarm
        return {
            "status": str(verdict.status),
            "since_s": _told(verdict.since_s - self.began_s),
            "difference_m": _told(verdict.difference_m),
            "threshold_m": _told(verdict.threshold_m),
            "reasons": list(verdict.reasons),
            "alarms": self.alarms,
            "first_alarm": None if first is None else {"status": first[0], "at_s": first[1] - self.began_s},
        }


def reading_of(time_s: float, word: Gnss) -> GnssReading:
    """A receiver's word as the monitor takes it.

    Positions alone: the course in GPS_RAW_INT means nothing at low speed, and the figures of the monitor were measured
    without velocities.
    """
    sigma = _SIGMA_M if word.sigma_m is None else word.sigma_m
    return GnssReading(time_s, word.lat_deg, word.lon_deg, sigma, fix=word.fix >= _FIX_3D)


def _sound(epoch: Epoch, estimate: Estimate) -> bool:
    """Whether all that the monitor reckons with is finite; it would not forget a NaN."""
    numbers = (epoch.time_s, epoch.lat_deg, epoch.lon_deg, *(epoch.velocity_mps or ()))
    said = not estimate.usable or bool(np.isfinite(estimate.ins_error_m).all() and np.isfinite(estimate.cov_m2).all())
    return said and all(map(math.isfinite, numbers))


def _told(value: float) -> float | None:
    """A figure, None where there is none."""
    return value if math.isfinite(value) else None
