"""From paper numbers to tables: run each study with progress, write it as soon as it is done, then go on."""

from __future__ import annotations

import base64
import contextlib
import re
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

from terranav.app.console import INCOMPLETE, OK, as_json, complain, one_line, show_json, width
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
from terranav.app.words import duration
from terranav.core.errors import ConfigError, DataError, TerranavError
from terranav.experiment.papers.outcome import Setup
from terranav.experiment.papers.registry import paper_number, papers, reproduce, title

OnRun = Callable[[int, int], None]

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
    """

    numbers: Sequence[str]
    setup: Setup
    out: Path | None = None
    json: bool = False
    command: str = ""


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
    attempts: list[Attempt] = []
    pictures: dict[str, list[Picture]] = {}
    status = OK
    for place, number in enumerate(task.numbers, 1):
        attempt, error = tried(number, task.setup, f"{number} ({place} of {len(task.numbers)})")
        attempts.append(attempt)
        if error is not None:
            if len(task.numbers) == 1 and isinstance(error, (ConfigError, DataError)):
                raise error  # what was typed does not suit this paper: there is nothing else to show
            complain(f"paper {number}: {attempt.error}")
            status = INCOMPLETE
        if task.out is not None and not keep(task, attempts, pictures, task.out):
            status = status or INCOMPLETE
        if not task.json:
            print_parts(*shown(attempt, width() if sys.stdout.isatty() else None))
            sys.stdout.flush()
    if task.json:
        show_json(document(task, attempts))
        return status
    if len(attempts) > 1:
        print_parts(verdict_table(attempts))
    print_parts(summary(attempts))
    if task.out is not None:
        print_parts(f"summary: {task.out / PAGE}")
    return status


def tried(number: str, setup: Setup, label: str) -> tuple[Attempt, Exception | None]:
    """Run one paper's study; an exception becomes its outcome."""
    name = ""
    start_s = time.perf_counter()
    try:
        with progress(label) as on_run:
            name = title(number)
            found = reproduce(number, replace(setup, on_run=on_run))
        return Attempt(number, found.title, time.perf_counter() - start_s, found), None
    except Exception as error:  # noqa: BLE001  one paper's failure must not cost the others
        text = one_line(error if isinstance(error, TerranavError) else f"{type(error).__name__}: {error}")
        full = traceback.format_exc()
        return Attempt(number, name, time.perf_counter() - start_s, error=text, traceback=full), error


@dataclass(frozen=True)
class Picture:
    """A figure of a paper as a file: its stem, its title and its PNG."""

    stem: str
    title: str
    png: bytes


def keep(task: Task, attempts: Sequence[Attempt], pictures: dict[str, list[Picture]], out: Path) -> bool:
    """Write what the latest paper found, then draw it, then the page of all so far; False when something failed."""
    latest = attempts[-1]
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
        facts=facts(task, attempts),
    )


def facts(task: Task, attempts: Sequence[Attempt]) -> list[tuple[str, str]]:
    """What it takes to make the same page again."""
    from terranav._version import __version__

    maps = "; ".join(f"{chart.name} ({chart.kind})" for chart in task.setup.maps) or "each paper's default ones"
    return [
        ("command", task.command),
        ("terranav", __version__),
        ("--runs", str(task.setup.runs)),
        ("seed", str(task.setup.seed)),
        ("maps", maps),
        ("took", duration(sum(attempt.wall_s for attempt in attempts))),
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


@contextlib.contextmanager
def progress(label: str) -> Iterator[OnRun | None]:
    """Give a callback that moves a bar with the time left on stderr; None when stderr is no terminal.

    A paper may make several studies of runs one after the other: the bar starts again for each.
    """
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("runs, left:"))
    console = Console(file=sys.stderr)
    with Progress(
        *columns, TimeRemainingColumn(), TextColumn("spent:"), TimeElapsedColumn(), console=console, transient=True,
        speed_estimate_period=120.0,
    ) as bars:  # fmt: skip
        task = bars.add_task(f"paper {label}", total=None)
        before, study = 0, 1

        def on_run(done: int, of: int) -> None:
            nonlocal before, study, task
            if done <= before:
                study += 1
                bars.remove_task(task)
                task = bars.add_task(f"paper {label}, study {study}", total=of)
            before = done
            bars.update(task, completed=done, total=of)

        yield on_run
