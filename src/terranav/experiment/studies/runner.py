"""Run a study, or what is left of it: the same figures for any number of workers and interruptions."""

from __future__ import annotations

import hashlib
import json
import math
import warnings
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import SeedSequence

import terranav
from terranav._version import __version__
from terranav.core.checks import finite
from terranav.core.errors import ConfigError, DataWarning, StateError
from terranav.experiment.campaign_files import SUMMARY, Columns, Folder
from terranav.experiment.montecarlo import Executor
from terranav.experiment.processes import Processes
from terranav.experiment.studies.study import Case, CaseRuns, Plan, Report, Setup, Study
from terranav.io.files import replacing

#: columns of a chunk besides the figures
_TEXTS = ("scenario", "estimator", "error")
_NUMBERS = ("run", "seed")


@dataclass(frozen=True)
class Part:
    """Some consecutive runs of one case: one file."""

    number: int
    case: Case
    runs: range


@dataclass(frozen=True)
class Prepared:
    """A study that is ready to run.

    Attributes
    ----------
    study : Study
    plan : Plan
    runs : int
        Of each case.
    seed : int
    fingerprint : str
        SHA-256 of all that the figures depend on, the program included.
    """

    study: Study
    plan: Plan
    runs: int
    seed: int
    fingerprint: str

    @property
    def parts(self) -> list[Part]:
        """All runs in parts of `study.chunk`."""
        size = self.study.chunk
        spans = [range(first, min(first + size, self.runs)) for first in range(0, self.runs, size)]
        pairs = [(case, span) for case in self.plan.cases for span in spans]
        return [Part(number, case, span) for number, (case, span) in enumerate(pairs)]

    def keys(self, part: Part) -> set[tuple[str, str, int]]:
        """What the part's file must hold."""
        return {(part.case.name, self.study.of_runs, k) for k in part.runs}


@dataclass(frozen=True)
class StudyResult:
    """What came of a study: its report, how many runs there are, were run now, and failed, and the first error."""

    report: Report
    runs: int
    ran: int
    failed: int
    first_error: str


def prepare_study(study: Study, setup: Setup, runs: int | None = None) -> Prepared:
    """Check what a study is given, and make its cases.

    Raises
    ------
    ConfigError, DataError
        Impossible numbers, data that is not there, or no case that is wanted.
    """
    count = study.runs if runs is None else int(finite("--runs", runs, minimum=2))
    seed = int(finite("--seed", setup.seed, minimum=0))
    plan = study.plan(setup)
    cases = [case for case in plan.cases if not setup.only or any(text in case.name for text in setup.only)]
    if not cases:
        wanted = ", ".join(repr(text) for text in setup.only)
        names = ", ".join(case.name for case in plan.cases) or "none: " + "; ".join(plan.notes)
        raise ConfigError(f"--only {wanted}: no case of {study.name} has such a name; cases: {names}")
    plan = Plan(cases, plan.notes)
    return Prepared(study, plan, count, seed, _fingerprint(study, plan, count, seed))


def run_study(
    prepared: Prepared,
    out: str | Path,
    *,
    executor: Executor | None = None,
    on_run: Callable[[int, int], None] | None = None,
) -> StudyResult:
    """Run a study, or what is left of it in its folder.

    Parameters
    ----------
    prepared : Prepared
    out : str or Path
        A new folder, or one with a part of this very study: study.json, a Parquet file for each part that is done,
        summary.json at the end.
    executor : Executor, optional
        Processes() by default. The figures do not depend on it.
    on_run : callable, optional
        Called with (runs done, runs in all), at first with those that were there.

    Raises
    ------
    ConfigError, DataError
        A folder that holds something else, or cannot be written.
    StateError
        A worker process died (the same call goes on), or every run failed.

    Warns
    -----
    DataWarning
        A part's file is damaged and its runs are run again.
    """
    study, parts = prepared.study, prepared.parts
    folder = Folder(Path(out), prepared.fingerprint, "study", "its runs, seed, cases, maps or the program")
    facts = {"name": study.of_runs, "runs": prepared.runs, "seed": prepared.seed}
    folder.begin({**facts, "cases": [case.facts() for case in prepared.plan.cases]}, resume=True)
    found = {part.number: folder.read(part.number, prepared.keys(part)) for part in parts}
    done = {number: columns for number, columns in found.items() if columns is not None}
    total, ready = prepared.runs * len(prepared.plan.cases), sum(len(columns["run"]) for columns in done.values())
    rows = ready
    if on_run is not None:
        on_run(rows, total)
    missing = [part.number for part in parts if part.number not in done]
    for number, columns in (executor or Processes()).unordered(partial(_done, prepared, folder), missing):
        done[number] = columns
        rows += len(columns["run"])
        if on_run is not None:
            on_run(rows, total)
    runs = list(_by_case(parts, done))
    failed = sum(one.failed for one in runs)
    first_error = next((one.first_error for one in runs if one.failed), "")
    if failed == total:
        raise StateError(f"all {total} runs failed, the first with {first_error}")
    report = study.report(runs)
    report = Report(report.tables, report.verdicts, [*prepared.plan.notes, *report.notes], report.figures)
    with replacing(folder.path / (SUMMARY if study.of_runs == study.name else f"{study.name}.json")) as aside:
        aside.write_text(json.dumps(report_facts(report), indent=2) + "\n", encoding="utf-8")
    return StudyResult(report, total, total - ready, failed, first_error)


