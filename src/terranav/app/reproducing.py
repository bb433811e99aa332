"""From paper numbers to tables: run each study with progress, write it as soon as it is done, then go on."""

from __future__ import annotations

import base64
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from terranav.app.console import INCOMPLETE, OK, as_json, complain, show_json, width
from terranav.app.reproduction import (
    Attempt,
    numeric_columns,
    print_parts,
    shown,
    summary,
    told,
    verdict_table,
    verdicts,
)
from terranav.app.studies import attempts, progress
from terranav.core.errors import ConfigError
from terranav.experiment.papers.outcome import Setup
from terranav.experiment.papers.registry import paper_number, papers

DEFAULT_FOLDER = "terranav-reproduce"
SUMMARY, PAGE = "reproduction.json", "reproduction.html"


@dataclass(frozen=True)
class Task:
    """What is wanted.

    Attributes
    ----------
    numbers : sequence of str
        Papers, in the order in which they are run.
    setup : Setup
        Without `on_run`.
    out : Path or None
        An existing folder for the files.
    json : bool
        One JSON document on stdout at the end instead of the tables as they come.
    command : str
        As it was typed.
    processes : int
        How many papers at the same time.
    """

    numbers: Sequence[str]
    setup: Setup
    out: Path | None = None
    json: bool = False
    command: str = ""
    processes: int = 1


def chosen(texts: Sequence[str]) -> list[str]:
    """Numbers of the papers that were typed, each once; 'all' is every one that there is.

    Raises
    ------
    ConfigError
        For a number without a paper.
    """
    numbers = [number for text in texts for number in (papers() if text == "all" else [paper_number(text)])]
    return list(dict.fromkeys(numbers))


def conclude(task: Task) -> int:
    """Reproduce every paper wanted, keep what came of each at once, and show it; return the exit status."""
    done: dict[str, Attempt] = {}
    pictures: dict[str, list[Picture]] = {}
    unshown = list(task.numbers)
    status = OK
    try:
        with progress() as bars:
            for attempt in attempts(task.numbers, task.setup, task.processes, bars.on_run):
                done[attempt.paper] = attempt
                if attempt.refused and len(task.numbers) == 1:
                    raise ConfigError(attempt.error)  # there is nothing else to show
                if attempt.error:
                    complain(f"paper {attempt.paper}: {attempt.error}")
                    status = INCOMPLETE
                if task.out is not None and not keep(task, in_order(task, done), attempt, pictures, task.out):
                    status = INCOMPLETE
                with bars.aside():
                    while not task.json and unshown and unshown[0] in done:
                        show_attempt(done[unshown.pop(0)])
    except KeyboardInterrupt:
        for number in unshown if not task.json else ():
            if number in done:
                show_attempt(done[number])
        raise
    found = in_order(task, done)
    if task.json:
        show_json(document(task, found))
        return status
    if len(found) > 1:
        print_parts(verdict_table(found))
    print_parts(summary(found))
    if task.out is not None:
        print_parts(f"summary: {task.out / PAGE}")
    return status


def in_order(task: Task, done: Mapping[str, Attempt]) -> list[Attempt]:
    """What is done, in the order in which it was asked for."""
    return [done[number] for number in task.numbers if number in done]


def show_attempt(attempt: Attempt) -> None:
    """Print a paper's outcome at once, also into a pipe."""
    print_parts(*shown(attempt, width() if sys.stdout.isatty() else None))
    sys.stdout.flush()


@dataclass(frozen=True)
class Picture:
    """A figure of a paper as a file: its stem, its title and its PNG."""

    stem: str
    title: str
    png: bytes


def keep(
    task: Task, attempts: Sequence[Attempt], latest: Attempt, pictures: dict[str, list[Picture]], out: Path
) -> bool:
    """Write what the latest paper found, then draw it, then the page of all so far; False when something failed."""
    steps: tuple[Callable[[], None], ...] = (
        lambda: _write(out / f"{latest.paper}.json", as_json(latest.as_json()) + "\n"),
        lambda: _write(out / SUMMARY, as_json(document(task, attempts)) + "\n"),
        lambda: pictures.update({latest.paper: list(_figures(latest, out))}),
        lambda: _write(out / PAGE, page(task, attempts, pictures)),
    )
    complete = True
    for step in steps:
        try:
            step()
        except Exception as error:  # noqa: BLE001  a full disk or a picture costs only what it touches
            complain(f"paper {latest.paper}: not everything was written to {out} ({type(error).__name__}: {error})")
            complete = False
    return complete


def document(task: Task, attempts: Sequence[Attempt]) -> dict[str, Any]:
    """Everything that was found, for programs."""
    from terranav._version import __version__

    return {
        "terranav": __version__,
        "command": task.command,
        "runs": task.setup.runs,
        "seed": task.setup.seed,
        "maps": [chart.info() for chart in task.setup.maps],
        "verdicts": verdicts(attempts),
        "papers": {attempt.paper: attempt.as_json() for attempt in attempts},
    }


def page(task: Task, attempts: Sequence[Attempt], pictures: Mapping[str, Sequence[Picture]]) -> str:
    """The HTML summary with its pictures inside."""
    from jinja2 import Environment, StrictUndefined

    template = files("terranav.app").joinpath("templates/reproduction.html.j2").read_text(encoding="utf-8")
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(template).render(
        attempts=attempts,
        verdict=summary(attempts),
        counts={name: count for name, count in verdicts(attempts).items() if count},
        missing=[number for number in task.numbers if number not in [attempt.paper for attempt in attempts]],
        pictures={
            paper: [(picture.stem, picture.title, base64.b64encode(picture.png).decode()) for picture in drawn]
            for paper, drawn in pictures.items()
        },
        told=told,
        numeric=numeric_columns,
        facts=facts(task),
    )


def facts(task: Task) -> list[tuple[str, str]]:
    """What it takes to make the same page again."""
    from terranav._version import __version__

    maps = "; ".join(f"{chart.name} ({chart.kind})" for chart in task.setup.maps) or "each paper's default ones"
    return [
        ("command", task.command),
        ("terranav", __version__),
        ("--runs", str(task.setup.runs)),
        ("seed", str(task.setup.seed)),
        ("maps", maps),
    ]


def _figures(attempt: Attempt, out: Path) -> Iterator[Picture]:
    """Write the data of each figure, then its picture."""
    from terranav.app.paper_figures import data_csv, draw
    from terranav.app.style import png
    from terranav.io.files import replacing

    for figure in attempt.found.figures if attempt.found is not None else ():
        stem = re.sub(r"[^\w.+-]+", "-", f"{attempt.paper}-{figure.name}")
        _write(out / f"{stem}.csv", data_csv(figure))
        picture = Picture(stem, figure.title, png(draw(figure)))
        with replacing(out / f"{stem}.png") as path:
            path.write_bytes(picture.png)
        yield picture


def _write(file: Path, text: str) -> None:
    """Write a text so that a reader sees the old one or the new one."""
    from terranav.io.files import replacing

    with replacing(file) as path:
        path.write_text(text, encoding="utf-8")
