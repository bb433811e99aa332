"""Real: the navigator over real flights and a real cruise, with the drift of an INS added to the true track."""

from __future__ import annotations

from collections.abc import Sequence

from numpy.random import SeedSequence

from terranav.core.errors import ConfigError
from terranav.experiment.registry import make_estimator
from terranav.experiment.studies.real_cruise import CruiseCase, cruise_cases, cruise_table
from terranav.experiment.studies.real_flights import FlightCase, flight_cases, flight_table, flight_verdicts
from terranav.experiment.studies.sources import ENVIRONMENT, data_folder
from terranav.experiment.studies.study import CaseRuns, Plan, Report, Setup, Study


def plan(setup: Setup) -> Plan:
    """The days and pieces that there are.

    Raises
    ------
    ConfigError
        No folder of real data, or nothing in it that is known; a setting that the navigator does not have.
    """
    data = data_folder(setup.data)
    if data is None:
        raise ConfigError(
            "the study of real runs needs recordings: name their folder with --data DIR, or the folder that holds "
            f"'data' in {ENVIRONMENT}"
        )
    flights, why_not = flight_cases(data, setup.settings)
    pieces, left_out = cruise_cases(data, setup.settings)
    if not flights and not pieces:
        raise ConfigError(f"--data {data}: {'; '.join((*why_not, *left_out))}")
    chart = (flights[0].source if flights else pieces[0].sources["bathymetry"]).open()
    make_estimator("marginalized", (chart,), flights[0].ins if flights else pieces[0].ins, **setup.settings)
    return Plan([*flights, *pieces], [*why_not, *left_out])


def run_case(case: FlightCase | CruiseCase, seeds: SeedSequence) -> dict[str, float]:
    """One drift."""
    return case.fly(seeds)


def report(cases: Sequence[CaseRuns]) -> Report:
    """Tables of the flights and of the cruise."""
    flights = [one for one in cases if isinstance(one.case, FlightCase)]
    pieces = [one for one in cases if isinstance(one.case, CruiseCase)]
    tables, figures = [], []
    for some, table_of in ((flights, flight_table), (pieces, cruise_table)):
        if some:
            table, facts = table_of(some)
            tables.append(table)
            figures += facts
    verdicts = flight_verdicts(flights) if flights else []
    notes = ["lost: ends beyond 1 km; unsaid: beyond 1 km in the second half with the status converged or degraded"]
    return Report(tables, verdicts, notes, figures)


STUDY = Study(
    "real", "What does the navigator do over real flights and a real cruise?", plan, run_case, report, runs=25, chunk=1
)
