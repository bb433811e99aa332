"""Scenario files: what they give, and one clear line for each thing that can be wrong in them."""

from __future__ import annotations

import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import BaseModel

from terranav.core.errors import ConfigError, DataError
from terranav.core.ins_grade import InsGrade
from terranav.experiment.demo import demo_scenario
from terranav.experiment.scenario import Scenario
from terranav.ins.grades import GRADES

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "flight.toml"

PLAIN = """
[[maps]]
file = "sample"

[route]
waypoints_deg = [[36.55, -84.30], [36.58, -84.25]]
altitude_m = 1500.0
speed_mps = 70.0

[ins]
mode = "drift"
position_sigma_m = 300.0

[sensors.radar_altimeter]
sigma_m = 2.0

[[estimators]]
name = "pointmass"
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "flight.toml"
    path.write_text(text, encoding="utf-8")
    return path


def read(folder: Path, text: str = PLAIN) -> Scenario:
    return Scenario.from_toml(written(folder, text))


def test_a_plain_file(tmp_path: Path) -> None:
    scenario = read(tmp_path)
    assert scenario.name == "flight"
    assert scenario.seed == 0
    assert scenario.told_ins() == InsGrade(position_sigma_m=300.0)
    np.testing.assert_array_equal(scenario.initial_prior().cov_m2, 300.0**2 * np.eye(2))
    assert scenario.methods() == {"pointmass": ("pointmass", {})}
    assert scenario.open_maps()[0].name == "jacksboro"


def test_the_example_reads_and_its_comments_are_true(tmp_path: Path) -> None:
    scenario = Scenario.from_toml(EXAMPLE)
    assert scenario.methods()["tercom-mad"] == ("tercom", {"metric": "mad", "window": 64})
    text = EXAMPLE.read_text(encoding="utf-8")
    for key in _keys(Scenario):
        assert re.search(rf"\b{key}\b", text), f"{key} is not in {EXAMPLE.name}"
    # what stands behind a single # before a key is valid, too
    commented = re.compile(r"^# ((?:\[[a-z_.]+\]|[a-z_]+ = ).*)$", re.MULTILINE)
    left_out = ("crs", "variable", "unit", "positive_down", "turn_radius_m")
    full = commented.sub(lambda found: found[1] if not found[1].startswith(left_out) else "", text)
    full = full.replace("[sensors.gravity]\nsigma = 1.0", "[sensors.terrain]\nsigma = 1.0")
    assert full.count("[ins_told]") == 1
    everything = read(tmp_path, full)
    assert everything.sensors.laser_altimeter is not None
    assert everything.sensors.terrain is not None
    assert everything.prior is not None
    assert everything.told_ins().gyro_bias_sigma_deg_per_h == GRADES["navigation"].gyro_bias_sigma_deg_per_h


def _keys(model: type[BaseModel]) -> set[str]:
    """Every key of a scenario, found in its models."""
    found: set[str] = set()
    schema = model.model_json_schema()
    for part in (schema, *schema.get("$defs", {}).values()):
        for name, entry in part["properties"].items():
            assert entry["description"], name
            assert entry["expected"], name
            found.add(name)
    return found


@pytest.mark.parametrize("scenario", [Scenario.from_toml(EXAMPLE), demo_scenario()], ids=["example", "demo"])
def test_round_trips(scenario: Scenario) -> None:
    again = Scenario.from_dict(scenario.to_dict())
    assert again.to_dict() == scenario.to_dict()
    assert pickle.loads(pickle.dumps(scenario)).to_dict() == scenario.to_dict()


def test_grades_and_what_is_told(tmp_path: Path) -> None:
    told = read(tmp_path, PLAIN + "[ins_told]\nvelocity_sigma_mps = 9.0\n").told_ins()
    assert told == InsGrade(position_sigma_m=300.0, velocity_sigma_mps=9.0)
    tactical = read(tmp_path, PLAIN.replace('mode = "drift"', 'grade = "tactical"'))
    assert tactical.told_ins().accel_bias_sigma_ug == GRADES["tactical"].accel_bias_sigma_ug
    assert tactical.told_ins().position_sigma_m == 300.0
    prior = read(tmp_path, PLAIN + '[prior]\nsigma_m = [200, 100.0]\nmean_m = [5.0, 0.0]\nshape = "uniform"\n')
    np.testing.assert_array_equal(prior.initial_prior().cov_m2, np.diag([200.0**2, 100.0**2]))
    assert prior.initial_prior().shape == "uniform"


def test_map_files_are_beside_the_scenario(tmp_path: Path) -> None:
    scenario = read(tmp_path, PLAIN.replace('"sample"', '"dem/none.tif"'))
    with pytest.raises(DataError, match=re.escape(str(tmp_path / "dem" / "none.tif"))):
        scenario.open_maps()
    with pytest.raises(ConfigError, match="file = 'sample' is a terrain map in metres"):
        read(tmp_path, PLAIN.replace('"sample"', '"sample"\nunit = "ft"')).open_maps()
    assert read(tmp_path, PLAIN.replace('"sample"', '"sample"\nsigma = 7')).open_maps()[0].sigma == 7.0


def test_seeds_of_runs() -> None:
    demo = demo_scenario()
    seeds = demo.seeds()
    assert len(set(seeds)) == demo.runs == 50
    assert demo.model_copy(update={"runs": 3}).seeds() == seeds[:3]
    assert demo.model_copy(update={"seed": 2}).seeds() != seeds


BAD: list[tuple[str, str, str]] = [
    ("speed_mps = 70.0", 'speed_mps = "fast"', '[route] speed_mps is "fast", expected a number > 0'),
    ("speed_mps = 70.0", "speed_mps = true", "[route] speed_mps is true, expected a number > 0"),
    ("speed_mps = 70.0", "speed_mps = -3.0", "[route] speed_mps is -3.0, expected a finite number and > 0"),
    ("speed_mps = 70.0", "speed_mps = [1.0, 2.0, 3.0]", "[route] speed_mps has 3 values, expected one or one a leg"),
    ("speed_mps = 70.0", "speed_mps = nan", "[route] speed_mps is NaN, expected a number > 0"),
    ("speed_mps = 70.0", "sped_mps = 70.0", "[route] unknown key 'sped_mps' (did you mean 'speed_mps'?); known: "),
    ("speed_mps = 70.0", "", "[route] speed_mps is missing, expected a number > 0"),
    ("speed_mps = 70.0", "speed_mps = 7.0\nrate_hz = 0", "[route] rate_hz is 0, expected a number > 0"),
    ("speed_mps = 70.0", "speed_mps = 7.0\nbank_deg = 80", "[route] bank_deg is 80, expected a number > 0, at most 75"),
    ("altitude_m = 1500.0", "altitude_m = [1.0]", "[route] altitude_m has 1 values, expected one or one a waypoint"),
    ("[36.55, -84.30]", "[36.55]", "[route] waypoints_deg holds another than [latitude, longitude], expected pairs"),
    ("[36.55, -84.30]", "[95.0, 5.0]", "[route] waypoint 1 latitude is 95.0, expected a finite number"),
    ("[36.55, -84.30]", "7", "[route] waypoints_deg is [7, [36.58, -84.25]], expected a list of at least two [lat"),
    ("[route]", "[rute]", "unknown key 'rute' (did you mean 'route'?); known: "),
    ("\n[[maps]]", "prior = 3\n[[maps]]", "prior is 3, expected a table [prior]"),
    ("[sensors.radar_altimeter]\nsigma_m = 2.0", "", "sensors is missing, expected a table [sensors]"),
    ("sigma_m = 2.0", "sigma = 2.0", "[sensors.radar_altimeter] unknown altimeter key 'sigma' (did you mean 'sigma_m'"),
    ("sigma_m = 2.0", "sigma_m = -2.0", "[sensors.radar_altimeter] band sigma_m is -2.0, expected a finite number"),
    ("sigma_m = 2.0", "period_s = -1", "[sensors.radar_altimeter] period_s is -1, expected a number > 0"),
    ("radar_altimeter", "radar", "[sensors] unknown key 'radar' (did you mean 'radar_altimeter'?); known: "),
    ('file = "sample"', "file = 3", "[[maps]] 1: file is 3, expected a path, or 'sample'"),
    ('file = "sample"', 'file = "sample"\nkind = "terain"', "[[maps]] 1: kind is \"terain\", expected 'terrain',"),
    ('file = "sample"', 'file = "sample"\nsigma = -1', "[[maps]] 1: sigma is -1, expected a number >= 0"),
    ('file = "sample"', 'fil = "sample"', "[[maps]] 1: unknown key 'fil' (did you mean 'file'?); known: "),
    ("[[maps]]", '[[maps]]\nfile = "a"\n[[maps]]', "[[maps]] are of kinds terrain, terrain, expected one of a kind"),
    ("[[maps]]", "[maps]", 'maps is {"file": "sample"}, expected at least one table [[maps]]'),
    ('mode = "drift"', 'mode = "walk"', "[ins] mode is \"walk\", expected 'strapdown' or 'drift'"),
    ('mode = "drift"', "", "[ins] grade is missing, expected one that says what the IMU is like, or mode = 'drift'"),
    ('mode = "drift"', 'grade = "tacticle"', "[ins] unknown INS grade 'tacticle' (did you mean 'tactical'?)"),
    ("position_sigma_m", "position_sigma", "[ins] unknown key 'position_sigma' (did you mean 'position_sigma_m'?); kn"),
    ("position_sigma_m = 300.0", "position_sigma_m = 0", "[ins] position_sigma_m is 0, expected a finite number"),
    ('"pointmass"', '"pointmas"', "[[estimators]] 1: unknown estimator 'pointmas' (did you mean 'pointmass'?)"),
    ('"pointmass"', '"ins"\n[[estimators]]\nname = "ins"', "[[estimators]] has 'ins' twice, expected a label"),
    ('"pointmass"', '"ins"\nlabel = "a/b"', '[[estimators]] 1: label is "a/b", expected letters, digits, spaces'),
    ('"pointmass"', '"ins"\nsettings = 3', "[[estimators]] 1: settings is 3, expected a table"),
    ('"pointmass"', '"ins"\n[prior]\nsigma_m = 0.0', "[prior] sigma_m is 0.0, expected a number > 0, or two"),
    ('"pointmass"', '"ins"\n[prior]\nshape = "round"', "[prior] sigma_m is missing, expected a number > 0, or two"),
    ('"pointmass"', '"ins"\n[map_error]\nsigma = "x"', '[map_error] sigma is "x", expected a number >= 0'),
    ("\n[[maps]]", "seed = -1\n[[maps]]", "seed is -1, expected a whole number >= 0"),
    ("\n[[maps]]", "seed = 1.5\n[[maps]]", "seed is 1.5, expected a whole number >= 0"),
    ("\n[[maps]]", "runs = 0\n[[maps]]", "runs is 0, expected a whole number >= 1"),
    ("\n[[maps]]", 'name = "../up"\n[[maps]]', 'name is "../up", expected letters, digits, spaces and . + - _'),
    ("\n[[maps]]", "sede = 1\n[[maps]]", "unknown key 'sede' (did you mean 'seed'?); known: name, seed"),
    ("\n[[maps]]", "seed = \n[[maps]]", "is no TOML file (Invalid value"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "message"), BAD, ids=[new.replace("\n", " ") or old for old, new, _ in BAD])
def test_bad_scenarios_get_one_clear_line(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in PLAIN
    path = written(tmp_path, PLAIN.replace(old, new, 1))
    with pytest.raises(ConfigError) as caught:
        Scenario.from_toml(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: {message}"), text
    assert "\n" not in text


def test_bad_files(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.toml: no such file, expected a scenario"):
        Scenario.from_toml(tmp_path / "none.toml")
    with pytest.raises(ConfigError, match="is a folder, expected a scenario"):
        Scenario.from_toml(tmp_path)
    with pytest.raises(ConfigError, match="the file is empty, expected a scenario"):
        Scenario.from_toml(written(tmp_path, ""))
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match=r"bytes\.toml: is no TOML file"):
        Scenario.from_toml(tmp_path / "bytes.toml")


def test_direct_values_are_frozen(tmp_path: Path) -> None:
    scenario: Any = read(tmp_path)
    with pytest.raises(ValueError, match="frozen"):
        scenario.seed = 3
