"""The kernels of the navigator against plain numpy, compiled and not."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import cauchy, norm

from terranav.kernels import marginalized as kernels
from terranav.kernels import reading
from terranav.kernels.walk_scale import linearised
from terranav.maps.fields import gaussian_map
from terranav.maps.map import Map

FloatArray = NDArray[np.float64]
BIAS = 4  # index of the bias in the rows below, the patch comes next


@dataclass(frozen=True)
class Case:
    """A map with voids, a cloud partly beyond its edge, and what `compare` finds there."""

    chart: Map
    frame: FloatArray
    rows: FloatArray
    weight: FloatArray
    bad: FloatArray
    value: float
    residual: FloatArray
    slope2: FloatArray

    @property
    def cloud(self) -> FloatArray:
        """(6, 900): a row a state."""
        return np.ascontiguousarray(self.rows.T)

    @property
    def there(self) -> NDArray[np.bool_]:
        return np.isfinite(self.residual)


@pytest.fixture(scope="module")
def case() -> Case:
    rng = np.random.default_rng(4)
    chart = gaussian_map(rng, cells=41, cell_m=50.0)
    values = np.array(chart.values)
    values[:12, 25:] = np.nan
    values[30, 10] = np.nan
    chart = Map(values, chart.transform)
    rows = rng.normal(0.0, [600.0, 600.0, 0.5, 0.5, 10.0, 3.0], (900, 6))
    weight = rng.random(900) ** 2
    found = chart.local_frame(*chart.centre_deg)
    frame = np.stack([found.row, found.col])
    residual, slope2 = np.empty(900), np.empty(900)
    cloud = np.ascontiguousarray(rows.T)
    reading.compare(chart.values, frame, cloud, np.ones(900), 500.0, BIAS, residual, slope2)
    return Case(chart, frame, rows, weight / weight.sum(), 0.3 * rng.random(900), 500.0, residual, slope2)


def test_compare_is_the_reading_less_the_bilinear_map_bias_and_patch(case: Case) -> None:
    found = case.chart.local_frame(*case.chart.centre_deg)
    row, col = found.cells(-case.rows[:, 0], -case.rows[:, 1])
    padded = np.full((60, 60), np.nan)  # whatever lies off the map is void
    padded[9:50, 9:50] = case.chart.values
    i, j = np.clip(np.floor(row).astype(int), -9, 49), np.clip(np.floor(col).astype(int), -9, 49)
    u, v = row - i, col - j
    one, two, three, four = (padded[i + 9 + a, j + 9 + b] for a in (0, 1) for b in (0, 1))
    h = (1 - u) * ((1 - v) * one + v * two) + u * ((1 - v) * three + v * four)
    np.testing.assert_array_equal(case.there, np.isfinite(h))
    off = (row < 0) | (row > 40) | (col < 0) | (col > 40)
    assert off.sum() > 20
    assert (~case.there & ~off).sum() > 50  # voids
    expected = case.value - h - case.rows[:, BIAS] - case.rows[:, BIAS + 1]
    np.testing.assert_allclose(case.residual, expected, rtol=0.0, atol=1e-9)
    by_row, by_col = (1 - v) * (three - one) + v * (four - two), (1 - u) * (two - one) + u * (four - three)
    north = by_row * found.row[1] + by_col * found.col[1]
    east = by_row * found.row[2] + by_col * found.col[2]
    np.testing.assert_allclose(case.slope2[case.there], (north**2 + east**2)[case.there], rtol=1e-9)
    assert np.isfinite(case.slope2).all()


def test_the_slope_is_that_of_the_residual(case: Case) -> None:
    """By small differences of the cloud: no formula is shared with the kernel."""
    away = 1e-3
    unused = np.empty(len(case.rows))
    steps = []
    for axis in (0, 1):
        moved = [case.cloud.copy(), case.cloud.copy()]
        moved[0][axis] += away
        moved[1][axis] -= away
        after, before = np.empty(len(case.rows)), np.empty(len(case.rows))
        reading.compare(case.chart.values, case.frame, moved[0], case.weight, case.value, BIAS, after, unused)
        reading.compare(case.chart.values, case.frame, moved[1], case.weight, case.value, BIAS, before, unused)
        steps.append((after - before) / (2 * away))
    slope2 = steps[0] ** 2 + steps[1] ** 2
    row, col = case.chart.local_frame(*case.chart.centre_deg).cells(-case.rows[:, 0], -case.rows[:, 1])
    inner = (np.abs(row % 1 - 0.5) < 0.49) & (np.abs(col % 1 - 0.5) < 0.49) & np.isfinite(slope2)
    assert inner.sum() > 500
    np.testing.assert_allclose(case.slope2[inner], slope2[inner], rtol=1e-2, atol=1e-8)


def test_at_a_corner_with_a_void_beside_it_the_cell_itself_counts() -> None:
    values = np.array([[1.0, np.nan, 3.0], [4.0, np.nan, 6.0], [7.0, 8.0, 9.0]], dtype=np.float32)
    frame = np.zeros((2, 6))
    frame[0, 1], frame[1, 2] = -1.0, 1.0  # row = -north, col = east, one metre a cell
    rows = np.zeros((4, 4))
    rows[:, :2] = [[0.0, 0.0], [1.0, 0.0], [2.0, -1.0], [2.0 + 1e-3, -2.0]]
    residual, slope2 = np.empty(4), np.empty(4)
    cloud, weight = np.ascontiguousarray(rows.T), np.array([0.4, 0.3, 0.2, 0.1])
    known, mean, variance, _ = reading.compare(values, frame, cloud, weight, 10.0, 2, residual, slope2)
    np.testing.assert_array_equal(residual, [9.0, 6.0, 2.0, np.nan])
    assert known == pytest.approx(0.9)
    assert mean == pytest.approx((0.4 * 9.0 + 0.3 * 6.0 + 0.2 * 2.0) / 0.9)
    assert variance == pytest.approx((0.4 * 81.0 + 0.3 * 36.0 + 0.2 * 4.0) / 0.9 - mean**2)
    assert np.isfinite(slope2).all()


def test_compare_gives_the_mean_and_the_variance_of_what_is_known(case: Case) -> None:
    residual, slope2 = np.empty(900), np.empty(900)
    values, about = case.chart.values, (case.value, BIAS, residual, slope2)
    known, mean, variance, steep = reading.compare(values, case.frame, case.cloud, case.weight, *about)
    w, r = case.weight[case.there], case.residual[case.there]
    assert known == pytest.approx(w.sum(), rel=1e-12)
    assert mean == pytest.approx(np.average(r, weights=w), rel=1e-12)
    assert variance == pytest.approx(np.average((r - mean) ** 2, weights=w), rel=1e-9)
    assert steep == pytest.approx(np.average(case.slope2[case.there], weights=w), rel=1e-12)
    away = case.cloud + np.array([1e6, 0.0, 0.0, 0.0, 0.0, 0.0])[:, None]
    nothing = reading.compare(values, case.frame, away, case.weight, *about)
    assert nothing[0] == nothing[3] == 0.0
    assert np.isnan(nothing[1:3]).all()


def test_evidence_is_the_likelihood_of_a_mixture_under_each_scale(case: Case) -> None:
    scales, out = 2.0 ** np.arange(-2.0, 3.0), np.empty(5)
    noise, common, reach = np.array([16.0, 25.0]), np.array([9.0, 4.0]), 8.0
    reading.evidence(case.weight, case.residual, case.slope2, case.bad, noise, common, reach, scales, out)
    r, w, bad = case.residual[case.there], case.weight[case.there], case.bad[case.there]
    white = 16.0 + 25.0 * case.slope2[case.there] + 4.0
    expected = [
        np.average(
            (1 - bad) * norm.pdf(r, scale=np.sqrt(s * white + 9.0)) + bad * cauchy.pdf(r, scale=reach), weights=w
        )
        for s in scales
    ]
    np.testing.assert_allclose(out, expected, rtol=1e-10)
    reading.evidence(case.weight, np.full(900, np.nan), case.slope2, case.bad, noise, common, reach, scales, out)
    np.testing.assert_array_equal(out, 1.0)  # nothing known: nothing learned


def test_evidence_of_a_large_cloud_takes_every_few_particles(case: Case) -> None:
    many = 3000
    residual, slope2 = np.linspace(-9.0, 9.0, many), np.full(many, 0.04)
    weight, bad, out = np.full(many, 1.0 / many), np.full(many, 0.1), np.empty(1)
    reading.evidence(weight, residual, slope2, bad, np.array([4.0, 1.0]), np.zeros(2), 5.0, np.ones(1), out)
    likely = 0.9 * norm.pdf(residual, scale=math.sqrt(4.04)) + 0.1 * cauchy.pdf(residual, scale=5.0)
    assert out[0] == pytest.approx(likely[::5].mean(), rel=1e-10)
    assert out[0] == pytest.approx(likely.mean(), rel=2e-2)


WHITE, COMMON, REACH = np.array([900.0, 400.0]), 125.0, 60.0
GAIN = np.array([0.0, 0.0, 0.5, -0.2, 100.0, 25.0])


def weighed(case: Case, kernel: object = reading.weigh) -> tuple[FloatArray, FloatArray, FloatArray, tuple[Any, ...]]:
    return weighed_with(case, case.residual, case.bad, kernel)


def weighed_with(
    case: Case, residual: FloatArray, bad: FloatArray, kernel: object
) -> tuple[FloatArray, FloatArray, FloatArray, tuple[Any, ...]]:
    cloud, weight, bad, centre = case.cloud, np.empty(900), bad.copy(), case.weight @ case.rows
    about = residual.copy(), case.slope2, WHITE, COMMON, REACH, GAIN, centre
    told = kernel(cloud, case.weight, bad, *about, weight)  # type: ignore[operator]
    return cloud.T, weight, bad, told


def test_weigh_is_bayes_rule_for_weights_regimes_and_means(case: Case) -> None:
    rows, weight, bad, (likely, effective, _, mean, cov) = weighed(case)
    there = case.there
    total = WHITE[0] + WHITE[1] * case.slope2 + COMMON
    near = (1 - case.bad) * norm.pdf(case.residual, scale=np.sqrt(total))
    far = case.bad * cauchy.pdf(case.residual, scale=REACH)
    average = np.average((near + far)[there], weights=case.weight[there])
    expected = case.weight * np.where(there, near + far, average)  # a void is neutral
    expected /= expected.sum()
    assert likely == pytest.approx(average, rel=1e-10)
    np.testing.assert_allclose(weight, expected, rtol=1e-10)
    assert weight.sum() == pytest.approx(1.0, rel=1e-12)
    assert weight[~there].sum() == pytest.approx(case.weight[~there].sum(), rel=1e-10)
    assert effective == pytest.approx(1.0 / np.sum(expected**2), rel=1e-10)
    np.testing.assert_allclose(bad, np.where(there, far / (near + far), case.bad), rtol=1e-10)
    good = near / (near + far)
    step = np.where(there, good * case.residual / total, 0.0)
    np.testing.assert_allclose(rows, case.rows + step[:, None] * GAIN, rtol=1e-10, atol=1e-10)
    np.testing.assert_array_equal(rows[:, :2], case.rows[:, :2])
    np.testing.assert_allclose(mean, weight @ rows, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(cov, np.cov(rows.T, aweights=weight, ddof=0), rtol=1e-9, atol=1e-9)


def test_weigh_leaves_the_residuals_of_the_rows_after_it(case: Case) -> None:
    """So that value - map = residual + bias + patch, before and after: GAIN moves these two by COMMON a step."""
    cloud, residual, centre = case.cloud, case.residual.copy(), np.zeros(6)
    height = residual + cloud[BIAS] + cloud[BIAS + 1]
    rest = WHITE, COMMON, REACH, GAIN, centre, np.empty(900)
    reading.weigh(cloud, case.weight, case.bad.copy(), residual, case.slope2, *rest)
    np.testing.assert_allclose(residual + cloud[BIAS] + cloud[BIAS + 1], height, rtol=1e-12, atol=1e-9)


def test_weigh_gives_the_linear_states_the_moments_of_the_mixture(case: Case) -> None:
    """Mean conditional covariance of the two regimes, state by state, and the spread between them."""
    common = np.outer(GAIN, GAIN) / COMMON + np.diag([0.0, 0.0, 1.0, 1.0, 50.0, 50.0])
    _, weight, bad, (_, _, reduction, _, _) = weighed(case)
    expected = np.zeros((6, 6))
    for k in range(900):
        good, total = 1 - bad[k], WHITE[0] + WHITE[1] * case.slope2[k] + COMMON
        if not case.there[k]:
            expected += weight[k] * common
            continue
        away = GAIN * case.residual[k] / total  # from the mean if the reading says nothing to that if it does
        expected += weight[k] * (common - good * np.outer(GAIN, GAIN) / total + good * bad[k] * np.outer(away, away))
    np.testing.assert_allclose(common - reduction * np.outer(GAIN, GAIN), expected, rtol=1e-9)
    assert reduction > 0.0


def test_a_reading_that_contradicts_all_changes_nothing(case: Case) -> None:
    far, none = np.where(case.there, 1e6, np.nan), np.zeros(900)
    rows, weight, bad, told = weighed_with(case, far, none, reading.weigh)
    assert told[:3] == (0.0, 0.0, 0.0)
    np.testing.assert_array_equal(rows, case.rows)
    np.testing.assert_array_equal(weight, case.weight)
    np.testing.assert_array_equal(bad, none)


def test_where_all_is_void_nothing_changes(case: Case) -> None:
    rows, weight, bad, told = weighed_with(case, np.full(900, np.nan), case.bad, reading.weigh)
    assert told[:3] == (0.0, 0.0, 0.0)
    np.testing.assert_array_equal(rows, case.rows)
    np.testing.assert_array_equal(weight, case.weight)
    np.testing.assert_array_equal(bad, case.bad)


def advanced(case: Case, phi: FloatArray, spread: FloatArray, kernel: object = kernels.advance) -> FloatArray:
    return moved(case.rows, case.weight, phi, spread, kernel)


def moved(
    rows: FloatArray, weight: FloatArray, phi: FloatArray, spread: FloatArray, kernel: object = kernels.advance
) -> FloatArray:
    noise, out = np.random.default_rng(9).standard_normal((2, len(rows))), np.empty(rows.shape[::-1])
    about = weight @ rows + 0.1  # near the mean is near enough
    kernel(np.ascontiguousarray(rows.T), weight, about, phi, spread, noise, out)  # type: ignore[operator]
    return out.T


PHI = np.eye(6) + 2.0 * np.eye(6, k=2) * (np.arange(6) < 2)[:, None]
SPREAD = np.array([[3.0, 0.0], [1.0, 2.0], [0.1, 0.0], [0.0, -0.2], [0.5, 0.5], [0.0, 0.0]])


def test_advance_adds_exactly_the_covariance_of_the_noise(case: Case) -> None:
    out = advanced(case, PHI, SPREAD)
    mean = case.weight @ case.rows
    cov = np.cov(case.rows.T, aweights=case.weight, ddof=0)
    np.testing.assert_allclose(case.weight @ out, PHI @ mean, atol=1e-9)
    after = np.cov(out.T, aweights=case.weight, ddof=0)
    expected = PHI @ cov @ PHI.T + SPREAD @ SPREAD.T
    np.testing.assert_allclose(after[:2, :2], expected[:2, :2], rtol=1e-10)
    drawn = out - case.rows @ PHI.T
    np.testing.assert_allclose(np.cov(drawn.T, aweights=case.weight, ddof=0), SPREAD @ SPREAD.T, atol=1e-9)
    assert np.linalg.matrix_rank(drawn, tol=1e-6) == 2
    assert np.std(drawn[:, 0]) > 2.0  # it is noise and no copy


def test_advance_about_a_far_mean_loses_no_digits(case: Case) -> None:
    rows = case.rows.copy()
    rows[:, 0] += 3e6
    out = moved(rows, case.weight, PHI, SPREAD)
    np.testing.assert_allclose(out - [3e6, 0, 0, 0, 0, 0], advanced(case, PHI, SPREAD), atol=1e-5)


def test_a_cloud_in_one_place_is_spread_too(case: Case) -> None:
    out = moved(np.ones_like(case.rows), case.weight, np.eye(6), SPREAD)
    np.testing.assert_allclose(np.cov(out.T, aweights=case.weight, ddof=0), SPREAD @ SPREAD.T, atol=1e-9)


def test_moments_are_numpys(case: Case) -> None:
    mean, cov = kernels.moments(case.cloud, case.weight)
    np.testing.assert_allclose(mean, case.weight @ case.rows, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(cov, np.cov(case.rows.T, aweights=case.weight, ddof=0), rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(cov, cov.T)


@pytest.mark.parametrize("stretch", [1.0, 4.0])
def test_area_of_a_square_and_of_a_normal_density(stretch: float) -> None:
    rng = np.random.default_rng(2)
    count = 400_000  # 2304 bins take (2304 - 1) / (2 count), half a percent, off the entropy
    weight = np.full(count, 1.0 / count)
    square = rng.uniform(-500.0, 500.0, (2, count)) * [[1.0], [stretch]]
    assert kernels.area(square, weight) == pytest.approx(1e6 * stretch, rel=0.01)
    normal = rng.normal(0.0, 100.0, (2, count)) * [[1.0], [stretch]]
    assert kernels.area(normal, weight) == pytest.approx(2 * math.pi * math.e * 1e4 * stretch, rel=0.02)
    far = np.hstack([square, [[1e6], [1e6]]])  # a particle without weight has no area
    assert kernels.area(far, np.append(weight, 0.0)) == pytest.approx(kernels.area(square, weight), rel=1e-9)


def test_area_of_two_places_is_that_of_both() -> None:
    rng = np.random.default_rng(3)
    count = 400_000
    place = rng.uniform(-200.0, 200.0, (2, count))
    place[0, ::2] += 1600.0
    assert kernels.area(place, np.full(count, 1.0 / count)) == pytest.approx(2 * 400.0**2, rel=0.15)  # bins are 42 m


@pytest.mark.parametrize("count", [400, 900, 2500])
def test_resampled_is_the_search_in_the_cumulative_sum_and_a_kernel(case: Case, count: int) -> None:
    rng = np.random.default_rng(count)
    regimes = np.stack([case.bad, 1.0 - case.bad])
    noise, centre = rng.standard_normal((2, count)), case.weight @ case.rows
    rows, bad = np.empty((6, count)), np.empty((2, count))
    kernels.resampled(case.cloud, case.weight, regimes, 0.37, centre, 0.9, SPREAD, noise, rows, bad)
    source = np.searchsorted(np.cumsum(case.weight), (np.arange(count) + 0.37) / count, side="right")
    source = np.minimum(source, 899)
    copies = np.bincount(source, minlength=900)
    assert (np.abs(copies - count * case.weight) < 1.0 + 1e-9).all()
    expected = centre + 0.9 * (case.rows[source] - centre) + noise.T @ SPREAD.T
    np.testing.assert_allclose(rows.T, expected, rtol=1e-12, atol=1e-9)
    np.testing.assert_array_equal(bad, regimes[:, source])


def test_a_sum_of_weights_a_little_below_one_runs_over_no_end(case: Case) -> None:
    weight = case.weight * (1.0 - 1e-9)
    rows, bad = np.empty((6, 900)), np.empty((1, 900))
    kernels.resampled(
        case.cloud, weight, case.bad[None], 1.0 - 1e-12, np.zeros(6), 1.0, SPREAD, np.zeros((2, 900)), rows, bad
    )
    np.testing.assert_array_equal(rows[:, -1], case.rows[-1])


def test_a_plane_is_found_by_weighted_least_squares(case: Case) -> None:
    w, there = np.where(case.there, case.weight, 0.0), case.there
    height = np.where(there, case.residual + case.rows[:, BIAS] + case.rows[:, BIAS + 1], 0.0)
    plane = linearised(case.cloud, case.weight, case.residual, BIAS, case.weight @ case.rows + 3.0)
    a, b, h = (np.average(x, weights=w) for x in (case.rows[:, 0], case.rows[:, 1], height))
    root = np.sqrt(w)
    design = root[:, None] * np.stack([case.rows[:, 0] - a, case.rows[:, 1] - b], axis=1)
    slope, rest, *_ = np.linalg.lstsq(design, root * (height - h))
    np.testing.assert_allclose(plane, [a, b, h, -slope[0], -slope[1], rest[0] / w.sum()], rtol=1e-8)
    assert np.isnan(linearised(case.cloud, case.weight, np.full(900, np.nan), BIAS, np.zeros(6))).all()


def test_the_regimes_come_and_go(case: Case) -> None:
    bad, out = np.stack([case.bad, 1.0 - case.bad]), np.empty((2, 900))
    kernels.regime(bad, 0.05, np.array([0.9, 0.2]), out)
    np.testing.assert_allclose(out, 0.05 + np.array([[0.9], [0.2]]) * (bad - 0.05), rtol=1e-12)


def test_the_same_without_compilation(case: Case) -> None:
    rng = np.random.default_rng(1)
    residual, slope2 = np.empty(900), np.empty(900)
    told = case.chart.values, case.frame, case.cloud, case.weight, case.value, BIAS, residual, slope2
    compiled = reading.compare(*told)
    with np.errstate(invalid="ignore"):
        assert reading.compare.py_func(*told) == pytest.approx(compiled, rel=1e-10)
    np.testing.assert_allclose(residual, case.residual, rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(slope2, case.slope2, rtol=1e-10)
    for mine, plain in zip(weighed(case)[:3], weighed(case, reading.weigh.py_func)[:3], strict=True):
        np.testing.assert_allclose(mine, plain, rtol=1e-10, atol=1e-12)
    for mine, plain in zip(weighed(case)[3], weighed(case, reading.weigh.py_func)[3], strict=True):
        np.testing.assert_allclose(mine, plain, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(
        advanced(case, PHI, SPREAD), advanced(case, PHI, SPREAD, kernels.advance.py_func), rtol=1e-10, atol=1e-9
    )
    white, common = np.array([16.0, 25.0]), np.array([9.0, 4.0])
    assert kernels.area(case.cloud, case.weight) == pytest.approx(kernels.area.py_func(case.cloud, case.weight))
    first, second = np.empty(3), np.empty(3)
    for out, kernel in ((first, reading.evidence), (second, reading.evidence.py_func)):
        kernel(case.weight, case.residual, case.slope2, case.bad, white, common, 8.0, np.array([0.5, 1.0, 2.0]), out)
    np.testing.assert_allclose(first, second, rtol=1e-10)
    for mine, plain in zip(
        kernels.moments(case.cloud, case.weight), kernels.moments.py_func(case.cloud, case.weight), strict=True
    ):
        np.testing.assert_allclose(mine, plain, rtol=1e-10, atol=1e-9)
    noise, drawn = rng.standard_normal((2, 500)), []
    for kernel in (kernels.resampled, kernels.resampled.py_func):
        rows, bad = np.empty((6, 500)), np.empty((1, 500))
        kernel(case.cloud, case.weight, case.bad[None], 0.2, np.zeros(6), 0.9, SPREAD, noise, rows, bad)
        drawn.append((rows, bad))
    np.testing.assert_allclose(drawn[0][0], drawn[1][0], rtol=1e-12, atol=1e-9)
    np.testing.assert_array_equal(drawn[0][1], drawn[1][1])
    plane = case.cloud, case.weight, case.residual, BIAS, np.zeros(6)
    np.testing.assert_allclose(linearised(*plane), linearised.py_func(*plane), rtol=1e-7)
