"""Campaigns: the same figures for any workers, nothing lost or run twice over 20 kills, damaged and foreign files."""

from __future__ import annotations

import ast
import itertools
import json
import os
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from terranav.core.errors import ConfigError, DataError, DataWarning
from terranav.experiment.campaign import FIGURES, Campaign, CampaignResult, run_campaign, summary_facts
from terranav.experiment.montecarlo import Threads
from terranav.experiment.run import run

SCENARIO = """
[[maps]]
file = "sample"
[route]
waypoints_deg = [[36.56, -84.30], [36.58, -84.27]]
altitude_m = 1500.0
speed_mps = 90.0
rate_hz = 0.5
[ins]
mode = "drift"
position_sigma_m = 150.0
velocity_sigma_mps = 0.3
[sensors.terrain]
sigma = 4.0
"""
CAMPAIGN: dict[str, Any] = {
    "name": "tiny",
    "seed": 5,
    "runs": 7,
    "chunk": 2,
    "scenarios": [
        {"file": "hop.toml", "name": "calm"},
        {"file": "hop.toml", "name": "wild", "change": {"ins": {"velocity_sigma_mps": 3.0}}},
    ],
    "estimators": [{"name": "ins"}, {"name": "sitan"}],
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "hop.toml").write_text(SCENARIO)
    return tmp_path


def campaign(folder: Path, **changes: Any) -> Campaign:
    return Campaign.from_dict({**CAMPAIGN, **changes}, folder=folder)


def assert_same(first: CampaignResult, second: CampaignResult) -> None:
    assert set(first.columns) == set(second.columns)
    for key, values in first.columns.items():
        np.testing.assert_array_equal(second.columns[key], values)


def test_figures_do_not_depend_on_workers_or_chunks(folder: Path) -> None:
    one = run_campaign(campaign(folder), folder / "one", executor=Threads(1))
    many = run_campaign(campaign(folder), folder / "many", executor=Threads(5))
    large = run_campaign(campaign(folder, chunk=50), folder / "large")
    assert_same(one, many)
    assert_same(one, large)
    rows = Counter(zip(*(one.columns[key].tolist() for key in ("scenario", "estimator", "run")), strict=True))
    assert rows == Counter({(s, e, k): 1 for s in ("calm", "wild") for e in ("ins", "sitan") for k in range(7)})
    assert one.ran == 28
    assert len(set(one.columns["seed"].tolist())) == 14


def test_resume_runs_only_what_is_missing(folder: Path) -> None:
    whole = run_campaign(campaign(folder), folder / "out")
    (folder / "out" / "chunk-00002.parquet").unlink()
    (folder / "out" / ".chunk-00002.parquet.1-1.part").write_bytes(b"half")
    seen: list[tuple[int, int]] = []
    again = run_campaign(
        campaign(folder), folder / "out", resume=True, on_run=lambda done, total: seen.append((done, total))
    )
    assert seen == [(24, 28), (28, 28)]
    assert again.ran == 4
    assert_same(whole, again)
    assert not list((folder / "out").glob(".*.part"))
    assert run_campaign(campaign(folder), folder / "out", resume=True).ran == 0


