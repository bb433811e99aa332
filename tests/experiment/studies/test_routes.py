"""The study `routes`: what it draws, its statistic by plain numpy, and a small real slice."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from terranav.core.earth import offset_m
from terranav.experiment.montecarlo import Threads
from terranav.experiment.studies import routes
from terranav.experiment.studies.registry import study_named
from terranav.experiment.studies.runner import prepare_study, run_study
from terranav.experiment.studies.study import Setup


@pytest.fixture(autouse=True)
def only_the_sample_dem(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TERRANAV_SHARED", raising=False)


def test_the_largest_rmse_is_over_runs_within_a_part() -> None:
    squared = np.random.default_rng(2).uniform(0.0, 9.0, (30, 2 * routes.PARTS))
    squared[:, 3] += 100.0
    squared[:, routes.PARTS + 5] += 400.0
    straight, route = (
        math.sqrt(max(part.mean() for part in half.T))
        for half in (squared[:, routes.PARTS :], squared[:, : routes.PARTS])
    )
    assert float(routes.largest(squared[:, : routes.PARTS])) == pytest.approx(route)
    assert float(routes.gain(squared)) == pytest.approx(straight / route)


def test_a_slice_of_the_sample_dem(tmp_path: Path) -> None:
    """Routes are told better than the straight lines, are little longer, and fly as they are told to."""
    prepared = prepare_study(study_named("routes"), Setup(tracks=2), 6)
    assert any("N48E009: not at hand" in note for note in prepared.plan.notes)
    for case in prepared.plan.cases:
        assert isinstance(case, routes.RouteCase)
        assert math.hypot(*offset_m(*case.start, *case.end)) > 10_000.0
    result = run_study(prepared, tmp_path, executor=Threads(1))
    assert (result.runs, result.failed) == (12, 0)
    for row in result.report.figures:
        assert row["route_m"] < row["straight_m"]
        assert 0.0 < row["extra"] < routes.EXTRA + 0.01
        assert 0.5 < row["rmse_route_m"][0] / row["route_m"] < 2.5
        assert row["gain"][1] <= row["gain"][0] <= row["gain"][2]
    assert result.report.verdicts[0].met is True
