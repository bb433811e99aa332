"""terranav campaign: the table, the JSON, resuming, and one line for wrong use."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from terranav.app.cli import main
from terranav.experiment.campaign import Campaign
from tests.experiment.test_campaign import SCENARIO

FILE = """
runs = 3
chunk = 2
[[scenarios]]
file = "hop.toml"
[[estimators]]
name = "ins"
"""
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    (tmp_path / "hop.toml").write_text(SCENARIO)
    (tmp_path / "study.toml").write_text(FILE)
    return tmp_path / "study.toml"


def test_table_then_resumed_json(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = file.parent / "out"
    assert main(["campaign", str(file), "--out", str(out), "--workers", "1"]) == 0
    shown, err = capsys.readouterr()
    assert err == ""
    assert "study: 95 % intervals over runs" in shown
    assert "DRMS [m]" in shown
    assert "3 runs, 3 of them now" in shown
    (out / "chunk-00001.parquet").unlink()
    assert main(["campaign", str(file), "--out", str(out), "--resume", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["campaign"], facts["runs"], facts["run_now"]) == ("study", 3, 1)
    assert facts["summary"][0]["estimator"] == "ins"
    assert facts["summary"] == json.loads((out / "summary.json").read_text())


def test_a_cut_chunk_is_a_warning(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = file.parent / "out"
    assert main(["campaign", str(file), "--out", str(out)]) == 0
    chunk = out / "chunk-00000.parquet"
    chunk.write_bytes(chunk.read_bytes()[:300])
    capsys.readouterr()
    assert main(["campaign", str(file), "--out", str(out), "--resume"]) == 0
    shown, err = capsys.readouterr()
    assert "2 of them now" in shown
    assert err.startswith(f"terranav: warning: {chunk}: ")
    assert err.endswith("; its runs are run again\n")


def test_failed_runs_are_told_and_the_status_says_so(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (file.parent / "hop.toml").write_text(SCENARIO.replace("36.58, -84.27", "36.98, -84.27"))
    assert main(["campaign", str(file), "--out", str(file.parent / "out")]) == 1
    _, err = capsys.readouterr()
    assert err.startswith("terranav: warning: 3 of 3 runs failed, the first with DataError: ")


def test_wrong_use_is_one_line(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(file.parent / "out")
    assert main(["campaign", str(file), "--out", out]) == 0
    capsys.readouterr()
    for arguments, expected in (
        ([str(file), "--out", out], "holds a campaign already, expected a new folder, or --resume to go on with it"),
        ([str(file)], "Missing option '--out'"),
        ([str(file), "--out", out, "--workers", "0"], "--workers is 0"),
        ([str(file.parent / "no.toml"), "--out", out], "no such file, expected a campaign (.toml)"),
    ):
        assert main(["campaign", *arguments]) == 2
        shown, err = capsys.readouterr()
        assert shown == ""
        assert len(err.splitlines()) == 1
        assert expected in err


def test_the_example_is_a_campaign() -> None:
    campaign = Campaign.from_toml(ROOT / "examples" / "campaign.toml")
    cases = campaign.cases()
    assert [case.name for case in cases] == ["tactical", "tactical-800m"]
    assert cases[1].ins.position_sigma_m == 800.0
    assert list(cases[0].methods) == ["ins", "pointmass", "fading-0.985"]
