"""Fading memory: squared differences of all readings so far, the older ones forgotten, at every INS error of a grid.

Feng, Shen and Chang, Terrain aided navigation using fading memory, 2003 (papers/004). With e_mn(k) the k-th reading
less the map at the indicated place moved by the error (m, n) (eq. 1), over its 1-sigma (eq. 7),

    aSD_mn(k) = sum_i alpha^(k-i) e_mn(i)^2                      (eq. 3)
              = alpha aSD_mn(k-1) + e_mn(k)^2                    (eq. 4)
    fix       = the (m, n) where aSD is smallest, once k >= 1/(1 - alpha)      (eq. 11, step 5)

The surface is made a probability. At the true error aSD has the mean W = sum alpha^(k-i) and the variance 2 W2, W2 =
sum alpha^(2(k-i)) (eqs. 8-10; as printed, with k-1 in place of k, they lack one term), as a chi-square of W^2/W2
readings has. The least-squares fix that it gives has the covariance of W^2/W2 equal readings, too, hence

    log p = -(1/2) (W/W2) aSD + log prior

whose curvature is that covariance's inverse. Two discounts, as for TERCOM: residuals at the fix whose mean square is
c > 1 times the told one make every variance c times larger, and residuals with a lag-one correlation r beyond the 95 %
band of white ones count as (1 - r)/(1 + r) each.

What the surface knows is the error at the mean time of its memory, T before now, or at that of the slopes under the
readings, if that is longer ago: over flat ground the memory lives on what it learned before. The drift since is added:
with v and q the INS's velocity sigma and walk, v^2 T^2 + q^2 T for an error that the map has told; what the unaided INS
has gained in that time for one that it has not, and in between by the share of the prior's variance that is left.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from terranav.core.checks import finite
from terranav.core.errors import ConfigError, StateError
from terranav.core.ins_grade import InsGrade
from terranav.core.judgement import Judge, Judgement, judge, largest_sigma_m, started_over
from terranav.core.records import Epoch, Estimate, Measurement, Posterior, Prior, Status
from terranav.filters._fading_surface import Memory, reframed
from terranav.filters._maps import one_map_a_kind
from terranav.kernels.fading_memory import log_posterior, moments, recall, rise
from terranav.kernels.lattice import bilinear_lattice
from terranav.maps.frame import LocalFrame
from terranav.maps.map import Map
from terranav.maps.noise import reading_sigma

FloatArray = NDArray[np.float64]

TAIL = 20.0  # log-probability below the best at which an error does not count
FINEST = 16  # a narrow prior makes the step at most this many times finer than the map
READINGS_UNFADING = 48  # before a fix with alpha = 1, where 1/(1 - alpha) would be never: the paper's TERCOM profile


@dataclass(frozen=True, slots=True)
class FadingMemoryState:
    """The memory, the fix that it gives at the mean time of its readings, and the estimate now."""

    prior: Prior
    memory: Memory
    mean_m: FloatArray
    cov_m2: FloatArray
    fix_m: FloatArray | None = None
    fix_cov_m2: FloatArray | None = None
    gained_m2: float = 0.0
    judgement: Judgement = field(default_factory=Judgement)
    start_s: float = math.nan
    epoch: Epoch | None = None
    last_reading: Epoch | None = None


@dataclass(frozen=True)
class FadingMemory:
    """Recursive correlation with fading memory over a grid of INS errors.

    Attributes
    ----------
    maps : tuple of Map
        One a kind; each reading is compared with the map of its kind and is one step of the recursion.
    ins : InsGrade
        How fast the position error grows.
    alpha : float
        Fading factor, in (0, 1]; 1 forgets nothing, as if the INS error were constant.
    readings : int or None
        Readings before the first fix; None is 1/(1 - alpha) (papers/004, step 5), and 48 for alpha = 1, for which that
        would be never.
    cell_m : float or None
        Step of the grid [m]; None is the map's cell. A prior narrower than that makes it finer.
    extent_sigma : float
        Half-width of the grid in sigmas of a Gaussian prior; a uniform prior's is its rectangle. The grid widens with a
        prior that drifts and moves with a fix.
    sub_cell : bool
        Locate the fix between the cells by the quadratic through 3 x 3 of them; without, it is a cell's centre (the
        paper's), and its covariance has the cell^2/12 of that.
    max_cells : int
        Most cells of the grid; a larger search area is searched in coarser steps.
    converged_sigma_m : float or None
        1-sigma (largest axis) that counts as a fix; None is the map's cell.

    Raises
    ------
    ConfigError
        For a setting out of its range, no map, or two maps of one kind.
    """

    maps: tuple[Map, ...]
    ins: InsGrade
    alpha: float = 0.985
    readings: int | None = None
    cell_m: float | None = None
    extent_sigma: float = 4.0
    sub_cell: bool = True
    max_cells: int = 1_000_000
    converged_sigma_m: float | None = None

    label: ClassVar[str] = "fading_memory"

    def __post_init__(self) -> None:
        finite(f"{self.label} alpha", self.alpha, above=0.0, maximum=1.0)
        finite(f"{self.label} extent_sigma", self.extent_sigma, minimum=1.0)
        finite(f"{self.label} max_cells", self.max_cells, minimum=100)
        for key in ("cell_m", "converged_sigma_m"):
            if getattr(self, key) is not None:
                finite(f"{self.label} {key}", getattr(self, key), above=0.0)
        count = self.readings
        if count is not None and (isinstance(count, bool) or not isinstance(count, int) or count < 1):
            raise ConfigError(f"{self.label} readings is {count!r}, expected a whole number >= 1")
        one_map_a_kind(self.label, self.maps)

    @property
    def least_readings(self) -> int:
        """Readings before the first fix."""
        if self.readings is not None:
            return self.readings
        return READINGS_UNFADING if self.alpha == 1.0 else math.ceil(1.0 / (1.0 - self.alpha) - 1e-9)

    def init(self, prior: Prior, rng: Generator) -> FadingMemoryState:
        """The prior, and a surface without a reading."""
        return FadingMemoryState(prior, self._blank(prior, 0.0), prior.mean_m, prior.cov_m2)

    def step(self, state: FadingMemoryState, epoch: Epoch, rng: Generator) -> FadingMemoryState:
        """Let the INS drift, take the readings into the surface, and find its minimum."""
        if state.epoch is None:
            state = replace(state, epoch=epoch, start_s=epoch.time_s)
        else:
            elapsed, dt = state.epoch.time_s - state.start_s, epoch.time_s - state.epoch.time_s
            gained = state.gained_m2 + self.ins.position_growth_m2(elapsed, dt)
            state = replace(state, epoch=epoch, gained_m2=gained)
        pairs = [(chart, m) for m in epoch.measurements for chart in self.maps if chart.kind == m.kind]
        off_map: list[bool] = []
        nis: list[float] = []
        for chart, reading in pairs:
            state, squared, known = self._remembered(state, chart, reading)
            nis += [squared] if math.isfinite(squared) else []
            off_map.append(not known)
        if pairs:
            state = self._fixed(replace(state, last_reading=epoch))
        state = self._now(state)
        judgement = judge(
            Judge(converged_sigma_m=self.maps[0].cell_m if self.converged_sigma_m is None else self.converged_sigma_m),
            state.judgement,
            largest_sigma_m(state.cov_m2),
            nis=sum(nis) / len(nis) if nis else math.nan,
            readings=len(nis),
            off_map=all(off_map) if off_map else None,
        )
        state = replace(state, judgement=judgement)
        return self._started_over(state) if judgement.status is Status.LOST else state

    def estimate(self, state: FadingMemoryState) -> Estimate:
        """The fix, or the prior before the first."""
        if state.epoch is None:
            raise StateError(f"{self.label}: no estimate before the first epoch")
        judgement = state.judgement
        return Estimate.at(state.epoch, state.mean_m, state.cov_m2, judgement.status, judgement.nis)

    def posterior(self, state: FadingMemoryState) -> Posterior | None:
        """Probability of each error of the grid at the mean time of the memory; None before the first fix."""
        if state.fix_m is None:
            return None
        log_p, row, col, _ = self._weighed(state)
        weight = np.exp(log_p - log_p[row, col])
        weight[np.isnan(weight)] = 0.0
        return Posterior(state.memory.north_m, state.memory.east_m, weight / weight.sum())

    def _half_m(self, prior: Prior, gained_m2: float) -> FloatArray:
        """(2,) half-widths of the search area [m]."""
        times = self.extent_sigma if prior.shape == "gaussian" else 3.0
        return np.asarray(times * np.sqrt(np.diag(prior.cov_m2) + gained_m2))

    def _blank(self, prior: Prior, gained_m2: float) -> Memory:
        """A grid over the search area, symmetric about the prior's mean, without a reading."""
        half, sigma = self._half_m(prior, gained_m2), np.sqrt(np.diag(prior.cov_m2))
        step = min(chart.cell_m for chart in self.maps) if self.cell_m is None else self.cell_m
        step = max(min(step, 0.7 * float(sigma.min())), step / FINEST)
        step = max(step, math.sqrt(4.0 * float(half.prod()) / (0.95 * self.max_cells)))
        count = np.maximum(np.round(half / step) if prior.shape == "uniform" else np.ceil(half / step - 1e-9), 2)
        south, west = prior.mean_m - count * step
        rows, cols = (2 * count + 1).astype(int)
        return Memory(float(south), float(west), step, np.zeros((rows, cols)))

    def _remembered(
        self, state: FadingMemoryState, chart: Map, reading: Measurement
    ) -> tuple[FadingMemoryState, float, bool]:
        """The state with one more reading in its memory, its NIS at the estimate, and if the map is known there."""
        epoch, memory = state.epoch, state.memory
        assert epoch is not None
        north, east = memory.north_m, memory.east_m
        radius = math.hypot(float(np.abs(north).max()), float(np.abs(east).max()))
        land = chart.around(epoch.lat_deg, epoch.lon_deg, radius + math.hypot(*state.mean_m) + chart.cell_m)
        frame = land.local_frame(epoch.lat_deg, epoch.lon_deg, radius)
        height, slope = _under(state.mean_m, land, frame)
        known = not math.isnan(height)
        sigma = reading_sigma(reading, chart, state.last_reading, epoch)
        after, coefficients = np.empty_like(memory.surface), np.stack([frame.row, frame.col])
        given = (reading.value, 1.0 / sigma**2)
        unknown = recall(land.values, coefficients, (north, east), given, self.alpha, memory.surface, after)
        if unknown == after.size:  # nothing to compare with: not a reading
            return state, math.nan, known
        missing = memory.missing
        if unknown or missing is not None:
            heights = np.empty_like(after)
            bilinear_lattice(land.values, frame.row, frame.col, -north, -east, heights)
            missing = self.alpha * (0.0 if missing is None else missing) + np.isnan(heights)
        memory = self._added(state, after, missing, slope / sigma)
        if state.fix_m is None or not known:
            return replace(state, memory=memory), math.nan, known
        innovation, alone = reading.value - height, math.hypot(reading.sigma, chart.sigma)
        residual = innovation / alone
        memory = replace(
            memory,
            residual=residual,
            residual2=self.alpha * memory.residual2 + residual**2,
            lagged=self.alpha * memory.lagged + residual * memory.residual,
            judged=self.alpha * memory.judged + 1.0,
        )
        spread = float(slope @ state.cov_m2 @ slope)
        return replace(state, memory=memory), float(innovation**2 / (alone**2 + spread)), known

    def _added(
        self, state: FadingMemoryState, surface: FloatArray, missing: FloatArray | None, told: FloatArray
    ) -> Memory:
        """The memory with a reading more: its surface, and its slopes (2,) north and east over its 1-sigma [1/m]."""
        assert state.epoch is not None
        memory, elapsed = state.memory, state.epoch.time_s - state.start_s
        return replace(
            memory,
            surface=surface,
            missing=missing,
            readings=memory.readings + 1,
            weight=self.alpha * memory.weight + 1.0,
            weight2=self.alpha**2 * memory.weight2 + 1.0,
            time_s=self.alpha * memory.time_s + elapsed,
            gained_m2=self.alpha * memory.gained_m2 + state.gained_m2,
            slope2=self.alpha * memory.slope2 + told**2,
            slope2_time=self.alpha * memory.slope2_time + told**2 * elapsed,
        )

    def _fixed(self, state: FadingMemoryState) -> FadingMemoryState:
        """The state with the fix that its memory gives; without one as long as the memory or the map is too short."""
        if state.memory.readings < self.least_readings:
            return state
        log_p, row, col, gain = self._weighed(state)
        memory = state.memory
        if row < 0 or not math.isfinite(gain):
            return replace(state, fix_m=None, fix_cov_m2=None)
        i, j, nn, ne, ee, _ = moments(log_p, row, col, self.sub_cell, TAIL)
        fix = np.array([memory.south_m + i * memory.cell_m, memory.west_m + j * memory.cell_m])
        cov = memory.cell_m**2 * np.array([[nn, ne], [ne, ee]])
        return self._followed(replace(state, fix_m=fix, fix_cov_m2=cov))

    def _weighed(self, state: FadingMemoryState) -> tuple[FloatArray, int, int, float]:
        """(p, q) logarithm of the posterior, its best cell, and the mean square there (NaN: the prior is unknown)."""
        memory, lattice = state.memory, (state.memory.north_m, state.memory.east_m)
        scores = memory.scores()
        prior = np.array([*state.prior.mean_m, 0.0, 0.0, 0.0])
        if state.prior.shape == "gaussian":
            cov = state.prior.cov_m2 + memory.gained_m2 / memory.weight * np.eye(2)
            prior[2:] = np.linalg.inv(cov)[[0, 0, 1], [0, 1, 1]]
        out = np.empty_like(scores)
        if memory.missing is not None:
            log_posterior(np.zeros_like(scores), 0.0, lattice, prior, out)
            share = np.exp(out - out.max())
            if share[np.isfinite(scores)].sum() <= 0.5 * share.sum():
                return out, -1, -1, math.nan
        readings = memory.weight**2 / memory.weight2
        cost = 0.5 * memory.weight / memory.weight2 * self._independent(memory)
        row, col = log_posterior(scores, cost, lattice, prior, out)
        gain = rise(out, row, col)
        square = max(float(scores[row, col]) - gain / cost, 0.0) / memory.weight
        spread = square * readings / max(readings - 2.0, 1.0)
        if spread > 1.0:
            row, col = log_posterior(scores, cost / spread, lattice, prior, out)
        return out, row, col, square

    @staticmethod
    def _independent(memory: Memory) -> float:
        """Share of the readings that counts as independent, from the lag-one correlation of the residuals at the fix.

        Residuals far below the told sigma count for no more than they weigh.
        """
        if memory.residual2 == 0.0 or memory.judged < 1.0:
            return 1.0
        lag = memory.lagged / memory.residual2
        if lag <= 2.0 / math.sqrt(memory.judged):
            return 1.0
        lag = min(lag * min(1.0, memory.residual2 / memory.judged), 0.99)
        return (1.0 - lag) / (1.0 + lag)

    def _now(self, state: FadingMemoryState) -> FadingMemoryState:
        """The estimate at the time of the epoch: the fix and the drift since (see the module docstring)."""
        prior, memory = state.prior, state.memory
        if state.fix_m is None or state.fix_cov_m2 is None or state.epoch is None:
            return replace(state, mean_m=prior.mean_m, cov_m2=prior.cov_m2 + state.gained_m2 * np.eye(2))
        elapsed, then_m2 = state.epoch.time_s - state.start_s, memory.gained_m2 / memory.weight
        age = np.maximum(elapsed - memory.mean_time_s(), 0.0)
        left = np.clip(np.diag(state.fix_cov_m2) / (np.diag(prior.cov_m2) + then_m2), 0.0, 1.0)
        drift = (self.ins.velocity_sigma_at_mps(elapsed) * age) ** 2 + self.ins.position_walk_m_per_sqrt_s**2 * age
        unaided = state.gained_m2 - (then_m2 if prior.shape == "gaussian" else 0.0)
        growth = left * unaided + (1.0 - left) * drift
        return replace(state, mean_m=state.fix_m, cov_m2=state.fix_cov_m2 + np.diag(growth))

    def _followed(self, state: FadingMemoryState) -> FadingMemoryState:
        """The grid moved with a good fix that leaves its middle half, or widened with a prior that has no fix."""
        memory = state.memory
        assert state.fix_m is not None
        assert state.fix_cov_m2 is not None
        shape = np.array(memory.surface.shape)
        half = 0.5 * (shape - 1) * memory.cell_m
        middle = np.array([memory.south_m, memory.west_m]) + half
        if largest_sigma_m(state.fix_cov_m2) < 0.2 * half.min():
            by = np.round((state.fix_m - middle) / memory.cell_m).astype(int)
            if (np.abs(by) * memory.cell_m <= 0.5 * half).all():
                return state
            return replace(state, memory=reframed(memory, by, shape))
        if state.judgement.fixed:  # one poor fix among good ones; a wrong one will be found lost
            return state
        wanted = self._half_m(state.prior, state.gained_m2)
        size = 2 * np.ceil(wanted / memory.cell_m).astype(int) + 1
        if (wanted <= 1.2 * half).all() or state.prior.shape == "uniform" or size.prod() > self.max_cells:
            return state
        size = np.maximum(size, shape)
        return replace(state, memory=reframed(memory, -((size - shape) // 2), size))

    def _started_over(self, state: FadingMemoryState) -> FadingMemoryState:
        """A lost state with its memory thrown away."""
        memory = self._blank(state.prior, state.gained_m2 if state.prior.shape == "gaussian" else 0.0)
        blank = replace(state, memory=memory, fix_m=None, fix_cov_m2=None, judgement=started_over(state.judgement))
        return self._now(blank)


def _under(mean_m: FloatArray, chart: Map, frame: LocalFrame) -> tuple[float, FloatArray]:
    """The map at an INS error [m], NaN where it says nothing, and its slopes (2,) north and east, 0 where unknown."""
    patch, half = np.empty((3, 3)), 0.5 * chart.cell_m
    around = np.array([-half, 0.0, half])
    bilinear_lattice(chart.values, frame.row, frame.col, -(mean_m[0] + around), -(mean_m[1] + around), patch)
    slope = np.array([patch[2, 1] - patch[0, 1], patch[1, 2] - patch[1, 0]]) / (2.0 * half)
    slope[np.isnan(slope)] = 0.0
    return float(patch[1, 1]), slope
