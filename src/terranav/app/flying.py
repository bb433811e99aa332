"""From inputs to answers: run the estimators with progress, save first, draw after, and show what came out."""

from __future__ import annotations

import contextlib
import functools
import re
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from terranav.app.console import INCOMPLETE, OK, as_json, complain, show, show_json, show_pairs, width
from terranav.app.outcome import BASELINE, Outcome

if TYPE_CHECKING:
    from terranav.core.ins_grade import InsGrade
    from terranav.core.recording import Recording
    from terranav.core.records import Prior
    from terranav.experiment.result import Result
    from terranav.experiment.scenario import Scenario
    from terranav.maps.geoid import Geoid
    from terranav.maps.map import Map

Methods = Mapping[str, tuple[str, Mapping[str, Any]]]
OnEpoch = Callable[[str, int, int], None]

METRICS = "metrics.json"


@dataclass(frozen=True)
class Wanted:
    """What is to come of a run.

    Attributes
    ----------
    out : Path or None
        An existing folder for the result files and the report.
    json : bool
        Machine-readable on stdout instead of the table.
    since_s : float
        Leave so much of the start out of the figures [s].
    command : str
        As it was typed.
    asked : str
        The estimator that the report is about; empty for the most accurate one.
    smooth : bool
        Also smooth every method but the INS alone.
    """

    out: Path | None = None
    json: bool = False
    since_s: float = 0.0
    command: str = ""
    asked: str = ""
    smooth: bool = False


def fly(
    rec: Recording,
    maps: tuple[Map, ...],
    ins: InsGrade | None,
    *,
    methods: Methods,
    seed: int,
    wanted: Wanted,
    prior: Prior | None = None,
    geoid: Sequence[Geoid] = (),
) -> Outcome:
    """Run every method over the recording; `methods` maps a label to an estimator's name and its settings."""
    from terranav.core.checks import finite
    from terranav.core.ins_grade import InsGrade
    from terranav.experiment.compare import compare

    since_s = finite("--since", wanted.since_s, minimum=0.0)
    with progress() as on_epoch:
        results = compare(methods, rec, maps, seed=seed, ins=ins, prior=prior, geoid=geoid, on_epoch=on_epoch)
        if wanted.smooth:
            same = {"seed": seed, "prior": prior, "geoid": geoid}
            results |= _smoothed(rec, maps, ins, methods=methods, same=same, on_epoch=on_epoch)
    told = ins or rec.ins or InsGrade()
    return Outcome(rec, maps, results, told, seed, since_s, wanted.command, wanted.asked)


def _smoothed(
    rec: Recording,
    maps: tuple[Map, ...],
    ins: InsGrade | None,
    *,
    methods: Methods,
    same: Mapping[str, Any],
    on_epoch: OnEpoch | None,
) -> dict[str, Result]:
    """The smoothed result of every method but the INS alone."""
    from terranav.core.errors import DataWarning
    from terranav.experiment.smooth import smooth, smoothed_name

    results: dict[str, Result] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)  # the run before has said it
        for label, (name, settings) in methods.items():
            if name != BASELINE:
                title = smoothed_name(label)
                each = None if on_epoch is None else functools.partial(on_epoch, title)
                results[title] = smooth(name, rec, maps, ins=ins, on_epoch=each, **same, **settings)
    return results


def fly_scenario(scenario: Scenario, names: Sequence[str], seed: int | None, wanted: Wanted) -> Outcome:
    """Simulate a scenario and run its estimators (or the named ones, or else all) over the recording."""
    from terranav.app.console import working
    from terranav.experiment.registry import estimators
    from terranav.experiment.simulate import simulate

    seed = scenario.seed if seed is None else seed
    own = scenario.methods()
    chosen = {name: own.get(name, (name, {})) for name in names} or own
    methods = {**with_baseline([]), **chosen} if chosen else with_baseline(estimators())
    with working("flying the scenario"):
        maps, rec = scenario.open_maps(), simulate(scenario, seed=seed)
    told, prior = scenario.told_ins(), scenario.initial_prior()
    return fly(rec, maps, told, prior=prior, methods=methods, seed=seed, wanted=wanted)


def with_baseline(names: list[str], settings: Mapping[str, Any] | None = None) -> Methods:
    """The methods asked for with the INS alone before them, which every table shows."""
    first = [] if BASELINE in names else [BASELINE]
    return {name: (name, {} if name in first else settings or {}) for name in [*first, *names]}


def conclude(outcome: Outcome, wanted: Wanted) -> int:
    """Save the results, draw the report, show the table; return the exit status."""
    from rich.text import Text

    from terranav.app.tables import facts, rich_table
    from terranav.app.words import verdict

    status = OK
    summary = outcome.as_json()
    if wanted.out is not None:
        summary["files"] = [*[_result_file(label) for label in outcome.results], METRICS]
        save(outcome, summary, wanted.out)
        status = report(outcome, wanted.out)
    if wanted.json:
        show_json(summary)
        return status
    show_pairs(facts(outcome))
    show(rich_table(outcome, width()), Text(verdict(outcome), style="bold"))
    if wanted.out is not None and status == OK:
        show(Text(f"report: {wanted.out / 'report.html'}"))
    return status


def save(outcome: Outcome, summary: Mapping[str, Any], out: Path) -> None:
    """Write the results and the metrics, before anything that could fail for a lesser reason."""
    from terranav.io.files import replacing

    for label, result in outcome.results.items():
        result.save(out / _result_file(label))
    with replacing(out / METRICS) as path:
        path.write_text(as_json(summary) + "\n", encoding="utf-8")


def report(outcome: Outcome, out: Path) -> int:
    """Draw the pictures and write the report; a failure costs only the report."""
    try:
        from terranav.app.report import draw, render
        from terranav.io.files import replacing

        pictures = draw(outcome)
        for stem, content in pictures.items():
            with replacing(out / f"{stem}.png") as path:
                path.write_bytes(content)
        with replacing(out / "report.html") as path:
            path.write_text(render(outcome, pictures), encoding="utf-8")
    except Exception as error:  # noqa: BLE001  whatever goes wrong with a picture, the results are already saved
        complain(f"the report was not written ({type(error).__name__}: {error}); the results are in {out}")
        return INCOMPLETE
    return OK


def _result_file(label: str) -> str:
    """Name of a result's file: what a file name may not hold becomes a dash."""
    plain = re.sub(r"[^\w.+-]+", "-", label)
    return f"result-{plain}.parquet"


@contextlib.contextmanager
def progress() -> Iterator[OnEpoch | None]:
    """Give a callback that moves one bar per estimator on stderr; None when stderr is no terminal."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description:<12}"), BarColumn(), TextColumn("{task.percentage:>3.0f} %"))
    with Progress(*columns, TimeElapsedColumn(), console=Console(file=sys.stderr), transient=True) as bars:
        tasks: dict[str, TaskID] = {}

        def on_epoch(label: str, done: int, of: int) -> None:
            if label not in tasks:
                tasks[label] = bars.add_task(label, total=of)
            if done == of or done % max(of // 200, 1) == 0:
                bars.update(tasks[label], completed=done)

        yield on_epoch
