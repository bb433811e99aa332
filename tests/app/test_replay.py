"""terranav replay: one line with a log and a map, and what it answers."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from benchmarks.replay_flight import Made, dataflash

import terranav as tn
from terranav.app import report
from terranav.app.cli import main
from terranav.app.replay import spans_from
from terranav.core.errors import ConfigError
from terranav.io.raster_out import write_map
from terranav.io.recordings import write_recording
from tests.app.conftest import Flight


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map and logs of four minutes: the autopilot without GNSS, with it, and what they lack."""
    pytest.importorskip("pymavlink", reason="needs the extra 'logs'")
    made = tmp_path_factory.mktemp("replay")
    write_map(tn.sample_map(), made / "dem.tif")
    (made / "blind.BIN").write_bytes(dataflash(Made(minutes=4.0, rest_s=30.0)))
    (made / "aided.BIN").write_bytes(dataflash(Made(minutes=2.0, rest_s=30.0, uses_gnss=True)))
    short: dict[str, Any] = {"minutes": 1.0, "rest_s": 15.0}
    (made / "no_altimeter.BIN").write_bytes(dataflash(Made(**short, without=("RFND",))))
    (made / "no_truth.BIN").write_bytes(dataflash(Made(**short, without=("GPS",))))
    (made / "no_position.BIN").write_bytes(dataflash(Made(**short, without=("GPS", "POS"))))
    (made / "low_laser.BIN").write_bytes(dataflash(Made(**short, laser_m=50.0)))
    return made


def replayed(folder: Path, log: str, *more: str) -> list[str]:
    return ["replay", str(folder / log), "--map", str(folder / "dem.tif"), *more]


