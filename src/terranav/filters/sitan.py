"""SITAN: an extended Kalman filter of the two horizontal INS position errors with stochastic linearisation.

Hostetler and Andreas, Nonlinear Kalman Filtering Techniques for Terrain-Aided Navigation, IEEE Trans. AC-28 (1983), and
Hostetler, Optimal Terrain-Aided Navigation Systems (1978), reference 2 of papers/000. Over the region where the error
may lie, a plane is fitted to the map by least squares,

    h(x) = z + g (x - m) + r,    z level, g slope (per metre of error), r what the plane leaves, E r^2 = R_fit

and a reading y updates mean m and covariance P as in a Kalman filter with h linear and R = sensor^2 + map^2 + R_fit:

    S = g P g' + R,  K = P g' / S,  m + K (y - z),  (I - K g) P (I - K g)' + K R K'   (Joseph's form)

What a plane leaves is no white noise along the track: readings closer together than the region is wide meet the same
hill. So R_fit counts once for all readings within one sigma of the error on the ground; on the sample map that takes
successful starts from 200 m and 500 m from 2 in 10 to 6 in 10. On a plane R_fit is zero and this is the Kalman filter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from terranav.core.checks import finite
from terranav.core.earth import offset_m, shift
from terranav.core.errors import ConfigError, StateError
from terranav.core.ins_grade import InsGrade
from terranav.core.judgement import Judge, Judgement, judge, largest_sigma_m, started_over
from terranav.core.records import Epoch, Estimate, Measurement, Prior, Status
from terranav.maps.map import Map
from terranav.maps.noise import MOST_REPEATED, reading_sigma

FloatArray = NDArray[np.float64]

# 5 x 5 places from -1.5 to 1.5 sigma along the axes of the error ellipse: their variance is 1.125 sigma^2, about that
# of the error itself, so that the fit is the one over its distribution
_STEPS = np.linspace(-1.5, 1.5, 5)
PATTERN = np.stack(np.meshgrid(_STEPS, _STEPS), axis=-1).reshape(-1, 2)
LEAST_PLACES = 13  # more than half of the 25 must have a map value


@dataclass(frozen=True, slots=True)
class Plane:
    """The map over the region of the error: level at the mean, slope, and mean square of what the plane leaves."""

    level: float
    slope: FloatArray  # (2,) per metre of error north, east
    left: float


@dataclass(frozen=True, slots=True)
class SitanState:
    """Mean and covariance after an epoch, and those it had if there had been no reading."""

    prior: Prior
    mean_m: FloatArray
    cov_m2: FloatArray
    unaided_m2: float = 0.0  # variance of each axis that an INS without corrections has gained
    judgement: Judgement = field(default_factory=Judgement)
    start_s: float = math.nan
    epoch: Epoch | None = None
    last_reading: Epoch | None = None


@dataclass(frozen=True)
class Sitan:
    """SITAN filter.

    It tracks; it does not acquire. Where the initial error spans several hills no plane describes the map: the fit's
    residual then all but switches the readings off (the status stays 'searching'), or the filter settles in a wrong
    valley, which the NIS betrays only once readings contradict it ('degraded', 'lost'). Then it starts over from the
    initial prior and the drift since. papers/000 shows it diverge; use it from a few hundred metres at most, or after a
    fix of another method.

    Attributes
    ----------
    maps : tuple of Map
        One a kind; readings of several kinds at one epoch are used one after the other.
    ins : InsGrade
        How fast the position error grows (`InsGrade.position_growth_m2`).
    gate_sigma : float or None
        A reading further from its prediction than this many sigmas is not used (but judged); None uses all.
    restart : bool
        Start over when lost; without, the filter stays where it is and goes on, as its first publications had it.
    converged_sigma_m : float or None
        1-sigma (largest axis) that counts as a fix; None is the finest map's cell.

    Raises
    ------
    ConfigError
        For a setting out of its range, or two maps of one kind.
    """

    maps: tuple[Map, ...]
    ins: InsGrade
    gate_sigma: float | None = None
    restart: bool = True
    converged_sigma_m: float | None = None

    def __post_init__(self) -> None:
        for key in ("gate_sigma", "converged_sigma_m"):
            if getattr(self, key) is not None:
                finite(f"sitan {key}", getattr(self, key), above=0.0)
        kinds = [chart.kind for chart in self.maps]
        if not kinds or len(set(kinds)) != len(kinds):
            raise ConfigError(f"sitan maps are of kinds {kinds}, expected one map of each kind that is measured")

    def init(self, prior: Prior, rng: Generator) -> SitanState:
        """Mean and covariance of the prior, whatever its shape."""
        return SitanState(prior, prior.mean_m, prior.cov_m2)

    def step(self, state: SitanState, epoch: Epoch, rng: Generator) -> SitanState:
        """Grow the covariance by the INS's drift since the last epoch, then use the readings one by one."""
        state = self._drifted(state, epoch)
        nis: list[float] = []
        off_map: list[bool] = []
        for reading in epoch.measurements:
            for chart in self.maps:
                if chart.kind == reading.kind:
                    plane = fitted_plane(chart, epoch, state.mean_m, state.cov_m2)
                    off_map.append(plane is None)
                    if plane is not None:
                        sigma = reading_sigma(reading, chart, state.last_reading, epoch)
                        state, innovation2 = self._updated(state, reading, plane, sigma)
                        nis.append(innovation2)
        judgement = judge(
            self._judge,
            state.judgement,
            largest_sigma_m(state.cov_m2),
            nis=sum(nis) / len(nis) if nis else math.nan,
            readings=len(nis),
            off_map=all(off_map) if off_map else None,
        )
        state = replace(state, judgement=judgement, last_reading=epoch if off_map else state.last_reading)
        return _started_over(state) if self.restart and judgement.status is Status.LOST else state

    def estimate(self, state: SitanState) -> Estimate:
        """Mean and covariance."""
        if state.epoch is None:
            raise StateError("sitan: no estimate before the first epoch")
        judgement = state.judgement
        return Estimate.at(state.epoch, state.mean_m, state.cov_m2, judgement.status, judgement.nis)

    @property
    def _judge(self) -> Judge:
        limit = self.converged_sigma_m
        return Judge(converged_sigma_m=min(chart.cell_m for chart in self.maps) if limit is None else limit)

    def _drifted(self, state: SitanState, epoch: Epoch) -> SitanState:
        """The state at the time of `epoch`, before its readings."""
        if state.epoch is None:
            return replace(state, epoch=epoch, start_s=epoch.time_s)
        elapsed, dt = state.epoch.time_s - state.start_s, epoch.time_s - state.epoch.time_s
        growth = [self.ins.position_growth_m2(elapsed, dt, float(v)) for v in np.diag(state.cov_m2)]
        unaided = state.unaided_m2 + self.ins.position_growth_m2(elapsed, dt)
        return replace(state, epoch=epoch, cov_m2=state.cov_m2 + np.diag(growth), unaided_m2=unaided)

    def _updated(self, state: SitanState, reading: Measurement, plane: Plane, sigma: float) -> tuple[SitanState, float]:
        """The state after one reading, and the NIS of that reading."""
        g, P = plane.slope, state.cov_m2
        noise = sigma**2 + plane.left * _alike(state)
        innovation = reading.value - plane.level
        spread = float(g @ P @ g) + noise
        nis = innovation**2 / spread
        if self.gate_sigma is not None and nis > self.gate_sigma**2:
            return state, nis
        gain = P @ g / spread
        keep = np.eye(2) - np.outer(gain, g)
        cov = keep @ P @ keep.T + noise * np.outer(gain, gain)
        return replace(state, mean_m=state.mean_m + gain * innovation, cov_m2=0.5 * (cov + cov.T)), nis


