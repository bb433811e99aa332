"""terranav campaign: many runs of scenarios and estimators, resumable, with intervals."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from terranav.app.commands import options

if TYPE_CHECKING:
    from rich.table import Table

    from terranav.experiment.campaign import Summary
    from terranav.experiment.montecarlo import Interval


def campaign(
    file: Annotated[Path, typer.Argument(metavar="FILE.toml", help="What to run: see examples/campaign.toml.")],
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="Folder of the campaign; a new one, or with --resume its own.")
    ],
    workers: Annotated[
        int | None, typer.Option(metavar="N", help="Runs at the same time; one a core unless given. Same figures.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on where a stopped or killed campaign was.")] = False,
    as_json: options.Json = False,
) -> int:
    """Run scenarios x estimators x seeds, and sum them up with 95 % intervals; a killed campaign can be resumed."""
    from terranav.app.console import INCOMPLETE, OK, complain, show, show_json
    from terranav.app.progress import run_bar
    from terranav.core.checks import finite
    from terranav.experiment.campaign import Campaign, run_campaign, summary_facts
    from terranav.experiment.montecarlo import Threads

    threads = None if workers is None else Threads(int(finite("--workers", workers, minimum=1)))
    plan = Campaign.from_toml(file)
    with run_bar() as on_run:
        result = run_campaign(plan, out, resume=resume, executor=threads, on_run=on_run)
    summaries = result.summary()
    rows = len(result.columns["run"])
    if as_json:
        facts = summary_facts(summaries)
        show_json({"campaign": plan.name, "out": str(out), "runs": rows, "run_now": result.ran, "summary": facts})
    else:
        show(_table(plan.name, summaries), f"{rows} runs, {result.ran} of them now; folder: {out}")
    failed = [one for one in summaries if one.failed]
    if failed:
        count = sum(one.failed for one in failed)
        complain(f"{count} of {rows} runs failed, the first with {failed[0].first_error}", "warning")
    return INCOMPLETE if failed else OK


def _table(name: str, summaries: list[Summary]) -> Table:
    """One row for each scenario and estimator."""
    from rich.table import Table
    from rich.text import Text

    from terranav.app.words import percent

    table = Table(title=f"{name}: 95 % intervals over runs")
    for head in ("scenario", "estimator"):
        table.add_column(head, overflow="fold")
    for head in ("runs", "failed", "DRMS [m]", "CEP [m]", "match [%]", "in 95 %", "fixed", "first fix [s]"):
        table.add_column(Text(head), justify="right", overflow="fold")  # no markup: [m] is a unit
    for one in summaries:
        figures = one.figures
        table.add_row(
            one.scenario, one.estimator, str(one.runs), str(one.failed or ""),
            _text(figures["drms_m"]), _text(figures["cep_m"]), _text(figures["match_rate"], 100.0),
            percent(figures["contained_95"].value), percent(figures["fixed"].value), _text(figures["first_fix_s"]),
        )  # fmt: skip
    return table


def _text(interval: Interval, scale: float = 1.0) -> str:
    """An interval in a cell."""
    from terranav.app.words import NOTHING

    return interval.text(0, scale) if math.isfinite(interval.value) else NOTHING