def report_facts(report: Report) -> dict[str, Any]:
    """A report as plain JSON values."""
    return {
        "tables": [
            {"title": table.title, "columns": list(table.columns), "rows": [list(row) for row in table.rows]}
            for table in report.tables
        ],
        "verdicts": [vars(verdict) for verdict in report.verdicts],
        "figures": [dict(row) for row in report.figures],
        "notes": list(report.notes),
    }


def seed_of(seed: int, case: str, k: int) -> SeedSequence:
    """Seed of run k of a case: it depends on nothing else."""
    return SeedSequence([seed, zlib.crc32(case.encode()), k])


def _done(prepared: Prepared, folder: Folder, number: int) -> Columns:
    """Run a part and write its file."""
    columns = _flown(prepared, prepared.parts[number])
    folder.write(number, columns)
    return columns


def _flown(prepared: Prepared, part: Part) -> Columns:
    """Every run of a part, a failure as a row with its error."""
    rows = [_row(prepared, part.case, k) for k in part.runs]
    figures = dict.fromkeys(key for row in rows for key in row if key not in (*_TEXTS, *_NUMBERS))
    texts = {key: np.array([row[key] for row in rows], dtype=np.str_) for key in _TEXTS}
    return {
        **texts,
        **{key: np.array([float(row.get(key, math.nan)) for row in rows]) for key in (*_NUMBERS, *figures)},
    }


def _row(prepared: Prepared, case: Case, k: int) -> dict[str, Any]:
    """One run."""
    seeds = seed_of(prepared.seed, case.name, k)
    row: dict[str, Any] = {
        "scenario": case.name, "estimator": prepared.study.of_runs, "error": "",
        "run": k, "seed": int(seeds.generate_state(1)[0]),
    }  # fmt: skip
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DataWarning)  # of thousands of runs: the plan has warned already
            return row | {key: float(value) for key, value in prepared.study.run(case, seeds).items()}
    except Exception as error:  # noqa: BLE001  a failed run is a result of the study
        return row | {"error": f"{type(error).__name__}: {' '.join(str(error).split())}"}


def _by_case(parts: Sequence[Part], done: Mapping[int, Columns]) -> Iterator[CaseRuns]:
    """The parts put together again, case by case."""
    grouped: dict[str, list[Part]] = {}
    for part in parts:
        grouped.setdefault(part.case.name, []).append(part)
    for mine in grouped.values():
        chunks = [done[part.number] for part in mine]
        errors = [text for chunk in chunks for text in chunk["error"].tolist()]
        well = np.array([not text for text in errors])
        names = dict.fromkeys(key for chunk in chunks for key in chunk if key not in (*_TEXTS, *_NUMBERS))
        figures = {
            name: np.concatenate([chunk.get(name, np.full(len(chunk["run"]), math.nan)) for chunk in chunks])[well]
            for name in names
        }
        yield CaseRuns(mine[0].case, figures, int((~well).sum()), next((text for text in errors if text), ""))


def _fingerprint(study: Study, plan: Plan, runs: int, seed: int) -> str:
    """SHA-256 of all that the figures and their parts depend on."""
    facts = {
        "runs_of": study.of_runs, "runs": runs, "seed": seed, "chunk": study.chunk,
        "cases": [case.facts() for case in plan.cases], "terranav": __version__, "program": program_checksum(),
    }  # fmt: skip
    return hashlib.sha256(json.dumps(facts, sort_keys=True, default=str).encode()).hexdigest()


@lru_cache(maxsize=1)
def program_checksum() -> str:
    """SHA-256 of the modules that figures come from: those of another program are not mixed in."""
    root = Path(terranav.__file__).parent
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        place = path.relative_to(root).parts
        if place[0] not in ("app", "live", "matchers") and "papers" not in place:
            digest.update(path.read_bytes())
    return digest.hexdigest()
