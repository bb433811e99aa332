"""tn.smooth: what it gains over the filter, that it means its covariance, and what it refuses."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import terranav as tn
from terranav.core.earth import shift
from terranav.core.errors import ConfigError, DataError
from terranav.core.recording import Recording
from terranav.experiment.result import Result
from terranav.maps.fields import gaussian_map
from terranav.maps.map import Map
from tests.experiment.helpers import chart, flight

FloatArray = NDArray[np.float64]
RUNS = 30
EPOCHS = 120
#: without the monitor, which has tests of its own
SETTINGS: dict[str, dict[str, Any]] = {"marginalized": {"integrity": False}, "pointmass": {"max_cells": 40_000}}
smoothable = pytest.mark.parametrize("name", list(SETTINGS))


def rough(seed: int) -> tuple[Recording, Map]:
    """Rough ground, another for each seed, a reading every 2 s, an INS of 200 m and 0.3 m/s."""
    ground = gaussian_map(np.random.default_rng(seed), std=60.0, correlation_m=600.0, cells=241, cell_m=60.0, sigma=0.5)
    time_s = np.arange(float(EPOCHS))
    lat, lon = shift(*ground.centre_deg, 30.0 * time_s - 2000.0, 20.0 * time_s - 1200.0)
    noise = np.random.default_rng([seed, 1]).normal(0.0, 5.0, EPOCHS)
    terrain = np.where(time_s % 2.0 == 0.0, ground.sample(lat, lon) + noise, np.nan)
    columns = {"time_s": time_s, "lat_deg": lat, "lon_deg": lon, "alt_m": np.full(EPOCHS, 900.0), "terrain_m": terrain}
    exact = Recording(columns, sigma={"terrain_m": 5.0}, name="rough")
    return tn.add_drift(exact, tn.InsGrade(200.0, 0.3, 1.0), 100 + seed), ground


@cache
def pairs(name: str) -> list[tuple[Result, Result]]:
    """Filter and smoother, for every seed but those, at most one, where the filter itself ended at a wrong place."""
    found = []
    for seed in range(RUNS + 1):
        rec, ground = rough(seed)
        both = [method(name, rec, [ground], seed=seed, **SETTINGS[name]) for method in (tn.run, tn.smooth)]
        if np.hypot(*both[0].error_m[-1]) < 300.0:
            found.append((both[0], both[1]))
    assert len(found) >= RUNS
    return found


def squared(result: Result) -> FloatArray:
    return np.asarray(np.sum(result.error_m**2, axis=1))


@smoothable
def test_better_than_the_filter_before_its_first_fix(name: str) -> None:
    """The issue asks for 20 % in RMSE; on rough ground it is far more."""
    before = []
    for filtered, smoothed in pairs(name):
        fix_s = filtered.metrics()["first_fix_s"]
        early = filtered.time_s < (fix_s if np.isfinite(fix_s) else np.inf)
        before.append([squared(one)[early].mean() for one in (filtered, smoothed)])
    whole = np.array(before)
    of_filter, of_smoother = np.sqrt(whole.mean(axis=0))
    assert of_smoother < 0.5 * of_filter
    of_filter, of_smoother = np.sqrt(np.median(whole, axis=0))
    assert of_smoother < 0.5 * of_filter


@smoothable
def test_never_worse_on_average(name: str) -> None:
    """In every tenth of the run, over all seeds; the last epoch is the filter's."""
    filtered, smoothed = (np.array([squared(pair[i]) for pair in pairs(name)]) for i in (0, 1))
    for part in np.array_split(np.arange(EPOCHS), 10):
        assert np.sqrt(smoothed[:, part].mean()) <= 1.02 * np.sqrt(filtered[:, part].mean())
    assert np.array_equal(filtered[:, -1], smoothed[:, -1])


@smoothable
def test_means_its_covariance(name: str) -> None:
    """NEES per axis about one. The errors of a run are alike from its start to its end, so that 30 runs are worth some
    30 to 60 draws of a chi-square with 2 degrees of freedom: their mean is within 0.4 of one 95 % of the time. The
    point-mass filter is cautious by its model of the drift."""
    metrics = [smoothed.metrics() for _, smoothed in pairs(name)]
    assert (0.6 if name == "marginalized" else 0.3) < np.mean([one["nees_per_axis"] for one in metrics]) < 1.4
    assert np.mean([one["contained_95"] for one in metrics]) > 0.88


