"""The table of benchmarks: what it prints, what it holds ratios to, and wrong use of `terranav bench`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from benchmarks import limits, table
from benchmarks.timing import Limit, Peer, Row, least_ns

from terranav.app.cli import main

ROW = Row("a step", "cell", 2.0, (Peer("numpy", 30.0, 10.0), Peer("textbook", 9.0)), Limit("arithmetic", 1.0, 1.5))


def test_a_row_says_ratio_limit_and_goal() -> None:
    first, numpy, textbook, limit = table.lines(ROW)
    assert first.split() == ["a", "step", "2", "ns", "per", "cell"]
    assert numpy.split() == ["15.0x", "numpy,", "30", "ns", "(goal", "10x)"]
    assert textbook.split() == ["4.5x", "textbook,", "9", "ns"]
    assert "2.00x  above the limit, arithmetic, 1 ns  (goal 1.5x)" in limit


@pytest.mark.parametrize(
    ("row", "lost"),
    [
        (ROW, []),
        (Row("a step", "cell", 4.4, (Peer("numpy", 30.0, 10.0),)), ["a step: 6.8x numpy, held to 7.0x"]),
        (Row("a step", "cell", 2.2, (), Limit("arithmetic", 1.0, 1.5)), ["a step: 2.20x the limit, held to 2.14x"]),
        (Row("a step", "cell", 3.0, (Peer("numpy", 30.0, 40.0, reached=12.0),)), []),
        (Row("a step", "cell", 4.0, (Peer("numpy", 30.0, 40.0, reached=12.0),)), ["a step: 7.5x numpy, held to 8.4x"]),
        (Row("a step", "cell", 99.0, (Peer("numpy", 1.0),), Limit("arithmetic", 1.0)), []),
    ],
)
def test_a_ratio_may_fall_by_the_slack_and_no_further(row: Row, lost: list[str]) -> None:
    assert table.short(row) == lost


def test_a_lost_ratio_is_exit_status_1(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    slow = Row("a step", "cell", 4.4, (Peer("numpy", 30.0, 10.0),))
    monkeypatch.setattr(table, "rows_of", lambda name: [ROW] if name == "good" else [slow])
    assert table.printed(["good"], as_json=True, out=tmp_path / "table.json") == 0
    said = json.loads(capsys.readouterr().out)
    assert said == json.loads((tmp_path / "table.json").read_text())
    assert said["rows"][0]["peers"][0] == {"name": "numpy", "ns": 30.0, "ratio": 15.0, "goal": 10.0, "held_to": 7.0}
    limit = said["rows"][0]["limit"]
    assert limit == {"name": "arithmetic", "ns": 1.0, "times": 2.0, "goal": 1.5, "held_to": pytest.approx(1.5 / 0.7)}
    assert said["machine"]["cores"] >= 1
    assert table.printed(["good", "slow"]) == 1
    assert "held to 7.0x" in capsys.readouterr().err


def test_a_goal_not_reached_says_so() -> None:
    row = Row("a step", "cell", 2.0, (Peer("numpy", 30.0, 40.0, reached=12.0),))
    assert table.lines(row)[1].endswith("(goal 40x, not reached)")


def test_times_are_the_least_of_repeats_per_unit() -> None:
    calls: list[str] = []
    least = least_ns({"a": lambda: calls.append("a"), "b": lambda: calls.append("b")}, units=2, repeats=3)
    assert calls == ["a", "b"] * 4
    assert 0.0 < least["a"] < 1e6


def test_limits_of_this_machine_are_positive_and_cached() -> None:
    assert 0.0 < limits.multiply_add_ns() == limits.multiply_add_ns() < 10.0


def test_a_benchmark_by_name_from_the_command_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert "growth" not in table.names()
    assert {"pointmass", "sampling"} <= set(table.names())
    status = main(["bench", "normals", "--json"])
    said = capsys.readouterr()
    rows = json.loads(said.out)["rows"]
    assert status == (1 if said.err else 0)
    assert all(row["ns"] > 0.0 and row["peers"][0]["ratio"] > 0.0 for row in rows)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nothing"], "no benchmark 'nothing', expected of "),
        (["--growth", "normals"], "--growth is a table of its own, expected no name beside it, not 'normals'"),
        (["--out", "missing/table.json"], "--out is 'missing/table.json', expected a file in a folder that exists"),
    ],
)
def test_wrong_use_is_one_line(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", *arguments]) == 2
    assert message in capsys.readouterr().err
