"""Campaign: scenarios x estimators x seeds, in chunks that survive a kill, with the same figures for any workers."""

from __future__ import annotations

import hashlib
import json
import math
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self, cast

import numpy as np
from numpy.random import SeedSequence
from numpy.typing import NDArray
from pydantic import PrivateAttr, model_validator

from terranav._version import __version__
from terranav.core.errors import ConfigError
from terranav.core.ins_grade import InsGrade
from terranav.core.records import Prior
from terranav.experiment.campaign_files import SUMMARY, Columns, Folder, joined
from terranav.experiment.montecarlo import Executor, Interval, Threads, bootstrap
from terranav.experiment.registry import make_estimator
from terranav.experiment.run import run
from terranav.experiment.scenario import Scenario
from terranav.experiment.scenario_tables import NAME, NAME_EXPECTED, EstimatorTable, Table, key
from terranav.experiment.simulate import simulate
from terranav.experiment.validation import toml_values, validated
from terranav.io.files import replacing
from terranav.maps.map import Map

#: figures of one run, from Result.metrics
FIGURES = (
    "drms_m", "cep_m", "r95_m", "mean_m", "max_m", "final_m", "match_rate", "nees", "contained_95", "first_fix_s",
    "lost_s",
)  # fmt: skip
_WHOLE = "a whole number >= 1"


class ScenarioEntry(Table):
    """[[scenarios]]: a scenario file, with some of its keys changed."""

    file: str = key(..., "a path, or 'demo'", "Scenario file, relative to the campaign's folder; 'demo': the demo's")
    name: str | None = key(None, NAME_EXPECTED, "What to call it in tables; else the scenario's name", pattern=NAME)
    change: dict[str, Any] = key({}, "a table", "Keys to change, nested as in the scenario: change.ins.grade = ...")


class Campaign(Table):
    """Scenarios, estimators and a number of runs; see examples/campaign.toml for every key."""

    name: str = key("campaign", NAME_EXPECTED, "What to call it; else the file's name", pattern=NAME)
    seed: int = key(0, "a whole number >= 0", "Seed of all runs; the scenarios' own do not count", ge=0)
    runs: int = key(..., _WHOLE, "Runs of each scenario; every estimator flies the same ones", ge=1)
    chunk: int = key(10, _WHOLE, "Runs of a scenario in one file: what a kill can cost", ge=1)
    since_s: float = key(0.0, "a number >= 0", "Leave so much of each start out of the figures [s]", ge=0)
    scenarios: list[ScenarioEntry] = key(..., "at least one table [[scenarios]]", "What is flown", min_length=1)
    estimators: list[EstimatorTable] = key([], "tables [[estimators]]", "Methods; else each scenario's own")

    _folder: Path = PrivateAttr(default=Path())

    @model_validator(mode="after")
    def _check(self) -> Self:
        labels = [table.label or table.name for table in self.estimators]
        twice = next((label for label in labels if labels.count(label) > 1), None)
        if twice is not None:
            raise ConfigError(f"[[estimators]] has {twice!r} twice, expected a label of its own for each")
        return self

    @classmethod
    def from_toml(cls, path: str | Path) -> Campaign:
        """Read a campaign file.

        Parameters
        ----------
        path : str or Path
            Its folder is where relative scenario files are looked for.

        Raises
        ------
        ConfigError
            Naming the file, the table, the key, the value and what was expected.
        """
        file, values = toml_values(path, "a campaign")
        return cls.from_dict({"name": file.stem, **values}, folder=file.parent, where=str(path))

    @classmethod
    def from_dict(cls, values: Mapping[str, Any], *, folder: str | Path = ".", where: str = "campaign") -> Campaign:
        """Make a campaign of nested tables; `folder` and `where` as for `Scenario.from_dict`, errors as `from_toml`."""
        campaign = cast("Campaign", validated(cls, values, where))
        campaign._folder = Path(folder)
        return campaign

    def cases(self) -> list[Case]:
        """The scenarios, checked with their maps and estimators.

        Raises
        ------
        ConfigError, DataError
            A scenario that cannot be read, two of one name, no estimator, or one that cannot be built.
        """
        cases = [self._case(entry) for entry in self.scenarios]
        names = [case.name for case in cases]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise ConfigError(
                f"{self.name}: two [[scenarios]] are called {twice!r}, expected a name of its own for each"
            )
        return cases

    def _case(self, entry: ScenarioEntry) -> Case:
        """One scenario with its changes."""
        if entry.file == "demo":
            from terranav.experiment.demo import demo_scenario

            base = demo_scenario()
        else:
            base = Scenario.from_toml(self._folder / entry.file)
        folder = Path() if entry.file == "demo" else (self._folder / entry.file).parent
        values = _merged(base.to_dict(), entry.change) if entry.change else base.to_dict()
        scenario = Scenario.from_dict(values, folder=folder, where=f"{self.name}: {entry.name or entry.file}")
        own = {table.label or table.name: (table.name, dict(table.settings)) for table in self.estimators}
        case = Case(entry.name or scenario.name, scenario, own or scenario.methods())
        if not case.methods:
            raise ConfigError(f"{self.name}: {case.name!r} has no estimator, expected tables [[estimators]]")
        for name, settings in case.methods.values():
            make_estimator(name, case.maps, case.ins, **settings)
        return case


