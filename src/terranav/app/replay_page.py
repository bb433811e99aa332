"""The page of a replay: the report of a run, with the verdict and the facts of the log at its head."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from importlib.resources import files
from typing import TYPE_CHECKING

from terranav.app import reasons, report, tables
from terranav.app.console import INCOMPLETE, OK, complain
from terranav.app.replay_words import Flight, denied_pairs, log_pairs, verdict

if TYPE_CHECKING:
    from pathlib import Path

    from terranav.io.logs import Log


def write_page(log: Log, flight: Flight, folder: Path) -> int:
    """Draw the pictures and write report.html into a folder; a failure costs only the page."""
    from terranav.io.files import replacing

    try:
        pictures = report.draw(flight.outcome)
        for stem, content in pictures.items():
            with replacing(folder / f"{stem}.png") as path:
                path.write_bytes(content)
        with replacing(folder / "report.html") as path:
            path.write_text(page(log, flight, pictures), encoding="utf-8")
    except Exception as error:  # noqa: BLE001  whatever goes wrong with a picture, the results are already saved
        complain(f"the report was not written ({type(error).__name__}: {error}); the results are in {folder}")
        return INCOMPLETE
    return OK


def page(log: Log, flight: Flight, pictures: Mapping[str, bytes]) -> str:
    """The page as one HTML text with the pictures inside; `report.render`, but for its head."""
    from jinja2 import Environment, StrictUndefined

    from terranav.app.style import STATUS_COLOUR

    outcome = flight.outcome
    template = files("terranav.app").joinpath("templates/report.html.j2").read_text(encoding="utf-8")
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    texts = report.captions(outcome)
    said = verdict([flight])
    return environment.from_string(template).render(
        title=outcome.recording.name,
        verdict=f"{said[0].upper()}{said[1:]}.",
        cards=report.cards(outcome),
        facts=[*log_pairs(log), *denied_pairs([flight.denied]), *tables.facts(outcome)],
        columns=tables.columns(outcome),
        rows=tables.rows(outcome),
        main=outcome.main,
        pictures=[
            {"stem": stem, "data": base64.b64encode(content).decode(), **texts[stem]}
            for stem, content in pictures.items()
        ],
        integrity=reasons.section(outcome),
        status_colour=STATUS_COLOUR,
        provenance=report.provenance_rows(outcome),
    )
