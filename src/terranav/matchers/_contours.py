"""One ICCP match: a trace of readings laid over the contours from many starts, and what each result is worth.

Papers/003, sections 2 to 4. The covariance is not in the paper. The target value is a sum of distances, so its minimum
is a least-absolute-deviations fit: with u_i the signed distance of point i from its contour along the unit normal n_i,
its 1-sigma s_i / |g_i| (s_i: reading and map error, g_i: slope of the map) and f_i = |g_i| / (sqrt(2 pi) s_i) the
density of u_i at zero, the estimate's covariance is inv(H) S inv(H), H = 2 sum f_i J_i' J_i, S = sum J_i' J_i (Koenker,
Quantile Regression, 2005, section 4.2), J_i = n_i' d x_i / d(errors). It is kept as information, H pinv(S) H, because
what the ground does not show is not known at all.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terranav.core.earth import offset_m, shift
from terranav.core.records import Profile
from terranav.kernels.contours import nearest_points, optimise, trace
from terranav.maps.map import Map

FloatArray = NDArray[np.float64]

LEAST_VALID = 0.8  # share of a trace's points that must lie on the map
LEAST_STEP_ERROR = 1e-6  # 1-sigma of the step errors of a perfect INS: the simplex needs some width


@dataclass(frozen=True)
class Task:
    """A trace to be matched.

    Attributes
    ----------
    chart, profile : Map, Profile
    sigma : (W,)
        1-sigma of reading less map [the kind's unit].
    per_step : bool
        Whether every step has its own velocity and course error, or all have the same.
    step_sigma : float
        1-sigma of velocity [1] and course error [rad].
    weight : float
        K of papers/003 eq. 1.
    reach_m : float
        Contours farther away are not seen [m].
    """

    chart: Map
    profile: Profile
    sigma: FloatArray
    per_step: bool
    step_sigma: float
    weight: float
    reach_m: float

    @property
    def variables(self) -> int:
        """Length of the vector that the simplex works on."""
        return 2 + 2 * (len(self.profile.epochs) - 1 if self.per_step else 1)


@dataclass(frozen=True)
class Optimisations:
    """What the simplex made of Q starts, best first; only those that lie on the map and on contours.

    Attributes
    ----------
    places_m : (Q, 2) [m]
        INS error at the last point: 'the last point of each W points is chosen as the optimal position'.
    target_m, contour_m : (Q,) [m]
        E and E_H.
    misfit : (Q, W)
        Reading less map at the trace's points over its 1-sigma; NaN off the map.
    information : (Q, 2, 2) [1/m^2]
        Of the places.
    """

    places_m: FloatArray
    target_m: FloatArray
    contour_m: FloatArray
    misfit: FloatArray
    information: FloatArray

    def best_near(self, chosen: int, within_m: float) -> int:
        """The best result of the place of `chosen`: which of those there a judge takes may hang on rounding alone."""
        away = np.hypot(*(self.places_m - self.places_m[chosen]).T)
        return int(np.argmax(away < within_m))


@dataclass(frozen=True)
class _Frame:
    """The INS trace in metres about its middle, and the map there."""

    land: Map
    row: FloatArray
    col: FloatArray
    metric: FloatArray
    points_m: FloatArray
    lat_deg: float
    lon_deg: float


def solve(task: Task, errors_m: FloatArray, step_errors: FloatArray, limits: tuple[float, int]) -> Optimisations:
    """Run the simplex from Q starts.

    Parameters
    ----------
    task : Task
    errors_m : (Q, 2) [m]
        INS errors at the last point to start from.
    step_errors : (Q, variables - 2)
        Velocity and course errors to start from.
    limits : (E_min [m], T_max)
    """
    frame = _frame(task, float(np.abs(errors_m).max()))
    first, steps = frame.points_m[0], np.diff(frame.points_m, axis=0)
    starts = np.concatenate([-errors_m, step_errors], axis=1)
    last = np.empty_like(frame.points_m)
    for start, error in zip(starts, errors_m, strict=True):  # the first point from which the steps lead to the last
        trace(start, first, steps, last)
        start[:2] += frame.points_m[-1] - error - last[-1]
    size = np.full(task.variables, task.step_sigma)
    size[:2] = task.chart.cell_m
    kernel = (frame.row, frame.col, frame.metric)
    out, score = np.empty_like(starts), np.empty((len(starts), 3))
    bounds = (task.weight, task.reach_m, limits[0], float(limits[1]))
    optimise(frame.land.values, kernel, task.profile.value, first, steps, starts, size, bounds, out, score)
    points = np.empty((len(out), *frame.points_m.shape))
    for p, x in zip(out, points, strict=True):
        trace(p, first, steps, x)
    return _valued(task, frame, points, score)


def _frame(task: Task, search_m: float) -> _Frame:
    """The map about the middle of the INS trace."""
    profile = task.profile
    middle = profile.epochs[len(profile.epochs) // 2]
    north, east = offset_m(middle.lat_deg, middle.lon_deg, profile.lat_deg, profile.lon_deg)
    radius = float(np.hypot(north, east).max()) + search_m + task.reach_m
    land = task.chart.around(middle.lat_deg, middle.lon_deg, 1.5 * radius)  # the simplex may stray
    frame = land.local_frame(middle.lat_deg, middle.lon_deg, radius)
    metric = np.linalg.inv(np.array([frame.row[1:3], frame.col[1:3]]))
    points = np.stack([north, east], axis=1)
    return _Frame(land, frame.row, frame.col, metric, points, middle.lat_deg, middle.lon_deg)


def _valued(task: Task, frame: _Frame, points: FloatArray, score: FloatArray) -> Optimisations:
    """Keep the results that mean something, best first, and find out what they are worth."""
    lat, lon = shift(frame.lat_deg, frame.lon_deg, points[..., 0], points[..., 1])
    misfit = (task.profile.value - task.chart.sample(lat, lon)) / task.sigma
    row, col = frame.land.cells(lat, lon)
    near = np.empty((row.size, 3))
    level = np.broadcast_to(task.profile.value, row.shape).ravel()
    nearest_points(frame.land.values, row.ravel(), col.ravel(), level, frame.metric, task.reach_m, near)
    found = np.isfinite(near[:, 0]).reshape(row.shape) & np.isfinite(misfit)
    on_map = np.isfinite(misfit).mean(axis=1) >= LEAST_VALID
    kept = np.flatnonzero(on_map & found.any(axis=1))
    kept = kept[np.argsort(score[kept, 0], kind="stable")]
    slope = np.stack(task.chart.gradient(lat[kept], lon[kept]), axis=-1)
    slope = np.where(found[kept, :, None] & np.isfinite(slope), slope, 0.0)
    return Optimisations(
        frame.points_m[-1] - points[kept, -1],
        score[kept, 0],
        score[kept, 1],
        misfit[kept],
        _information(task, slope, points[kept]),
    )


def _information(task: Task, slope: FloatArray, points: FloatArray) -> FloatArray:
    """Information (Q, 2, 2) about the last points of traces (Q, W, 2); slopes are zero where no contour is [1/m^2]."""
    size = np.hypot(slope[..., 0], slope[..., 1])[..., None]
    away = points - points[:, -1:]
    turned = np.stack([-away[..., 1], away[..., 0]], axis=-1)
    along = [np.sum(slope * part, axis=-1) for part in (away, turned)]
    # metres and parts of a thousand, so that pinv sees like with like
    j = np.stack([slope[..., 0], slope[..., 1], 1e-3 * along[0], 1e-3 * along[1]], axis=-1)
    j = np.divide(j, size, out=np.zeros_like(j), where=size > 0.0)
    density = size / (math.sqrt(2.0 * math.pi) * task.sigma[:, None])
    h = 2.0 * j.transpose(0, 2, 1) @ (density * j)
    info = h @ np.linalg.pinv(j.transpose(0, 2, 1) @ j, rcond=1e-9, hermitian=True) @ h
    info[:, 2:, 2:] += np.eye(2) * (1e-3 / task.step_sigma) ** 2
    reduced = info[:, :2, :2] - info[:, :2, 2:] @ np.linalg.solve(info[:, 2:, 2:], info[:, 2:, :2])
    return np.asarray(0.5 * (reduced + reduced.transpose(0, 2, 1)))
