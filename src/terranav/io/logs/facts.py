"""The facts of a log as plain JSON, and the same in words: what there is, how good, and what is missing."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import timedelta
from typing import Any

import numpy as np

from terranav.core.earth import offset_m
from terranav.core.recording import ATTITUDE, RAW, READY, TRUTH, VELOCITY, FloatArray
from terranav.io.logs.found import DATUMS, NO_HEIGHT, SEA_LEVEL, Found, Series

#: a series has a gap where its rows are further apart than this or five times the usual step, whichever is more [s]
GAP_S = 1.0
_UNITS = {
    "gnss": "deg, m",
    "own": "deg, m",
    "velocity": "m/s",
    "attitude": "deg",
    "fusing": "1",
    "airspeed": "m/s",
    "imu": "rad/s, m/s^2",
}
#: what people call each role
WORDS = {
    "gnss": "GNSS",
    "own": "own position",
    "velocity": "velocity",
    "attitude": "attitude",
    "baro": "barometer",
    "laser": "laser altimeter",
    "radar": "radar altimeter",
    "depth": "depth sounder",
    "fusing": "use of GNSS",
    "airspeed": "airspeed",
    "imu": "inertial sensors",
}
_LACKING = {
    "gnss": "no GNSS fix is logged: there is no truth, and no error can be told",
    "own": "the autopilot's own position is not logged: the positions are the GNSS receiver's, add an INS with "
    "terranav.add_drift",
    "velocity": "no velocity is logged",
    "attitude": "no attitude is logged: a slant range cannot be made vertical",
    "baro": "no barometer is logged: the altitude is the indicated one",
    "altimeter": "no altimeter that looks down is logged: the ground below was not measured, so this log cannot be "
    "matched with a terrain map",
}


def facts_of(
    found: Found, by_role: Mapping[str, Series], columns: Mapping[str, FloatArray], story: Mapping[str, Any]
) -> dict[str, Any]:
    """What `Log.facts` holds.

    Parameters
    ----------
    found : Found
    by_role : mapping of str to Series
        The series of the run that was read.
    columns : mapping of str to (n,) arrays
        The recording's.
    story : mapping
        base: role of the series that made the epochs; start_s: its first time on the log's clock [s]; offset_m: what
        was added to the barometer [m], or None.
    """
    time_s = columns["time_s"]
    duration_s = float(time_s[-1])
    facts: dict[str, Any] = {
        "file": found.path.name,
        "format": found.format,
        "whole": found.whole,
        "vehicle": dict(found.vehicle),
        "duration_s": round(duration_s, 3),
        "epochs": int(time_s.size),
        "epochs_from": story["base"],
        "series": {role: _series_facts(part, float(story["start_s"]), duration_s) for role, part in by_role.items()},
        "readings": {key: _share(columns[key]) for key in (*READY, *RAW) if key in columns},
    }
    if found.start_utc is not None:
        start = found.start_utc + timedelta(seconds=float(story["start_s"]))
        facts["start_utc"] = start.isoformat().replace("+00:00", "Z")
    facts["truth"] = _truth_facts(columns)
    facts["own_position"] = _own_facts(by_role, columns)
    facts["seen_with_gnss"] = _seen_with_gnss(by_role, columns, story["base"])
    if story["offset_m"] is not None:
        facts["barometer"] = _baro_facts(columns, float(story["offset_m"]))
    for role in ("laser", "radar"):
        if role in by_role:
            facts.setdefault("altimeters", {})[role] = _altimeter_facts(by_role[role], columns)
    facts["missing"] = _missing(by_role, columns)
    return facts


def _share(column: FloatArray) -> float:
    """The share of epochs that have a value, rounded."""
    return round(float(np.isfinite(column).mean()), 4)


def _series_facts(part: Series, start_s: float, duration_s: float) -> dict[str, Any]:
    """Rows, rate, gaps, unit and height reference of one series."""
    time_s = part.time_s - start_s
    steps = np.diff(time_s)
    step = float(np.median(steps)) if steps.size else 0.0
    gaps = steps[steps > max(GAP_S, 5 * step)]
    covered = min(float(time_s[-1]), duration_s) - max(float(time_s[0]), 0.0) - float(gaps.sum())
    facts: dict[str, Any] = {
        "from": part.source,
        "rows": len(part),
        "rate_hz": round(1.0 / step, 3) if step > 0 else None,
        "first_s": round(float(time_s[0]), 3),
        "last_s": round(float(time_s[-1]), 3),
        "gaps": int(gaps.size),
        "longest_gap_s": round(float(gaps.max()), 3) if gaps.size else 0.0,
        "covers": round(min(max(covered, 0.0) / duration_s, 1.0), 4) if duration_s > 0 else 1.0,
        "unit": _UNITS.get(part.role, "m"),
        "uses_gnss": part.uses_gnss,
    }
    if part.height:
        facts["height"] = part.height
    if part.limits_m is not None:
        facts["limits_m"] = [round(limit, 3) for limit in part.limits_m]
    return facts


def _truth_facts(columns: Mapping[str, FloatArray]) -> dict[str, Any]:
    """At how many epochs the truth is known, and the longest stretch where it always is [s]."""
    if TRUTH[0] not in columns:
        return {"known": 0.0}
    known = np.isfinite(columns[TRUTH[0]])
    edges = np.flatnonzero(np.diff(np.concatenate(([0], known.astype(np.int8), [0]))))
    time_s = columns["time_s"]
    stretches = [(float(time_s[a]), float(time_s[b - 1])) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    facts: dict[str, Any] = {"known": _share(columns[TRUTH[0]])}
    if stretches:
        longest = max(stretches, key=lambda ends: ends[1] - ends[0])
        facts["longest_s"] = [round(longest[0], 3), round(longest[1], 3)]
    return facts


def _used_gnss(by_role: Mapping[str, Series]) -> str:
    """Whether the autopilot's estimate used GNSS: 'yes', 'no', 'part' (of the time) or 'unknown'."""
    if "fusing" in by_role:
        share = float(np.nanmean(by_role["fusing"].values["gnss"]))
        return "yes" if share > 0.999 else "no" if share < 0.001 else "part"
    declared = by_role["own"].uses_gnss if "own" in by_role else None
    return "unknown" if declared is None else "yes" if declared else "no"


