"""A step of `marginalized` in plain numpy, one line a formula: what the kernels are held against, and timed beside.

One map, one reading; it begins with a state of the estimator and gives what its `step` gives, but for rounding.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from terranav.core.earth import offset_of
from terranav.core.judgement import largest_sigma_m
from terranav.core.records import Epoch
from terranav.filters._cloud import KERNEL_CELLS, KERNEL_DIMENSIONS
from terranav.filters._noise_scale import SCALES, SWITCH
from terranav.filters._reading import GROUND
from terranav.filters._walk_scale import FACTORS, FORGET, START
from terranav.filters.marginalized import BAD_PATCH, RESAMPLE_SHARE, Marginalized, MarginalizedState
from terranav.ins.error_state import ErrorModel
from terranav.kernels.marginalized import BINS
from terranav.kernels.sampling import SLACK
from terranav.maps.map import Map

FloatArray = NDArray[np.float64]
Walk = tuple[FloatArray, tuple[FloatArray, FloatArray] | None]  # probabilities, and the bank of filters
Normal = Callable[[Generator, tuple[int, int]], FloatArray]


@dataclass(frozen=True)
class Plain:
    """What of a state the next step needs: rows (m, d), weight (m,), bad (m,), the rest as in the estimator's state."""

    epoch: Epoch
    rows: FloatArray
    weight: FloatArray
    bad: FloatArray
    common: FloatArray
    spacing_m: float
    mean: FloatArray
    cov: FloatArray
    scale: FloatArray
    walk: FloatArray
    bank: tuple[FloatArray, FloatArray] | None

    @classmethod
    def of(cls, state: MarginalizedState) -> Plain:
        cloud, walk = state.cloud, state.walk
        assert cloud is not None and state.epoch is not None  # noqa: PT018
        return cls(
            state.epoch, np.ascontiguousarray(cloud.rows.T), cloud.weight, cloud.bad[0], cloud.common,
            cloud.spacing_m, state.mean, state.cov, state.scale[0], walk.probability,
            None if walk.idle else (walk.mean, walk.cov),
        )  # fmt: skip


