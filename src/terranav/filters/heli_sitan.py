"""Heli/SITAN: a bank of parallel SITAN filters that acquires, and the best of them that tracks.

Hollowell, Heli/SITAN: a terrain referenced navigation algorithm for helicopters, IEEE PLANS 1990; Boozer and
Fellerhoff, Terrain-aided navigation test results in the AFTI/F-16 aircraft, Navigation 35 (1988). One SITAN filter
linearises the map about one place and diverges from a large initial error (papers/000). So filters are started on a
square lattice over the prior, close enough that one of them starts within the reach of its plane. Every filter k keeps
its smoothed weighted residual

    w_k <- (1 - 1/n) w_k + (r_k^2 / S_k + ln S_k)

of innovation r_k and its variance S_k, and the one with the smallest is the vehicle's, once it is settled and clearly
better than every filter elsewhere. ln S_k belongs to a likelihood; without it the filter whose plane fits worst, and
that therefore expects anything, would win. From then on this filter tracks alone, as `Sitan` does; when it is lost, the
bank starts over from the prior and the drift since.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from terranav.core.checks import finite
from terranav.core.earth import offset_m, shift
from terranav.core.errors import ConfigError, StateError
from terranav.core.ins_grade import InsGrade
from terranav.core.judgement import Judge, Judgement, judge, largest_sigma_m, started_over
from terranav.core.records import Epoch, Estimate, Measurement, Posterior, Prior, Status
from terranav.filters._kalman import KalmanState
from terranav.filters._maps import one_map_a_kind
from terranav.filters.sitan import LEAST_PLACES, PATTERN, Sitan
from terranav.maps.map import Map
from terranav.maps.noise import MOST_REPEATED, reading_sigma

FloatArray = NDArray[np.float64]

REACH = 3.0  # the bank covers the prior out to this many sigmas
_DESIGN = np.column_stack([np.ones(len(PATTERN)), PATTERN])


@dataclass(frozen=True, slots=True)
class Bank:
    """Filters of the search: means (k, 2) [m], covariances (k, 2, 2) [m^2], smoothed weighted residuals (k,)."""

    mean_m: FloatArray
    cov_m2: FloatArray
    residual: FloatArray
    readings: int = 0


@dataclass(frozen=True, slots=True)
class HeliSitanState:
    """The bank while it searches; the tracking filter after."""

    prior: Prior
    bank: Bank
    tracker: KalmanState | None = None
    unaided_m2: float = 0.0
    judgement: Judgement = field(default_factory=Judgement)
    start_s: float = math.nan
    epoch: Epoch | None = None
    last_reading: Epoch | None = None


@dataclass(frozen=True)
class HeliSitan:
    """Bank of SITAN filters, the best chosen by smoothed weighted residuals.

    While it searches, the estimate is the INS's own (the prior and the drift since): no filter of the bank is believed
    before it is chosen.

    Attributes
    ----------
    maps : tuple of Map
        One a kind; readings of several kinds at one epoch are used one after the other.
    ins : InsGrade
        How fast the position error grows.
    spacing_m : float or None
        Between the filters' starts [m]; None is half the correlation length of the roughest map, sqrt(2) times the
        standard deviation of its values over that of its slopes.
    max_filters : int
        The spacing grows until no more are needed.
    memory : int
        Readings n over which residuals are smoothed, >= 2; none is chosen before that many.
    margin : float
        Lead of the best over any filter elsewhere before it is chosen [logarithm of the likelihood], > 0.
    converged_sigma_m : float or None
        1-sigma (largest axis) that counts as a fix, and at which a filter may be chosen; None is the finest map's cell.

    Raises
    ------
    ConfigError
        For a setting out of its range, or two maps of one kind.
    """

    maps: tuple[Map, ...]
    ins: InsGrade
    spacing_m: float | None = None
    max_filters: int = 400
    memory: int = 50
    margin: float = 10.0
    converged_sigma_m: float | None = None

    def __post_init__(self) -> None:
        for key in ("spacing_m", "converged_sigma_m"):
            if getattr(self, key) is not None:
                finite(f"heli_sitan {key}", getattr(self, key), above=0.0)
        finite("heli_sitan margin", self.margin, above=0.0)
        for key, least in (("max_filters", 1), ("memory", 2)):
            value = getattr(self, key)
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise ConfigError(f"heli_sitan {key} is {value!r}, expected a whole number >= {least}")
        one_map_a_kind("heli_sitan", self.maps)

    def init(self, prior: Prior, rng: Generator) -> HeliSitanState:
        """Filters over the prior."""
        return HeliSitanState(prior, self._started(prior, 0.0))

    def step(self, state: HeliSitanState, epoch: Epoch, rng: Generator) -> HeliSitanState:
        """One step of the tracking filter, or of all filters of the bank."""
        dt = 0.0 if state.epoch is None else epoch.time_s - state.epoch.time_s
        start_s = epoch.time_s if state.epoch is None else state.start_s
        elapsed = epoch.time_s - dt - start_s
        unaided = state.unaided_m2 + self.ins.position_growth_m2(elapsed, dt)
        if (tracker := state.tracker) is not None:
            state = replace(state, start_s=start_s, epoch=epoch, unaided_m2=unaided)
            return self._tracked(state, self._sitan.step(tracker, epoch, rng))
        variance = float(np.median(np.trace(state.bank.cov_m2, axis1=1, axis2=2))) / 2.0
        growth = self.ins.position_growth_m2(elapsed, dt, variance)
        bank = replace(state.bank, cov_m2=state.bank.cov_m2 + growth * np.eye(2))
        return self._searched(replace(state, start_s=start_s, epoch=epoch, unaided_m2=unaided, bank=bank))

    def estimate(self, state: HeliSitanState) -> Estimate:
        """Mean and covariance of the tracking filter; of the unaided INS while the bank searches."""
        if state.epoch is None:
            raise StateError("heli_sitan: no estimate before the first epoch")
        if state.tracker is not None:
            return self._sitan.estimate(state.tracker)
        judgement = state.judgement
        return Estimate.at(state.epoch, state.prior.mean_m, _unaided(state), judgement.status, judgement.nis)

    def posterior(self, state: HeliSitanState) -> Posterior | None:
        """The filters' means by their likelihood while the bank searches."""
        if state.tracker is not None:
            return None
        lead = np.exp(-0.5 * (state.bank.residual - state.bank.residual.min()))
        return Posterior(state.bank.mean_m[:, 0], state.bank.mean_m[:, 1], lead / lead.sum())

    @property
    def _limit_m(self) -> float:
        return min(chart.cell_m for chart in self.maps) if self.converged_sigma_m is None else self.converged_sigma_m

    @property
    def _judge(self) -> Judge:
        return Judge(converged_sigma_m=self._limit_m)

    @cached_property
    def _sitan(self) -> Sitan:
        """The filter that tracks; it is this class that starts it over."""
        return Sitan(self.maps, self.ins, restart=False, converged_sigma_m=self.converged_sigma_m)

    @cached_property
    def _spacing_m(self) -> float:
        if self.spacing_m is not None:
            return self.spacing_m
        return 0.5 * min(correlation_length_m(chart) for chart in self.maps)

    def _started(self, prior: Prior, unaided_m2: float) -> Bank:
        """Filters on a lattice over the ellipse of the error."""
        cov = prior.cov_m2 + unaided_m2 * np.eye(2)
        variance, axes = np.linalg.eigh(cov)
        sigma = np.sqrt(variance)
        spacing = min(self._spacing_m, 10.0 * float(sigma.max()))  # a flat map's is infinite
        while True:
            half = np.floor(REACH * sigma / spacing + 0.5).astype(int).tolist()
            a, b = np.meshgrid(*(spacing * np.arange(-n, n + 1) for n in half), indexing="ij")
            places = np.stack([a.ravel(), b.ravel()], axis=1)
            distance2 = ((places / sigma) ** 2).sum(axis=1)
            inside = distance2 <= (REACH + 0.5 * spacing / float(sigma.min())) ** 2
            if int(inside.sum()) <= self.max_filters:
                break
            spacing *= 1.1
        own = np.minimum(0.5 * spacing, sigma) if inside.sum() > 1 else sigma
        covs = np.repeat(((axes * own**2) @ axes.T)[None], int(inside.sum()), axis=0)
        start = distance2[inside] if prior.shape == "gaussian" else np.zeros(int(inside.sum()))
        return Bank(prior.mean_m + places[inside] @ axes.T, covs, start)

    def _tracked(self, state: HeliSitanState, tracker: KalmanState) -> HeliSitanState:
        """The state with its tracking filter moved on; back to the bank when that is lost."""
        if tracker.judgement.status is not Status.LOST:
            return replace(state, tracker=tracker)
        bank = self._started(state.prior, state.unaided_m2)
        judgement = started_over(tracker.judgement)
        return replace(state, tracker=None, bank=bank, judgement=judgement, last_reading=tracker.last_reading)

    def _searched(self, state: HeliSitanState) -> HeliSitanState:
        """The state with the epoch's readings used by every filter of the bank; one may be chosen."""
        nis: list[float] = []
        off_map: list[bool] = []
        epoch, bank = _at(state), state.bank
        for reading in epoch.measurements:
            for chart in self.maps:
                if chart.kind == reading.kind:
                    level, slope, left = fitted_planes(chart, epoch, bank.mean_m, bank.cov_m2)
                    known = np.isfinite(level)
                    off_map.append(2 * int(known.sum()) <= known.size)
                    if known.any():
                        sigma = reading_sigma(reading, chart, state.last_reading, epoch)
                        noise = sigma**2 + left * _alike(state)
                        bank, innovation2 = self._updated(bank, reading, (level, slope, noise))
                        nis.append(float(innovation2[int(bank.residual.argmin())]))
        judgement = judge(
            self._judge,
            state.judgement,
            largest_sigma_m(_unaided(state)),
            nis=float(np.mean(nis)) if nis and np.isfinite(nis).all() else math.nan,
            readings=len(nis),
            off_map=all(off_map) if off_map else None,
        )
        state = replace(state, bank=bank, judgement=judgement, last_reading=epoch if off_map else state.last_reading)
        return self._chosen(state) if nis else state

    def _updated(
        self, bank: Bank, reading: Measurement, planes: tuple[FloatArray, FloatArray, FloatArray]
    ) -> tuple[Bank, FloatArray]:
        """The bank after one reading, and the NIS of each filter (NaN where its map says nothing)."""
        level, g, noise = planes
        P = bank.cov_m2
        innovation = reading.value - level
        Pg = np.einsum("kij,kj->ki", P, g)
        spread = np.einsum("ki,ki->k", g, Pg) + noise
        known = np.isfinite(level)
        nis = innovation**2 / spread
        gain = np.where(known[:, None], Pg / spread[:, None], 0.0)
        keep = np.eye(2) - gain[:, :, None] * np.where(known[:, None], g, 0.0)[:, None, :]
        cov = keep @ P @ keep.transpose(0, 2, 1)
        cov = cov + np.where(known, noise, 0.0)[:, None, None] * gain[:, :, None] * gain[:, None, :]
        new = nis + np.log(spread)
        new = np.where(known, new, new[known].mean())  # neither confirmed nor refuted
        return Bank(
            bank.mean_m + gain * np.where(known, innovation, 0.0)[:, None],
            0.5 * (cov + cov.transpose(0, 2, 1)),
            (1.0 - 1.0 / self.memory) * bank.residual + new,
            bank.readings + 1,
        ), nis

    def _chosen(self, state: HeliSitanState) -> HeliSitanState:
        """Track with the best filter if it is settled, passable and clearly better than all that are elsewhere."""
        bank, judgement = state.bank, state.judgement
        best = int(bank.residual.argmin())
        if bank.readings < self.memory or largest_sigma_m(bank.cov_m2[best]) > self._limit_m:
            return state
        apart = np.hypot(*(bank.mean_m - bank.mean_m[best]).T)
        elsewhere = apart > max(0.5 * self._spacing_m, 3.0 * self._limit_m)
        lead = 0.5 * (bank.residual[elsewhere] - bank.residual[best])
        if judgement.nis > self._judge.nis_degraded or (lead.size and float(lead.min()) < self.margin):
            return state
        tracker = KalmanState(
            state.prior,
            bank.mean_m[best],
            bank.cov_m2[best],
            state.unaided_m2,
            replace(judgement, status=Status.CONVERGED, fixed=True),
            state.start_s,
            state.epoch,
            state.last_reading,
        )
        return replace(state, tracker=tracker, judgement=tracker.judgement)