@pytest.mark.parametrize("damage", ["cut", "empty", "garbage", "another chunk", "another campaign"])
def test_a_damaged_chunk_is_run_again_with_a_warning(folder: Path, damage: str) -> None:
    whole = run_campaign(campaign(folder), folder / "out")
    victim = folder / "out" / "chunk-00001.parquet"
    content = victim.read_bytes()
    if damage == "another campaign":
        run_campaign(campaign(folder, seed=6), folder / "other")
    victim.write_bytes({
        "cut": content[: len(content) // 2],
        "empty": b"",
        "garbage": b"\0" * 500,
        "another chunk": (folder / "out" / "chunk-00002.parquet").read_bytes(),
        "another campaign": content if damage != "another campaign" else (folder / "other" / victim.name).read_bytes(),
    }[damage])  # fmt: skip
    with pytest.warns(DataWarning, match=r"chunk-00001\.parquet: .*; its runs are run again"):
        again = run_campaign(campaign(folder), folder / "out", resume=True)
    assert again.ran == 4
    assert_same(whole, again)


def test_a_folder_is_not_taken_by_mistake(folder: Path) -> None:
    out = folder / "out"
    run_campaign(campaign(folder, runs=1), out)
    with pytest.raises(ConfigError, match="holds a campaign already, expected a new folder, or --resume"):
        run_campaign(campaign(folder, runs=1), out)
    with pytest.raises(ConfigError, match="holds another campaign"):
        run_campaign(campaign(folder, runs=1, seed=6), out, resume=True)
    (folder / "hop.toml").write_text(SCENARIO.replace("sigma = 4.0", "sigma = 5.0"))
    with pytest.raises(ConfigError, match=r"holds another campaign .*a scenario or a map differs"):
        run_campaign(campaign(folder, runs=1), out, resume=True)
    (folder / "hop.toml").write_text(SCENARIO)
    manifest = out / "campaign.json"
    kept = manifest.read_text()
    manifest.write_text(json.dumps({**json.loads(kept), "terranav": "0.0.0"}))
    with pytest.raises(ConfigError, match=r"begun with terranav 0\.0\.0"):
        run_campaign(campaign(folder, runs=1), out, resume=True)
    manifest.write_text(kept[:20])
    with pytest.raises(DataError, match=r"campaign\.json: is not readable"):
        run_campaign(campaign(folder, runs=1), out, resume=True)
    (folder / "letters").mkdir()
    (folder / "letters" / "dear.txt").write_text("x")
    for resume, line in ((False, "is not empty already"), (True, r"holds no campaign\.json")):
        with pytest.raises(ConfigError, match=line):
            run_campaign(campaign(folder, runs=1), folder / "letters", resume=resume)
    with pytest.raises(ConfigError, match="is a file, expected a folder"):
        run_campaign(campaign(folder, runs=1), folder / "hop.toml")


def test_a_failed_run_is_recorded_and_the_rest_goes_on(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = iter(range(1000))

    def brittle(name: str, *given: Any, **options: Any) -> Any:
        if name == "sitan" and next(calls) == 1:
            raise ValueError("no map\nhere")
        return run(name, *given, **options)

    monkeypatch.setattr("terranav.experiment.campaign.run", brittle)
    result = run_campaign(campaign(folder, runs=3, scenarios=CAMPAIGN["scenarios"][:1]), folder / "out")
    failed = result.columns["error"] != ""
    assert result.columns["error"][failed].tolist() == ["ValueError: no map here"]
    assert np.isnan(result.columns["drms_m"][failed]).all()
    assert np.isfinite(result.columns["drms_m"][~failed]).all()
    ins, sitan = result.summary()
    assert (ins.failed, sitan.failed, sitan.runs, sitan.first_error) == (0, 1, 3, "ValueError: no map here")
    assert sitan.figures["drms_m"].low <= sitan.figures["drms_m"].value <= sitan.figures["drms_m"].high
    assert (
        run_campaign(campaign(folder, runs=3, scenarios=CAMPAIGN["scenarios"][:1]), folder / "out", resume=True).ran
        == 0
    )


def test_a_route_off_the_map_fails_each_run_and_says_why(folder: Path) -> None:
    away = {"file": "hop.toml", "name": "away", "change": {"route": {"waypoints_deg": [[36.56, -84.3], [36.9, -84.3]]}}}
    result = run_campaign(campaign(folder, runs=1, scenarios=[away]), folder / "out")
    (one, _) = result.summary()
    assert one.failed == 1
    assert "leaves the map" in one.first_error
    facts = summary_facts(result.summary())
    assert facts[0]["drms_m"] == [None, None, None]
    assert json.loads((folder / "out" / "summary.json").read_text()) == facts
    assert set(FIGURES) <= set(facts[0])


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"runs": 0}, "runs is 0, expected a whole number >= 1"),
        ({"chunk": 0}, "chunk is 0"),
        ({"estimatrs": []}, "unknown key 'estimatrs' .did you mean 'estimators'"),
        ({"scenarios": []}, "scenarios is"),
        ({"estimators": []}, "'calm' has no estimator"),
        ({"estimators": [{"name": "sitan"}, {"name": "sitan"}]}, "has 'sitan' twice"),
        ({"estimators": [{"name": "sitan", "settings": {"wndow": 3}}]}, "unknown setting of 'sitan' 'wndow'"),
        ({"scenarios": [{"file": "hop.toml"}, {"file": "hop.toml"}]}, "two .*scenarios.* are called 'hop'"),
        ({"scenarios": [{"file": "no.toml"}]}, "no.toml: no such file"),
        ({"scenarios": [{"file": "hop.toml", "change": {"ins": {"grde": 1}}}]}, "tiny: hop.toml: .*unknown key 'grde'"),
    ],
)
def test_impossible_campaigns_are_one_line(folder: Path, changes: dict[str, Any], line: str) -> None:
    with pytest.raises(ConfigError, match=line):
        run_campaign(campaign(folder, **changes), folder / "out")
    assert not (folder / "out").exists()


