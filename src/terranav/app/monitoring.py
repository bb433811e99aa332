"""What `terranav monitor` reads and says: the recording, the verdict in one line, the alarms."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from terranav.app.console import complain, show, show_pairs
from terranav.app.given import ins_from
from terranav.app.words import NOTHING, distance, duration, moment, percent
from terranav.core.checks import finite
from terranav.core.errors import ConfigError, DataError
from terranav.core.ins_grade import InsGrade
from terranav.core.recording import Recording
from terranav.experiment.gnss import Alarm, Watch
from terranav.experiment.result import Result
from terranav.integrity.gnss import GnssMonitor, GnssStatus

MOUNT_M = 1.0  # of the barometer of a vehicle on the ground
_MAP_SAID = (GnssStatus.CONSISTENT, GnssStatus.SUSPECT, GnssStatus.UNKNOWN)


@dataclass(frozen=True)
class Monitored:
    """A recording that was watched.

    Attributes
    ----------
    watch : Watch
    result : Result
        The map-aided estimates.
    monitor : GnssMonitor
    told : str
        How the INS was had.
    pull_mps : float
        At which speed GNSS was pulled away to see what happens, 0 for not [m/s].
    pull_from_s : float
        From when on [s].
    """

    watch: Watch
    result: Result
    monitor: GnssMonitor
    told: str
    pull_mps: float = 0.0
    pull_from_s: float = math.nan

    @property
    def start_s(self) -> float:
        """Of the recording [s]."""
        return float(self.watch.time_s[0])

    @property
    def flagged(self) -> Alarm | None:
        """The first alarm that the pull caused."""
        if not self.pull_mps:
            return None
        return next((one for one in self.watch.alarms if one.from_s >= self.pull_from_s), None)


@dataclass(frozen=True)
class Typed:
    """What was typed of the INS and of how long: texts as for `ins_from`; `on_ground`: a barometer on wheels."""

    ins: str = ""
    drift: str = ""
    drift_seed: int = 0
    by: str = "auto"
    on_ground: bool = False
    first_s: float | None = None


@dataclass(frozen=True)
class Watchable:
    """An INS free of GNSS, GNSS beside it as the truth, and how the INS was had, in words."""

    rec: Recording
    ins: InsGrade | None
    told: str


def read(log: Path | None, recording: Path | None, typed: Typed, finest_m: float) -> Watchable:
    """A recording as it is, or a log whose INS is dead reckoning from its first fix on.

    Parameters
    ----------
    log, recording : Path or None
        One of them.
    typed : Typed
    finest_m : float
        Cell of the finest map: readings of a log are thinned to half of it [m].
    """
    told = ins_from("--ins", typed.ins) if typed.ins else None
    drift = ins_from("--drift", typed.drift) if typed.drift else None
    if log is not None:
        return _dead_reckoned(log, typed, (told, drift), finest_m)
    from terranav.io.recordings import read_recording

    assert recording is not None
    if typed.by != "auto" or typed.on_ground:
        what = "--ground-vehicle" if typed.on_ground else f"--by {typed.by}"
        raise ConfigError(f"{what} is given for a recording, expected a log: a recording has an INS, or --drift")
    rec = _shortened(_with_gnss(read_recording(recording)), typed.first_s)
    if drift is None:
        return Watchable(rec, told, "the indicated position of the recording")
    from terranav.ins.drift import add_drift

    return Watchable(add_drift(rec, drift, typed.drift_seed), told, "the GNSS track with the drift of an INS added")


def _dead_reckoned(
    path: Path, typed: Typed, grades: tuple[InsGrade | None, InsGrade | None], finest_m: float
) -> Watchable:
    """A log, navigated without GNSS as `terranav replay` does; one line where GNSS helped all the same."""
    from terranav.app.replay import open_any
    from terranav.experiment.replay import Withheld, spaced, withhold
    from terranav.experiment.replay_ways import Flown

    told, drift = grades
    log = open_any(path, imu=typed.by == "imu")
    _with_gnss(log.recording)
    flown = Flown(drift, typed.drift_seed, told)
    wanted = Withheld("auto", typed.by, flown, MOUNT_M if typed.on_ground else None)
    denied = spaced(withhold(log, wanted)[0], 0.5 * finest_m)
    if denied.optimistic:
        complain(
            f"{path}: GNSS went into {', '.join(denied.seen_with_gnss)}, or may have, so that a false GNSS pulls the "
            "INS along; expected --by another way or --drift",
            "warning",
        )
    return Watchable(_shortened(denied.recording, typed.first_s), told, denied.by.told)


def _with_gnss(rec: Recording) -> Recording:
    """The recording; DataError where it has no GNSS."""
    if not rec.has_truth:
        raise DataError(f"{rec.name}: has no GNSS to monitor, expected the columns true_lat_deg and true_lon_deg")
    return rec


def _shortened(rec: Recording, first_s: float | None) -> Recording:
    """Its first seconds, if so many are wanted."""
    if first_s is None:
        return rec
    start_s = float(rec.time_s[0])
    return rec.between(start_s, start_s + finite("--first", first_s, above=0.0))


def facts(found: Monitored) -> dict[str, Any]:
    """Everything, for machines."""
    watch, flagged = found.watch, found.flagged
    off_m = found.pull_mps * (flagged.from_s - found.pull_from_s) if flagged else math.nan
    pull = {
        "speed_mps": found.pull_mps, "from_s": found.pull_from_s, "flagged": flagged is not None,
        "flagged_after_s": flagged.from_s - found.pull_from_s if flagged else math.nan, "off_m": off_m,
    }  # fmt: skip
    return {
        "recording": watch.name,
        "ins": found.told,
        "verdict": verdict_line(found),
        "status": str(watch.status[-1]),
        "reasons": list(watch.reasons),
        "shares": {status.value: watch.share(status) for status in GnssStatus},
        "alarms": [asdict(one) for one in watch.alarms],
        "difference_m": float(watch.difference_m[-1]),
        "threshold_m": float(watch.threshold_m[-1]),
        "false_alarms_per_h": found.monitor.false_alarms_per_h,
        "pull": pull if found.pull_mps else None,
    }


def verdict_line(found: Monitored) -> str:
    """The whole flight in one line."""
    watch, flagged = found.watch, found.flagged
    alarms = len(watch.alarms)
    lasted = duration(float(watch.time_s[-1]) - found.start_s)
    if found.pull_mps:
        at = f"GNSS pulled away at {found.pull_mps:g} m/s from {moment(found.pull_from_s - found.start_s)} on"
        if flagged is None:
            end_m = found.pull_mps * (float(watch.time_s[-1]) - found.pull_from_s)
            return f"{at}: not flagged, {distance(end_m)} off at the end"
        after_s = flagged.from_s - found.pull_from_s
        more = f"; {alarms - 1} other alarm{'s' if alarms > 2 else ''}" if alarms > 1 else ""
        return f"{at}: flagged after {duration(after_s)}, {distance(found.pull_mps * after_s)} off{more}"
    said = ", ".join(f"{status.value} {percent(watch.share(status))}" for status in _MAP_SAID if watch.share(status))
    if not alarms:
        return f"no alarm in {lasted}: GNSS {said}"
    worst = watch.alarms[0]
    return (
        f"{alarms} alarm{'s' if alarms > 1 else ''} in {lasted}: GNSS {worst.status.value} from "
        f"{moment(worst.from_s - found.start_s)} on: {worst.reasons[0]}"
    )


def show_monitored(found: Monitored, files: Mapping[str, str]) -> None:
    """The verdict, the alarms, and where things were written, for people."""
    from rich import box
    from rich.table import Table

    watch, start_s = found.watch, found.start_s
    usable = percent(float(found.result.usable.mean()))
    show_pairs(
        [
            ("recording", watch.name),
            ("INS", found.told),
            ("map", f"a fix is usable at {usable} of the epochs"),
            ("limits", f"set for {found.monitor.false_alarms_per_h:g} false alarms per flight hour"),
            ("verdict", verdict_line(found)),
            ("at the end", f"{watch.status[-1]}: {'; '.join(watch.reasons)}"),
        ]
    )
    if watch.alarms:
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
        for head in ("alarm", "from", "to", "difference", "why"):
            table.add_column(head, justify="left" if head in ("alarm", "why") else "right", overflow="fold")
        for one in watch.alarms:
            end = moment(one.to_s - start_s) if math.isfinite(one.to_s) else NOTHING
            row = (one.status.value, moment(one.from_s - start_s), end, distance(one.difference_m))
            table.add_row(*row, "; ".join(one.reasons))
        show(table)
    show_pairs(files.items())
