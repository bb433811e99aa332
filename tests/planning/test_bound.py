"""The Cramer-Rao bound: a Kalman filter where that is exact, laws, and a filter that comes close to it."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import quad

import terranav as tn
from terranav.core.earth import offset_m, shift
from terranav.core.errors import ConfigError, DataError, DataWarning, StateError
from terranav.core.ins_grade import InsGrade
from terranav.core.kinds import KINDS
from terranav.core.recording import Recording
from terranav.core.records import Prior
from terranav.experiment.result import Result
from terranav.filters.marginalized import Marginalized
from terranav.ins.drift import add_drift
from terranav.maps.fields import gaussian_map, plane_map
from terranav.maps.map import Map
from terranav.planning import bound as bounds
from terranav.planning.bound import Bound, bound, informed, mixture_information, patch_slope

FloatArray = NDArray[np.float64]

INS = InsGrade(400.0, 0.5, 1.0, 0.01)
TERRAIN = KINDS["terrain"]
STEP_S = 2.0


def flight(chart: Map, epochs: int = 150, *, every: int = 1, kind: str = "terrain", sigma: float = 4.0) -> Recording:
    """A straight true flight over the middle of a map, oblique to its cells, with a drifting INS."""
    t = STEP_S * np.arange(epochs)
    away = 50.0 * (t - t[-1] / 2)
    lat, lon = shift(*chart.centre_deg, 0.83 * away, 0.56 * away)
    column = KINDS[kind].column
    reading = np.where(np.arange(epochs) % every == 0, KINDS[kind].sign * chart.sample(lat, lon), np.nan)
    columns = {"time_s": t, "lat_deg": lat, "lon_deg": lon, "alt_m": np.full(epochs, 2000.0), column: reading}
    return add_drift(Recording(columns, sigma={column: sigma}), INS, 11)


@pytest.fixture(scope="module")
def hills() -> Map:
    return gaussian_map(np.random.default_rng(2), std=120.0, correlation_m=900.0, cell_m=90.0, sigma=4.0)


def dynamics(rec: Recording, k: int, chart: Map) -> tuple[FloatArray, FloatArray]:
    """Transition and noise of (p, v, bias, patch) by hand."""
    north, east = offset_m(rec.lat_deg[k - 1], rec.lon_deg[k - 1], rec.lat_deg[k], rec.lon_deg[k])
    keep = math.exp(-math.hypot(north, east) / chart.error_length_m)
    dt, w2, a2 = STEP_S, INS.position_walk_m_per_sqrt_s**2, INS.velocity_walk_mps_per_sqrt_s**2
    phi, q = np.eye(6), np.zeros((6, 6))
    for i in (0, 1):
        phi[i, i + 2] = dt
        q[i, i], q[i + 2, i + 2] = w2 * dt + a2 * dt**3 / 3, a2 * dt
        q[i, i + 2] = q[i + 2, i] = a2 * dt**2 / 2
    q[4, 4] = TERRAIN.bias_walk**2 * dt
    phi[5, 5], q[5, 5] = keep, chart.sigma**2 * (1 - keep**2)
    return phi, q


def start(chart: Map) -> FloatArray:
    sigma = [INS.position_sigma_m] * 2 + [INS.velocity_sigma_mps] * 2 + [TERRAIN.bias_sigma, chart.sigma]
    return np.diag(np.square(sigma))


def test_is_the_covariance_of_the_kalman_filter_on_a_plane() -> None:
    chart = plane_map(0.25, -0.125, cells=513, cell_m=64.0, sigma=3.0, centre_deg=(0.0, 10.0))
    rec = flight(chart, sigma=5.0)
    found = bound(rec, chart, INS, outlier_share=0.0, blur_cells=0.0)
    cov, h = start(chart), np.array([-0.25, 0.125, 0.0, 0.0, 1.0, 1.0])
    for k in range(len(rec)):
        if k:
            phi, q = dynamics(rec, k, chart)
            cov = phi @ cov @ phi.T + q
        gain = cov @ h / (h @ cov @ h + 5.0**2)
        cov = (np.eye(6) - np.outer(gain, h)) @ cov
        assert found.cov_m2[k] == pytest.approx(cov[:2, :2], rel=1e-5)
    assert found.sigma is not None
    assert found.sigma[-1] == pytest.approx(np.sqrt(np.diag(cov)), rel=1e-5)
    assert found.names == ("north_m", "east_m", "vn_mps", "ve_mps", "terrain_bias", "terrain_patch")


def test_is_the_recursion_of_the_information(hills: Map) -> None:
    rec = flight(hills, 60, sigma=4.0)
    found = bound(rec, [hills], INS)
    lat, lon = rec.columns["true_lat_deg"], rec.columns["true_lon_deg"]
    share, scale, blur = Marginalized.outlier_share, Marginalized.outlier_scale, Marginalized.blur_cells
    away = 1e-3  # the slope anew, by small differences of what sampling says
    north = (hills.sample(*shift(lat, lon, away, 0.0)) - hills.sample(*shift(lat, lon, -away, 0.0))) / (2 * away)
    east = (hills.sample(*shift(lat, lon, 0.0, away)) - hills.sample(*shift(lat, lon, 0.0, -away))) / (2 * away)
    information = np.linalg.inv(start(hills))
    for k in range(len(rec)):
        if k:
            phi, q = dynamics(rec, k, hills)
            d22 = np.linalg.inv(q)  # Tichavsky et al. eq. 21: J' = D22 - D21 (J + D11)^-1 D12
            d12 = -phi.T @ d22
            information = d22 - d12.T @ np.linalg.inv(information + phi.T @ d22 @ phi) @ d12
        h = np.array([-north[k], -east[k], 0.0, 0.0, 1.0, 1.0])
        white = 4.0**2 + (blur * hills.cell_m) ** 2 * (north[k] ** 2 + east[k] ** 2)
        reach = scale * math.hypot(4.0, hills.sigma)
        information = information + mixture_information(share, reach / math.sqrt(white)) / white * np.outer(h, h)
        assert found.cov_m2[k] == pytest.approx(np.linalg.inv(information)[:2, :2], rel=1e-3)


@pytest.mark.parametrize(("share", "reach"), [(0.05, 2.8), (0.01, 50.0), (0.5, 1.5), (0.3, 20.0), (0.2, 0.1)])
def test_information_of_a_mixture(share: float, reach: float) -> None:
    def density(x: float) -> float:
        normal = math.exp(-(x**2) / 2) / math.sqrt(2 * math.pi)
        return (1 - share) * normal + share * reach / (math.pi * (x**2 + reach**2))

    def squared_score(x: float) -> float:
        slope = (density(x + 1e-4) - density(x - 1e-4)) / 2e-4
        return slope**2 / density(x)

    pieces = sorted([0.0, 0.3, 1.0, 2.0, 4.0, 8.0, 2 * reach, 8 * reach, 1000.0])
    there = sum(quad(squared_score, a, b, limit=200)[0] for a, b in pairwise(pieces))
    found = mixture_information(share, reach)
    assert found == pytest.approx(2 * there, rel=1e-4)
    assert found < 1 - share + share / (2 * reach**2)  # if one knew who is who
    assert mixture_information(0.0, reach) == 1.0


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:32632"])
def test_slope_is_that_of_sampling(crs: str, hills: Map) -> None:
    chart = hills
    if crs != "EPSG:4326":
        chart = replace(hills, transform=(90.0, 10.0, 550000.0, 5.0, -90.0, 5000000.0), crs=crs)
    rng = np.random.default_rng(5)
    lat, lon = shift(*chart.centre_deg, *rng.uniform(-4000.0, 4000.0, (2, 200)))
    row, col = chart.cells(lat, lon)
    middle = (np.abs(row % 1 - 0.5) < 0.49) & (np.abs(col % 1 - 0.5) < 0.49)  # not where the slope jumps
    found = patch_slope(chart, lat, lon)[middle]
    lat, lon = lat[middle], lon[middle]
    for axis, (north, east) in enumerate(((0.1, 0.0), (0.0, 0.1))):
        rise = chart.sample(*shift(lat, lon, north, east)) - chart.sample(*shift(lat, lon, -north, -east))
        assert found[:, axis] == pytest.approx(rise / 0.2, abs=2e-5)


class Tiled(Map):
    """A map of which only windows may be looked at."""

    def around(self, lat_deg: ArrayLike, lon_deg: ArrayLike, radius_m: float) -> Map:
        lat, lon = np.asarray(lat_deg), np.asarray(lon_deg)
        low = [float(axis) for axis in shift(lat.min(), lon.min(), -radius_m, -radius_m)]
        high = [float(axis) for axis in shift(lat.max(), lon.max(), radius_m, radius_m)]
        fields = {name: getattr(self, name) for name in Map.__dataclass_fields__}
        part = Map(**fields).crop(*low, *high)
        assert part.values.size <= 6 * 400  # the 400 asked for, and cells on every side
        return part


def test_slopes_need_no_more_of_a_map_than_windows(hills: Map, monkeypatch: pytest.MonkeyPatch) -> None:
    """Positions all over a map, off it too: the same slopes, by windows of a few cells."""
    monkeypatch.setattr(bounds, "WINDOW_CELLS", 400)
    south, west, north, east = hills.bounds_deg
    rng = np.random.default_rng(6)
    lat, lon = rng.uniform(south - 0.01, north + 0.01, 300), rng.uniform(west - 0.01, east + 0.01, 300)
    lat[:3], lon[:3] = (south, north, np.nan), (west, east, west)
    tiled = Tiled(**{name: getattr(hills, name) for name in Map.__dataclass_fields__})
    found, whole = patch_slope(tiled, lat, lon), patch_slope(hills, lat, lon)
    assert (whole != 0.0).any(axis=1).sum() > 200
    np.testing.assert_allclose(found, whole, rtol=1e-6, atol=1e-9)


def test_off_the_map_and_in_voids_there_is_no_information(hills: Map) -> None:
    values = hills.values.copy()
    values[:, 120:140] = np.nan
    holed = replace(hills, values=values)
    rec = flight(holed)
    lat, lon = rec.columns["true_lat_deg"], rec.columns["true_lon_deg"]
    known = np.isfinite(holed.sample(lat, lon))
    assert 0 < known.sum() < len(rec)
    rec = rec.with_columns(terrain_m=np.full(len(rec), 500.0))
    kept = rec.with_columns(terrain_m=np.where(known, 500.0, np.nan))
    assert np.array_equal(bound(rec, holed, INS).cov_m2, bound(kept, holed, INS).cov_m2)
    assert (patch_slope(holed, lat, lon)[~known] == 0.0).all()


def test_grows_like_the_ins_on_flat_land() -> None:
    flat = plane_map(0.0, 0.0, cells=257, cell_m=100.0, sigma=2.0)
    rec = flight(flat)
    t, walk = rec.time_s, INS.velocity_walk_mps_per_sqrt_s
    variance = 400.0**2 + (0.5 * t) ** 2 + 1.0**2 * t + walk**2 * t**3 / 3
    found = bound(rec, flat, INS)
    assert found.cov_m2 == pytest.approx(variance[:, None, None] * np.eye(2), rel=1e-9)
    assert found.drms_m == pytest.approx(np.sqrt(2 * variance))
    assert found.sigma_m == pytest.approx(np.sqrt(np.stack([variance, variance], axis=1)))


def test_more_knowledge_never_raises_it(hills: Map) -> None:
    rec = flight(hills)
    gravity = gaussian_map(np.random.default_rng(3), std=20.0, correlation_m=3000.0, mean=0.0, kind="gravity")
    lat, lon = rec.columns["true_lat_deg"], rec.columns["true_lon_deg"]
    both = replace(rec.with_columns(gravity_mgal=gravity.sample(lat, lon)), sigma={**rec.sigma, "gravity_mgal": 1.0})
    told = bound(both, [hills, gravity], INS)
    fewer = [
        bound(both, hills, INS),
        bound(flight(hills, every=3), hills, INS),
        bound(replace(both, sigma={"terrain_m": 8.0, "gravity_mgal": 1.0}), [hills, gravity], INS),
        bound(both, [hills, gravity], replace(INS, position_sigma_m=800.0)),
        bound(both, [hills, gravity], INS, bias_sigma={"terrain": 60.0}),
        bound(both, [hills, gravity], INS, outlier_share=0.2),
        bound(both, [hills, gravity], INS, blur_cells=0.5),
        bound(both, [replace(hills, sigma=10.0), gravity], INS),
    ]
    for less in fewer:
        assert (np.linalg.eigvalsh(less.cov_m2 - told.cov_m2) >= -1e-9).all()
        assert (less.drms_m >= told.drms_m * (1 - 1e-12)).all()
    assert told.drms_m[-1] < fewer[0].drms_m[-1] < 100.0


def test_the_readings_values_and_the_prior_mean_do_not_count(hills: Map) -> None:
    rec = flight(hills)
    found = bound(rec, hills, INS, prior=Prior(np.array([300.0, -50.0]), 400.0**2 * np.eye(2)))
    shuffled = rec.with_columns(terrain_m=rec.columns["terrain_m"][::-1] + 40.0)
    assert np.array_equal(found.cov_m2, bound(shuffled, hills, INS).cov_m2)
    wide = bound(rec, hills, INS, prior=Prior(np.zeros(2), 400.0**2 * np.eye(2), "uniform"))
    normal = bound(rec, hills, INS, prior=Prior(np.zeros(2), 3.0 * 400.0**2 * np.eye(2)))
    assert np.array_equal(wide.cov_m2, normal.cov_m2)


def test_raw_altimeters_count(hills: Map) -> None:
    rec = flight(hills)
    columns = {key: value for key, value in rec.columns.items() if key != "terrain_m"}
    columns |= {"radar_altitude_m": 2000.0 - rec.columns["terrain_m"], "baro_altitude_m": np.full(len(rec), 2000.0)}
    raw = replace(rec, columns=columns, sigma={"radar_altitude_m": 2.4, "baro_altitude_m": 3.2})
    assert bound(raw, hills, INS).cov_m2 == pytest.approx(bound(rec, hills, INS).cov_m2)


def test_truth_that_is_missing_here_and_there_is_filled(hills: Map) -> None:
    rec = flight(hills)
    there = np.arange(len(rec)) % 5 != 2
    gaps = {key: np.where(there, rec.columns[key], np.nan) for key in ("true_lat_deg", "true_lon_deg")}
    whole, filled = bound(rec, hills, INS), bound(rec.with_columns(**gaps), hills, INS)
    assert filled.drms_m == pytest.approx(whole.drms_m, rel=0.05)


def test_what_it_refuses(hills: Map) -> None:
    rec = flight(hills)
    blind = replace(rec, columns={key: value for key, value in rec.columns.items() if not key.startswith("true_")})
    mute = replace(rec, columns={key: value for key, value in rec.columns.items() if key != "terrain_m"}, sigma={})
    deep = replace(hills, kind="bathymetry")
    with pytest.raises(StateError, match=r"^recording: the bound needs the true track"):
        bound(blind, hills)
    with pytest.raises(DataError, match="no map is given"):
        bound(rec, [])
    with pytest.raises(ConfigError, match="expected one map of each kind"):
        bound(rec, [hills, hills])
    with pytest.raises(DataError, match="holds no reading, expected at least one of kind terrain"):
        bound(mute, hills)
    with pytest.raises(DataError, match="readings of kind terrain, expected at least one of kind bathymetry"):
        bound(rec, deep)
    with pytest.raises(ConfigError, match="expected Map objects"):
        bound(rec, ["dem.tif"])  # type: ignore[list-item]
    for setting in ({"outlier_share": 0.7}, {"outlier_scale": 0.0}, {"blur_cells": -1.0}, {"bias_sigma": {"x": 1.0}}):
        with pytest.raises(ConfigError, match=r"bound (outlier_share|outlier_scale|blur_cells|bias_sigma)"):
            bound(rec, hills, **setting)
    with pytest.warns(DataWarning, match="the bound assumes"):
        bound(replace(rec, ins=None), hills)


def test_joseph_form_stays_positive() -> None:
    cov = np.diag([1e8, 1e8, 1e-12, 1e4])
    rng = np.random.default_rng(1)
    for _ in range(200):
        cov = informed(cov, rng.normal(size=4), 1e-6)
        cov = 0.5 * (cov + cov.T)
        assert np.linalg.eigvalsh(cov)[0] > -1e-18


def test_public_names() -> None:
    assert tn.bound is bound
    assert tn.Bound is Bound


def drawn(chart: Map, rng: np.random.Generator, epochs: int = 200) -> Recording:
    """One flight drawn from the very model: drift, bias, correlated patch, outliers, the place within the cell."""
    t = STEP_S * np.arange(epochs)
    away = 60.0 * (t - t[-1] / 2)
    lat, lon = shift(*chart.centre_deg, 0.83 * away, 0.56 * away)
    keep = math.exp(-60.0 * STEP_S / chart.error_length_m)
    patch = rng.normal(0.0, chart.sigma, epochs)
    for k in range(1, epochs):
        patch[k] = keep * patch[k - 1] + math.sqrt(1 - keep**2) * patch[k]
    bias: FloatArray = rng.normal(0.0, TERRAIN.bias_sigma) + np.concatenate(
        [[0.0], np.cumsum(rng.normal(0.0, TERRAIN.bias_walk * math.sqrt(STEP_S), epochs - 1))]
    )
    far = Marginalized.outlier_scale * math.hypot(3.0, chart.sigma) * rng.standard_cauchy(epochs)
    outlier = rng.random(epochs) < Marginalized.outlier_share
    slope = np.hypot(*patch_slope(chart, lat, lon).T)
    sigma = np.hypot(3.0, Marginalized.blur_cells * chart.cell_m * slope)
    reading = chart.sample(lat, lon) + bias + patch + np.where(outlier, far, sigma * rng.standard_normal(epochs))
    columns = {"time_s": t, "lat_deg": lat, "lon_deg": lon, "alt_m": np.full(epochs, 2000.0), "terrain_m": reading}
    return add_drift(Recording(columns, sigma={"terrain_m": 3.0}), INS, rng)


@pytest.mark.filterwarnings("ignore:.*terrain readings lie:terranav.core.errors.DataWarning")  # a bias is drawn
def test_the_filter_comes_close_to_it() -> None:
    chart = gaussian_map(np.random.default_rng(8), std=150.0, correlation_m=800.0, cell_m=90.0, cells=400, sigma=4.0)
    squared, bounds = [], []
    for seed in range(40):
        rec = drawn(chart, np.random.default_rng(seed))
        found: Result = tn.run("marginalized", rec, chart, seed=seed)
        squared.append(np.sum(found.error_m**2, axis=1))
        bounds.append(bound(rec, chart).drms_m)
    after = rec.time_s > 150.0
    rmse = np.sqrt(np.mean(squared, axis=0)[after].mean())
    least = np.sqrt(np.mean(np.square(bounds), axis=0)[after].mean())
    assert 0.9 < rmse / least < 1.3
