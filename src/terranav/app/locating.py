"""`terranav locate`: from what was typed to a track and a search, and what it found in numbers and lines."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from terranav.core.checks import finite
from terranav.core.earth import offset_of
from terranav.core.errors import ConfigError, DataError
from terranav.planning.locate import MOST_SCALE, Located, LocateSettings, Track, locate
from terranav.sensors.ready import ready

if TYPE_CHECKING:
    from terranav.core.ins_grade import InsGrade
    from terranav.core.recording import Recording
    from terranav.maps.map import Map

UNKNOWN = "unknown"
SIGMAS = 3.0  # either way, that are searched
LEAST_HEADING_DEG, LEAST_SCALE_PERCENT = 0.7, 0.3  # 1-sigma where nothing is told
SHOWN = 10  # candidates


@dataclass(frozen=True)
class Typed:
    """Options as they were typed; an empty text is one that was not."""

    span: str = ""
    heading_sigma: str = ""
    scale_sigma: str = ""
    offset_sigma: str = UNKNOWN
    sigma: float | None = None
    certain: float = 0.99
    most_places: int = LocateSettings.most_places


@dataclass(frozen=True)
class Search:
    """A profile of a recording, the map to look on, and what was found.

    `row` is the epoch of the last reading; `scale_sigma` is told in percent.
    """

    recording: Recording
    chart: Map
    track: Track
    row: int
    first_row: int
    heading_sigma_deg: float
    scale_sigma: float
    settings: LocateSettings
    found: Located


def one_map(charts: tuple[Map, ...]) -> Map:
    """The map to look on."""
    if len(charts) != 1:
        raise ConfigError(f"--map is given {len(charts)} times, expected once: the map to look on")
    return charts[0]


def cut(rec: Recording, text: str) -> Recording:
    """The part of a recording between two times of its own, such as '600,900'; one left out is its end."""
    if not text:
        return rec
    parts = text.split(",")
    ends = [float(rec.time_s[0]), float(rec.time_s[-1])]
    try:
        if len(parts) != 2:
            raise ValueError
        start, end = (float(part) if part.strip() else default for part, default in zip(parts, ends))
        if not (math.isfinite(start) and math.isfinite(end) and start < end):
            raise ValueError
    except ValueError:
        raise ConfigError(f"--span is {text!r}, expected FROM,TO in seconds, such as 600,900 or 600,") from None
    return rec.between(start, end)


def looked_for(rec: Recording, chart: Map, ins: InsGrade | None, typed: Typed) -> Search:
    """Make the track of a recording and find it on the map.

    Raises
    ------
    ConfigError, DataError
    """
    part = cut(rec, typed.span)
    epochs = list(ready(part.epochs()))
    rows = [i for i, epoch in enumerate(epochs) if any(one.kind == chart.kind for one in epoch.measurements)]
    if not rows:
        kinds = ", ".join(part.readings) or "none at all"
        raise DataError(f"{rec.name}: no reading compares with a {chart.kind} map, expected some (it has {kinds})")
    try:
        track = Track.of(epochs, chart.kind, None if typed.sigma is None else finite("--sigma", typed.sigma, above=0.0))
    except DataError as error:
        raise DataError(f"{rec.name}: {error}") from None
    share = _velocity_share(rec, part, ins, track)
    heading = _sigma("--heading-sigma", typed.heading_sigma, max(LEAST_HEADING_DEG, math.degrees(math.atan(share))))
    scale = _sigma("--scale-sigma", typed.scale_sigma, max(LEAST_SCALE_PERCENT, 100.0 * share), allow_unknown=False)
    if SIGMAS * scale > 100.0 * MOST_SCALE:
        if typed.scale_sigma:
            most = 100.0 * MOST_SCALE / SIGMAS
            raise ConfigError(f"--scale-sigma is {typed.scale_sigma!r}, expected at most {most:.2g} (percent)")
        scale = 100.0 * MOST_SCALE / SIGMAS
    offset = _sigma("--offset-sigma", typed.offset_sigma, math.inf)
    settings = LocateSettings(
        heading_deg=min(SIGMAS * heading, 180.0), scale=SIGMAS * scale / 100.0,
        offset_sigma=offset, certain=typed.certain, most_places=typed.most_places,
    )  # fmt: skip
    return Search(part, chart, track, rows[-1], rows[0], heading, scale, settings, locate(track, chart, settings))


def _sigma(option: str, text: str, otherwise: float, *, allow_unknown: bool = True) -> float:
    """A 1-sigma that was typed; infinite where it is unknown."""
    if not text:
        return otherwise
    if allow_unknown and text.strip().lower() == UNKNOWN:
        return math.inf
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    above = 0.0 if option == "--offset-sigma" else -1e-300
    if not math.isfinite(value) or not value > above:
        least = "> 0" if above == 0.0 else ">= 0"
        unknown = " or 'unknown'" if allow_unknown else ""
        raise ConfigError(f"{option} is {text!r}, expected a number {least}{unknown}")
    return value


def _velocity_share(rec: Recording, part: Recording, ins: InsGrade | None, track: Track) -> float:
    """1-sigma of the INS's velocity error over the speed: along the track a wrong scale, across it a wrong heading."""
    grade = ins or rec.ins
    if grade is None:
        return 0.0
    speed = track.length_m / max(float(part.time_s[-1] - part.time_s[0]), 1e-9)
    return float(grade.velocity_sigma_at_mps(float(part.time_s[-1] - rec.time_s[0])) / max(speed, 1e-9))


