"""Terrain ahead in the report: the same look-ahead as `terranav cue`, on a made-up outcome."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from terranav.app.ahead import Flight
from terranav.app.ahead_figure import MOST_CUES, margin_m, terrain_ahead
from terranav.app.outcome import Outcome
from terranav.planning.cue import CueSettings


def lowered(outcome: Outcome, alt_m: float) -> Outcome:
    """The outcome as flown at another altitude."""
    flown = {name: replace(result, alt_m=np.full_like(result.alt_m, alt_m)) for name, result in outcome.results.items()}
    return replace(outcome, results=flown)


def test_margin_is_the_usual_one_high_up_and_half_the_clearance_low_down(outcome: Outcome) -> None:
    result = outcome.results[outcome.main]
    ground = float(np.nanmedian(outcome.maps[0].sample(result.lat_deg, result.lon_deg)))
    assert margin_m(lowered(outcome, ground + 5000.0)) == CueSettings().margin_m
    low = margin_m(lowered(outcome, ground + 100.0))
    assert low == 50.0
    assert math.isnan(margin_m(lowered(outcome, ground - 5000.0)))


def test_picture_needs_ground_to_keep_clear_of(outcome: Outcome) -> None:
    high = lowered(outcome, 3000.0)
    figure = terrain_ahead(high)
    assert figure is not None
    assert len(figure.axes) == 2
    assert terrain_ahead(lowered(outcome, -5000.0)) is None
    magnetic = replace(outcome.maps[0], kind="magnetic", unit="nT")
    assert terrain_ahead(replace(high, maps=(magnetic,))) is None


def test_timeline_looks_at_few_epochs_of_a_long_flight(outcome: Outcome) -> None:
    result = outcome.results[outcome.main]
    flight = Flight(outcome.recording, result, outcome.maps[0], CueSettings())
    assert 1 <= len(flight.rows(3)) <= 3
    assert len(flight.rows(MOST_CUES)) <= MOST_CUES
    assert flight.rows(MOST_CUES)[0] == 0