def _own_facts(by_role: Mapping[str, Series], columns: Mapping[str, FloatArray]) -> dict[str, Any]:
    """Whether the autopilot's own position used GNSS, None where there is none, and how far from GNSS it is [m]."""
    if "own" not in by_role:
        return {"used_gnss": None}
    facts: dict[str, Any] = {"from": by_role["own"].source, "used_gnss": _used_gnss(by_role)}
    if "fusing" in by_role:
        facts["gnss_share"] = round(float(np.nanmean(by_role["fusing"].values["gnss"])), 4)
    if TRUTH[0] in columns and np.isfinite(columns[TRUTH[0]]).any():
        north, east = offset_m(columns[TRUTH[0]], columns[TRUTH[1]], columns["lat_deg"], columns["lon_deg"])
        away = np.hypot(north, east)
        facts["from_gnss_m"] = {"median": round(float(np.nanmedian(away)), 2), "max": round(float(np.nanmax(away)), 2)}
    return facts


def _seen_with_gnss(by_role: Mapping[str, Series], columns: Mapping[str, FloatArray], base: str) -> list[str]:
    """The columns a navigator would see that GNSS went into, or may have."""
    estimate = _used_gnss(by_role) != "no"
    by_baro = "baro_altitude_m" in columns and bool(np.isfinite(columns["baro_altitude_m"]).any())
    seen: list[str] = []
    if base == "gnss" or estimate:
        seen += ["lat_deg", "lon_deg"] if base == "gnss" and by_baro else ["lat_deg", "lon_deg", "alt_m"]
    moving = next((by_role[role] for role in ("velocity", base, "gnss") if role in by_role), None)
    if VELOCITY[0] in columns and moving is not None:
        used = estimate if moving.uses_gnss is None else moving.uses_gnss
        seen += [key for key in VELOCITY if used and key in columns]
    if "attitude" in by_role:
        used = estimate if by_role["attitude"].uses_gnss is None else by_role["attitude"].uses_gnss
        seen += [key for key in ATTITUDE if used and key in columns]
    return seen


