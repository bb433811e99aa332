"""The HTML report: one file that needs nothing else, readable by someone who never saw the project."""

from __future__ import annotations

import base64
import math
import re
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any

from terranav.app import reasons, tables, words
from terranav.app.outcome import BASELINE, Outcome

_LONGEST_TEXT = 10_000


def draw(outcome: Outcome) -> dict[str, bytes]:
    """Every picture that the outcome has something for, as PNG by file stem, in the order of the report."""
    from terranav.app.figures import FIGURES
    from terranav.app.style import png

    figures = {stem: make(outcome) for stem, make in FIGURES.items()}
    return {stem: png(figure) for stem, figure in figures.items() if figure is not None}


def render(
    outcome: Outcome,
    pictures: Mapping[str, bytes],
    *,
    verdict: str | None = None,
    facts: Sequence[tuple[str, str]] = (),
) -> str:
    """The report as one HTML text with the pictures inside.

    Parameters
    ----------
    outcome : Outcome
    pictures : mapping of file stem to PNG
        As `draw` makes them.
    verdict : str, optional
        The sentence at its head; by default what the outcome comes to.
    facts : sequence of (what, value)
        Stand before the outcome's own.
    """
    from jinja2 import Environment, StrictUndefined

    from terranav.app.style import STATUS_COLOUR

    template = files("terranav.app").joinpath("templates/report.html.j2").read_text(encoding="utf-8")
    environment = Environment(
        finalize=_unbroken, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    texts = captions(outcome)
    return environment.from_string(template).render(
        title=outcome.recording.name,
        verdict=words.verdict(outcome) if verdict is None else verdict,
        cards=cards(outcome),
        facts=[*facts, *tables.facts(outcome)],
        columns=tables.columns(outcome),
        rows=tables.rows(outcome),
        main=outcome.main,
        pictures=[
            {"stem": stem, "data": base64.b64encode(content).decode(), **texts[stem]}
            for stem, content in pictures.items()
        ],
        integrity=reasons.section(outcome),
        status_colour=STATUS_COLOUR,
        provenance=provenance_rows(outcome),
    )


def cards(outcome: Outcome) -> list[tuple[str, str]]:
    """The few numbers that matter most, each with what it is."""
    name = outcome.main
    fix_s = outcome.first_fix_s(name)
    fix = ("never" if math.isnan(fix_s) else words.duration(fix_s), "until the first fix")
    available = words.percent(outcome.metrics(name)["available"])
    offered = [(available, "of epochs with a fix offered as usable")] if outcome.results[name].watched else []
    if not outcome.recording.has_truth:
        return [
            (words.distance(outcome.final_correction_m(name)), "from the INS position at the end"),
            (words.distance(outcome.final_claim_m(name)), "95 % radius it claims at the end"),
            fix,
            *offered,
        ]
    off = (words.distance(outcome.final_ins_error_m), "INS alone, at the end")
    if name == BASELINE:
        return [off]
    held = outcome.metrics_after_fix(name)
    return [
        off,
        (words.distance(held["r95_m"]), f"{name}, 95 % of the time after its first fix"),
        fix,
        (words.percent(held["contained_95"]), "of epochs since then with the truth inside its 95 % ellipse"),
        *offered,
    ]


def captions(outcome: Outcome) -> dict[str, dict[str, str]]:
    """Title, caption and text for those who cannot see it, for each picture."""
    name, known = outcome.main, outcome.recording.has_truth
    bound, watched = outcome.bound is not None, outcome.results[name].watched
    return {
        "track": {
            "title": "Where it went",
            "caption": (
                f"The map, lit from the north-west. The INS alone (dashed red) leaves the true track (black); {name} "
                "(blue), like any other estimator, is drawn while it says that it has a fix."
                if known
                else f"The map, lit from the north-west, the track the INS indicates (dashed red) and {name}'s (blue)."
            ),
        },
        "error": {
            "title": "How far off",
            "caption": (
                "Distance from the truth, on a logarithmic scale. The blue line should lie inside the shaded 2σ that "
                f"{name} claims for itself nearly always. Below: what each estimator says its position is worth."
                if known
                else f"The shaded 2σ that {name} claims for its position; below, what each estimator says it is worth."
            )
            + (
                " The protection level (dashed blue) is what the error may exceed with no more than the declared risk "
                "while the fix is usable."
                if watched
                else ""
            )
            + (
                " The Cramér-Rao bound (dash-dotted) is the root mean square that no estimator can go below on "
                "average, if the readings are as good as told; a single run may."
                if bound
                else ""
            ),
        },
        "profile": {
            "title": "Does the map fit what was measured?",
            "caption": (
                f"Dots are measurements. The blue line is what the map says where {name} puts the vehicle, the red one "
                "where the INS alone puts it. Below: measurement minus map at both."
            ),
        },
        "north_east": {
            "title": "Is it honest?",
            "caption": f"Both error components of {name} after its first fix, inside the ±2σ band it claims."
            + (" A band as narrow as the dash-dotted bound is as good as it can be." if bound else ""),
        },
        "posterior": {
            "title": "What it believed at the end",
            "caption": (
                f"How probable {name} holds each error of the INS (darker is more), and the 95 % ellipse it claims."
                + (" The cross is the error the INS really had." if known else "")
            ),
        },
        "ahead": {
            "title": "Terrain ahead",
            "caption": (
                "Altitude over the ground below the corrected track. Shaded red where, looking two minutes ahead with "
                f"the position and covariance of {name}, the clearance may fall under the margin with more than 1 % "
                "probability; shaded yellow where the map does not say."
            ),
        },
    }


def provenance_rows(outcome: Outcome) -> list[tuple[str, str]]:
    """What it takes to make the same report again."""
    found: dict[str, str] = {"command": outcome.command, "seed": str(outcome.seed)}
    for result in outcome.results.values():
        for key, value in result.provenance.items():
            if key in ("estimator", "ins", "prior", "command", "seed", "wall_s"):
                continue
            found.setdefault(key, _told(value))
    for name, result in outcome.results.items():
        settings = (result.provenance.get("estimator") or {}).get("settings") or {}
        wall = result.provenance.get("wall_s")
        took = f"; took {wall:.2f} s" if isinstance(wall, (int, float)) else ""
        found[name] = (_told(settings) or "no settings") + took
    found["ins"] = found.get("ins", "")
    found["INS grade"] = _told({key: value for key, value in vars(outcome.ins).items() if value})
    return [(key, text) for key, text in found.items() if text]


def _unbroken(value: Any) -> Any:
    """Keep numbers and their units on one line; pictures are left alone."""
    if not isinstance(value, str) or len(value) > _LONGEST_TEXT:
        return value
    return re.sub(r"(?<=\d) (?=(?:%|m|km|s|min|h)(?![\w/]))|(?<=\d h) (?=\d)", "\N{NO-BREAK SPACE}", value)


def _told(value: Any) -> str:
    """Nested plain values as text."""
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_told(entry)}" for key, entry in value.items())
    if isinstance(value, (list, tuple)):
        return "; ".join(_told(entry) for entry in value)
    return f"{value:g}" if isinstance(value, float) else str(value)