def _started_over(state: SitanState) -> SitanState:
    """The state as if there had never been a reading."""
    cov = state.prior.cov_m2 + state.unaided_m2 * np.eye(2)
    return replace(state, mean_m=state.prior.mean_m, cov_m2=cov, judgement=started_over(state.judgement))


def _alike(state: SitanState) -> float:
    """Readings that share what the plane leaves: those within one sigma of the error on the ground."""
    if state.last_reading is None or state.epoch is None:
        return 1.0
    last, now = state.last_reading, state.epoch
    spacing = math.hypot(*np.stack(offset_m(last.lat_deg, last.lon_deg, now.lat_deg, now.lon_deg)).tolist())
    return min(max(1.0, largest_sigma_m(state.cov_m2) / max(spacing, 1e-9)), MOST_REPEATED)


def fitted_plane(chart: Map, epoch: Epoch, mean_m: FloatArray, cov_m2: FloatArray) -> Plane | None:
    """Least-squares plane through the map over the region where the error may lie; None where the map says nothing.

    Parameters
    ----------
    chart : Map
    epoch : Epoch
        Its indicated position, less an error, is a place on the map.
    mean_m, cov_m2 : (2,) [m], (2, 2) [m^2]
        Of the error. The region reaches at least half a map cell along each axis of the ellipse.
    """
    variance, axes = np.linalg.eigh(cov_m2)
    reach = np.maximum(np.sqrt(np.maximum(variance, 0.0)), 0.5 * chart.cell_m / _STEPS[-1])
    off = (PATTERN * reach) @ axes.T
    error = mean_m + off
    value = chart.sample(*shift(epoch.lat_deg, epoch.lon_deg, -error[:, 0], -error[:, 1]))
    known = np.isfinite(value)
    count = int(known.sum())
    if count < LEAST_PLACES:
        return None
    scale = float(reach.max())
    design = np.column_stack([np.ones(count), off[known] / scale])
    solution, *_ = np.linalg.lstsq(design, value[known], rcond=None)
    rest = value[known] - design @ solution
    return Plane(float(solution[0]), solution[1:] / scale, float(rest @ rest) / (count - 3))