@dataclass(frozen=True)
class Case:
    """One scenario of a campaign and the methods that fly it, label -> (name, settings)."""

    name: str
    scenario: Scenario
    methods: dict[str, tuple[str, dict[str, Any]]]

    @cached_property
    def maps(self) -> tuple[Map, ...]:
        """The scenario's maps, read once."""
        return self.scenario.open_maps()

    @property
    def ins(self) -> InsGrade:
        """What the estimators are told of the INS."""
        return self.scenario.told_ins()

    @property
    def prior(self) -> Prior:
        """What they believe at the start."""
        return self.scenario.initial_prior()

    def facts(self) -> dict[str, Any]:
        """All that its figures depend on, as plain JSON values."""
        maps = [(chart.checksum, chart.sigma) for chart in self.maps]
        return {"name": self.name, "scenario": self.scenario.to_dict(), "methods": self.methods, "maps": maps}


@dataclass(frozen=True)
class Chunk:
    """Some consecutive runs of one case."""

    number: int
    case: Case
    runs: range

    @property
    def keys(self) -> set[tuple[str, str, int]]:
        """(scenario, estimator, run) of each row."""
        return {(self.case.name, label, k) for label in self.case.methods for k in self.runs}


@dataclass(frozen=True)
class Summary:
    """Figures of one estimator in one scenario over the runs."""

    scenario: str
    estimator: str
    runs: int
    failed: int
    first_error: str
    figures: dict[str, Interval]


@dataclass(frozen=True)
class CampaignResult:
    """All runs of a campaign.

    Attributes
    ----------
    columns : dict of name to (rows,) array
        scenario, estimator, run, seed, error (empty where the run went well), and the figures of each run, NaN where it
        failed. A row for each scenario, estimator and run, in the order of the campaign.
    ran : int
        Rows that were run now; the others were there.
    """

    columns: Columns
    ran: int

    def summary(self) -> list[Summary]:
        """Means over the runs of each estimator in each scenario, with 95 % bootstrap intervals.

        `drms_m` is the root of the mean square over runs, `first_fix_s` the mean of the runs with a fix, and `fixed`
        their share.
        """
        pairs = dict.fromkeys(zip(self.columns["scenario"].tolist(), self.columns["estimator"].tolist(), strict=True))
        return [self._summed(scenario, estimator) for scenario, estimator in pairs]

    def _summed(self, scenario: str, estimator: str) -> Summary:
        """The figures of one pair."""
        rows = (self.columns["scenario"] == scenario) & (self.columns["estimator"] == estimator)
        errors = [text for text in self.columns["error"][rows].tolist() if text]
        well = rows & (self.columns["error"] == "")
        figures = {name: _interval(self.columns[name][well], name) for name in FIGURES}
        figures["fixed"] = _interval(np.isfinite(self.columns["first_fix_s"][well]).astype(np.float64), "fixed")
        return Summary(scenario, estimator, int(rows.sum()), len(errors), errors[0] if errors else "", figures)


def run_campaign(
    campaign: Campaign,
    out: str | Path,
    *,
    resume: bool = False,
    executor: Executor | None = None,
    on_run: Callable[[int, int], None] | None = None,
) -> CampaignResult:
    """Run a campaign, or what is left of it.

    Parameters
    ----------
    campaign : Campaign
    out : str or Path
        Its folder: campaign.json, a Parquet file for each chunk that is done, and at the end summary.json.
    resume : bool
        Go on in a folder that holds a part of this very campaign (its file, its scenarios, its maps).
    executor : Executor, optional
        Threads() by default. The figures do not depend on it.
    on_run : callable, optional
        Called with (rows done, rows in all), at first with those that were there.

    Returns
    -------
    CampaignResult

    Raises
    ------
    ConfigError, DataError
        An impossible campaign or folder, before anything is run; a chunk that cannot be written.

    Warns
    -----
    DataWarning
        A chunk's file is damaged and its runs are run again.
    """
    cases = campaign.cases()
    chunks = list(_chunks(campaign, cases))
    folder = Folder(Path(out), _fingerprint(campaign, cases))
    facts = {"name": campaign.name, "runs": campaign.runs, "seed": campaign.seed, "chunk": campaign.chunk}
    folder.begin({**facts, "cases": {case.name: list(case.methods) for case in cases}}, resume=resume)
    found = {chunk.number: folder.read(chunk.number, chunk.keys) for chunk in chunks}
    done = {number: columns for number, columns in found.items() if columns is not None}
    total, ready = sum(len(chunk.keys) for chunk in chunks), sum(len(columns["run"]) for columns in done.values())
    rows = ready
    if on_run is not None:
        on_run(rows, total)

    def work(number: int) -> Columns:
        columns = _flown(campaign, chunks[number])
        folder.write(number, columns)
        return columns

    missing = [chunk.number for chunk in chunks if chunk.number not in done]
    for number, columns in (executor or Threads()).unordered(work, missing):
        done[number] = columns
        rows += len(columns["run"])
        if on_run is not None:
            on_run(rows, total)
    result = CampaignResult(joined([done[chunk.number] for chunk in chunks]), total - ready)
    with replacing(folder.path / SUMMARY) as aside:
        aside.write_text(json.dumps(summary_facts(result.summary()), indent=2) + "\n", encoding="utf-8")
    return result


