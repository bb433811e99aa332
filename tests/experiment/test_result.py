"""Result: metrics over the right epochs, and a file that gives back every bit."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terranav.core.errors import ConfigError, DataError
from terranav.core.records import Estimate, Posterior, Status
from terranav.experiment.result import Result
from terranav.experiment.run import run
from terranav.io.results import read_result_table, write_result_table
from tests.experiment.helpers import chart, flight, without_truth


def made(**changes: object) -> Result:
    """Four epochs with errors of 0, 30, 40 and 50 m north."""
    metre = 1.0 / 110574.2758  # of latitude at the equator [deg]
    result = Result(
        estimator="made",
        time_s=np.array([5.0, 6.0, 8.0, 9.0]),
        lat_deg=metre * np.array([0.0, 30.0, 40.0, 50.0]),
        lon_deg=np.zeros(4),
        alt_m=np.full(4, 100.0),
        status=np.array(["searching", "lost", "converged", "degraded"]),
        ins_error_m=np.zeros((4, 2)),
        cov_m2=np.broadcast_to(np.diag([100.0, 400.0]), (4, 2, 2)),
        nis=np.array([np.nan, 1.0, 1.1, 1.2]),
        indicated_lat_deg=np.zeros(4),
        indicated_lon_deg=np.full(4, 2.0),
        true_lat_deg=np.zeros(4),
        true_lon_deg=np.zeros(4),
        map_cell_m=25.0,
        provenance={"seed": 1},
        name="recording of four",
    )
    return replace(result, **changes)  # type: ignore[arg-type]


def test_metrics_by_hand() -> None:
    figures = made().metrics()
    assert figures["n"] == 4
    assert figures["max_m"] == pytest.approx(50.0, rel=1e-5)
    assert figures["drms_m"] == pytest.approx(math.sqrt(5000.0 / 4.0), rel=1e-5)
    assert figures["match_rate"] == 0.5  # within sqrt(2) cells of 25 m
    assert figures["first_fix_s"] == 3.0
    assert figures["lost_s"] == 2.0
    assert made().metrics(match_m=45.0)["match_rate"] == 0.75


def test_metrics_of_a_part() -> None:
    late = made().metrics(since_s=1.0)
    assert late["n"] == 3
    assert late["mean_m"] == pytest.approx(40.0, rel=1e-5)
    assert late["first_fix_s"] == 3.0  # from the start all the same
    assert late["lost_s"] == 2.0
    fixed = made().metrics(after_first_fix=True)
    assert (fixed["n"], fixed["lost_s"]) == (2, 0.0)
    assert made().metrics(since_s=4.0, after_first_fix=True)["n"] == 1
    never = made(status=np.full(4, "searching")).metrics(after_first_fix=True)
    assert never["n"] == 0
    assert math.isnan(never["drms_m"])
    assert math.isnan(never["first_fix_s"])


def test_metrics_without_truth_or_map() -> None:
    figures = made(true_lat_deg=None, true_lon_deg=None).metrics()
    assert figures["n"] == 0
    assert math.isnan(figures["drms_m"])
    assert math.isnan(figures["contained_95"])
    assert (figures["first_fix_s"], figures["lost_s"]) == (3.0, 2.0)
    assert math.isnan(made(map_cell_m=math.nan).metrics()["match_rate"])
    assert np.isnan(made(true_lat_deg=None, true_lon_deg=None).error_m).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [({"since_s": -1.0}, "since_s is -1.0, expected"), ({"match_m": 0.0}, "match_m is 0.0, expected")],
)
def test_metrics_refuse(arguments: dict[str, float], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        made().metrics(arguments.get("since_s", 0.0), arguments.get("match_m"))


def assert_same(first: Result, second: Result) -> None:
    assert first.digest() == second.digest()
    for key in ("estimator", "name", "provenance"):
        assert getattr(first, key) == getattr(second, key)
    assert first.map_cell_m == second.map_cell_m or math.isnan(first.map_cell_m + second.map_cell_m)
    arrays = ("time_s", "lat_deg", "status", "ins_error_m", "cov_m2", "nis", "indicated_lon_deg", "true_lat_deg")
    for key in (*arrays, "protection_m", "usable"):
        np.testing.assert_array_equal(getattr(first, key), getattr(second, key))
    assert first.reasons == second.reasons


def test_file_gives_back_every_bit(tmp_path: Path) -> None:
    result = run("pointmass", flight(), [chart()], seed=3)
    assert result.posterior is not None
    result.save(tmp_path / "result.parquet")
    loaded = Result.load(tmp_path / "result.parquet")
    assert_same(result, loaded)
    assert loaded.posterior is not None
    np.testing.assert_array_equal(loaded.posterior.weight, result.posterior.weight)
    assert loaded.metrics() == result.metrics()


def test_file_without_truth_posterior_or_map(tmp_path: Path) -> None:
    result = run("ins", without_truth(flight()))
    result.save(str(tmp_path / "result.parquet"))
    loaded = Result.load(str(tmp_path / "result.parquet"))
    assert_same(result, loaded)
    assert loaded.true_lat_deg is None
    assert loaded.posterior is None
    assert math.isnan(loaded.map_cell_m)


@given(st.lists(st.floats(width=64), min_size=4, max_size=4), st.sampled_from([None, "grid", "cloud"]))
def test_any_numbers_come_back(values: list[float], shape: str | None) -> None:
    import tempfile

    odd = np.array(values)
    weight = {"grid": np.tile(odd[:, None], 3), "cloud": odd}.get(shape or "")
    posterior = None if weight is None else Posterior(odd, odd[:3] if shape == "grid" else odd, weight)
    result = made(nis=odd, posterior=posterior)
    with tempfile.TemporaryDirectory() as folder:
        result.save(Path(folder) / "r.parquet")
        loaded = Result.load(Path(folder) / "r.parquet")
    np.testing.assert_array_equal(loaded.nis, odd)
    if posterior is not None and loaded.posterior is not None:
        np.testing.assert_array_equal(loaded.posterior.weight, posterior.weight)


def watched(**changes: object) -> Result:
    """The same four epochs with an integrity monitor."""
    told = {
        "protection_m": np.array([np.nan, np.inf, 45.0, 45.0]),
        "usable": np.array([False, False, True, True]),
        "reasons": ((), ("lost: \0 odd \u00e9", "withheld"), (), ()),
    }
    return made(**{**told, **changes})


def test_what_the_monitor_said_comes_back(tmp_path: Path) -> None:
    watched().save(tmp_path / "r.parquet")
    loaded = Result.load(tmp_path / "r.parquet")
    assert_same(watched(), loaded)
    assert loaded.usable.dtype == np.bool_
    assert loaded.watched
    figures = loaded.metrics()
    assert (figures["available"], figures["protection_m"], figures["misleading"]) == (0.5, 45.0, 0.5)


def test_estimates_bring_what_the_monitor_said() -> None:
    rec = flight()
    estimates = [
        Estimate(t, 45.0, 10.0, 0.0, np.zeros(2), np.eye(2), Status.CONVERGED, 1.0, 5.0 + k, k > 2, (f"why {k}",))
        for k, t in enumerate(rec.time_s.tolist())
    ]
    result = Result.from_estimates("made", estimates, rec)
    assert result.protection_m[:3].tolist() == [5.0, 6.0, 7.0]
    assert result.usable[:4].tolist() == [False, False, False, True]
    assert result.reasons[1] == ("why 1",)


def test_without_a_monitor(tmp_path: Path) -> None:
    assert not made().watched
    assert made().reasons == ((),) * 4
    assert not made().usable.any()
    assert math.isnan(made().metrics()["available"])
    made().save(tmp_path / "new.parquet")
    columns, metadata = read_result_table(tmp_path / "new.parquet")
    old = {key: value for key, value in columns.items() if key not in ("protection_m", "usable", "reasons")}
    facts = {key: value for key, value in json.loads(metadata["terranav"]).items() if key != "reasons"}
    write_result_table(tmp_path / "old.parquet", old, {"terranav": json.dumps(facts)})
    assert_same(Result.load(tmp_path / "old.parquet"), made())


def test_digest_sees_every_array() -> None:
    assert made().digest() == made(provenance={}, name="other").digest()
    changed = {
        "nis": np.array([np.nan, 1.0, 1.1, np.nextafter(1.2, 2.0)]),
        "status": np.array(["searching", "lost", "converged", "lost"]),
        "cov_m2": np.broadcast_to(np.diag([100.0, 401.0]), (4, 2, 2)),
        "true_lat_deg": None,
        "posterior": Posterior(np.zeros(1), np.zeros(1), np.ones((1, 1))),
    }
    for key, value in changed.items():
        assert made(**{key: value}).digest() != made().digest(), key
    assert watched().digest() != made().digest()
    said: dict[str, object] = {
        "protection_m": np.array([np.nan, np.inf, 45.0, np.nextafter(45.0, 46.0)]),
        "usable": np.array([False, False, True, False]),
        "reasons": ((), ("lost: \0 odd \u00e9", "Withheld"), (), ()),
    }
    for key, told in said.items():
        assert watched(**{key: told}).digest() != watched().digest(), key
    shifted = watched(reasons=((), (), ("lost: \0 odd \u00e9", "withheld"), ()))
    assert shifted.digest() != watched().digest()


def test_load_refuses(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"none\.parquet"):
        Result.load(tmp_path / "none.parquet")
    other = tmp_path / "other.parquet"
    write_result_table(other, {"time_s": np.zeros(2)}, {})
    with pytest.raises(DataError, match=r"other\.parquet: terranav is missing, expected a result saved by terranav"):
        Result.load(other)
    facts = {"format": "terranav-result-99"}
    write_result_table(other, {"time_s": np.zeros(2)}, {"terranav": json.dumps(facts)})
    with pytest.raises(DataError, match=r"the format is 'terranav-result-99', expected 'terranav-result-1'"):
        Result.load(other)
    with pytest.raises(DataError, match="cannot be written"):
        made().save(tmp_path / "no" / "folder.parquet")
