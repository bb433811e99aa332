"""The page of a replay: the report of a run, with the verdict and the facts of the log at its head."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from terranav.app import report
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
    """The report of a flight with the verdict of the replay and the facts of the log at its head."""
    said = verdict([flight])
    facts = [*log_pairs(log), *denied_pairs([flight.denied])]
    return report.render(flight.outcome, pictures, verdict=f"{said[0].upper()}{said[1:]}.", facts=facts)
