"""A log flown once more without GNSS: when it is taken away, and what a navigator would have known from then on.

GNSS is withheld, never shown: the navigator starts at the last position that GNSS gave, knows nothing of it until the
span ends, and is scored against it. Several spans are several flights, each from the last fix before it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from terranav.core.earth import offset_m
from terranav.core.errors import ConfigError, DataError
from terranav.core.recording import TRUTH, VELOCITY, FloatArray, Recording
from terranav.experiment.replay_ways import WAYS, Flown, Way, dead_reckoned, filled
from terranav.io.logs import Log

#: in the air: so high above the start, or so fast, for so long
TAKE_OFF_M, TAKE_OFF_MPS, TAKE_OFF_S = 10.0, 8.0, 10.0
#: a vehicle on the ground drives: so fast for TAKE_OFF_S
DRIVE_MPS = 3.0
#: a span must be at least so long to say anything [s]
SHORTEST_S = 10.0
#: a vehicle that stands still is not thought to hear nothing [s]
LONGEST_S = 30.0
_CLEARANCE = ("laser_altitude_m", "radar_altitude_m")
_GROUND = ("terrain_m", "depth_m", "gravity_mgal", "magnetic_nt", *_CLEARANCE)
#: 1-sigma of the ground height that a barometer on wheels gives: noise, airflow and the car's own pressure [m]
WHEELS_SIGMA_M = 2.0


@dataclass(frozen=True)
class Denied:
    """One span without GNSS, as a navigator would have seen it.

    Attributes
    ----------
    recording : Recording
        Indicated position by dead reckoning from the last fix; the truth is GNSS's; `ins` is what is told of it.
    start_s, end_s : float
        Since the log began [s]; the start is the last fix, where one is known.
    by : Way
        How it navigated.
    seen_with_gnss : tuple of str
        What the navigator saw that GNSS went into, or may have: then the log flatters it.
    remarks : tuple of str
    """

    recording: Recording
    start_s: float
    end_s: float
    by: Way
    seen_with_gnss: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()

    @property
    def optimistic(self) -> bool:
        """Whether its motion was known with the help of GNSS."""
        return bool(self.seen_with_gnss)


@dataclass(frozen=True)
class Withheld:
    """When GNSS is taken away, and how the vehicle then navigates.

    Attributes
    ----------
    spans : 'auto', 'take-off', a time [s], or (start, end) pairs [s]
        Since the log began; 'auto' is 'take-off' where there is one to be seen, else the start.
    by : str
        A key of WAYS, or 'auto': the most honest that the log allows.
    flown : Flown
        Drift, seed, and the INS that the estimators are told of.
    on_ground_m : float, optional
        A vehicle on the ground whose barometer is so high above it [m].
    """

    spans: str | float | Sequence[tuple[float, float]] = "auto"
    by: str = "auto"
    flown: Flown = field(default_factory=Flown)
    on_ground_m: float | None = None


def withhold(log: Log, wanted: Withheld) -> list[Denied]:
    """Take GNSS away from a log.

    Parameters
    ----------
    log : Log
        Of `open_log`, or `as_log` of a recording.
    wanted : Withheld

    Returns
    -------
    list of Denied
        One a span, in the order of time.

    Raises
    ------
    DataError
        When the log holds no reading to match, no take-off, or not what the way of navigating needs.
    ConfigError
        When a span lies outside of the log, is too short, reversed or overlaps another; for an unknown way.
    """
    rec = log.recording
    if wanted.on_ground_m is not None:
        rec = on_ground(rec, wanted.on_ground_m)
    _check_readings(log, rec)
    log = replace(log, recording=rec)
    way = WAYS[_way(log, wanted)]
    spans, remarks = spans_of(rec, wanted.spans, on_ground=wanted.on_ground_m is not None)
    denied = []
    for start_s, end_s in spans:
        first, last, told = _rows(rec, start_s, end_s)
        flown, more = dead_reckoned(log, way, first, last, wanted.flown)
        seen = tuple(key for key in log.facts.get("seen_with_gnss", ()) if key in way.uses)
        began_s, ended_s = (float(rec.time_s[row] - rec.time_s[0]) for row in (first, last - 1))
        denied.append(Denied(flown, began_s, ended_s, way, seen, (*remarks, *told, *more)))
    return denied


def as_log(rec: Recording) -> Log:
    """A recording as if it were a log: its indicated position is that of an INS, no one knows what GNSS went into."""
    step = float(np.median(np.diff(rec.time_s))) if len(rec) > 1 else 0.0
    facts: dict[str, Any] = {
        "file": rec.name,
        "format": "recording",
        "duration_s": round(float(rec.time_s[-1] - rec.time_s[0]), 3),
        "epochs": len(rec),
        "rate_hz": round(1.0 / step, 3) if step > 0 else None,
        "readings": {key: round(float(np.isfinite(rec.columns[key]).mean()), 4) for key in rec.readings},
        "truth": {"known": round(float(np.isfinite(rec.columns[TRUTH[0]]).mean()), 4) if rec.has_truth else 0.0},
        "own_position": {"used_gnss": None if _is_truth(rec) else "unknown"},
        "seen_with_gnss": [],
    }
    remarks = [] if rec.has_truth else ["no true position is given: the indicated one is an INS's, or true (--drift)"]
    return Log(rec, facts, tuple(remarks))


def spaced(denied: Denied, spacing_m: float) -> Denied:
    """Leave out readings that lie closer together than the map tells apart.

    They see the same ground through the same map error, while estimators and their monitor take them for independent.
    The rule of the live engine: a reading counts once the indicated position has moved by `spacing_m` [m] since the
    last that did, or after 30 s. The barometer is not thinned: it is no reading of the ground.
    """
    rec = denied.recording
    keys = [key for key in _GROUND if key in rec.columns]
    any_there = np.isfinite(np.stack([rec.columns[key] for key in keys])).any(axis=0)
    rows = np.flatnonzero(any_there)
    north, east = offset_m(rec.lat_deg[0], rec.lon_deg[0], rec.lat_deg, rec.lon_deg)
    places = list(zip(rows.tolist(), north[rows].tolist(), east[rows].tolist(), rec.time_s[rows].tolist(), strict=True))
    spared, used = [], places[:1]
    for place in places[1:]:
        _, last_north, last_east, last_s = used[-1]
        if math.hypot(place[1] - last_north, place[2] - last_east) < spacing_m and place[3] - last_s < LONGEST_S:
            spared.append(place[0])
        else:
            used.append(place)
    if not spared:
        return denied
    columns = dict(rec.columns)
    for key in keys:
        columns[key] = columns[key].copy()
        columns[key][spared] = np.nan
    told = f"{len(used)} of {len(places)} readings are used: one every {spacing_m:.0f} m or more"
    return replace(denied, recording=replace(rec, columns=columns), remarks=(*denied.remarks, told))


def _is_truth(rec: Recording) -> bool:
    """Whether the indicated position is the true one: then no INS was recorded."""
    if not rec.has_truth:
        return False
    return float(np.nanmax(np.abs(rec.ins_error_m()))) < 1e-3


def on_ground(rec: Recording, height_m: float) -> Recording:
    """A vehicle on the ground: its barometer, less the height it is mounted at, is the height of the terrain.

    Parameters
    ----------
    rec : Recording
    height_m : float
        Of the barometer above the ground [m].

    Raises
    ------
    DataError
        When there is no barometer.
    """
    baro = rec.columns.get("baro_altitude_m")
    if baro is None or not np.isfinite(baro).any():
        raise DataError(f"{rec.name}: no barometer is logged, expected one to tell the height of the ground on wheels")
    columns = {key: value for key, value in rec.columns.items() if not key.startswith(_GROUND)}
    sigma = {key: value for key, value in rec.sigma.items() if key in columns}
    datum = {key: value for key, value in rec.datum.items() if key in ("all", *columns)}
    terrain = rec.datum_of("baro_altitude_m")
    return replace(
        rec,
        columns={**columns, "terrain_m": baro - height_m},
        sigma={**sigma, "terrain_m": WHEELS_SIGMA_M},
        datum=datum | ({"terrain_m": terrain} if terrain is not None else {}),
    )


def take_off_s(rec: Recording, *, on_ground: bool = False) -> float | None:
    """When the vehicle took off: the first time from which on it was in the air for ten seconds.

    Parameters
    ----------
    rec : Recording
        In the air is 10 m above the height of the first five seconds, or 8 m/s over ground.
    on_ground : bool
        A vehicle on wheels: 3 m/s, whatever the height.

    Returns
    -------
    float or None
        On the recording's clock [s]; its first time where it was under way then; None where it never was.
    """
    time_s = rec.time_s
    height = rec.columns.get("baro_altitude_m", rec.alt_m)
    height = np.where(np.isfinite(height), height, rec.alt_m)
    start = float(np.median(height[time_s <= time_s[0] + 5.0]))
    moving = _speed(rec) >= (DRIVE_MPS if on_ground else TAKE_OFF_MPS)
    up = moving if on_ground else moving | (height - start >= TAKE_OFF_M)
    ends = np.flatnonzero(np.diff(np.concatenate(([0], up.astype(np.int8), [0]))))
    for first, after in zip(ends[::2].tolist(), ends[1::2].tolist(), strict=True):
        if time_s[after - 1] - time_s[first] >= min(TAKE_OFF_S, float(time_s[-1] - time_s[0])):
            return float(time_s[first])
    return None


def _speed(rec: Recording) -> FloatArray:
    """(n,) speed over ground [m/s]: as logged, else the displacement over some three seconds."""
    if all(key in rec.columns for key in VELOCITY[:2]):
        speed = np.hypot(rec.columns["vn_mps"], rec.columns["ve_mps"])
        if np.isfinite(speed).mean() > 0.5:
            return np.asarray(np.nan_to_num(speed))
    lat, lon = (
        filled(rec, key, fallback) for key, fallback in (("true_lat_deg", "lat_deg"), ("true_lon_deg", "lon_deg"))
    )
    time_s = rec.time_s
    before = np.searchsorted(time_s, time_s - 1.5)
    after = np.minimum(np.searchsorted(time_s, time_s + 1.5), time_s.size - 1)
    before, after = np.minimum(before, np.arange(time_s.size)), np.maximum(after, before)
    moved = np.hypot(*offset_m(lat[before], lon[before], lat[after], lon[after]))
    return np.asarray(moved / np.maximum(time_s[after] - time_s[before], 1e-3))


def spans_of(
    rec: Recording, asked: str | float | Sequence[tuple[float, float]], *, on_ground: bool = False
) -> tuple[list[tuple[float, float]], list[str]]:
    """Spans without GNSS [s], and what is to be said of them; the parameters are those of `Withheld`."""
    first_s, last_s = float(rec.time_s[0]), float(rec.time_s[-1])
    remarks: list[str] = []
    if isinstance(asked, str):
        start_s = take_off_s(rec, on_ground=on_ground)
        what = "drove off" if on_ground else "took off"
        if start_s is None and asked == "take-off":
            least = f"{DRIVE_MPS:g} m/s" if on_ground else f"{TAKE_OFF_M:g} m above its start or {TAKE_OFF_MPS:g} m/s"
            raise DataError(
                f"{rec.name}: no take-off: it never was {least} for {TAKE_OFF_S:g} s, expected --gnss-off with a time"
            )
        if start_s is None:
            remarks.append("no take-off is to be seen: GNSS is taken away from the start on")
        elif start_s == first_s:
            remarks.append("it was under way when the log began: GNSS is taken away from the start on")
        else:
            remarks.append(f"it {what} at {start_s - first_s:.1f} s: GNSS is taken away from then on")
        asked = ((start_s if start_s is not None else first_s, last_s),)
    elif isinstance(asked, (int, float)):
        asked = ((first_s + float(asked), last_s),)
    else:
        asked = [(first_s + start_s, first_s + end_s) for start_s, end_s in asked]
    spans = sorted((float(start), min(float(end), last_s)) for start, end in asked)
    for i, (start, end) in enumerate(spans):
        told = f"--gnss-off {start - first_s:g} to {end - first_s:g} s"
        if start < first_s or end - start < SHORTEST_S:
            raise ConfigError(
                f"{told}: expected a span of {SHORTEST_S:g} s or more within the {last_s - first_s:g} s of {rec.name}"
            )
        if i and start < spans[i - 1][1]:
            raise ConfigError(f"{told}: begins before the span before it ends, at {spans[i - 1][1] - first_s:g} s")
    return spans, remarks


def _rows(rec: Recording, start_s: float, end_s: float) -> tuple[int, int, list[str]]:
    """First row (the last fix at or before the start, else the first after it) and the row after the last."""
    last = int(np.searchsorted(rec.time_s, end_s, side="right"))
    first = int(np.searchsorted(rec.time_s, start_s, side="left"))
    if not rec.has_truth:
        return _enough(rec, first, last, start_s, end_s), last, ["no GNSS position is known: there is no score"]
    known = np.flatnonzero(np.isfinite(rec.columns[TRUTH[0]]) & np.isfinite(rec.columns[TRUTH[1]]))
    before, after = known[known <= first], known[(known > first) & (known < last)]
    remarks = []
    if before.size:
        away_s = float(rec.time_s[first] - rec.time_s[before[-1]])
        first = int(before[-1])
        if away_s > 1.0:
            remarks.append(f"the last fix is {away_s:.0f} s older than the start of the span, which begins there")
    elif after.size:
        remarks.append(f"the first fix is at {rec.time_s[after[0]]:.1f} s: the span begins there")
        first = int(after[0])
    else:
        raise DataError(f"{rec.name}: no GNSS position is known up to {end_s:g} s, expected one to start from")
    return _enough(rec, first, last, start_s, end_s), last, remarks


def _enough(rec: Recording, first: int, last: int, start_s: float, end_s: float) -> int:
    """The first row, or DataError where the span holds no two epochs."""
    if last - first < 2:
        raise DataError(f"{rec.name}: {last - first} epochs from {start_s:g} to {end_s:g} s, expected two or more")
    return first


def _way(log: Log, wanted: Withheld) -> str:
    """How to navigate: as asked, else the most honest way that the log allows."""
    if wanted.by != "auto":
        if wanted.by not in WAYS:
            raise ConfigError(f"--by is {wanted.by!r}, expected {', '.join(WAYS)}")
        return wanted.by
    if wanted.flown.drift is not None:
        return "drift"
    facts: Mapping[str, Any] = log.facts
    seen, columns = facts.get("seen_with_gnss", []), log.recording.columns
    used = facts.get("own_position", {}).get("used_gnss")
    if used == "no" or (facts.get("format") == "recording" and used is not None):
        return "position"
    moving = VELOCITY[0] in columns and bool(np.isfinite(columns[VELOCITY[0]]).any())
    if moving and VELOCITY[0] not in seen:
        return "velocity"
    if "airspeed" in log.beside and np.isfinite(columns.get("heading_deg", np.full(1, np.nan))).any():
        return "airspeed"
    return "velocity" if moving and used is not None else "drift"


def _check_readings(log: Log, rec: Recording) -> None:
    """Raise DataError when the log measured nothing that a map could be compared with."""
    if any(key in rec.columns and np.isfinite(rec.columns[key]).any() for key in _GROUND):
        return
    wheels = ""
    if "baro_altitude_m" in rec.columns:
        wheels = "; for a car or a boat, whose barometer tells the height of the ground: --ground-vehicle"
    raise DataError(
        f"{log.facts.get('file', rec.name)}: nothing in it measured the ground below, expected an altimeter that looks "
        f"down or a depth sounder{wheels}"
    )
