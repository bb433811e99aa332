"""The GNSS monitor over a recording: the columns true_lat_deg and true_lon_deg are the GNSS under test."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terranav.core.checks import finite
from terranav.core.earth import shift
from terranav.core.errors import DataError
from terranav.core.recording import Recording
from terranav.core.records import Epoch, Estimate, Status
from terranav.experiment.result import Result
from terranav.integrity.gnss import ALARMS, GnssMonitor, GnssReading, GnssState, GnssStatus

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Alarm:
    """One alarm: what was said, from when to when (NaN: to the end), and why [s], [m]."""

    status: GnssStatus
    from_s: float
    to_s: float
    difference_m: float
    reasons: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Watch:
    """What the monitor said of a recording.

    Attributes
    ----------
    name : str
        Of the recording.
    time_s : (n,) [s]
    status : (n,) array of str
        Values of `GnssStatus`.
    difference_m : (n,) [m]
        GNSS from the reference: the map-aided position, where that is usable.
    threshold_m : (n,) [m]
        From there on it is an alarm.
    alarms : tuple of Alarm
    reasons : tuple of str
        At the end.
    """

    name: str
    time_s: FloatArray
    status: NDArray[np.str_]
    difference_m: FloatArray
    threshold_m: FloatArray
    alarms: tuple[Alarm, ...]
    reasons: tuple[str, ...]

    def share(self, status: GnssStatus) -> float:
        """Share of the epochs with a status."""
        return float(np.mean(self.status == status.value))


def monitor_recording(rec: Recording, result: Result, monitor: GnssMonitor, *, sigma_m: float = 3.0) -> Watch:
    """Watch the GNSS of a recording.

    Parameters
    ----------
    rec : Recording
        Its indicated positions are those of an INS free of GNSS; its true ones are what GNSS said, NaN where nothing.
    result : Result
        The map-aided estimates of the same epochs.
    monitor : GnssMonitor
    sigma_m : float
        1-sigma of GNSS per horizontal axis, > 0 [m].

    Raises
    ------
    DataError
        A recording without GNSS, or a result of other epochs.
    """
    finite("gnss sigma_m", sigma_m, above=0.0)
    if not rec.has_truth:
        raise DataError(f"{rec.name}: has no GNSS to monitor, expected the columns true_lat_deg and true_lon_deg")
    if not np.array_equal(rec.time_s, result.time_s):
        raise DataError(
            f"{rec.name}: the result has {len(result)} epochs of other times, expected those of the recording"
        )
    readings = readings_of(rec.time_s, rec.columns["true_lat_deg"], rec.columns["true_lon_deg"], sigma_m)
    states = list(watched(monitor, monitor.init(), list(rec.epochs()), estimates_of(result), readings))
    verdicts = [monitor.verdict(state) for state in states]
    return Watch(
        name=rec.name,
        time_s=rec.time_s,
        status=np.array([one.status.value for one in verdicts]),
        difference_m=np.array([one.difference_m for one in verdicts]),
        threshold_m=np.array([one.threshold_m for one in verdicts]),
        alarms=alarms_of(rec.time_s, states),
        reasons=verdicts[-1].reasons,
    )


def pulled(rec: Recording, speed_mps: float, from_s: float, towards_deg: float) -> Recording:
    """A recording whose GNSS is false: from a time on it is pulled away.

    Parameters
    ----------
    rec : Recording
        With a truth, which is taken for what an honest GNSS says.
    speed_mps : float
        >= 0 [m/s].
    from_s : float
        On the recording's clock [s].
    towards_deg : float
        Clockwise from north [deg].
    """
    lat, lon = rec.columns["true_lat_deg"], rec.columns["true_lon_deg"]
    away, towards = speed_mps * np.maximum(rec.time_s - from_s, 0.0), math.radians(towards_deg)
    lat, lon = shift(lat, lon, away * math.cos(towards), away * math.sin(towards))
    return rec.with_columns(true_lat_deg=lat, true_lon_deg=lon)


def watched(
    monitor: GnssMonitor,
    state: GnssState,
    epochs: Sequence[Epoch],
    estimates: Sequence[Estimate],
    readings: Sequence[GnssReading | None],
) -> Iterator[GnssState]:
    """The monitor's state after each epoch."""
    for epoch, estimate, reading in zip(epochs, estimates, readings, strict=True):
        state = monitor.step(state, epoch.time_s, reading, epoch, estimate)
        yield state


def alarms_of(time_s: FloatArray, states: Sequence[GnssState]) -> tuple[Alarm, ...]:
    """The alarms of a run of states, with the reasons and the difference when each began."""
    found: list[Alarm] = []
    before = GnssStatus.UNKNOWN
    for now, state in zip(time_s.tolist(), states, strict=True):
        verdict = state.verdict
        if verdict.status is not before:
            if before in ALARMS:
                last = found.pop()
                found.append(Alarm(last.status, last.from_s, now, last.difference_m, last.reasons))
            if verdict.status in ALARMS:
                found.append(Alarm(verdict.status, now, math.nan, verdict.difference_m, verdict.reasons))
        before = verdict.status
    return tuple(found)


def readings_of(
    time_s: FloatArray, lat_deg: FloatArray, lon_deg: FloatArray, sigma_m: float
) -> list[GnssReading | None]:
    """A reading at each time, none where the position is NaN."""
    known = np.isfinite(lat_deg) & np.isfinite(lon_deg)
    rows = zip(time_s.tolist(), lat_deg.tolist(), lon_deg.tolist(), known.tolist(), strict=True)
    return [GnssReading(t, lat, lon, sigma_m) if there else None for t, lat, lon, there in rows]


def estimates_of(result: Result) -> list[Estimate]:
    """The estimates that a result was made of."""
    rows = zip(result.time_s.tolist(), result.lat_deg.tolist(), result.lon_deg.tolist(), result.alt_m.tolist())
    return [
        Estimate(
            *row,
            result.ins_error_m[i],
            result.cov_m2[i],
            Status(str(result.status[i])),
            float(result.nis[i]),
            float(result.protection_m[i]),
            bool(result.usable[i]),
            result.reasons[i],
        )
        for i, row in enumerate(rows)
    ]