#: kills a child that runs the campaign after a while, 20 times; forked, so that imports and kernels are loaded once
KILLER = """
import os, random, signal, sys, time
from pathlib import Path
from terranav.experiment.campaign import Campaign, run_campaign
from terranav.experiment.montecarlo import Threads
from terranav.experiment.run import run
from terranav.experiment.simulate import simulate
folder, rng = Path(sys.argv[1]), random.Random(1)
plan = Campaign.from_toml(folder / "campaign.toml")
case = plan.cases()[0]
run("ins", simulate(case.scenario, 0), case.maps).save(folder / "warm.parquet")
for _ in range(20):
    child = os.fork()
    if child == 0:
        run_campaign(plan, folder / "killed", resume=True, executor=Threads(2))
        os._exit(0)
    time.sleep(rng.uniform(0.0, 0.5))
    os.kill(child, signal.SIGKILL)
    status = os.waitpid(child, 0)[1]
    done = {file.name: file.stat().st_mtime_ns for file in (folder / "killed").glob("chunk-*.parquet")}
    print(os.WTERMSIG(status), done, sep=";", flush=True)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="kills forked children")
def test_killed_at_20_random_moments_nothing_is_lost_or_run_twice(folder: Path) -> None:
    runs = 40
    text = [f'name = "tiny"\nseed = 5\nruns = {runs}\nchunk = 1', '[[scenarios]]\nfile = "hop.toml"\nname = "calm"']
    text += ['[[scenarios]]\nfile = "hop.toml"\nname = "wild"\nchange.ins.velocity_sigma_mps = 3.0']
    text += ['[[estimators]]\nname = "ins"', '[[estimators]]\nname = "ins"\nlabel = "again"']
    (folder / "campaign.toml").write_text("\n".join(text))
    done = subprocess.run([sys.executable, "-c", KILLER, str(folder)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    kills = [(line.partition(";")[0], ast.literal_eval(line.partition(";")[2])) for line in done.stdout.splitlines()]
    assert len(kills) == 20
    assert all(signal == "9" or len(files) == 2 * runs for signal, files in kills)  # or it had finished before
    for (_, before), (_, after) in itertools.pairwise(kills):
        assert before.items() <= after.items()  # what was done stays, and is not written again
    ready = len(kills[-1][1])
    assert ready > 0
    plan = Campaign.from_toml(folder / "campaign.toml")
    result = run_campaign(plan, folder / "killed", resume=True)
    assert result.ran == 4 * runs - 2 * ready  # a chunk is one run by two methods
    rows = Counter(zip(*(result.columns[key].tolist() for key in ("scenario", "estimator", "run")), strict=True))
    assert rows == Counter({(s, e, k): 1 for s in ("calm", "wild") for e in ("ins", "again") for k in range(runs)})
    assert_same(run_campaign(plan, folder / "undisturbed"), result)
    assert not list((folder / "killed").glob(".*.part"))
