"""The picture of terrain ahead: ground and altitude along the corrected track, and what the look-ahead said."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from terranav.app.ahead import Flight
from terranav.app.outcome import Outcome
from terranav.app.style import MAIN, new_figure, styled, time_axis
from terranav.core.errors import DataError
from terranav.maps.map import Map
from terranav.planning.cue import CueSettings, CueState

FloatArray = NDArray[np.float64]

LEAST_PROBABILITY = 1e-6  # where the picture of it ends
MOST_CUES = 240
SHADES = {CueState.WARNING: "#e07b6a", CueState.UNKNOWN: "#d9c58a"}


def margin_m(outcome: Outcome) -> float:
    """Margin that the picture looks for: the usual one, or half the clearance of a flight that is lower [m].

    NaN where the flight has no terrain map below it, or an altitude that is not above it.
    """
    chart = _chart(outcome)
    if chart is None:
        return float("nan")
    result = outcome.results[outcome.main]
    clearance = result.alt_m - chart.sample(result.lat_deg, result.lon_deg)
    known = clearance[np.isfinite(clearance)]
    middle = float(np.median(known)) if known.size else float("nan")
    return min(CueSettings().margin_m, float(f"{0.5 * middle:.2g}")) if middle > 1.0 else float("nan")


def terrain_ahead(outcome: Outcome) -> Figure | None:
    """Altitude over the ground, shaded where the look-ahead warns; None where there is no ground to keep clear of."""
    chart, margin = _chart(outcome), margin_m(outcome)
    if chart is None or not np.isfinite(margin):
        return None
    rec, result = outcome.recording, outcome.results[outcome.main]
    settings = CueSettings(margin_m=margin)
    try:
        flight = Flight(rec, result, chart, settings)
    except DataError:  # one epoch without a velocity: nothing is ahead
        return None
    rows = np.array(flight.rows(MOST_CUES))
    cues = [flight.cue(int(row), evade=False) for row in rows]
    ground = chart.sample(result.lat_deg, result.lon_deg)
    with styled():
        figure = new_figure(4.8)
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[2.2, 1.0])
        time, label = time_axis(rec.time_s, float(rec.time_s[0]))
        upper.fill_between(time, np.nanmin(ground), ground, color="#b9ac93", linewidth=0, label="ground by the map")
        upper.plot(time, ground + margin, color="#8a7c61", linewidth=0.9, label=f"margin of {margin:g} m")
        upper.plot(time, result.alt_m, color=MAIN, linewidth=1.8, label="altitude")
        upper.set_ylabel("height [m]")
        peak = np.array([max(found.peak, LEAST_PROBABILITY) for found in cues])
        lower.step(time[rows], peak, where="post", color=MAIN, linewidth=1.4)
        lower.axhline(settings.threshold, color="#8a3324", linewidth=0.9, linestyle="--")
        lower.set_yscale("log")
        lower.set_ylim(LEAST_PROBABILITY, 2.0)
        lower.set_ylabel("probability\nahead")
        lower.set_xlabel(label)
        edges = np.append(time[rows], time[-1])
        for state, shade in SHADES.items():
            for k in np.flatnonzero([found.state is state for found in cues]):
                for panel in (upper, lower):
                    panel.axvspan(edges[k], edges[k + 1], color=shade, alpha=0.45, linewidth=0)
        upper.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=3, fontsize=9.5, borderpad=0.2)
        upper.set_xlim(float(time[0]), float(time[-1]) if time.size > 1 else float(time[0]) + 1.0)
    return figure


def _chart(outcome: Outcome) -> Map | None:
    """The first terrain map."""
    return next((chart for chart in outcome.maps if chart.kind == "terrain"), None)
