"""run and compare: the same bits, the checks at the door, and what was assumed."""

from __future__ import annotations

import subprocess
import sys
import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from terranav.core.errors import ConfigError, DataError, DataWarning
from terranav.core.ins_grade import InsGrade
from terranav.core.recording import Recording
from terranav.core.records import Candidates, Prior, Profile
from terranav.experiment.compare import compare
from terranav.experiment.registry import estimators, make_estimator
from terranav.experiment.run import run
from terranav.filters.ins import InsOnly
from terranav.filters.pointmass import PointMass
from terranav.maps.fields import plane_map
from terranav.matchers.tercom import Tercom
from terranav.matchers.windowed import Windowed
from tests.experiment.helpers import INS, chart, flight, without_truth

SCRIPT = """
from terranav.experiment.run import run
from tests.experiment.helpers import chart, flight
print(run("pointmass", flight(), [chart()], seed=9).digest())
"""


def test_same_seed_same_bits_twice_and_in_two_processes() -> None:
    digest = run("pointmass", flight(), [chart()], seed=9).digest()
    assert run("pointmass", flight(), [chart()], seed=9).digest() == digest
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == digest


def test_results_do_not_depend_on_who_else_is_compared() -> None:
    together = compare(estimators(), flight(), [chart()], seed=9)
    assert list(together) == estimators()
    for name, result in together.items():
        assert run(name, flight(), [chart()], seed=9).digest() == result.digest()
    reversed_order = compare(estimators()[::-1], flight(), [chart()], seed=9)
    assert {name: result.digest() for name, result in reversed_order.items()} == {
        name: result.digest() for name, result in together.items()
    }


def test_truth_never_reaches_the_estimator() -> None:
    blind = run("pointmass", without_truth(flight()), [chart()])
    seeing = run("pointmass", flight(), [chart()])
    np.testing.assert_array_equal(blind.cov_m2, seeing.cov_m2)
    np.testing.assert_array_equal(blind.lat_deg, seeing.lat_deg)
    assert not blind.has_truth
    assert seeing.metrics()["final_m"] < 30.0


def test_errors_are_what_they_are_called() -> None:
    result = run("ins", flight())
    np.testing.assert_allclose(result.error_m, flight().ins_error_m(), atol=1e-6)
    np.testing.assert_allclose(result.indicated_error_m, flight().ins_error_m(), atol=1e-6)
    assert result.name == "short"
    assert len(result) == 60


def test_what_is_given_wins_over_the_recording() -> None:
    other = InsGrade(position_sigma_m=80.0)
    assert run("ins", flight()).cov_m2[0, 0, 0] == INS.position_sigma_m**2
    assert run("ins", flight(), ins=other).cov_m2[0, 0, 0] == 80.0**2
    prior = Prior(np.array([10.0, 20.0]), np.diag([4.0, 9.0]))
    result = run("ins", flight(), ins=other, prior=prior)
    np.testing.assert_array_equal(result.cov_m2[0], prior.cov_m2)
    np.testing.assert_allclose(result.ins_error_m[0], [10.0, 20.0])


def test_provenance_says_how_to_do_it_again() -> None:
    facts = run("tercom", flight(), chart(), seed=5, metric="mad", window=20).provenance
    assert facts["seed"] == 5
    assert facts["estimator"]["name"] == "tercom"
    assert facts["estimator"]["settings"]["window"] == 20
    assert facts["estimator"]["settings"]["matcher"]["metric"] == "mad"
    assert facts["ins"]["velocity_sigma_mps"] == INS.velocity_sigma_mps
    assert facts["maps"][0]["checksum"] == chart().checksum
    assert facts["recording"]["name"] == "short"
    assert facts["versions"]["numba"]
    assert facts["assumed"] == []
    assert facts["wall_s"] > 0.0
    again = run("ins", flight()).provenance["recording"]["checksum"]
    assert again == facts["recording"]["checksum"]
    louder = replace(flight(), sigma={"terrain_m": 4.0})
    assert run("ins", louder).provenance["recording"]["checksum"] != again


def test_progress_is_told() -> None:
    seen: list[tuple[int, int]] = []
    run("ins", flight(), on_epoch=lambda done, of: seen.append((done, of)))
    assert seen == [(i, 60) for i in range(1, 61)]
    labels: list[str] = []
    compare(["ins"], flight(), on_epoch=lambda label, done, of: labels.append(label))
    assert labels == ["ins"] * 60


