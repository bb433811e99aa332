"""`terranav plan leg`: what it prints, and one line for every wrong use."""

from __future__ import annotations

import json

import numpy as np
import pytest

from terranav.app.cli import main
from terranav.ins.grades import grade_named
from terranav.io.rasters import open_map
from terranav.planning.forecast import forecast, leg_recording
from terranav.planning.suitability import LegSettings
from tests.app.conftest import Flight

A, B = (36.56, -84.30), (36.59, -84.25)


def asked(flight: Flight, *more: str) -> list[str]:
    ends = [f"{lat},{lon}" for lat, lon in (A, B)]
    return ["plan", "leg", *ends, "--map", str(flight.map), "--crs", "EPSG:4326", *more]


def test_it_is_the_forecast(flight: Flight, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*asked(flight), "--json"]) == 0
    told = json.loads(capsys.readouterr().out, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert told["length_m"] == pytest.approx(5570.0, abs=100.0)
    chart, grade = open_map(flight.map, crs="EPSG:4326"), grade_named("tactical")
    rec = leg_recording(chart, A, B, grade, LegSettings())
    np.testing.assert_allclose(told["drms_m"], forecast(rec, chart, grade).drms_m)
    assert told["sigma_m"][-1] < 0.5 * told["sigma_m"][0]
    assert told["bound_m"][-1] < 1.05 * told["sigma_m"][-1]
    assert main(asked(flight)) == 0
    said = capsys.readouterr().out
    assert "as forecast" in said
    assert "\n5.6 km " in said


@pytest.mark.parametrize(
    ("more", "named"),
    [
        (("--speed", "0"), "speed_mps is 0"),
        (("--ins", "granite"), "granite"),
        (("--map", "none.tif"), "none.tif"),
        (("--speed", "9000"), "expected at least the way between two readings"),
    ],
)
def test_wrong_use_is_one_line(
    flight: Flight, capsys: pytest.CaptureFixture[str], more: tuple[str, ...], named: str
) -> None:
    assert main(asked(flight, *more)) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert len(said.err.splitlines()) == 1
    assert named in said.err


@pytest.mark.parametrize(("end", "named"), [("36.59,-80", "leaves the map"), ("here", "B is 'here', expected")])
def test_a_leg_off_the_map(flight: Flight, capsys: pytest.CaptureFixture[str], end: str, named: str) -> None:
    wrong = asked(flight)
    wrong[3] = end
    assert main(wrong) == 2
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1
    assert named in said