def _baro_facts(columns: Mapping[str, FloatArray], offset_m: float) -> dict[str, Any]:
    """How the barometer was set, and how far it is from the true altitude then [m]."""
    facts: dict[str, Any] = {"set_by_m": round(offset_m, 2)}
    if TRUTH[2] in columns and "baro_altitude_m" in columns:
        away = columns["baro_altitude_m"] - columns[TRUTH[2]]
        away = away[np.isfinite(away)]
        if away.size:
            part = max(1, away.size // 20)
            first, last = float(np.median(away[:part])), float(np.median(away[-part:]))
            facts["minus_true_m"] = {
                "start": round(first, 2),
                "end": round(last, 2),
                "std": round(float(away.std()), 2),
            }
    return facts


def _altimeter_facts(part: Series, columns: Mapping[str, FloatArray]) -> dict[str, Any]:
    """How much of the run an altimeter covers, and how much was too high for it."""
    values = part.values["range_m"]
    key = f"{part.role}_altitude_m"
    facts: dict[str, Any] = {
        "in_range": _share(values),
        "covers": _share(columns[key]),
        "largest_m": round(float(np.nanmax(values)), 2) if np.isfinite(values).any() else None,
    }
    if part.limits_m is not None:
        facts["limits_m"] = [round(limit, 3) for limit in part.limits_m]
        above = columns["alt_m"] - np.nanmedian(columns["alt_m"][: max(1, columns["alt_m"].size // 200)])
        facts["higher_than_limit_above_start"] = round(float((above > part.limits_m[1]).mean()), 4)
    return facts


def _missing(by_role: Mapping[str, Series], columns: Mapping[str, FloatArray]) -> list[str]:
    """What a terrain navigator would want and the log has not, as keys of _LACKING."""
    missing = [role for role in ("gnss", "own", "attitude", "baro") if role not in by_role]
    if VELOCITY[0] not in columns:
        missing.append("velocity")
    if "laser" not in by_role and "radar" not in by_role and "depth" not in by_role:
        missing.append("altimeter")
    return missing


def remarks_of(facts: Mapping[str, Any]) -> Iterator[str]:
    """The facts in words, what hurts first."""
    for key in facts["missing"]:
        yield _LACKING[key]
    for role, altimeter in facts.get("altimeters", {}).items():
        yield _altimeter_told(role, altimeter)
    own = facts["own_position"]["used_gnss"]
    if own in ("yes", "part", "unknown"):
        told = {"yes": "used GNSS", "part": f"used GNSS {facts['own_position'].get('gnss_share', 0):.1%} of the time"}
        yield (
            f"the autopilot's own position {told.get(own, 'may have used GNSS (the log does not tell)')}: it is no INS "
            "without GNSS; add one with terranav.add_drift to test the loss of GNSS"
        )
    if 0 < facts["truth"]["known"] < 1 and "longest_s" in facts["truth"]:
        start_s, end_s = facts["truth"]["longest_s"]
        yield (
            f"the truth is known at {facts['truth']['known']:.1%} of the epochs; it has no gap from {start_s:g} to "
            f"{end_s:g} s: recording.between({start_s:g}, {end_s:g})"
        )
    for role, part in facts["series"].items():
        if part["gaps"]:
            yield f"{WORDS[role]} ({part['from']}): gaps: {part['gaps']}, the longest {part['longest_gap_s']:g} s"
    height = facts["series"][facts["epochs_from"]].get("height", "")
    if height == NO_HEIGHT:
        yield "no altitude is logged: alt_m is 0"
    elif height != SEA_LEVEL:
        then = "a map above the sea needs a geoid grid to go with it" if height in DATUMS else "terrain_m was not made"
        yield f"altitudes count {height or 'from an unknown level'}: {then}"


def _altimeter_told(role: str, facts: Mapping[str, Any]) -> str:
    """How much of the run an altimeter covers, in words."""
    limits = facts.get("limits_m")
    told = f"measures {limits[0]:g} to {limits[1]:g} m" if limits else "limits not logged"
    text = f"{WORDS[role]} ({told}): a reading at {facts['covers']:.1%} of the epochs"
    text += f", {facts['in_range']:.1%} of its rows in range"
    if limits and facts["higher_than_limit_above_start"] > 0:
        text += (
            f"; out of range above {limits[1]:g} m: {facts['higher_than_limit_above_start']:.1%} of the run was flown "
            "more than that above its starting place"
        )
    return text