def facts(search: Search) -> dict[str, Any]:
    """Everything in numbers."""
    rec, chart, found, track, settings = search.recording, search.chart, search.found, search.track, search.settings
    first_s, last_s = float(rec.time_s[search.first_row]), float(rec.time_s[search.row])
    return {
        "verdict": found.verdict,
        "reasons": list(found.reasons),
        "complete": found.complete,
        "recording": {"name": rec.name, "from_s": first_s, "to_s": last_s, "readings": int(track.height.size)},
        "track": {"length_m": track.length_m, "sigma": track.sigma, "spread": float(np.std(track.height))},
        "map": {"name": chart.name, "kind": chart.kind, "unit": chart.unit, "sigma": chart.sigma,
                "cells": list(chart.shape), "cell_m": chart.cell_m},
        "searched": {"heading_deg": settings.heading_deg, "scale": settings.scale,
                     "offset_sigma": settings.offset_sigma, "certain": settings.certain,
                     "most_places": settings.most_places},
        "candidates": [_candidate(search, k) for k in range(len(found.candidates))],
        "ins_error_m": _ins_error(search),
        "error_m": _error(search),
        "left_out": {"margin": found.margin, "probability": found.tail if found.complete else None},
        "work": {"blocks": found.blocks, "lookups": found.lookups, "share_of_exhaustive": found.share,
                 "variance_factor": found.noise},
    }  # fmt: skip


def _candidate(search: Search, number: int) -> dict[str, Any]:
    place = search.found.candidates[number]
    keys = (
        "probability", "lat_deg", "lon_deg", "first_lat_deg", "first_lon_deg", "sigma_m", "heading_deg", "scale",
        "offset", "rms", "misfit", "cov_m2",
    )  # fmt: skip
    return {key: getattr(place, key) for key in keys}


def _ins_error(search: Search) -> list[float] | None:
    """North and east, where the place is found [m]."""
    if search.found.ambiguous:
        return None
    rec, row = search.recording, search.row
    north, east = search.found.prior(float(rec.lat_deg[row]), float(rec.lon_deg[row])).mean_m.tolist()
    return [north, east]


def _error(search: Search) -> float | None:
    """Of the best candidate's end against the truth, where that is known [m]."""
    rec, row = search.recording, search.row
    if not rec.has_truth or not search.found.candidates:
        return None
    best, lat, lon = search.found.candidates[0], rec.columns["true_lat_deg"][row], rec.columns["true_lon_deg"][row]
    return float(np.hypot(*offset_of(float(lat), float(lon), best.lat_deg, best.lon_deg)))