def summary_facts(summaries: list[Summary]) -> list[dict[str, Any]]:
    """Summaries as plain JSON values: each figure as [value, low, high], null where there is none."""

    def plain(value: float) -> float | None:
        return value if math.isfinite(value) else None

    return [
        {
            "scenario": one.scenario, "estimator": one.estimator, "runs": one.runs, "failed": one.failed,
            "first_error": one.first_error,
            **{name: [plain(i.value), plain(i.low), plain(i.high)] for name, i in one.figures.items()},
        }
        for one in summaries
    ]  # fmt: skip


def _chunks(campaign: Campaign, cases: list[Case]) -> Iterator[Chunk]:
    """The runs in parts of `chunk`."""
    number = 0
    for case in cases:
        for first in range(0, campaign.runs, campaign.chunk):
            yield Chunk(number, case, range(first, min(first + campaign.chunk, campaign.runs)))
            number += 1


def _flown(campaign: Campaign, chunk: Chunk) -> Columns:
    """Every run of a chunk by every method, a failure as a row with its error."""
    rows = [row for k in chunk.runs for row in _rows(campaign, chunk.case, k)]
    columns: dict[str, NDArray[Any]] = {
        name: np.array([row[name] for row in rows], dtype=np.str_) for name in ("scenario", "estimator", "error")
    }
    numbers = {name: np.array([row.get(name, math.nan) for row in rows], dtype=np.float64) for name in FIGURES}
    return {**columns, **{name: np.array([float(row[name]) for row in rows]) for name in ("run", "seed")}, **numbers}


def _rows(campaign: Campaign, case: Case, k: int) -> Iterator[dict[str, Any]]:
    """A row for each method of run k: all fly the same recording."""
    children = SeedSequence([campaign.seed, zlib.crc32(case.name.encode()), k])
    seed = int(children.generate_state(1)[0])
    failed, rec = "", None
    try:
        rec = simulate(case.scenario, seed=seed)
    except Exception as error:  # noqa: BLE001  a failed run is a result of the campaign
        failed = _said(error)
    for label, (name, settings) in case.methods.items():
        row: dict[str, Any] = {"scenario": case.name, "estimator": label, "run": k, "seed": seed, "error": failed}
        if rec is not None:
            try:
                result = run(name, rec, case.maps, seed=seed, ins=case.ins, prior=case.prior, **settings)
                row |= {name: result.metrics(since_s=campaign.since_s)[name] for name in FIGURES}
            except Exception as error:  # noqa: BLE001  as above
                row["error"] = _said(error)
        yield row


def _said(error: Exception) -> str:
    """An error in one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


def _fingerprint(campaign: Campaign, cases: list[Case]) -> str:
    """SHA-256 of all that the figures and their chunks depend on."""
    own = campaign.model_dump(exclude={"scenarios", "estimators"})
    facts = {"campaign": own, "cases": [case.facts() for case in cases], "terranav": __version__}
    return hashlib.sha256(json.dumps(facts, sort_keys=True, default=str).encode()).hexdigest()


def _interval(values: NDArray[np.float64], name: str) -> Interval:
    """A figure over the runs that have it."""
    known = values[np.isfinite(values)]
    if not known.size:
        return Interval(math.nan, math.nan, math.nan)
    return bootstrap(known, _root_mean_square if name == "drms_m" else np.mean, draws=1000)


def _root_mean_square(values: NDArray[np.float64], axis: Any) -> NDArray[np.float64]:
    return np.asarray(np.sqrt(np.mean(values**2, axis=axis)))


def _merged(values: Mapping[str, Any], change: Mapping[str, Any]) -> dict[str, Any]:
    """Nested tables with some keys changed."""
    out = dict(values)
    for name, value in change.items():
        inner = out.get(name)
        out[name] = _merged(inner, value) if isinstance(value, dict) and isinstance(inner, dict) else value
    return out
