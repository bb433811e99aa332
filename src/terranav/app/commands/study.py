"""terranav study: what the navigator is worth, in tables with intervals beside what was asked of it."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from terranav.app.commands import options

if TYPE_CHECKING:
    from rich.table import Table

    from terranav.experiment.studies.runner import Prepared, StudyResult
    from terranav.experiment.studies.study import Report

Texts = tuple[str, Sequence[str], Sequence[Sequence[str]]]  # title, heads, rows

_DEFAULT = Path("terranav-study")


def study(
    name: Annotated[
        str,
        typer.Argument(metavar="NAME", help="bound, consistency, integrity, monitor, plan, real, robust or routes."),
    ],
    *,
    runs: Annotated[
        int | None, typer.Option(metavar="N", help="Runs of each case; the study's own number unless given.")
    ] = None,
    seed: options.Seed = 0,
    data: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder of real maps and recordings; else $TERRANAV_SHARED/data."),
    ] = None,
    maps: Annotated[
        list[Path] | None, typer.Option("--map", metavar="FILE", help="One more terrain map for tracks. Repeatable.")
    ] = None,
    tracks: Annotated[int | None, typer.Option(metavar="N", help="Tracks on each map, where tracks are drawn.")] = None,
    only: Annotated[
        list[str] | None, typer.Option(metavar="TEXT", help="Only cases with this text in their name. Repeatable.")
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Setting of the estimator in study. Repeatable."),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(metavar="N", help="Processes; one a core unless given. Same figures.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder of the runs; a stopped study goes on in it. terranav-study/NAME-... unless given, '...' "
            "telling apart runs, seed, cases, maps and program.",
        ),
    ] = None,
    as_json: options.Json = False,
) -> int:
    """Run a study of the navigator: its table with 95 % intervals, beside what was asked; goes on where it stopped."""
    from terranav.app.console import INCOMPLETE, OK, complain, show_json
    from terranav.app.given import settings_from
    from terranav.app.progress import run_bar
    from terranav.core.checks import finite
    from terranav.experiment.processes import Processes
    from terranav.experiment.studies.registry import study_named
    from terranav.experiment.studies.runner import prepare_study, report_facts, run_study
    from terranav.experiment.studies.study import Setup

    wanted = study_named(name)
    at_once = (os.cpu_count() or 1) if workers is None else int(finite("--workers", workers, minimum=1))
    of_map = None if tracks is None else int(finite("--tracks", tracks, minimum=1))
    setup = Setup(data, tuple(maps or ()), of_map, seed, tuple(only or ()), settings_from(settings or ()))
    prepared = prepare_study(wanted, setup, runs)
    folder = out or _DEFAULT / f"{wanted.of_runs}-{prepared.fingerprint[:8]}"
    with run_bar() as on_run:
        result = run_study(prepared, folder, executor=Processes(at_once), on_run=on_run)
    if as_json:
        counts = {"runs": result.runs, "run_now": result.ran, "failed": result.failed}
        show_json({"study": name, "out": str(folder), **counts, **report_facts(result.report)})
    else:
        _show(prepared, result, folder)
    if result.failed:
        complain(f"{result.failed} of {result.runs} runs failed, the first with {result.first_error}", "warning")
    return INCOMPLETE if result.failed else OK


def _show(prepared: Prepared, result: StudyResult, folder: Path) -> None:
    """Tables, verdicts, notes, and where the runs are."""
    from terranav.app.console import show

    show(prepared.study.title)
    for number, table in enumerate(_tables(result.report)):
        show(table) if number == 0 else show("", table)
    for note in result.report.notes:
        show(f"note: {note}")
    show(f"{result.runs} runs, {result.ran} of them now; folder: {folder}")
    sys.stdout.flush()


def _tables(report: Report) -> list[Table]:
    """What the study measured, and the verdicts as the last table."""
    from rich import box
    from rich.table import Table as RichTable
    from rich.text import Text

    texts: list[Texts] = [(one.title, one.columns, one.rows) for one in report.tables]
    if report.verdicts:
        words = {True: "yes", False: "no", None: "–"}
        asked = [(one.text, one.asked, one.measured, words[one.met]) for one in report.verdicts]
        texts.append(("Asked and measured", ("figure", "asked", "measured (95 % interval)", "met"), asked))
    tables: list[RichTable] = []
    for title, columns, rows in texts:
        table = RichTable(title=Text(title), title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
        for i, head in enumerate(columns):
            table.add_column(Text(head), justify="left" if i == 0 else "right", overflow="fold")  # [m] is no markup
        for row in rows:
            table.add_row(*map(Text, row))
        tables.append(table)
    return tables
