"""terranav run --smooth: filter and smoother side by side, in the table, in JSON and in the report."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from terranav.app.cli import main
from terranav.experiment.result import Result
from tests.app.conftest import EPOCHS, Flight


def test_table_shows_both(flight: Flight, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", *flight.arguments, "--estimator", "pointmass", "--smooth"]) == 0
    out, err = capsys.readouterr()
    rows = [line.split("  ")[0].strip() for line in out.splitlines()]
    assert [row for row in rows if row in ("ins", "pointmass", "pointmass smoothed")] == [
        "ins",
        "pointmass",
        "pointmass smoothed",
    ]
    assert err == ""


def test_json_and_files(flight: Flight, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert main(["run", *flight.arguments, "--estimator", "marginalized", "--smooth", "--json", "--out", str(out)]) == 0
    told = json.loads(capsys.readouterr().out)
    assert list(told["estimators"]) == ["ins", "marginalized", "marginalized smoothed"]
    assert told["estimator"] == "marginalized smoothed"
    assert told["estimators"]["marginalized smoothed"]["drms_m"] < told["estimators"]["marginalized"]["drms_m"]
    smoothed = Result.load(out / "result-marginalized-smoothed.parquet")
    filtered = Result.load(out / "result-marginalized.parquet")
    assert len(smoothed) == EPOCHS
    assert np.array_equal(smoothed.cov_m2[-1], filtered.cov_m2[-1])
    assert "marginalized smoothed" in (out / "report.html").read_text(encoding="utf-8")


def test_without_truth(flight: Flight, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--recording", str(flight.no_truth), *flight.map_arguments]
    assert main(["run", *arguments, "--estimator", "pointmass", "--smooth"]) == 0
    assert "pointmass smoothed" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["tercom", "ins"])
def test_refuses_others_in_one_line(name: str, flight: Flight, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", *flight.arguments, "--estimator", name, "--smooth"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err == f"terranav: error: '{name}' cannot be smoothed, expected marginalized or pointmass\n"
