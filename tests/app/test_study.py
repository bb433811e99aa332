"""terranav study: the table, the JSON, going on, and one line for wrong use."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from terranav.app.cli import main


@pytest.fixture(autouse=True)
def only_the_sample_dem(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("TERRANAV_SHARED", raising=False)
    monkeypatch.chdir(tmp_path)


def test_table_then_json_of_the_same_runs(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    given = ["--tracks", "1", "--runs", "2", "--workers", "1"]
    assert main(["study", "bound", *given]) == 0
    shown, err = capsys.readouterr()
    assert err == ""
    assert "How close does the navigator come" in shown
    assert "bound, drms [m]" in shown
    assert "<= 1.08" in shown
    assert "2 runs, 2 of them now; folder: terranav-study/matched-" in shown
    (folder,) = (tmp_path / "terranav-study").iterdir()
    assert main(["study", "consistency", *given, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["study"], facts["runs"], facts["run_now"], facts["failed"]) == ("consistency", 2, 0, 0)
    assert Path(facts["out"]).name == folder.name
    assert facts["verdicts"][0]["asked"] == ">= 90 %"
    assert facts["tables"][0]["columns"][0] == "map"


def test_wrong_use_is_one_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "letters").mkdir()
    (tmp_path / "letters" / "dear.txt").write_text("x")
    for arguments, expected in (
        (["bond"], "unknown study 'bond' (did you mean 'bound'?)"),
        ([], "Missing argument 'NAME'"),
        (["bound", "--runs", "1"], "--runs is 1"),
        (["bound", "--workers", "0"], "--workers is 0"),
        (["bound", "--tracks", "0"], "--tracks is 0"),
        (["bound", "--seed", "-1"], "--seed is -1"),
        (["bound", "--set", "partcles=5"], "unknown setting of 'marginalized' 'partcles'"),
        (["bound", "--data", "no"], "--data no: no such folder"),
        (["bound", "--map", "no.tif"], "--map no.tif: no such file"),
        (["bound", "--tracks", "1", "--only", "storm"], "--only 'storm': no case of bound has such a name"),
        (["bound", "--tracks", "1", "--out", "letters"], "is not empty and holds no study.json"),
        (["real"], "needs recordings"),
    ):
        assert main(["study", *arguments]) == 2, arguments
        shown, err = capsys.readouterr()
        assert shown == ""
        assert len(err.splitlines()) == 1
        assert expected in err
