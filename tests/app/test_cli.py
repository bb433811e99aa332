"""The command line: what it prints, what it writes, and one line for every wrong use or input."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from terranav.app import figures, flying
from terranav.app.cli import main
from terranav.core.recording import Recording
from terranav.experiment.result import Result
from terranav.io.recordings import read_recording
from tests.app.conftest import EPOCHS, Flight

HEAVY = {"numba", "rasterio", "matplotlib", "pandas", "pyarrow", "scipy", "xarray", "pyproj", "jinja2"}


def run_python(*code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *code], capture_output=True, text=True, check=False, timeout=120)


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """The one line on stderr of a command that ends with status 2 and says nothing on stdout."""
    assert main([str(argument) for argument in arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    *warnings, line = err.splitlines()
    assert all(text.startswith("terranav: warning: ") for text in warnings), err
    assert line.startswith("terranav: error: ")
    return line.removeprefix("terranav: error: ")


def answered(capsys: pytest.CaptureFixture[str], *arguments: object, status: int = 0) -> Any:
    """The JSON on stdout of a command that works."""
    assert main([str(argument) for argument in arguments]) == status
    return json.loads(capsys.readouterr().out, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))


@pytest.mark.parametrize(
    "first",
    ["import terranav", "import terranav.app.cli", "from terranav.app.cli import main; main(['run', '--help'])"],
)
def test_import_and_help_load_nothing_heavy(first: str) -> None:
    done = run_python("-c", f"{first}; import sys; print(*sys.modules)")
    assert done.returncode == 0, done.stderr
    loaded = {name.split(".")[0] for name in done.stdout.splitlines()[-1].split()}
    assert loaded & HEAVY == set()


@pytest.mark.parametrize(
    "command",
    [
        "demo",
        "run",
        "compare",
        "simulate",
        "convert",
        "map",
        "estimators",
        "map info",
        "map view",
        "map fetch",
        "bench",
        "plan",
    ],
)
def test_help_of_every_command(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*command.split(), "--help"]) == 0
    out, err = capsys.readouterr()
    assert "Usage: terranav" in out
    assert err == ""


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    from terranav import __version__

    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"terranav {__version__}\n"


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([], "Missing command"),
        (["rum"], "Did you mean 'run'?"),
        (["run", "--recodring", "x"], "did you mean --recording?"),
        (["run"], "Missing option '--recording'"),
        (["run", "--recording", "x", "--seed", "many"], "'--seed'"),
        (["compare"], "a scenario file or --recording"),
        (["compare", "a.toml", "--recording", "b.csv"], "not both"),
        (["map"], "Missing command"),
        (["simulate", "nowhere.toml", "--out", "x"], "nowhere.toml"),
        (["simulate", "a.toml", "--out", "x", "--format", "xls"], "expected csv or parquet"),
        (["map", "info", "nowhere.tif"], "nowhere.tif: no such file"),
        (["run", "--recording", "nowhere.csv"], "nowhere.csv: no such file"),
    ],
)
def test_wrong_use_is_one_line(arguments: list[str], expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert expected in refused(capsys, *arguments)


def test_wrong_use_from_the_shell() -> None:
    call = "import sys; from terranav.app.cli import main; sys.exit(main())"
    done = run_python("-c", call, "run", "--recording", "nowhere.csv")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        (["--estimator", "pontmass"], "did you mean 'pointmass'?"),
        (["--set", "particels=9"], "did you mean 'particles'?"),
        (["--set", "particles"], "expected key=value"),
        (["--seed", "-1"], "seed is -1"),
        (["--since", "-1"], "--since is -1"),
        (["--first", "0"], "--first is 0"),
        (["--ins", "tactcal"], "did you mean 'tactical'?"),
        (["--ins", "1,2,3,4"], "three numbers"),
        (["--ins", "-5,0,0"], "position_sigma_m"),
        (["--ins", "nowhere.toml"], "nowhere.toml: no such file"),
        (["--map-kind", "terain"], "did you mean 'terrain'?"),
        (["--map-sigma", "-3"], "sigma"),
        (["--map-correlation", "0"], "correlation_m is 0.0, expected a finite number and > 0"),
        (["--map-kind", "terrain", "--map-kind", "gravity"], "--map-kind is given 2 times for 1 maps"),
        (["--map-crs", "EPSG:999999"], "EPSG:999999"),
    ],
)
def test_wrong_options_are_one_line(
    more: list[str], expected: str, flight: Flight, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["run", "--recording", flight.recording, "--map", flight.map]
    if "--map-crs" not in more:
        arguments += ["--map-crs", "EPSG:4326"]
    assert expected in refused(capsys, *arguments, *more)


def test_map_that_is_missing_or_elsewhere(flight: Flight, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "no map is given" in refused(capsys, "run", "--recording", flight.recording)
    text = tmp_path / "not.tif"
    text.write_text("hello")
    assert "not.tif" in refused(capsys, "run", "--recording", flight.recording, "--map", text)
    moved = tmp_path / "far.asc"
    moved.write_text(flight.map.read_text().replace("xllcorner -84", "xllcorner 12"))
    far = ["--map", moved, "--map-crs", "EPSG:4326"]
    assert "no map covers" in refused(capsys, "run", "--recording", flight.recording, *far)


def test_an_ins_file(flight: Flight, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "ins.toml"
    file.write_text("[ins]\nposition_sigma_m = 321.0\n")
    told = answered(capsys, "run", *flight.arguments, "--estimator", "ins", "--ins", file, "--json")
    assert told["ins"]["position_sigma_m"] == 321.0
    file.write_text("[ins]\nposition_sigma = 321.0\n")
    message = refused(capsys, "run", *flight.arguments, "--ins", file)
    assert "ins.toml" in message
    assert "did you mean" in message
    file.write_text("position_sigma_m = 321.0\n")
    assert "[ins] is missing" in refused(capsys, "run", *flight.arguments, "--ins", file)


def test_output_folder_is_checked_before_the_run(
    flight: Flight, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(flying, "fly", lambda *_, **__: pytest.fail("it ran"))
    taken = tmp_path / "taken"
    taken.write_text("a file")
    assert "is a file, expected a folder" in refused(capsys, "run", *flight.arguments, "--out", taken)
    assert "cannot be written" in refused(capsys, "run", *flight.arguments, "--out", taken / "below")
    assert "cannot be written" in refused(capsys, "run", *flight.arguments, "--out", "/proc/terranav")


def test_run_writes_everything(flight: Flight, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "made" / "here"
    summary = answered(capsys, "run", *flight.arguments, "--seed", 3, "--out", out, "--json")
    assert summary["estimator"] == "marginalized"
    assert list(summary["estimators"]) == ["ins", "marginalized"]
    assert summary["metrics"]["drms_m"] < summary["estimators"]["ins"]["drms_m"]
    assert summary["estimators"]["ins"]["first_fix_s"] is None
    assert summary["recording"]["epochs"] == EPOCHS
    assert summary["seed"] == 3
    names = {path.name for path in out.iterdir()}
    assert {*summary["files"], "report.html", "track.png", "error.png", "profile.png", "posterior.png"} <= names
    assert json.loads((out / "metrics.json").read_text()) == summary
    saved = Result.load(out / "result-marginalized.parquet")
    assert saved.metrics()["drms_m"] == summary["metrics"]["drms_m"]


def test_run_shows_a_table_and_a_verdict(flight: Flight, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", *flight.arguments, "--estimator", "ins"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    for text in ("map ", "120 epochs", "DRMS", "NEES", "first fix", "The INS alone"):
        assert text in out


def test_same_seed_same_bytes(flight: Flight, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shown = [
        answered(capsys, "run", *flight.arguments, "--first", 60, "--seed", 3, "--json")["estimators"] for _ in range(2)
    ]
    assert shown[0] == shown[1]


def test_without_truth(flight: Flight, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["run", "--recording", str(flight.no_truth), *flight.map_arguments]
    assert main(arguments) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert "no true position to check" in out.replace("\n", " ")
    assert "95 % radius" in out
    summary = answered(capsys, *arguments, "--json")
    assert summary["metrics"]["drms_m"] is None
    assert summary["estimators"]["marginalized"]["final_95_m"] > 0


def test_drift_makes_a_test_of_a_true_position(flight: Flight, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["run", "--recording", flight.true_position, *flight.map_arguments, "--estimator", "ins", "--json"]
    shown = answered(capsys, *arguments, "--drift", "300,1,0.5", "--drift-seed", 5)
    same = answered(capsys, "run", *flight.arguments, "--estimator", "ins", "--json")
    assert shown["metrics"] == same["metrics"]
    other = answered(capsys, *arguments, "--drift", "300,1,0.5", "--drift-seed", 6)
    assert other["metrics"] != same["metrics"]
    assert answered(capsys, *arguments, "--drift", "tactical")["ins"]["name"] == "tactical"


def test_warnings_are_one_line_on_stderr(flight: Flight, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["run", "--recording", flight.true_position, *flight.map_arguments, "--estimator", "ins", "--json"]
    assert main([str(argument) for argument in arguments]) == 0
    out, err = capsys.readouterr()
    json.loads(out)
    assert [line.startswith("terranav: warning: ") for line in err.splitlines()] == [True]
    assert "nothing is said about the INS" in err


def test_compare_recording(flight: Flight, capsys: pytest.CaptureFixture[str]) -> None:
    summary = answered(capsys, "compare", *flight.arguments, "--estimator", "pointmass", "--estimator", "ins", "--json")
    assert list(summary["estimators"]) == ["pointmass", "ins"]
    alone = answered(capsys, "run", *flight.arguments, "--json")
    assert summary["estimators"]["pointmass"] == alone["metrics"] | summary["estimators"]["pointmass"]


def test_map_info(flight: Flight, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["map", "info", str(flight.map), "--crs", "EPSG:4326"]) == 0
    out = capsys.readouterr().out
    assert "terrain [m], sigma 3 m" in out
    facts = answered(capsys, "map", "info", flight.map, "--crs", "EPSG:4326", "--sigma", 7, "--json")
    assert facts["sigma"] == 7.0
    assert facts["voids"] == 0


def test_convert(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table, columns, out = tmp_path / "log.txt", tmp_path / "columns.toml", tmp_path / "log.csv"
    table.write_text("t,la,lo,h\n0,46.0,7.0,1000\n1,46.1,7.0,1010\n")
    columns.write_text(
        '[time]\ncolumn = "t"\nformat = "seconds"\n[columns]\nlat_deg = "la"\nlon_deg = "lo"\nalt_m = "h"\n'
    )
    assert main(["convert", str(table), "--columns", str(columns), "--out", str(out)]) == 0
    assert "2 epochs" in capsys.readouterr().out
    np.testing.assert_array_equal(read_recording(out).alt_m, [1000.0, 1010.0])
    columns.write_text(columns.read_text().replace('"la"', '"lat"'))
    assert "'lat'" in refused(capsys, "convert", table, "--columns", columns, "--out", tmp_path / "again.csv")


def test_estimators(capsys: pytest.CaptureFixture[str]) -> None:
    found = answered(capsys, "estimators", "--json")
    assert {"ins", "pointmass"} <= {entry["name"] for entry in found}
    assert all(entry["about"] for entry in found)


def test_a_failing_picture_costs_only_the_report(
    flight: Flight, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(_: object) -> None:
        raise ValueError("no ink\nleft")

    monkeypatch.setitem(figures.FIGURES, "error", broken)
    summary = answered(capsys, "run", *flight.arguments, "--out", tmp_path, "--json", status=1)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"result-ins.parquet", "result-marginalized.parquet", "metrics.json"}
    assert set(summary["files"]) == names
    assert main(["run", *flight.arguments, "--out", str(tmp_path)]) == 1
    out, err = capsys.readouterr()
    assert "DRMS" in out
    assert err.count("\n") == 1
    assert "no ink left" in err


def test_ctrl_c_ends_with_130(
    flight: Flight, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(flying, "fly", stopped)
    assert main(["run", *flight.arguments]) == 130
    assert capsys.readouterr().err == "terranav: note: stopped\n"


def test_a_full_disk_is_one_line(
    flight: Flight, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(flying, "fly", full)
    assert main(["run", *flight.arguments]) == 1
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.skipif(os.name != "posix", reason="pipes close differently elsewhere")
def test_a_reader_that_went_away() -> None:
    call = "import sys; from terranav.app.cli import main; sys.exit(main(['estimators', '--json']))"
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run([sys.executable, "-c", call], stdout=write, stderr=subprocess.PIPE, check=False, timeout=120)
    os.close(write)
    assert done.returncode == 1
    assert done.stderr == b""


def test_a_recording_no_one_can_read(
    true_flight: Recording, flight: Flight, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = tmp_path / "bad.csv"
    for text, expected in [
        ("", "empty"),
        ("time_s,lat_deg,lon_deg\n0,1,2\n", "alt_m"),
        ("time_s,lat_deg,lon_deg,alt_m\n", "zero epochs"),
        ("time_s,lat_deg,lon_deg,alt_m\n0,95,0,0\n", "lat_deg in row 1 is 95"),
        ("time_s,lat_deg,lon_deg,alt_m\n1,9,0,0\n1,9,0,0\n", "increasing times"),
    ]:
        bad.write_text(text)
        message = refused(capsys, "run", "--recording", bad, *flight.map_arguments)
        assert "bad.csv" in message
        assert expected in message


SCENARIO = """
name = "short hop"
seed = 2
[[maps]]
file = "sample"
[route]
waypoints_deg = [[36.55, -84.30], [36.58, -84.25]]
altitude_m = 1500.0
speed_mps = 60.0
rate_hz = 1.0
[ins]
mode = "drift"
position_sigma_m = 300.0
velocity_sigma_mps = 0.5
[sensors.terrain]
sigma = 3.0
[[estimators]]
name = "pointmass"
label = "fine grid"
settings = { max_cells = 90000 }
"""


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    path = tmp_path / "hop.toml"
    path.write_text(SCENARIO)
    return path


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_simulate(suffix: str, scenario: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flown = ["simulate", scenario, "--out", tmp_path / "out", "--format", suffix]
    facts = answered(capsys, *flown, "--seed", 5, "--json")
    rec = read_recording(facts["file"])
    assert Path(facts["file"]).name == f"short hop.{suffix}"
    assert len(rec) == facts["epochs"]
    assert rec.has_truth
    assert rec.source["seed"] == "5"
    assert main([str(argument) for argument in flown]) == 0
    assert "short hop" in capsys.readouterr().out
    assert read_recording(facts["file"]).source["seed"] == "2"


def test_compare_scenario(scenario: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    summary = answered(capsys, "compare", scenario, "--out", tmp_path / "out", "--json")
    assert list(summary["estimators"]) == ["ins", "fine grid"]
    assert summary["seed"] == 2
    saved = Result.load(tmp_path / "out" / "result-fine-grid.parquet")
    assert saved.provenance["estimator"]["settings"]["max_cells"] == 90000
    named = answered(capsys, "compare", scenario, "--estimator", "ins", "--seed", 9, "--json")
    assert list(named["estimators"]) == ["ins"]
    assert named["estimators"]["ins"] != summary["estimators"]["ins"]


def test_scenario_with_a_wrong_key(scenario: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scenario.write_text(SCENARIO.replace("speed_mps", "sped_mps"))
    message = refused(capsys, "compare", scenario)
    assert "hop.toml" in message
    assert "speed_mps" in message


def test_demo(
    scenario: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from terranav.experiment import demo
    from terranav.experiment.scenario import Scenario

    monkeypatch.setattr(demo, "demo_scenario", lambda: Scenario.from_toml(scenario))  # the real one takes its time
    monkeypatch.chdir(tmp_path)
    assert main(["demo"]) == 0
    out = capsys.readouterr().out
    assert "fine grid held the position" in out
    assert out.splitlines()[-1] == "report: terranav-demo/report.html"
    assert (tmp_path / "terranav-demo" / "report.html").is_file()
