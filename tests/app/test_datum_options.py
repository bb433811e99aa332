"""run, compare and cue: --map-datum and --geoid, and that options which cannot be used are not passed over."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from terranav.app.cli import main
from terranav.core.recording import Recording
from terranav.io.raster_out import write_map
from terranav.io.recordings import write_recording
from terranav.maps.map import Map

RISE = -31.0  # height of the geoid that is used here [m]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory, chart: Map, recording: Recording) -> dict[str, str]:
    """A recording with heights above the ellipsoid, a map above EGM96 that does not say so, and the geoid."""
    folder = tmp_path_factory.mktemp("datums")
    raised = {**recording.columns, "terrain_m": recording.columns["terrain_m"] + RISE}
    high = replace(recording, columns=raised, datum={"all": "ellipsoid"})
    write_recording(high, folder / "high.csv")
    write_recording(recording, folder / "low.csv")
    write_map(chart, folder / "hills.tif")
    grid = np.full((40, 40), RISE)
    grid[0, 0] += 1.0
    write_map(Map(grid, (0.1, 0.0, -86.0, 0.0, -0.1, 38.0)), folder / "geoid.tif")
    return {key: str(folder / name) for key, name in (
        ("high", "high.csv"), ("low", "low.csv"), ("map", "hills.tif"), ("geoid", "geoid.tif"))}  # fmt: skip


@pytest.fixture
def nothing_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("terranav.io.geoid.find_geoid", lambda datum: None)


def ran(capsys: pytest.CaptureFixture[str], *arguments: str) -> Any:
    assert main(list(arguments)) == 0
    return json.loads(capsys.readouterr().out)


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert main(list(arguments)) == 2
    out, err = capsys.readouterr()
    assert out == ""
    return err.splitlines()[-1]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("command", ["run", "compare"])
def test_heights_are_brought_together_by_the_geoid_that_is_given(
    command: str, files: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    asked = [command, "--map", files["map"], "--estimator", "sitan", "--json"]
    low = ran(capsys, *asked, "--recording", files["low"])
    grid = ["--map-datum", "EGM96", "--geoid", f"EGM96={files['geoid']}"]
    high = ran(capsys, *asked, "--recording", files["high"], *grid)
    found = [each["estimators"]["sitan"]["drms_m"] for each in (low, high)]
    assert found[0] == pytest.approx(found[1], rel=1e-2)


@pytest.mark.usefixtures("nothing_installed")
@pytest.mark.parametrize("command", ["run", "compare", "cue"])
@pytest.mark.parametrize(
    ("given", "message"),
    [
        ((), "no grid of it is at hand; expected the geoid grid of EGM96 (geoid=, --geoid FILE)"),
        (("--geoid", "nowhere.gtx"), "nowhere.gtx: no such file, expected a geoid grid"),
        (("--geoid", "GEOID"), "expected datum= (--geoid EGM2008=FILE)"),
        (("--map-datum", "EGM69"), "map datum is 'EGM69' (did you mean"),
        (("--map-datum", "EGM96", "--map-datum", "EGM96"), "--map-datum is given 2 times for 1 maps"),
    ],
)
def test_datums_that_cannot_be_brought_together(
    command: str, given: tuple[str, ...], message: str, files: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    asked = [command, "--map", files["map"], "--recording", files["high"], "--estimator", "sitan"]
    named = [] if "--map-datum" in given else ["--map-datum", "EGM96"]
    said = refused(capsys, *asked, *named, *[part.replace("GEOID", files["geoid"]) for part in given])
    assert message in said


@pytest.mark.parametrize(
    "given",
    [("--map", "map"), ("--geoid", "geoid"), ("--map-kind", "terrain"), ("--ins", "tactical"), ("--first", "9")],
)
def test_compare_of_a_scenario_takes_no_options_of_a_recording(
    given: tuple[str, str], files: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    scenario = Path(__file__).resolve().parents[2] / "examples" / "flight.toml"
    value = f"EGM96={files['geoid']}" if given[1] == "geoid" else files.get(given[1], given[1])
    said = refused(capsys, "compare", str(scenario), given[0], value)
    assert f"{given[0]} goes with --recording" in said