def _at(state: HeliSitanState) -> Epoch:
    """The epoch a state is at."""
    if state.epoch is None:
        raise StateError("heli_sitan: no readings before the first epoch")
    return state.epoch


def _unaided(state: HeliSitanState) -> FloatArray:
    """Covariance of the INS that nothing has corrected."""
    return np.asarray(state.prior.cov_m2 + state.unaided_m2 * np.eye(2))


def _alike(state: HeliSitanState) -> FloatArray:
    """(k,) readings that share what a filter's plane leaves, as in `filters.sitan`."""
    if state.last_reading is None:
        return np.ones(len(state.bank.residual))
    last, now = state.last_reading, _at(state)
    spacing = math.hypot(*np.stack(offset_m(last.lat_deg, last.lon_deg, now.lat_deg, now.lon_deg)).tolist())
    largest = np.sqrt(np.linalg.eigvalsh(state.bank.cov_m2)[:, 1])
    return np.asarray(np.clip(largest / max(spacing, 1e-9), 1.0, MOST_REPEATED))


def fitted_planes(
    chart: Map, epoch: Epoch, mean_m: FloatArray, cov_m2: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """`sitan.fitted_plane` for many filters at once.

    Parameters
    ----------
    chart : Map
    epoch : Epoch
    mean_m, cov_m2 : (k, 2) [m], (k, 2, 2) [m^2]

    Returns
    -------
    level, slope, left : (k,), (k, 2), (k,)
        NaN where the map says nothing.
    """
    variance, axes = np.linalg.eigh(cov_m2)
    reach = np.maximum(np.sqrt(np.maximum(variance, 0.0)), 0.5 * chart.cell_m / float(PATTERN.max()))
    error = mean_m[:, None, :] + (PATTERN * reach[:, None, :]) @ axes.transpose(0, 2, 1)
    value = chart.sample(*shift(epoch.lat_deg, epoch.lon_deg, -error[..., 0], -error[..., 1]))
    known = np.isfinite(value)
    count = known.sum(axis=1)
    enough = count >= LEAST_PLACES
    weight = np.where(enough[:, None], known, True).astype(np.float64)
    normal = np.einsum("pi,kp,pj->kij", _DESIGN, weight, _DESIGN)
    filled = np.where(known, value, 0.0)
    fit = np.linalg.solve(normal, ((filled * weight) @ _DESIGN)[..., None])[..., 0]
    rest = ((filled - fit @ _DESIGN.T) ** 2 * weight).sum(axis=1) / np.maximum(count - 3, 1)
    slope = np.einsum("kij,kj->ki", axes, fit[:, 1:] / reach)
    fit[~enough], slope[~enough], rest[~enough] = np.nan, np.nan, np.nan
    return fit[:, 0], slope, rest


def correlation_length_m(chart: Map) -> float:
    """L of a field with covariance exp(-(r/L)^2) that has the map's standard deviation and slopes; at least a cell."""
    values = chart.typical().values.astype(np.float64)
    steps = [np.diff(values, axis=axis) for axis in (0, 1)]
    slope2 = float(np.mean([np.nanmean(step**2) for step in steps])) / chart.cell_m**2
    return max(chart.cell_m, math.sqrt(2.0 * float(np.nanvar(values)) / slope2)) if slope2 > 0.0 else math.inf
