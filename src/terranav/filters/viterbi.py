"""HMMTEM: the most probable path of the INS error on a grid, by the Viterbi algorithm (papers/000).

Hidden states are the cells, of side delta, of a square of side 6 sigma in the space of the INS error. In one step the
error stays in its cell with probability p or moves to one of the eight neighbours with (1 - p)/8 each (eq. 1 and the
one after it). A reading y weighs a cell with the probability of its residual v_j = y - h(X - theta_j) (eqs. 2-4): in
place of the density, the probability of an interval of one sigma_h on either side of it (eqs. 5 and 6). Then

    S_k(j) = max_i [S_{k-1}(i) a_ij] b_j(y(k))              the best path into each cell                 eqs. 8-11
    phi_k(j) = argmax_i [S_{k-1}(i) a_ij]                    and where it came from                       eq. 12
    DX*(k) = argmax_j S_k(j)                                 the estimate, epoch by epoch                 eqs. 13, 14
    DX*(t) = phi_{t+1}(DX*(t + 1)), t = k - 1 .. 1           the whole path: `Viterbi.backtrace`          eq. 15

all in logarithms, so that hours of readings do not underflow. Of equal best cells the one nearest the prior's mean is
taken.

What the paper leaves open, and what is done here:

- p "relates to the INS performances and the sampling interval". A step with stay-probability p adds the variance
  (3/4)(1 - p) delta^2 to each axis; p is chosen such that this is what the InsGrade says the error gains in the time.
- In a long step an error drifts further than one cell: the 3 x 3 step is then applied m times, m such that p stays
  at least 1/2 and 3 sigma of drift (velocity sigma times dt) are within m cells.
- The error drifts out of the square of the start: the square grows, its sigma being that of an unaided INS. Its sides
  have an odd number of cells, so that the prior's mean is a cell's centre.
- An error lies anywhere in its cell, not at its centre: the terrain's change over a cell counts as noise,
  sigma_j^2 = sigma_h^2 + |slope_j|^2 delta^2 / 12. Without it a steep cell next to the true one may never win.
- A maximum has no covariance. The forward recursion of the same model (sums in place of maxima) runs beside it, and the
  covariance told is its mean square deviation from the estimate, plus delta^2 / 12 per axis for the cell. So it is
  wide where several paths compete, however clear the best one's lead by score.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from terranav.core.checks import finite, unknown_name
from terranav.core.errors import ConfigError, StateError
from terranav.core.frozen import changed
from terranav.core.ins_grade import InsGrade
from terranav.core.judgement import Judge, Judgement, judge, largest_sigma_m
from terranav.core.records import Epoch, Estimate, Measurement, Posterior, Prior
from terranav.filters import _blocks
from terranav.filters._backpointers import History, Origins
from terranav.filters._maps import one_map_a_kind
from terranav.kernels import noises
from terranav.kernels import viterbi as kernel
from terranav.kernels.lattice import bilinear_lattice
from terranav.maps.map import Map
from terranav.maps.noise import reading_sigma

FloatArray = NDArray[np.float64]

NOISES = {
    "integral_gaussian": noises.INTEGRAL,
    "gaussian": noises.GAUSSIAN,
    "laplace": noises.LAPLACE,
    "student_t": noises.STUDENT_T,
    "mixture": noises.MIXTURE,
}
SQUARE = 3.0  # half the side of the square [sigma]: papers/000's 6 sigma
REACH = 5.0  # half the side where the prior is a Gaussian, whose tails count
LEAST_STAY = 0.5  # p, where it is chosen here: the paper asks that staying be the most probable
BYTES = 56  # a cell takes in scores, probabilities and work arrays


@dataclass(frozen=True, slots=True)
class ViterbiState:
    """Scores and probabilities of the cells after an epoch; cell (i, j) is lattice index (south + i, west + j)."""

    prior: Prior
    cell_m: float
    south: int
    west: int
    score: FloatArray  # (rows, cols) log S_k, the best is 0
    probability: FloatArray  # (rows, cols) P(DX(k) | Y_k), sums to one
    log_best: float  # log P* of eq. 13, up to the constants of the densities
    history: History
    estimate_m: FloatArray
    spread_m2: FloatArray  # (2, 2) covariance of the forward recursion about its own mean
    cov_m2: FloatArray
    judgement: Judgement
    unaided_m2: float = 0.0
    start_s: float = math.nan
    epoch: Epoch | None = None
    last_reading: Epoch | None = None

    @property
    def north_m(self) -> FloatArray:
        """(rows,) errors north [m]."""
        return float(self.prior.mean_m[0]) + self.cell_m * (self.south + np.arange(self.score.shape[0], dtype=float))

    @property
    def east_m(self) -> FloatArray:
        """(cols,) errors east [m]."""
        return float(self.prior.mean_m[1]) + self.cell_m * (self.west + np.arange(self.score.shape[1], dtype=float))


@dataclass(frozen=True)
class Viterbi:
    """HMMTEM of papers/000: Viterbi search for the path of the INS error (see the module for the equations).

    The start is the prior's: flat over the square of side 6 sigma (eq. 7) when its shape is 'uniform', else its
    Gaussian, out to 5 sigma.

    Attributes
    ----------
    maps : tuple of Map
        One a kind; readings of several kinds multiply their probabilities.
    ins : InsGrade
        How fast the error drifts.
    cell_m : float or None
        delta, side of a cell [m]; None is half the finest map's cell, or half the prior's sigma where that is smaller.
    stay : float or None
        p, in (0, 1): probability per epoch that the error stays in its cell; None is the InsGrade's growth.
    noise : str
        'integral_gaussian' (eq. 6), 'gaussian', 'laplace', 'student_t' (each with the reading's sigma as standard
        deviation), or 'mixture' of a Gaussian and a wider one.
    degrees_of_freedom : float
        Of 'student_t', > 2.
    outlier_share, outlier_scale : float
        Of 'mixture': share of readings that are noisier, in [0, 0.5], and how many times, > 1.
    cell_noise : bool
        Whether the terrain's change over a cell counts as noise; without, residuals are those of the cell's centre.
    max_memory_mb : float
        Memory for the grid and, apart, for the back-pointers [MB]. A square of the start that needs more is refused;
        later the square stops growing, and `backtrace` gives the latest epochs only.
    converged_sigma_m : float or None
        1-sigma (largest axis) that counts as a fix; None is the finest map's cell.

    Raises
    ------
    ConfigError
        For a setting out of its range, two maps of one kind; at `init`, for a cell as large as the search area or a
        grid that needs more than `max_memory_mb`.
    """

    maps: tuple[Map, ...]
    ins: InsGrade
    cell_m: float | None = None
    stay: float | None = None
    noise: str = "integral_gaussian"
    degrees_of_freedom: float = 4.0
    outlier_share: float = 0.05
    outlier_scale: float = 5.0
    cell_noise: bool = True
    max_memory_mb: float = 256.0
    converged_sigma_m: float | None = None

    def __post_init__(self) -> None:
        for key in ("cell_m", "converged_sigma_m", "max_memory_mb"):
            if getattr(self, key) is not None:
                finite(f"viterbi {key}", getattr(self, key), above=0.0)
        if self.stay is not None and not finite("viterbi stay", self.stay, above=0.0) < 1.0:
            raise ConfigError(f"viterbi stay is {self.stay!r}, expected a probability in (0, 1)")
        if self.noise not in NOISES:
            unknown_name("viterbi noise", self.noise, NOISES)
        finite("viterbi degrees_of_freedom", self.degrees_of_freedom, above=2.0)
        finite("viterbi outlier_share", self.outlier_share, minimum=0.0, maximum=0.5)
        finite("viterbi outlier_scale", self.outlier_scale, above=1.0)
        one_map_a_kind("viterbi", self.maps)

    def init(self, prior: Prior, rng: Generator) -> ViterbiState:
        """The cells and their initial probabilities pi_i (eq. 7)."""
        sigma = np.sqrt(np.diag(prior.cov_m2))
        cell = self._cell_m(sigma)
        half = self._half(prior, cell, 0.0)
        rows, cols = (2 * half + 1).tolist()
        self._check_memory(cell, rows, cols)
        start = np.zeros((rows, cols))
        if prior.shape == "gaussian":
            # centres of cells whose density is flat within: the cells' own variance is part of the prior's
            inverse = np.linalg.inv(prior.cov_m2 - cell**2 / 12.0 * np.eye(2))
            north, east = (cell * np.arange(-n, n + 1) for n in half.tolist())
            n, e = north[:, None], east[None, :]
            start = -0.5 * (inverse[0, 0] * n * n + 2.0 * inverse[0, 1] * n * e + inverse[1, 1] * e * e)
        share = np.exp(start)
        log_best = -math.log(share.sum())
        history = History(self.max_memory_mb * 1e6)
        state = ViterbiState(
            prior, cell, int(-half[0]), int(-half[1]), start, share / share.sum(), log_best, history,
            prior.mean_m, prior.cov_m2, prior.cov_m2, Judgement(),
        )  # fmt: skip
        estimate, spread, cov = _measured(state)
        return changed(state, estimate_m=estimate, spread_m2=spread, cov_m2=cov)

    def step(self, state: ViterbiState, epoch: Epoch, rng: Generator) -> ViterbiState:
        """One recursion of eqs. 11 and 12, with all readings of the epoch."""
        state = self._moved(state, epoch)
        nis: list[float] = []
        known: list[float] = []
        for reading in epoch.measurements:
            for chart in self.maps:
                if chart.kind == reading.kind:
                    state, share, innovation2 = self._weighed(state, epoch, chart, reading)
                    known.append(share)
                    if share > 0.5:
                        nis.append(innovation2)
        estimate, spread, cov = _measured(state)
        judgement = judge(
            self._judge,
            state.judgement,
            largest_sigma_m(cov),
            nis=sum(nis) / len(nis) if nis else math.nan,
            readings=len(nis),
            off_map=max(known) <= 0.5 if known else None,
        )
        return changed(
            state, estimate_m=estimate, spread_m2=spread, cov_m2=cov, judgement=judgement,
            last_reading=epoch if known else state.last_reading,
        )  # fmt: skip

    def estimate(self, state: ViterbiState) -> Estimate:
        """The end of the best path (eq. 14) and the mean square deviation of the forward recursion from it."""
        if state.epoch is None:
            raise StateError("viterbi: no estimate before the first epoch")
        judgement = state.judgement
        return Estimate.at(state.epoch, state.estimate_m, state.cov_m2, judgement.status, judgement.nis)

    def posterior(self, state: ViterbiState) -> Posterior:
        """The forward recursion's probabilities."""
        return Posterior(state.north_m, state.east_m, state.probability)

    def backtrace(self, state: ViterbiState) -> FloatArray:
        """The most probable path given all readings so far (eq. 15).

        Parameters
        ----------
        state : ViterbiState
            After any epoch.

        Returns
        -------
        ins_error_m : (n, 2) [m]
            INS error north and east at the latest n epochs, all of them unless `state.history.given_up` says that
            memory was short. The last row is the streaming estimate.

        Raises
        ------
        StateError
            Before the first epoch.
        """
        if state.epoch is None:
            raise StateError("viterbi: no path before the first epoch")
        end = np.rint((state.estimate_m - state.prior.mean_m) / state.cell_m).astype(int).tolist()
        return np.asarray(state.prior.mean_m + state.cell_m * state.history.path(end[0], end[1]))

    @cached_property
    def _judge(self) -> Judge:
        limit = self.converged_sigma_m
        return Judge(converged_sigma_m=min(chart.cell_m for chart in self.maps) if limit is None else limit)

    def _cell_m(self, sigma: FloatArray) -> float:
        """delta; ConfigError where it is as large as the square."""
        side = 2.0 * SQUARE * float(sigma.min())
        if self.cell_m is None:
            return min(0.5 * min(chart.cell_m for chart in self.maps), 0.5 * float(sigma.min()))
        if self.cell_m > side / 4.0:
            raise ConfigError(
                f"viterbi cell_m is {self.cell_m:g} with a search area of {side:g} m, expected at most a quarter of it"
            )
        return self.cell_m

    def _half(self, prior: Prior, cell_m: float, unaided_m2: float) -> NDArray[np.int64]:
        """Cells on either side of the one at the prior's mean; in all INT(6 sigma / delta), or one more to be odd."""
        reach = SQUARE if prior.shape == "uniform" else REACH
        side = reach * np.sqrt(np.diag(prior.cov_m2) + unaided_m2)
        return np.asarray(np.maximum(np.floor(side / cell_m + 1e-9), 1), dtype=np.int64)

    def _check_memory(self, cell_m: float, rows: int, cols: int) -> None:
        """Raise ConfigError for a grid that does not fit."""
        need_mb = BYTES * rows * cols / 1e6
        if need_mb > self.max_memory_mb:
            fits = cell_m * math.sqrt(need_mb / self.max_memory_mb)
            raise ConfigError(
                f"viterbi: a grid of {rows} x {cols} cells needs {need_mb:.1f} MB, max_memory_mb is "
                f"{self.max_memory_mb:g}; expected cell_m >= {math.ceil(fits * 10.0) / 10.0:g} (it is {cell_m:g}), a "
                "smaller prior sigma or more memory"
            )

    def _moved(self, state: ViterbiState, epoch: Epoch) -> ViterbiState:
        """Transitions from the epoch before to this one."""
        none = np.empty((0, *state.score.shape), dtype=np.uint8)
        if state.epoch is None:
            history = state.history.extended(Origins(state.south, state.west, none))
            return changed(state, epoch=epoch, start_s=epoch.time_s, history=history)
        elapsed, dt = state.epoch.time_s - state.start_s, epoch.time_s - state.epoch.time_s
        growth = max(self.ins.position_growth_m2(elapsed, dt, float(v)) for v in np.diag(state.spread_m2))
        unaided = state.unaided_m2 + self.ins.position_growth_m2(elapsed, dt)
        state = self._enlarged(state, unaided)
        reach = 3.0 * self.ins.velocity_sigma_at_mps(elapsed + dt) * dt
        times, stay = self._steps(growth, reach, state, dt)
        pointers = _blocks.empty((times, *state.score.shape), np.uint8)
        score, probability = state.score, state.probability
        for layer in pointers:
            score, probability = _transition(score, probability, stay, layer)
        history = state.history.extended(Origins(state.south, state.west, pointers))
        return changed(state, epoch=epoch, unaided_m2=unaided, score=score, probability=probability, history=history)

    def _steps(self, growth_m2: float, reach_m: float, state: ViterbiState, dt: float) -> tuple[int, float]:
        """How many times the 3 x 3 step is applied, and p."""
        most = max(int(self.max_memory_mb * 1e6 / state.score.size), 1)  # after hours without an epoch
        far = math.ceil(reach_m / state.cell_m)
        if self.stay is not None:
            return (min(max(1, far), most), self.stay) if dt > 0.0 else (0, 1.0)
        if growth_m2 <= 0.0:
            return 0, 1.0
        whole = 0.75 * state.cell_m**2  # variance of a step that never stays
        times = min(max(math.ceil(growth_m2 / ((1.0 - LEAST_STAY) * whole)), far, 1), most)
        return times, max(1.0 - growth_m2 / (times * whole), 1.0 / 9.0)

    def _enlarged(self, state: ViterbiState, unaided_m2: float) -> ViterbiState:
        """The square of the unaided INS now, as far as memory goes; new cells have no path yet."""
        half = self._half(state.prior, state.cell_m, unaided_m2)
        if half[0] <= -state.south and half[1] <= -state.west:
            return state
        half = np.maximum(half, [-state.south, -state.west])
        if BYTES * float((2 * half + 1).prod()) > self.max_memory_mb * 1e6:
            return state
        pad = [(int(half[0]) + state.south,) * 2, (int(half[1]) + state.west,) * 2]
        score = np.pad(state.score, pad, constant_values=-np.inf)
        probability = np.pad(state.probability, pad)
        return changed(state, south=-int(half[0]), west=-int(half[1]), score=score, probability=probability)

    def _weighed(
        self, state: ViterbiState, epoch: Epoch, chart: Map, reading: Measurement
    ) -> tuple[ViterbiState, float, float]:
        """The state after one reading, the share of probability that is on the map, and the NIS."""
        north, east = state.north_m, state.east_m
        radius = math.hypot(float(np.abs(north).max()), float(np.abs(east).max()))
        land = chart.around(epoch.lat_deg, epoch.lon_deg, radius)
        frame = land.local_frame(epoch.lat_deg, epoch.lon_deg, radius)
        field = _blocks.empty(state.score.shape)
        bilinear_lattice(land.values, frame.row, frame.col, -north, -east, field)
        sigma = reading_sigma(reading, chart, state.last_reading, epoch)
        first, second = self.degrees_of_freedom, 0.0
        if self.noise == "mixture":
            first, second = self.outlier_share, self.outlier_scale
        model = (reading.value, sigma, self.cell_noise / 12.0, NOISES[self.noise], first, second)
        score, probability = _blocks.empty(field.shape), _blocks.empty(field.shape)
        known, miss, spread, gained = kernel.weigh(state.score, state.probability, field, model, score, probability)
        if known <= 0.0:
            return state, 0.0, math.nan
        now = changed(state, score=score, probability=probability, log_best=state.log_best + gained)
        return now, known, miss**2 / (sigma**2 + spread)


def _transition(
    score: FloatArray, probability: FloatArray, stay: float, pointer: NDArray[np.uint8]
) -> tuple[FloatArray, FloatArray]:
    """One 3 x 3 step of both recursions; writes the back-pointers."""
    move = (1.0 - stay) / 8.0
    scores, probabilities = _blocks.empty(score.shape), _blocks.empty(score.shape)
    kernel.max_sum(score, math.log(stay), math.log(move) if move > 0.0 else -math.inf, scores, pointer)
    kernel.spread(probability, stay, move, probabilities)
    return scores, probabilities


def _measured(state: ViterbiState) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Estimate, covariance of the probabilities about their mean and about the estimate, read off the grid."""
    row, col, *mean, nn, ne, ee = kernel.moments(state.score, state.probability, state.south, state.west)
    cell, own = state.cell_m, 1.0 / 12.0  # the cell's own variance
    north, east = mean[0] - row, mean[1] - col
    estimate = state.prior.mean_m + cell * np.array([row, col], dtype=np.float64)
    spread = cell * cell * np.array([[nn + own, ne], [ne, ee + own]])
    return (
        estimate,
        spread,
        spread + cell * cell * np.array([[north * north, north * east], [north * east, east * east]]),
    )