@smoothable
def test_covers_every_epoch_and_ends_as_the_filter(name: str) -> None:
    filtered, smoothed = pairs(name)[0]
    assert smoothed.estimator == f"{name} smoothed"
    assert np.array_equal(smoothed.time_s, filtered.time_s)
    assert np.isfinite(smoothed.error_m).all()
    assert (np.linalg.eigvalsh(smoothed.cov_m2) > 0.0).all()
    for key in ("lat_deg", "lon_deg", "cov_m2", "status"):
        assert np.array_equal(getattr(smoothed, key)[-1], getattr(filtered, key)[-1])
    assert smoothed.posterior is not None


@smoothable
def test_a_search_that_ended_well_was_a_fix(name: str) -> None:
    filtered, smoothed = pairs(name)[1]
    first = int(np.argmax(filtered.status == "converged"))
    assert first > 0
    sigma = np.sqrt(np.linalg.eigvalsh(smoothed.cov_m2)[:, -1])
    expected = np.where((sigma <= smoothed.map_cell_m)[:first], "converged", filtered.status[:first])
    assert (smoothed.status[:first] == expected).all()
    assert (smoothed.status[first:] == filtered.status[first:]).all()
    assert smoothed.metrics()["first_fix_s"] < filtered.metrics()["first_fix_s"]


@smoothable
def test_same_seed_same_bits(name: str) -> None:
    settings = SETTINGS[name]
    one, two = (tn.smooth(name, flight(20), [chart()], seed=3, **settings) for _ in range(2))
    assert one.digest() == two.digest()
    assert one.provenance["smoothed"] is True
    assert one.digest() != tn.run(name, flight(20), [chart()], seed=3, **settings).digest()


@smoothable
def test_counts_both_passes(name: str) -> None:
    told: list[tuple[int, int]] = []
    tn.smooth(name, flight(15), [chart()], on_epoch=lambda done, of: told.append((done, of)), **SETTINGS[name])
    assert told == [(k, 30) for k in range(1, 31)]


@smoothable
def test_a_gap_of_an_hour(name: str) -> None:
    """The INS drifts on in the gap, and the smoother carries the fix after it back to its beginning and no further."""
    rec = flight(40)
    time_s = np.where(np.arange(40) < 20, rec.time_s, rec.time_s + 3600.0)
    result = tn.smooth(name, replace(rec, columns={**rec.columns, "time_s": time_s}), [chart()], **SETTINGS[name])
    assert np.isfinite(result.error_m).all()
    assert (np.linalg.eigvalsh(result.cov_m2) > 0.0).all()


def test_what_a_monitor_said_in_flight_does_not_carry_over() -> None:
    filtered, smoothed = (method("marginalized", flight(40), [chart()], seed=1) for method in (tn.run, tn.smooth))
    assert np.array_equal(smoothed.cov_m2[-1], filtered.cov_m2[-1])
    assert np.isnan(smoothed.protection_m).all()
    assert not smoothed.usable.any()


def test_takes_an_object_and_its_maps() -> None:
    method = tn.make_estimator("pointmass", [chart()], tn.InsGrade(150.0, 0.3, 0.5), max_cells=40_000)
    assert tn.smooth(method, flight(20)).estimator == "pointmass smoothed"


@pytest.mark.parametrize("name", ["tercom", "sitan", "ins"])
def test_names_what_can_be_smoothed(name: str) -> None:
    with pytest.raises(ConfigError, match=f"^'{name}' cannot be smoothed, expected marginalized or pointmass$"):
        tn.smooth(name, flight(), [chart()])


def test_other_bad_input() -> None:
    with pytest.raises(ConfigError, match=r"unknown estimator 'pointmas' \(did you mean 'pointmass'\?\)"):
        tn.smooth("pointmas", flight(), [chart()])
    with pytest.raises(ConfigError, match="seed is -1"):
        tn.smooth("pointmass", flight(), [chart()], seed=-1)
    with pytest.raises(ConfigError, match="max_cell"):
        tn.smooth("pointmass", flight(), [chart()], max_cell=3)
    with pytest.raises(DataError, match="no map is given"):
        tn.smooth("pointmass", flight())
    with pytest.raises(ConfigError, match="cannot be smoothed"):
        tn.smooth(tn.make_estimator("sitan", [chart()], tn.InsGrade()), flight())
