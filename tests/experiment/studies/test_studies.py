"""Small slices of the real studies, with loose limits: they run, and what they say is plausible."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from terranav.core.errors import ConfigError
from terranav.experiment.montecarlo import Threads
from terranav.experiment.studies import integrity_study, matched, real_cruise, real_flights, robust
from terranav.experiment.studies.registry import studies, study_named
from terranav.experiment.studies.runner import StudyResult, prepare_study, run_study
from terranav.experiment.studies.study import Setup

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture(autouse=True)
def only_the_sample_dem(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TERRANAV_SHARED", raising=False)


def ran(name: str, folder: Path, runs: int, **asked: Any) -> StudyResult:
    return run_study(prepare_study(study_named(name), Setup(**asked), runs), folder, executor=Threads(1))


def fact(result: StudyResult, key: str) -> Any:
    return next(row[key] for row in result.report.figures if key in row)


def test_every_study_can_be_named() -> None:
    assert studies() == ["bound", "consistency", "integrity", "monitor", "plan", "real", "robust", "routes"]
    for name in studies():
        assert study_named(name).name == name
    with pytest.raises(ConfigError, match=r"unknown study 'bond' .did you mean 'bound'"):
        study_named("bond")


def test_bound_and_consistency_on_two_tracks_of_the_sample_dem(tmp_path: Path) -> None:
    result = ran("bound", tmp_path, 8, tracks=2)
    assert (result.runs, result.failed) == (16, 0)
    middle, low, high = fact(result, "median_ratio")
    assert 0.7 < middle < 1.6  # 16 runs: the interval of a healthy filter spans 0.2 to either side
    assert low <= middle <= high
    assert any("only the sample DEM is at hand" in note for note in result.report.notes)
    assert [verdict.met for verdict in result.report.verdicts][-1] is False  # 2 tracks are not 40
    again = ran("consistency", tmp_path, 8, tracks=2)
    assert again.ran == 0  # the same runs, summed up otherwise
    assert 0.8 < fact(again, "contained_95")[0] <= 1.0
    assert 0.8 < fact(again, "nees")[0] < 5.0


def test_settings_reach_the_navigator_and_are_part_of_the_study() -> None:
    plain = prepare_study(study_named("bound"), Setup(tracks=1))
    few = prepare_study(study_named("bound"), Setup(tracks=1, settings={"particles": 500, "least_particles": 500}))
    assert plain.fingerprint != few.fingerprint
    case = few.plan.cases[0]
    assert isinstance(case, matched.MatchedCase)
    assert dict(case.settings)["particles"] == 500
    with pytest.raises(ConfigError, match="unknown setting of 'marginalized' 'partcles'"):
        prepare_study(study_named("bound"), Setup(tracks=1, settings={"partcles": 5}))


def test_every_part_of_robust_runs(tmp_path: Path) -> None:
    result = ran("robust", tmp_path, 2, tracks=1, settings={"particles": 2000, "least_particles": 500})
    assert result.failed == 0
    whats = {row["what"] for row in result.report.figures}
    assert whats == {*robust.BIASES, *robust.WRONG, robust.KIDNAPPED, robust.SMOOTHING}
    assert 0.5 < fact(result, "rmse_ratio")[0] < 2.0
    assert len(result.report.tables) == 4


def test_a_kidnapped_ins_is_5_km_off_and_stays_on_the_map() -> None:
    case = next(case for case in robust.plan(Setup(tracks=1)).cases if robust.KIDNAPPED in case.name)
    assert isinstance(case, robust.RobustCase)
    rng = np.random.default_rng(3)
    rec = case.track.true_recording()
    jumped = robust._jumped(rec, case, len(rec) // 2, rng)
    off = np.hypot(*jumped.ins_error_m().T)
    np.testing.assert_allclose(off[: len(rec) // 2], 0.0, atol=1e-6)
    np.testing.assert_allclose(off[len(rec) // 2 :], 5000.0, rtol=1e-3)
    assert np.isfinite(case.track.chart.sample(jumped.lat_deg, jumped.lon_deg)).all()


def test_integrity_counts_by_terrain(tmp_path: Path) -> None:
    result = ran("integrity", tmp_path, 3)
    assert [row["terrain"] for row in result.report.figures] == ["flat", "rough", "self-similar", "all"]
    assert [row["runs"] for row in result.report.figures] == [3, 3, 3, 9]
    assert len(result.report.verdicts) == 5
    assert integrity_study.STUDY.runs == 10_000


def test_real_needs_data_and_says_so(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="needs recordings: name their folder with --data DIR"):
        prepare_study(study_named("real"), Setup())
    with pytest.raises(ConfigError, match=r"--data .*holds no flight_.*the cruise is left out"):
        prepare_study(study_named("real"), Setup(data=tmp_path))
    with pytest.raises(ConfigError, match="no such folder"):
        prepare_study(study_named("real"), Setup(data=tmp_path / "no"))
    with pytest.raises(ConfigError, match=r"--map .*no such file"):
        prepare_study(study_named("bound"), Setup(maps=(tmp_path / "no.tif",)))


def test_a_day_of_flying(shared_data: Path, tmp_path: Path) -> None:
    result = ran("real", tmp_path, 2, data=shared_data, only=("flight 20210120",))
    row = next(row for row in result.report.figures if row["method"] == "marginalized")
    ins = next(row for row in result.report.figures if row["method"] == "ins")
    assert row["drms_median_m"][0] < 0.5 * ins["drms_median_m"][0]
    assert len(result.report.verdicts) == 5


def test_pieces_of_the_cruise_that_are_unfit_are_named(shared_data: Path) -> None:
    cases, notes = real_cruise.cruise_cases(shared_data, {})
    assert len(cases) >= 5
    assert any("ship day 1: left out, 65 rows, expected at least 700 of 1440" in note for note in notes)
    assert any("map covers" in note for note in notes)
    assert 0.0 < real_cruise.bound_m(cases[0], "both") <= real_cruise.bound_m(cases[0], "depth") * 1.001
    assert math.isclose(math.hypot(*[real_cruise.INS.velocity_sigma_mps] * 2), 1852.0 / 3600.0)


@pytest.mark.parametrize("columns", [real_flights.COLUMNS, real_cruise.COLUMNS])
def test_the_package_reads_the_survey_as_the_examples_do(columns: Path) -> None:
    assert columns.read_bytes() == (ROOT / "examples" / columns.name).read_bytes()