def test_objects_bring_their_own_maps() -> None:
    named = run("pointmass", flight(), [chart()], max_cells=4000)
    given = run(PointMass((chart(),), INS, max_cells=4000), flight())
    assert given.digest() == named.digest()
    assert given.provenance["maps"] == named.provenance["maps"]
    assert given.map_cell_m == chart().cell_m
    wrapped = run(Tercom((chart(),)), flight())
    assert wrapped.digest() == run("tercom", flight(), [chart()]).digest()
    assert wrapped.digest() == run(Windowed(Tercom((chart(),)), INS), flight()).digest()
    assert set(compare([Tercom((chart(),)), InsOnly((), INS)], flight())) == {"tercom", "ins"}


def test_labels_with_settings() -> None:
    results = compare(
        {"plain": "tercom", "short": ("tercom", {"window": 12}), "own": PointMass((chart(),), INS)}, flight(), [chart()]
    )
    assert list(results) == ["plain", "short", "own"]
    assert results["short"].provenance["estimator"]["settings"]["window"] == 12
    assert results["plain"].digest() == run("tercom", flight(), [chart()]).digest()


class Nearest:
    """A matcher from outside the package."""

    def match(self, prior: Prior, profile: Profile) -> Candidates:
        return Candidates(np.zeros((1, 2)), np.eye(2)[None], np.ones(1), np.zeros(1))


