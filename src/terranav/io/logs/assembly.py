"""From what was found in a log to a Recording: epochs, truth kept apart, readings at the epoch nearest to them.

- Epochs are the rows of the autopilot's own position (of the GNSS receiver where it logged none), thinned to a rate.
- Truth is the GNSS receiver's position, interpolated to the epochs and never across a gap.
- Velocity and attitude are interpolated likewise; a reading of a sensor stays as it was measured and goes to the epoch
  nearest in time, one of a kind an epoch.
- The barometer is set to the height of the starting place, as before take-off; nothing corrects it afterwards.
- terrain_m = altitude - clearance, the altitude the barometer's, else the indicated; it counts from what the altitude
  counts from, which the recording names, and is not made where the log does not tell.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terranav.core.earth import metres_per_degree
from terranav.core.errors import DataError
from terranav.core.recording import (
    ATTITUDE,
    DEFAULT_RAW_SIGMA_M,
    LIMITS,
    READY,
    TRUTH,
    VELOCITY,
    FloatArray,
    Recording,
)
from terranav.io.logs.clocks import median_around, one_run
from terranav.io.logs.facts import facts_of, remarks_of
from terranav.io.logs.found import DATUMS, NO_HEIGHT, POSITION, Found, Series

#: the barometer is set to the indicated altitude over so many seconds from the start [s]
SETTING_S = 5.0
#: nothing is interpolated over a gap longer than this or three times the usual step, whichever is more [s]
GAP_S = 1.0
#: how far beyond its ends a series is drawn out, in steps
_REACH = 0.5001
#: a position further than this from the median of its neighbours, and than the fastest could be, is damage
_STRAY_M, _FASTEST_MPS = 500.0, 400.0
_READINGS = {"laser": "laser_altitude_m", "radar": "radar_altitude_m"}
_BESIDE = ("airspeed", "imu")
_TURNS = {"lon_deg": 360.0, "roll_deg": 360.0, "heading_deg": 360.0}


@dataclass(frozen=True, eq=False)
class Log:
    """A log as read by `open_log`.

    Attributes
    ----------
    recording : Recording
    facts : dict
        Plain JSON: what was found, at which rate, with which gaps, units, height references and limits; what GNSS went
        into; what is missing.
    remarks : tuple of str
        The same in words, a line each, damage first.
    beside : mapping of role to Series
        What a recording has no column for, on its clock and at its own rate: airspeed, imu.
    """

    recording: Recording
    facts: dict[str, Any]
    remarks: tuple[str, ...]
    beside: Mapping[str, Series] = field(default_factory=dict)


def assembled(found: Found, rate_hz: float) -> Log:
    """Make a Log of what a reader found; DataError where the log holds no position."""
    parts, clock = one_run([part for part in found.series if len(part)], found.wrap_s, found.in_order)
    by_role = {part.role: part for part in parts if len(part)}
    for role in ("own", "gnss"):
        if role in by_role:
            by_role[role] = by_role[role].rows(_placed(by_role[role]))
            near = _near(by_role[role])
            if not near.all():
                lost = np.count_nonzero(~near)
                clock.append(f"{by_role[role].source}: {lost} positions far from those around them were left out")
            by_role[role] = by_role[role].rows(near)
    base = next((by_role[role] for role in ("own", "gnss") if role in by_role and len(by_role[role])), None)
    if base is None:
        there = ", ".join(part.source for part in found.series) or "nothing that a recording needs"
        raise DataError(
            f"{found.path}: no position in this {found.format}, expected a GNSS fix or the autopilot's own; has {there}"
        )
    base = base.rows(_thinned(base.time_s, rate_hz))
    if "gnss" in by_role and len(by_role["gnss"]):
        base = base.rows(_with_truth(base.time_s, by_role["gnss"].time_s))
    columns = _columns(base, by_role)
    offset_m = _set_barometer(columns, base, by_role)
    _add_terrain(columns, base)
    start_s = float(base.time_s[0])
    columns["time_s"] = base.time_s - start_s
    story = {"offset_m": offset_m, "start_s": start_s, "base": base.role}
    facts = facts_of(found, by_role, columns, story)
    remarks = (*found.remarks, *clock, *remarks_of(facts))
    facts["remarks"] = list(remarks)
    source = {"log": found.path.name, "format": found.format}
    if "start_utc" in facts:
        source["start_utc"] = facts["start_utc"]
    try:
        name = found.path.stem or found.path.name
        recording = Recording(columns, source=source, name=name, datum=_datum(base, columns))
    except DataError as problem:
        raise DataError(f"{found.path}: {problem}") from None
    beside = {
        role: replace(by_role[role], time_s=by_role[role].time_s - start_s) for role in _BESIDE if role in by_role
    }
    return Log(recording, facts, remarks, beside)


def _datum(base: Series, columns: dict[str, FloatArray]) -> dict[str, str]:
    """What the heights count from; depths count from the water, whose level no log tells."""
    if base.height not in DATUMS:
        return {}
    return {"all": DATUMS[base.height]} | ({"depth_m": "unknown"} if "depth_m" in columns else {})


def _placed(part: Series) -> NDArray[np.bool_]:
    """(n,) whether a row has a position on the globe; latitude and longitude both 0 mean 'none yet'."""
    lat, lon = part.values["lat_deg"], part.values["lon_deg"]
    good = np.isfinite(lat) & np.isfinite(lon) & np.isfinite(part.values["alt_m"]) & ~((lat == 0) & (lon == 0))
    for key in POSITION:
        low, high = LIMITS[key]
        good &= (part.values[key] >= low) & (part.values[key] <= high)
    return np.asarray(good)


def _near(part: Series) -> NDArray[np.bool_]:
    """(n,) whether a position is where the median of its neighbours lets a vehicle be: a damaged row seldom is."""
    reach_s = step_of(part.time_s) * 6
    lat, alt = part.values["lat_deg"], part.values["alt_m"]
    lon = np.unwrap(part.values["lon_deg"], period=360.0)
    away = [np.abs(values - median_around(values)) for values in (lat, lon, alt)]
    horizontal = np.hypot(away[0], away[1] * np.cos(np.radians(lat))) * metres_per_degree(0.0)[1]
    return np.asarray((horizontal < _STRAY_M + _FASTEST_MPS * reach_s) & (away[2] < _STRAY_M + _FASTEST_MPS * reach_s))


def _thinned(time_s: FloatArray, rate_hz: float) -> NDArray[np.int64]:
    """The rows to keep so that the rate is not far above `rate_hz`."""
    rows = np.arange(time_s.size)
    if time_s.size < 3 or step_of(time_s) * rate_hz > 1 / 1.5:
        return rows
    slot = np.floor((time_s - time_s[0]) * rate_hz + 1e-6)
    return np.asarray(np.unique(slot, return_index=True)[1])


def _with_truth(time_s: FloatArray, gnss_s: FloatArray) -> NDArray[np.bool_]:
    """The epochs without those few before the first fix, or after the last, that are within a step or two of it."""
    step = step_of(gnss_s)
    keep = np.ones(time_s.size, dtype=bool)
    first, last = gnss_s[0] - _REACH * step, gnss_s[-1] + _REACH * step
    if time_s[0] > gnss_s[0] - 2 * step:
        keep &= time_s >= first
    if time_s[-1] < gnss_s[-1] + 2 * step:
        keep &= time_s <= last
    return keep if keep.any() else np.ones(time_s.size, dtype=bool)


def step_of(time_s: FloatArray) -> float:
    """The usual step of a clock: the median [s]; 1 where it has one row."""
    return float(np.median(np.diff(time_s))) if time_s.size > 1 else 1.0


def between(part: Series, key: str, at_s: FloatArray) -> FloatArray:
    """(m,) one column of a series at other times, linear between its rows; NaN over gaps and outside of them."""
    values = part.values[key]
    there = np.isfinite(values)
    time_s, values = part.time_s[there], values[there]
    if time_s.size == 0:
        return np.full(at_s.size, np.nan)
    step = step_of(time_s)
    if key in _TURNS:
        values = np.unwrap(values, period=_TURNS[key])
    result = np.interp(at_s, time_s, values)
    if time_s.size > 1:  # half a step beyond the ends, on the line of the last two rows
        for end, inner, beyond in ((0, 1, at_s < time_s[0]), (-1, -2, at_s > time_s[-1])):
            rate = (values[end] - values[inner]) / (time_s[end] - time_s[inner])
            result[beyond] = values[end] + rate * (at_s[beyond] - time_s[end])
    after = np.searchsorted(time_s, at_s)
    left, right = time_s[np.clip(after - 1, 0, time_s.size - 1)], time_s[np.clip(after, 0, time_s.size - 1)]
    inside = (at_s >= time_s[0] - _REACH * step) & (at_s <= time_s[-1] + _REACH * step)
    result[~inside | ((right - left > max(GAP_S, 3 * step)) & (at_s != right))] = np.nan
    if key == "heading_deg":
        return np.asarray(result % 360.0)
    return np.asarray((result + 180.0) % 360.0 - 180.0) if key in _TURNS else result


def _nearest(part: Series, key: str, epochs_s: FloatArray) -> FloatArray:
    """(n,) each reading at the epoch nearest to it, the closest where several are; NaN where an epoch gets none."""
    readings = np.full(epochs_s.size, np.nan)
    there = np.flatnonzero(np.isfinite(part.values[key]))
    time_s = part.time_s[there]
    after = np.clip(np.searchsorted(epochs_s, time_s), 1, max(epochs_s.size - 1, 1))
    before = np.minimum(after - 1, epochs_s.size - 1)
    after = np.minimum(after, epochs_s.size - 1)
    epoch = np.where(time_s - epochs_s[before] <= epochs_s[after] - time_s, before, after)
    away = np.abs(time_s - epochs_s[epoch])
    near = away <= 0.5 * max(step_of(epochs_s), 0.1) + 1e-6
    far_first = np.argsort(-away[near], kind="stable")
    readings[epoch[near][far_first]] = part.values[key][there[near][far_first]]
    return readings


def _columns(base: Series, by_role: dict[str, Series]) -> dict[str, FloatArray]:
    """Every column but time_s, the barometer not yet set."""
    epochs_s = base.time_s
    columns = {key: base.values[key] for key in POSITION}
    if "gnss" in by_role and len(by_role["gnss"]):
        for key, true in zip(POSITION, TRUTH, strict=True):
            columns[true] = between(by_role["gnss"], key, epochs_s)
        if by_role["gnss"].height == NO_HEIGHT:
            del columns[TRUTH[2]]
    moving = next(
        (p for p in (by_role.get("velocity"), base, by_role.get("gnss")) if p and VELOCITY[0] in p.values), None
    )
    if moving is not None:
        columns |= {key: between(moving, key, epochs_s) for key in VELOCITY if key in moving.values}
    if "attitude" in by_role:
        columns |= {key: between(by_role["attitude"], key, epochs_s) for key in ATTITUDE}
    for role, key in _READINGS.items():
        if role in by_role:
            columns[key] = _nearest(by_role[role], "range_m", epochs_s)
    if "depth" in by_role:
        columns["depth_m"] = _nearest(by_role["depth"], "depth_m", epochs_s)
    if "baro" in by_role:
        columns["baro_altitude_m"] = _nearest(by_role["baro"], "altitude_m", epochs_s)
    return columns


def _set_barometer(columns: dict[str, FloatArray], base: Series, by_role: dict[str, Series]) -> float | None:
    """Set the barometer to the starting place, let it hold the altitude where only GNSS would; the offset [m]."""
    if "baro" not in by_role or base.height == NO_HEIGHT:
        return None
    baro = between(by_role["baro"], "altitude_m", base.time_s)
    both = np.flatnonzero(np.isfinite(baro))
    if both.size == 0:
        return None
    start = both[base.time_s[both] <= base.time_s[both[0]] + SETTING_S]
    offset_m = float(np.median(base.values["alt_m"][start] - baro[start]))
    columns["baro_altitude_m"] = columns["baro_altitude_m"] + offset_m
    if base.role == "gnss" and np.isfinite(baro).all():
        columns["alt_m"] = baro + offset_m
    return offset_m


def _add_terrain(columns: dict[str, FloatArray], base: Series) -> None:
    """Add terrain_m and its sigma where an altitude of a known datum goes with a clearance."""
    if base.height not in DATUMS or not any(name in columns for name in _READINGS.values()):
        return
    clearance, sigma = _clearance(columns)
    if not np.isfinite(clearance).any():
        return
    altitude = columns["alt_m"]
    if "baro_altitude_m" in columns:
        baro = Series("baro", "", base.time_s, {"altitude_m": columns["baro_altitude_m"]}, base.order)
        held = between(baro, "altitude_m", base.time_s)
        altitude = np.where(np.isfinite(held), held, altitude)
    columns["terrain_m"] = altitude - clearance
    columns[READY["terrain_m"].sigma_column] = np.hypot(DEFAULT_RAW_SIGMA_M["baro_altitude_m"], sigma)


def _clearance(columns: dict[str, FloatArray]) -> tuple[FloatArray, FloatArray]:
    """(n,) height above ground and its 1-sigma [m], NaN for none: the laser's, made vertical, else the radar's."""
    none = np.full(columns["alt_m"].size, np.nan)
    laser, radar = columns.get("laser_altitude_m", none), columns.get("radar_altitude_m", none)
    # the down component of the body's down axis; a beam of unknown attitude is taken for vertical
    tilt = np.cos(np.radians(columns.get("roll_deg", none))) * np.cos(np.radians(columns.get("pitch_deg", none)))
    tilt = np.where(np.isfinite(tilt), tilt, 1.0)
    by_laser, by_radar = np.isfinite(laser), np.isfinite(radar)
    sigma = np.where(by_laser, DEFAULT_RAW_SIGMA_M["laser_altitude_m"] * np.abs(tilt), np.nan)
    sigma = np.where(by_radar & ~by_laser, DEFAULT_RAW_SIGMA_M["radar_altitude_m"], sigma)
    return np.where(by_laser, laser * tilt, radar), sigma