def show_search(search: Search, files: dict[str, str]) -> None:
    """Lines for people, and a table of the candidates."""
    from terranav.app.console import show, show_pairs
    from terranav.app.words import coordinate, distance, duration, percent

    told = facts(search)
    rec, chart, found = told["recording"], told["map"], search.found
    seen = f"{rec['readings']} {chart['kind']} readings over {distance(told['track']['length_m'])}"
    cells = f"{chart['cells'][0]} x {chart['cells'][1]} cells of {distance(chart['cell_m'])}"
    pairs = [
        ("recording", f"{rec['name']}, {seen} in {duration(rec['to_s'] - rec['from_s'])}"),
        ("map", f"{chart['name']}, {chart['kind']}, {cells}"),
        ("searched", _searched(search)),
        ("verdict", found.verdict),
        *(("because" if k == 0 else "", reason) for k, reason in enumerate(found.reasons)),
    ]
    if found.candidates:
        best = found.candidates[0]
        place = f"{coordinate(best.lat_deg, 'N', 'S', 5)}, {coordinate(best.lon_deg, 'E', 'W', 5)}"
        word = "position" if not found.ambiguous else "likeliest" if found.complete else "first of them"
        pairs.append((word, f"{place} at {rec['to_s']:g} s, 1-sigma {distance(best.sigma_m)}"))
    if told["ins_error_m"] is not None:
        pairs.append(("INS error", "{:.0f} m north, {:.0f} m east".format(*told["ins_error_m"])))
    if told["error_m"] is not None:
        pairs.append(("truth", f"{distance(told['error_m'])} from the {word}"))
    if found.complete and found.candidates:
        pairs.append(("left out", f"places with at most {percent(found.tail, 2)} of the probability together"))
    elif not found.complete:
        pairs.append(("left out", "search stopped: any part of the map may fit better; --most-places raises the limit"))
    pairs.append(("work", f"{found.lookups:.3g} lookups, {found.share:.2g} of exhaustive search"))
    show_pairs([*pairs, *files.items()])
    if found.candidates:
        show(_table(search))


def _searched(search: Search) -> str:
    settings, unit = search.settings, search.chart.unit
    heading = "any heading" if settings.heading_deg >= 180.0 else f"heading within {settings.heading_deg:.2g} deg"
    offset = "any offset" if math.isinf(settings.offset_sigma) else f"offset 1-sigma {settings.offset_sigma:g} {unit}"
    reading = f"a reading's 1-sigma {search.track.sigma:.3g} {unit}"
    return f"the whole map; {heading}, scale within {100.0 * settings.scale:.2g} %, {offset}, {reading}"


def _table(search: Search) -> Any:
    """The candidates."""
    from rich import box
    from rich.table import Table

    from terranav.app.words import coordinate, distance

    table, unit, places = Table(box=box.SIMPLE_HEAD, pad_edge=False), search.chart.unit, search.found.candidates
    chance = ("probability",) if search.found.complete else ()
    for head in ("", *chance, "latitude", "longitude", "1-sigma", "turned", "scale", "offset", "misfit rms"):
        table.add_column(head, justify="right")
    for k, place in enumerate(places[:SHOWN]):
        table.add_row(
            str(k + 1),
            *(f"{place.probability:.4f}" for _ in chance),
            coordinate(place.lat_deg, "N", "S", 5),
            coordinate(place.lon_deg, "E", "W", 5),
            distance(place.sigma_m),
            f"{place.heading_deg:+.2f} deg",
            f"{100.0 * place.scale:+.2f} %",
            f"{place.offset:+.1f} {unit}",
            f"{place.rms:.1f} {unit}",
        )
    if len(places) > SHOWN:
        table.caption = f"and {len(places) - SHOWN} {'less likely' if chance else 'more'}"
    return table
