"""The study `plan`: its statistics by plain numpy, what it draws, and a small real slice."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from terranav.core.earth import offset_m
from terranav.experiment.montecarlo import Threads
from terranav.experiment.studies import plan
from terranav.experiment.studies.registry import study_named
from terranav.experiment.studies.runner import prepare_study, run_study
from terranav.experiment.studies.sources import MapSource
from terranav.experiment.studies.study import CaseRuns, Setup
from terranav.experiment.studies.tracks import INS


@pytest.fixture(autouse=True)
def only_the_sample_dem(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TERRANAV_SHARED", raising=False)


def test_rmse_is_along_the_longest_axis() -> None:
    turn = math.radians(30.0)
    along, across = np.random.default_rng(1).normal(size=(2, 3, 500)) * np.array([20.0, 3.0])[:, None, None]
    errors = np.stack(
        [along * math.cos(turn) - across * math.sin(turn), along * math.sin(turn) + across * math.cos(turn)], axis=-1
    )
    found = plan.rmse(errors)
    assert found.shape == (3,)
    for one, run in zip(found, errors, strict=True):
        assert one == pytest.approx(math.sqrt(np.linalg.eigvalsh(run.T @ run / len(run))[-1]))
    np.testing.assert_allclose(found, np.sqrt((along**2).mean(axis=1)), rtol=0.02)


def test_wilson_by_its_definition() -> None:
    """The ends are where the share lies 1.96 of its own standard errors away."""
    for count, of in ((0, 10), (36, 40), (40, 40), (7, 31)):
        share = plan.wilson(count, of)
        for end in (share.low, share.high):
            if 0.0 < end < 1.0:
                assert abs(share.value - end) == pytest.approx(1.959964 * math.sqrt(end * (1.0 - end) / of), rel=1e-5)
        assert 0.0 <= share.low <= share.value <= share.high <= 1.0
    assert plan.wilson(40, 40).low == pytest.approx(0.912, abs=0.001)
    assert math.isnan(plan.wilson(0, 0).value)


def test_legs_are_random_long_enough_and_depend_on_the_seed() -> None:
    legs = plan.drawn_legs(MapSource(), 4, 0)
    assert plan.drawn_legs(MapSource(), 2, 0) == legs[:2]
    assert plan.drawn_legs(MapSource(), 1, 1)[0].leg != legs[0].leg
    for track in legs:
        lat, lon = track.leg.positions_deg()
        assert math.hypot(*offset_m(lat[0], lon[0], lat[-1], lon[-1])) == pytest.approx(plan.DISTANCE_M, abs=70.0)
        assert np.isfinite(track.chart.sample(lat, lon)).all()


def test_a_slice_of_the_sample_dem(tmp_path: Path) -> None:
    """On good ground promise, map and bound are near each other, and the error of few flights not far from them."""
    prepared = prepare_study(study_named("plan"), Setup(tracks=2), 8)
    result = run_study(prepared, tmp_path, executor=Threads(1))
    assert (result.runs, result.failed) == (16, 0)
    legs = [row for row in result.report.figures if "leg" in row]
    assert len(legs) == 2
    for row in legs:
        assert 0.95 < row["promised_m"] / row["bound_m"] < 1.4
        assert 0.6 < row["mapped_m"] / row["bound_m"] < 1.6
        assert 0.5 < row["rmse_m"][0] / row["bound_m"] < 2.0  # of 8 runs, half of which are within 25 % of the truth
        assert row["rmse_m"][1] <= row["rmse_m"][0] <= row["rmse_m"][2]
        assert row["promised_m"] < 0.1 * INS.position_sigma_m
    assert [verdict.met for verdict in result.report.verdicts][-1] is False  # 2 legs are not 40
    assert len(result.report.tables) == 3
    assert any("only the sample DEM is at hand" in note for note in result.report.notes)


def test_a_promise_kept_and_one_broken() -> None:
    """A leg whose errors are as promised agrees; one with a run in twenty elsewhere does not, but for that run."""
    rng = np.random.default_rng(4)
    cases = []
    for track, lost in zip(plan.drawn_legs(MapSource(), 2, 0), (0, 20), strict=True):
        errors = rng.normal(0.0, 10.0, (400, 2))
        errors[:lost] = 800.0
        figures = {"north_m": errors[:, 0], "east_m": errors[:, 1], "bound_m": np.full(400, 9.5)}
        figures |= {"converged": np.ones(400), "claimed_m": np.full(400, 10.0)}
        cases.append(CaseRuns(plan.LegCase(track, 10.0, 9.0), figures))
    told = plan.report(cases)
    assert [row[-1] for row in told.tables[0].rows] == ["yes", "no"]
    assert [row[-2] for row in told.tables[0].rows] == ["0 of 400", "20 of 400"]
    shares = [row["all_legs"][0] for row in told.figures if "against" in row]
    assert shares == [0.5, 1.0] * 3
    assert told.verdicts[0].met is False
    assert next(row["share_within"][0] for row in told.figures if row.get("map") == "all") == 0.5