@pytest.mark.parametrize(
    ("estimator", "settings", "message"),
    [
        ("pointmas", {}, r"unknown estimator 'pointmas' \(did you mean 'pointmass'\?\); known: .*ins, .*pointmass"),
        ("windowed", {}, "unknown estimator 'windowed'"),
        ("_peaks", {}, "unknown estimator '_peaks'"),
        ("pointmass", {"max_cell": 5}, r"unknown setting of 'pointmass' 'max_cell' \(did you mean 'max_cells'\?\)"),
        ("tercom", {"windw": 5}, r"unknown setting of 'tercom' 'windw' \(did you mean 'window'\?\)"),
        ("tercom", {"matcher": 5}, "unknown setting of 'tercom' 'matcher'"),
        ("tercom", {"metric": "mse"}, "metric 'mse'"),
        ("pointmass", {"max_cells": "many"}, "max_cells is 'many', expected"),
        (InsOnly((), INS), {"window": 5}, "settings window are given beside the object 'ins'"),
        (PointMass, {}, "estimator is the class PointMass, expected its name or an object"),
        (3, {}, "estimator is 3, expected a name or an object with"),
        (Nearest(), {}, "windowed matcher Nearest has no maps"),
    ],
)
def test_bad_estimators(estimator: Any, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        run(estimator, flight(), [chart()], **settings)


def test_windows_longer_than_the_recording() -> None:
    wrong = r"window is 5000, but short holds 60 readings to compare; expected at most that many"
    with pytest.raises(ConfigError, match=f"tercom {wrong}"):
        run("tercom", flight(), [chart()], window=5000)
    with pytest.raises(ConfigError, match=f"tercom {wrong}"):
        compare({"long": ("tercom", {"window": 5000})}, flight(), [chart()])
    with pytest.raises(ConfigError, match="fading_memory readings is 61"):
        run("fading_memory", flight(), [chart()], readings=61)


def test_estimators_are_found_without_importing_them() -> None:
    script = (
        "import sys; from terranav.experiment.registry import estimators; print(estimators()); "
        "print(sorted({'numba', 'rasterio', 'pandas', 'matplotlib', 'pyarrow', 'scipy'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    names, heavy = done.stdout.splitlines()
    assert {"ins", "pointmass", "sitan", "tercom"} <= set(eval(names))
    assert heavy == "[]"
    assert make_estimator("ins", [], INS) == InsOnly((), INS)


@pytest.mark.parametrize("seed", [-1, 1.5, True, "7"])
def test_bad_seed(seed: Any) -> None:
    with pytest.raises(ConfigError, match=r"seed is .*, expected a whole number >= 0"):
        run("ins", flight(), seed=seed)


def test_nothing_to_compare() -> None:
    bare = Recording({key: flight().columns[key] for key in ("time_s", "lat_deg", "lon_deg", "alt_m")}, INS)
    gravity = plane_map(0.0, 0.0, kind="gravity", centre_deg=chart().centre_deg)
    with pytest.raises(DataError, match="short: no map is given, expected at least one"):
        run("pointmass", flight())
    with pytest.raises(DataError, match="recording: holds no reading, expected at least one of kind terrain"):
        run("pointmass", bare, [chart()])
    with pytest.raises(DataError, match="short: holds readings of kind terrain, but the maps are of kind gravity"):
        run("pointmass", flight(), [gravity])
    with pytest.raises(ConfigError, match=r"maps holds 'dem\.tif', expected Map objects"):
        run("pointmass", flight(), ["dem.tif"])  # type: ignore[list-item]
    with pytest.raises(ConfigError, match="estimators is empty"):
        compare([], flight(), [chart()])
    with pytest.raises(ConfigError, match="estimator 'ins' is given twice, expected a mapping with a label for each"):
        compare(["ins", "ins"], flight(), [chart()])


def test_maps_that_miss_the_track() -> None:
    elsewhere = replace(chart(), transform=(*chart().transform[:5], chart().transform[5] + 3.0))
    message = r"short: the track spans 44\.99.* to 45\.\d+ N, 9\.99.* E, which no map covers \(synthetic spans 47\.95"
    with pytest.raises(DataError, match=message):
        run("pointmass", flight(), [elsewhere])
    with pytest.raises(DataError, match="which no map covers"):
        compare(["ins", "sitan"], flight(), elsewhere)


def test_maps_that_do_not_overlap() -> None:
    far = plane_map(0.0, 0.0, kind="gravity", centre_deg=(50.0, 50.0))
    with pytest.raises(DataError, match=r"which the gravity map does not cover \(.* spans 4\d\.\d+ to 50"):
        run("pointmass", flight(), [chart(), far])


def test_a_part_of_the_track_off_the_map_is_a_warning() -> None:
    south, west, north, east = chart().bounds_deg
    half = chart().crop(south, west, 0.5 * (south + north), east)
    with pytest.warns(DataWarning, match=r"short: the maps cover \d+\.\d % of the indicated positions") as caught:
        result = run("pointmass", flight(), [half])
    assert result.provenance["assumed"] == [str(caught[0].message)]
    assert caught[0].filename == __file__


@pytest.mark.parametrize(("map_scale", "reading_scale"), [(1 / 0.3048, 1.0), (1.0, 1 / 0.3048)])
def test_feet_taken_for_metres_are_doubted(map_scale: float, reading_scale: float) -> None:
    """A map (or readings) in feet that nobody says is in feet."""
    raised = replace(chart(), values=(chart().values + 400.0) * np.float32(map_scale), name="raised")
    rec = flight().with_columns(terrain_m=(flight().columns["terrain_m"] + 400.0) * reading_scale)
    with pytest.warns(
        DataWarning, match=r"median terrain reading is \d+ m where raised has \d+ m; is the unit of .* feet"
    ):
        run("pointmass", rec, [raised])
    straight = replace(raised, values=chart().values + np.float32(400.0))
    run("pointmass", flight().with_columns(terrain_m=flight().columns["terrain_m"] + 400.0), [straight])


def test_what_is_assumed_is_said() -> None:
    bare = replace(flight(), ins=None, sigma={})
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", DataWarning)
        result = run("pointmass", bare, [chart()])
    texts = [str(one.message) for one in caught if one.category is DataWarning]
    assert texts == result.provenance["assumed"]
    assert texts[0].startswith("short: nothing is said about the INS; assumed position_sigma_m = 500, velocity")
    assert texts[1] == "short: no sigma is given for some readings; assumed terrain_m = 5 m"
    with pytest.warns(DataWarning, match="assumed radar_altitude_m = 3 m, baro_altitude_m = 5 m"):
        run("pointmass", _raw(), [chart()])


def test_sigma_columns_and_tables_need_no_warning() -> None:
    n = len(flight())
    own = replace(flight(), sigma={}).with_columns(terrain_sigma_m=np.full(n, 2.0))
    run("pointmass", own, [chart()])
    run("pointmass", replace(_raw(), sigma={"radar_altitude_m": 2.0, "baro_altitude_m": 2.0}), [chart()])


def _raw() -> Recording:
    """The flight with raw readings in place of ready ones."""
    columns = {key: value for key, value in flight().columns.items() if key != "terrain_m"}
    columns["radar_altitude_m"] = flight().alt_m - flight().columns["terrain_m"]
    columns["baro_altitude_m"] = flight().alt_m
    return replace(flight(), columns=columns, sigma={})


def test_one_map_needs_no_list_around_it() -> None:
    chart = plane_map(0.1, 0.2)
    assert make_estimator("pointmass", chart, InsGrade()) == make_estimator("pointmass", [chart], InsGrade())
    for wrong in ("map.tif", 3, [chart, "map.tif"]):
        with pytest.raises(ConfigError, match="expected Map objects"):
            make_estimator("pointmass", wrong, InsGrade())  # type: ignore[arg-type]