def plain_step(filter_: Marginalized, at: Plain, epoch: Epoch, rng: Generator, normal: Normal) -> Plain:
    """The state after an epoch with one reading; `normal` draws (2, m) numbers."""
    chart, reading = filter_.maps[0], epoch.measurements[0]
    model = ErrorModel(filter_.ins, filter_.maps, ErrorModel.level_for(filter_.ins, epoch), filter_.bias_sigma)
    n, bias, d = model.inertial, model.inertial, model.size
    passed = model.transition(at.epoch, epoch)
    phi, q = passed.phi, passed.q.copy()
    q[bias + 1, bias + 1] *= at.scale @ SCALES
    bank = None if at.bank is None else _bank_passed(*at.bank, phi, q, n)
    q[:n, :n] *= at.walk @ FACTORS
    rows, common = _moved(at, phi, q, normal(rng, (2, len(at.rows))).T)
    travelled = math.hypot(*offset_of(at.epoch.lat_deg, at.epoch.lon_deg, epoch.lat_deg, epoch.lon_deg))
    keep = math.exp(-travelled / (BAD_PATCH * chart.error_length_m))
    bad = filter_.outlier_share + keep * (at.bad - filter_.outlier_share)

    height, slope2 = _height(chart, epoch, rows[:, :2])
    residual = reading.value - height - rows[:, bias] - rows[:, bias + 1]
    there = np.isfinite(residual)
    gain = common[bias] + common[bias + 1]
    variance, patch = gain[bias] + gain[bias + 1], common[bias + 1, bias + 1]
    told = np.array([reading.sigma**2, (filter_.blur_cells * chart.cell_m) ** 2])
    reach, ground = filter_.outlier_scale * math.hypot(reading.sigma, chart.sigma), GROUND * at.spacing_m**2

    factor, some = at.scale @ SCALES, slice(None, None, max(len(rows) // 512, 1))
    white = told[0] + (told[1] + ground / factor) * slope2[some] + patch / factor
    spread = np.multiply.outer(SCALES, white) + (variance - patch)
    likely = _likelihood(residual[some], spread, bad[some], reach)[0]
    likelihood = np.nansum(at.weight[some] * likely, axis=1) / at.weight[some][there[some]].sum()
    moved = (1.0 - 2.0 * SWITCH) * at.scale
    moved += SWITCH * (np.append(at.scale[1:], at.scale[-1]) + np.append(at.scale[0], at.scale[:-1]))
    scale = _bayes(moved, likelihood)

    total = (scale @ SCALES) * (told[0] + told[1] * slope2) + ground * slope2 + variance
    likely, far = _likelihood(residual, total, bad, reach)
    average = np.nansum(at.weight * likely) / at.weight[there].sum()
    weight = at.weight * np.where(there, likely, average)
    weight /= weight.sum()
    bad = np.where(there, far / likely, bad)
    good, jump = np.where(there, 1.0 - bad, 0.0), np.where(there, residual / total, 0.0)
    rows += (good * jump)[:, None] * gain
    reduction = weight @ (good / total) - weight @ (good * (1.0 - good) * jump**2)
    common = common - reduction * np.outer(gain, gain)
    mean = weight @ rows
    away = rows - mean
    of_rows = (weight[:, None] * away).T @ away

    walk = at.walk
    if filter_.adapt_walk:
        noise = (scale @ SCALES) * told[0]
        after = Weighed(rows, weight, reading.value - height, bad, mean, of_rows + common)
        walk, bank = _wandered(filter_, (walk, bank), after, noise, reach)
    spacing = at.spacing_m
    cov = of_rows + common
    if 1.0 / np.sum(weight**2) < RESAMPLE_SHARE * len(rows):
        count, rest = len(rows), KERNEL_DIMENSIONS
        sigma = largest_sigma_m(of_rows[:2, :2])
        width = min((4.0 / (count * (rest + 2.0))) ** (1.0 / (rest + 4.0)), KERNEL_CELLS * chart.cell_m / sigma)
        carry = of_rows[:, :2] @ np.linalg.inv(of_rows[:2, :2] + 1e-9 * np.eye(2))
        root = np.linalg.cholesky(of_rows[:2, :2] + 1e-9 * np.eye(2))
        noise2, offset = normal(rng, (2, count)).T, rng.random()
        spacing = math.sqrt(_area(rows, weight, of_rows) / count)
        source = np.searchsorted(np.cumsum(weight), (np.arange(count) + offset) / count, side="right")
        source = np.minimum(source, count - 1)
        carry[:2] = np.eye(2)
        rows = mean + math.sqrt(1.0 - width**2) * (rows[source] - mean) + noise2 @ (width * carry @ root).T
        bad, weight = bad[source], np.full(count, 1.0 / count)
        part = width**2 * (of_rows - carry @ of_rows[:2])
        part[:2], part[:, :2] = 0.0, 0.0
        common = common + 0.5 * (part + part.T)
    assert rows.shape[1] == d
    return Plain(epoch, rows, weight, bad, common, spacing, mean, cov, scale, walk, bank)


def _moved(at: Plain, phi: FloatArray, q: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rows and common covariance after a transition."""
    grown = phi @ at.common @ phi.T + q
    values, vectors = np.linalg.eigh(grown[:2, :2])
    vectors = vectors * np.sign([vectors[1, 0], vectors[0, 1]])
    carry = grown[:, :2] @ np.linalg.inv(grown[:2, :2])
    common = grown - carry @ grown[:2]
    common[:2], common[:, :2] = 0.0, 0.0
    moved = at.rows @ phi.T
    joint = np.hstack([moved[:, :4], noise])
    away = joint - at.weight @ joint
    root = np.linalg.cholesky((at.weight[:, None] * away).T @ away)
    white = np.linalg.solve(root, away.T)[4:]
    return moved + white.T @ (carry @ (vectors * np.sqrt(values))).T, 0.5 * (common + common.T)


def _height(chart: Map, epoch: Epoch, error_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Bilinear height, NaN where the map is silent, and squared slope."""
    frame = chart.local_frame(epoch.lat_deg, epoch.lon_deg, 2.0 * float(np.abs(error_m).max()))
    row, col = frame.cells(-error_m[:, 0], -error_m[:, 1])
    last_row, last_col = chart.shape[0] - 1, chart.shape[1] - 1
    inside = (row >= -SLACK) & (row <= last_row + SLACK) & (col >= -SLACK) & (col <= last_col + SLACK)
    i = np.clip(row, 0, last_row - 1).astype(np.int64)
    j = np.clip(col, 0, last_col - 1).astype(np.int64)
    u, v = np.clip(row - i, 0.0, 1.0), np.clip(col - j, 0.0, 1.0)
    one, two, three, four = (chart.values[i + a, j + b].astype(np.float64) for a in (0, 1) for b in (0, 1))
    low, high = one + v * (two - one), three + v * (four - three)
    by_row, by_col = high - low, (1.0 - u) * (two - one) + u * (four - three)
    height = np.where(inside, low + u * by_row, np.nan)
    odd = inside & np.isnan(height)
    if odd.any():  # beside a void: it does not count where it has no weight
        corners = np.stack([one, two, three, four])[:, odd]
        weight = np.stack([(1 - u) * (1 - v), (1 - u) * v, u * (1 - v), u * v])[:, odd]
        weight = np.where(weight > SLACK, weight, 0.0)
        height[odd] = np.where(weight > 0.0, weight * corners, 0.0).sum(axis=0) / weight.sum(axis=0)
    north = by_row * frame.row[1] + by_col * frame.col[1]
    east = by_row * frame.row[2] + by_col * frame.col[2]
    return height, np.nan_to_num(north**2 + east**2)


def _likelihood(
    residual: FloatArray, variance: FloatArray, bad: FloatArray, reach: float
) -> tuple[FloatArray, FloatArray]:
    """Of both regimes together, and of the bad one."""
    near = (1.0 - bad) * np.exp(-0.5 * residual**2 / variance) / np.sqrt(2.0 * np.pi * variance)
    far = bad * reach / (np.pi * (reach**2 + residual**2))
    return near + far, far


def _bayes(probability: FloatArray, likelihood: FloatArray) -> FloatArray:
    after = probability * (likelihood + 1e-12 * likelihood.max())
    return np.asarray(after / after.sum())


def _bank_passed(
    mean: FloatArray, cov: FloatArray, phi: FloatArray, q: FloatArray, inertial: int
) -> tuple[FloatArray, FloatArray]:
    """The bank of Kalman filters after a transition of told noise."""
    noise = np.repeat(q[None], len(FACTORS), axis=0)
    noise[:, :inertial, :inertial] *= FACTORS[:, None, None]
    return mean @ phi.T, phi @ cov @ phi.T + noise


@dataclass(frozen=True)
class Weighed:
    """The cloud after a reading, and the reading less the map at each particle."""

    rows: FloatArray
    weight: FloatArray
    against: FloatArray
    bad: FloatArray
    mean: FloatArray
    cov: FloatArray


def _wandered(filter_: Marginalized, before: Walk, cloud: Weighed, noise: float, reach: float) -> Walk:
    """What a reading says of the walk of the INS, the map being a plane over the cloud."""
    (walk, bank), rows, weight, against = before, cloud.rows, cloud.weight, cloud.against
    mean, cov, bad, bias = cloud.mean, cloud.cov, cloud.bad, len(cloud.mean) - 2
    if largest_sigma_m(cov[:2, :2]) > filter_._cell_m:
        return walk, None
    there = np.isfinite(against)
    if weight[there].sum() <= 0.5:
        return walk, None
    w, y, p = weight[there], against[there], rows[there, :2]
    middle, centre = np.average(y, weights=w), np.average(p, axis=0, weights=w)
    away = p - centre
    slope = np.linalg.solve((w[:, None] * away).T @ away, (w * (y - middle)) @ away)
    rest = np.average((y - middle - away @ slope) ** 2, weights=w)
    noise += rest
    if not 2.0 * rest < noise:
        return walk, None
    if bank is None:
        return walk, (np.tile(mean, (len(FACTORS), 1)), np.tile(cov, (len(FACTORS), 1, 1)))
    row = np.zeros(len(mean))
    row[:2], row[bias : bias + 2] = -slope, 1.0
    left = middle - slope @ centre - bank[0] @ row
    gain = bank[1] @ row
    spread = gain @ row + noise
    near = np.exp(-0.5 * left**2 / spread) / np.sqrt(2.0 * np.pi * spread)
    far = reach / (np.pi * (reach**2 + left**2))
    likelihood = (1.0 - filter_.outlier_share) * near + filter_.outlier_share * far
    walk = _bayes((1.0 - FORGET) * walk + FORGET * START, likelihood)
    if weight @ bad < 0.5:
        means = bank[0] + gain * (left / spread)[:, None]
        covs = bank[1] - gain[:, :, None] * gain[:, None, :] / spread[:, None, None]
        return walk, (means, covs)
    return walk, bank


def _area(rows: FloatArray, weight: FloatArray, cov: FloatArray) -> float:
    """exp(entropy) of a histogram of the positions, or of a normal density where that is less [m^2]."""
    heavy = weight > 1e-4 / len(weight)
    p, w = rows[heavy, :2], weight[heavy]
    low = p.min(axis=0)
    step = (p.max(axis=0) - low) / BINS + 1e-9
    mass = np.bincount((np.minimum((p - low) // step, BINS - 1) @ [BINS, 1]).astype(np.int64), w)
    mass = mass[mass > 0.0]
    flat = math.exp(-mass @ np.log(mass)) * step[0] * step[1]
    return min(float(flat), 2.0 * math.pi * math.e * math.sqrt(np.linalg.det(cov[:2, :2])))