def answered(capsys: pytest.CaptureFixture[str], arguments: list[str]) -> dict[str, Any]:
    assert main([*arguments, "--json"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def refused(capsys: pytest.CaptureFixture[str], arguments: list[str]) -> str:
    """What it says in one line, with status 2 and nothing that looks like a traceback."""
    assert main(arguments) == 2
    err = capsys.readouterr().err
    errors = [line for line in err.splitlines() if line.startswith("terranav: error:")]
    assert len(errors) == 1
    assert "Traceback" not in err
    return errors[0]


def test_one_line_answers(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert main(replayed(folder, "blind.BIN", "--out", str(out))) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "log blind.BIN: ArduPilot DataFlash log, 4 min" in said
    assert "GNSS off 30 s to 4 min 30 s" in said
    assert "by position: the vehicle's own position" in said
    assert "held within" in said
    assert "unaided" in said
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "Held within" in page
    assert "ArduPilot DataFlash log" in page
    summary = json.loads((out / "replay.json").read_text(encoding="utf-8"))
    assert summary["verdict"] in said
    assert summary["score"]["held_m"] < 0.5 * summary["score"]["unaided_m"]
    assert {path.name for path in out.iterdir()} >= {"track.png", "metrics.json", "result-marginalized.parquet"}


def test_the_same_bits_twice_and_others_with_another_seed(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runs = [answered(capsys, replayed(folder, "aided.BIN", "--seed", seed)) for seed in ("4", "4", "5")]
    assert runs[0]["digest"] == runs[1]["digest"]
    assert runs[0]["verdict"] == runs[1]["verdict"]
    assert runs[0]["digest"] != runs[2]["digest"]


def test_a_velocity_made_with_gnss_is_called_optimistic(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flattering = answered(capsys, replayed(folder, "aided.BIN", "--by", "velocity"))
    assert flattering["optimistic"]
    assert flattering["verdict"].startswith("nothing to hold")
    assert "optimistic: vn_mps, ve_mps made with GNSS" in flattering["verdict"]
    assert "--drift-nmph 1" in flattering["verdict"]
    honest = answered(capsys, replayed(folder, "aided.BIN", "--drift-nmph", "20"))
    assert not honest["optimistic"]
    assert honest["by"] == "drift"
    assert honest["score"]["unaided_m"] > 200.0
    assert honest["verdict"].startswith("held within")


def test_several_spans_are_several_flights(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(report, "draw", lambda outcome: {})  # the pictures are drawn above
    spans = ["--gnss-off", "60-120,150-200", "--out", str(tmp_path)]
    found = answered(capsys, replayed(folder, "blind.BIN", *spans))
    assert [[round(end) for end in span] for span in found["gnss_off_s"]] == [[60, 120], [150, 200]]
    assert "in 2 spans" in found["verdict"]
    assert (tmp_path / "span-2" / "report.html").is_file()
    assert found["score"]["duration_s"] == pytest.approx(110.0, abs=0.5)


def test_a_log_without_truth_has_no_score(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = answered(capsys, replayed(folder, "no_truth.BIN"))
    assert found["verdict"].startswith("no score: no GNSS position to check against")
    assert found["score"]["held_m"] is None


def test_an_altimeter_out_of_range_is_said(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    refused(capsys, replayed(folder, "low_laser.BIN", "--gnss-off", "50"))
    assert main(replayed(folder, "low_laser.BIN")) in (0, 2)
    said = " ".join(capsys.readouterr().out.split())
    assert "laser altimeter (measures 0.2 to 50 m): a reading at" in said
    assert "out of range above 50 m" in said


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (["--gnss-off", "soon"], "--gnss-off is 'soon', expected take-off, a time in s"),
        (["--gnss-off", "9000"], "expected a span of 10 s or more within the"),
        (["--gnss-off", "20-10"], "expected a span of 10 s or more"),
        (["--by", "magic"], "--by is 'magic', expected velocity, airspeed, position, imu, drift"),
        (["--by", "imu"], "no inertial sensors are logged"),
        (["--drift", "5,1", "--drift-nmph", "1"], "both given, expected one"),
        (["--drift", "5,1", "--by", "velocity"], "a drift is given, expected one of them"),
        (["--drift-nmph", "-1"], "--drift-nmph is -1.0, expected"),
        (["--spacing", "-1"], "--spacing is -1.0, expected"),
        (["--estimator", "magic"], "magic"),
    ],
)
def test_wrong_use_is_one_line(folder: Path, capsys: pytest.CaptureFixture[str], more: list[str], told: str) -> None:
    assert told in refused(capsys, replayed(folder, "aided.BIN", *more))


def test_logs_that_will_not_do_are_one_line(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = refused(capsys, replayed(folder, "no_altimeter.BIN"))
    assert "no_altimeter.BIN: nothing in it measured the ground below" in said
    assert "--ground-vehicle" in said
    assert "no position in this" in refused(capsys, replayed(folder, "no_position.BIN"))
    assert "nothing.BIN" in refused(capsys, replayed(folder, "nothing.BIN"))
    assert "--map is not given" in refused(capsys, ["replay", str(folder / "aided.BIN")])
    zeros = tmp_path / "zeros.BIN"
    with zeros.open("wb") as stream:
        stream.truncate(3 * 2**30)  # sparse: costs no disk
    assert "only zeros" in refused(capsys, ["replay", str(zeros), "--map", str(folder / "dem.tif")])
    text = tmp_path / "notes.txt"
    text.write_text("nothing of use\n", encoding="utf-8")
    said = refused(capsys, ["replay", str(text), "--map", str(folder / "dem.tif")])
    assert "expected a log" in said
    table = tmp_path / "table.csv"
    table.write_text("time_s,lat_deg,lon_deg,alt_m,height\n0,36.5,-84.3,500,1\n", encoding="utf-8")
    assert "unknown column 'height'" in refused(capsys, ["replay", str(table), "--map", str(folder / "dem.tif")])


def test_no_map_where_it_flew(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    away = tmp_path / "away.tif"
    write_map(tn.sample_map().crop(36.70, -84.12, 36.72, -84.09), away)
    said = refused(capsys, ["replay", str(folder / "aided.BIN"), "--map", str(away)])
    assert "no map covers" in said


def test_a_cut_log_is_flown_as_far_as_it_goes(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = (folder / "aided.BIN").read_bytes()
    (tmp_path / "cut.BIN").write_bytes(whole[: len(whole) * 3 // 4 + 7])
    assert main(["replay", str(tmp_path / "cut.BIN"), "--map", str(folder / "dem.tif"), "--json"]) == 0
    captured = capsys.readouterr()
    assert "the file is cut" in captured.err
    found = json.loads(captured.out)
    assert found["remarks"][0].startswith("the file is cut")
    assert found["log"]["whole"] is False
    assert 60.0 < found["score"]["duration_s"] < 100.0


def test_a_recording_replays_as_a_log(flight: Flight, capsys: pytest.CaptureFixture[str]) -> None:
    found = answered(capsys, ["replay", str(flight.recording), *flight.map_arguments])
    assert found["by"] == "position"
    assert found["verdict"].startswith("held within")
    blind = answered(capsys, ["replay", str(flight.no_truth), *flight.map_arguments])
    assert blind["verdict"].startswith("no score")
    true = answered(capsys, ["replay", str(flight.true_position), *flight.map_arguments, "--drift", "5,3"])
    assert true["by"] == "drift"


def test_a_car_is_held_by_its_barometer(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from terranav.io.logs import open_log

    rec = open_log(folder / "aided.BIN").recording
    ground = tn.sample_map().sample(rec.columns["true_lat_deg"], rec.columns["true_lon_deg"]) + 1.0
    kept = ("time_s", "lat_deg", "lon_deg", "alt_m", "true_lat_deg", "true_lon_deg", "true_alt_m")
    columns = {key: rec.columns[key] for key in kept}
    car = tn.Recording({**columns, "alt_m": ground, "baro_altitude_m": ground}, name="car")
    write_recording(car, tmp_path / "car.csv")
    shutil.copy(folder / "dem.tif", tmp_path)
    assert "--ground-vehicle" in refused(capsys, replayed(tmp_path, "car.csv", "--drift-nmph", "20"))
    found = answered(capsys, replayed(tmp_path, "car.csv", "--drift-nmph", "20", "--ground-vehicle"))
    assert found["verdict"].startswith("held within")


def test_when_gnss_is_off_is_read() -> None:
    assert spans_from("take-off") == "take-off"
    assert spans_from("12.5") == 12.5
    assert spans_from("10-20,30-1e3") == [(10.0, 20.0), (30.0, 1000.0)]
    for text in ("-5", "10-", "a-b", "10-20-30", "", "nan", "inf"):
        with pytest.raises(ConfigError, match="--gnss-off is"):
            spans_from(text)
