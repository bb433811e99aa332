"""How well any estimator could know the position: the posterior Cramer-Rao bound along a track.

Tichavsky, Muravchik and Nehorai, Posterior Cramer-Rao bounds for discrete-time nonlinear filtering, IEEE Trans. Signal
Processing 46 (1998), 1386-1396. The mean squared error of an estimator is at least J^-1; with linear dynamics (phi, q)
and readings y = h(x) + e the recursion of their eq. 21 becomes (their section IV.A, by the matrix inversion lemma)

    J^-1 of the next epoch before its readings = phi J^-1 phi' + q
    J after a reading = J before + i s s',    s = dh/dx at the true state,  i the Fisher information of e

which stands here in terms of J^-1, so that a state known exactly or a step without noise does no harm. With the true
track given, nothing is random: the slopes are those on the true track and there is nothing to average.

State and dynamics are those of `terranav.ins.error_state`, the readings those of the filter `marginalized`. As the
position error p is indicated minus true, a reading y = map(indicated - p) + bias + patch + e has

    s = (-d map/d north, -d map/d east, 0, ..., 1 for its bias, 1 for its patch),

the slope being that of the bilinear patch that the sampling uses. e is the white part,

    e ~ (1 - b) N(0, v) + b Cauchy(reach),   v = sigma^2 + blur^2 |slope|^2,   reach^2 = scale^2 (sigma^2 + map sigma^2)

whose Fisher information is less than 1/v (`mixture_information`): 0.90 of it for b = 5 %, reach = 2.8 sqrt(v). What the
filter must find out besides only makes its task harder and is left out, so that the bound holds with or without it: how
noisy readings really are, and where the map lies as a whole. Outliers are taken one by one; knowing that they come in
runs could add no more than the knowledge which readings they are, (1 - b)/v + b/(2 reach^2), 6 % in the same case.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from terranav.core.checks import finite
from terranav.core.earth import shift
from terranav.core.errors import DataError, DataWarning, StateError
from terranav.core.ins_grade import InsGrade
from terranav.core.recording import Recording
from terranav.core.records import Epoch, Prior
from terranav.filters._cloud import prior_covariance
from terranav.filters._maps import one_map_a_kind
from terranav.filters.marginalized import Marginalized
from terranav.ins.error_state import ErrorModel, check_bias_sigma
from terranav.maps.map import Map, as_maps
from terranav.sensors.ready import ready

FloatArray = NDArray[np.float64]

WINDOW_CELLS = 4_000_000  # of a map, whose values are looked at together

NO_BIAS: Mapping[str, float] = MappingProxyType({})  # every kind takes its own `Kind.bias_sigma`


@dataclass(frozen=True, eq=False)
class Bound:
    """Least covariance of any estimator's error, after the readings of each epoch.

    Attributes
    ----------
    time_s : (n,) [s]
    cov_m2 : (n, 2, 2) [m^2]
        Of the position error, north and east.
    names : tuple of d texts
        The states of the model, each with its unit.
    sigma : (n, d)
        1-sigma bound of each of them [its unit].
    """

    time_s: FloatArray
    cov_m2: FloatArray
    names: tuple[str, ...] = ()
    sigma: FloatArray | None = None

    def __len__(self) -> int:
        return int(self.time_s.size)

    @property
    def sigma_m(self) -> FloatArray:
        """(n, 2) 1-sigma bound of the position error, north and east [m]."""
        return np.asarray(np.sqrt(np.diagonal(self.cov_m2, axis1=1, axis2=2)))

    @property
    def drms_m(self) -> FloatArray:
        """(n,) bound of the root of the mean squared distance from the truth [m]."""
        return np.asarray(np.sqrt(np.trace(self.cov_m2, axis1=1, axis2=2)))


def bound(
    rec: Recording,
    maps: Sequence[Map] | Map,
    ins: InsGrade | None = None,
    *,
    prior: Prior | None = None,
    bias_sigma: Mapping[str, float] = NO_BIAS,
    outlier_share: float = Marginalized.outlier_share,
    outlier_scale: float = Marginalized.outlier_scale,
    blur_cells: float = Marginalized.blur_cells,
) -> Bound:
    """Posterior Cramer-Rao bound along the true track of a recording, for the model of the filter `marginalized`.

    Only times, sigmas, the indicated and the true track count; the values of the readings do not. A reading where the
    map says nothing, at the true position, carries no information.

    Parameters
    ----------
    rec : Recording
        With truth. Between epochs that have one the error of the INS is interpolated; before the first and after the
        last it is held.
    maps : sequence of Map, or one
        One a kind.
    ins : InsGrade, optional
        Else the recording's own, else the default grade with a warning.
    prior : Prior, optional
        Of the INS error at the first epoch; else the initial position sigma of the INS. A uniform one, which has no
        Fisher information, counts as the normal one of the same covariance.
    bias_sigma, outlier_share, outlier_scale, blur_cells
        As in `marginalized`, with its defaults.

    Returns
    -------
    Bound

    Raises
    ------
    StateError
        Without truth.
    DataError
        No map, or no reading that one of them can be compared with.
    ConfigError
        Two maps of a kind, or a setting out of its range.
    """
    check_noise("bound", bias_sigma, outlier_share, outlier_scale, blur_cells)
    asked = asked_of("bound", rec, maps, ins)
    epochs = asked.epochs
    model = ErrorModel(asked.ins, asked.charts, ErrorModel.level_for(asked.ins, epochs[0]), bias_sigma)
    readings = _readings(model, epochs, asked.track, blur_cells, (float(outlier_share), float(outlier_scale)))
    cov = model.initial_covariance(prior_covariance(prior or Prior.from_ins(asked.ins)))
    return _recursion(model, epochs, cov, readings)


@dataclass(frozen=True)
class Asked:
    """A flight: maps, latitude and longitude (n,) of the true track [deg], the INS, epochs with ready measurements."""

    charts: tuple[Map, ...]
    track: tuple[FloatArray, FloatArray]
    ins: InsGrade
    epochs: tuple[Epoch, ...]


def asked_of(name: str, rec: Recording, maps: Sequence[Map] | Map, ins: InsGrade | None) -> Asked:
    """What `name` is asked of a recording; the errors are those of `bound`."""
    charts = as_maps(maps)
    if not charts:
        raise DataError(f"{rec.name}: no map is given, expected at least one")
    one_map_a_kind(name, charts)
    track = _true_track(name, rec)
    grade = _grade(name, rec, ins)
    epochs = tuple(ready(rec.epochs()))
    _check_kinds(rec, charts, epochs)
    return Asked(charts, track, grade, epochs)


def check_noise(
    name: str, bias_sigma: Mapping[str, float], outlier_share: float, outlier_scale: float, blur_cells: float
) -> None:
    """Raise ConfigError for a setting out of its range."""
    finite(f"{name} outlier_share", outlier_share, minimum=0.0, maximum=0.5)
    finite(f"{name} outlier_scale", outlier_scale, above=0.0)
    finite(f"{name} blur_cells", blur_cells, minimum=0.0)
    check_bias_sigma(name, bias_sigma)


@dataclass(frozen=True, slots=True)
class _Reading:
    """One reading: its sensitivity (d,) to the state and the variance that a normal one of its information has."""

    sensitivity: FloatArray
    variance: float


def _recursion(model: ErrorModel, epochs: Sequence[Epoch], cov: FloatArray, readings: list[list[_Reading]]) -> Bound:
    """J^-1 after every epoch."""
    covs, sigma = np.empty((len(epochs), 2, 2)), np.empty((len(epochs), model.size))
    for k, epoch in enumerate(epochs):
        if k:
            passed = model.transition(epochs[k - 1], epoch)
            cov = passed.phi @ cov @ passed.phi.T + passed.q
            cov = 0.5 * (cov + cov.T)
        for reading in readings[k]:
            cov = informed(cov, reading.sensitivity, reading.variance)
        covs[k] = cov[:2, :2]
        sigma[k] = np.sqrt(np.maximum(np.diagonal(cov), 0.0))
    return Bound(np.array([epoch.time_s for epoch in epochs]), covs, model.names, sigma)


def informed(cov: FloatArray, sensitivity: FloatArray, variance: float) -> FloatArray:
    """(cov^-1 + s s'/r)^-1 in Joseph's form: symmetric and positive however far apart the scales of the states are.

    Parameters
    ----------
    cov : (d, d)
    sensitivity : (d,) s
    variance : float, r > 0
    """
    with_reading = cov @ sensitivity
    gain = with_reading / (float(sensitivity @ with_reading) + variance)
    kept = np.eye(len(cov)) - np.outer(gain, sensitivity)
    return np.asarray(kept @ cov @ kept.T + variance * np.outer(gain, gain))


@lru_cache(maxsize=4096)
def mixture_information(share: float, reach: float) -> float:
    """Fisher information of the location of (1 - share) N(0, 1) + share Cauchy(reach), 1 without outliers.

    Integral of score^2 density, score = -x (1 - p) - 2 x p / (reach^2 + x^2), p(x) being the probability that x is an
    outlier; by the trapezoidal rule in t, x = min(reach, 1) sinh t.

    Parameters
    ----------
    share : float in [0, 1)
    reach : float > 0
        Half width of the Cauchy density.
    """
    if share == 0.0:
        return 1.0
    unit, farthest = min(reach, 1.0), 1e4 * max(reach, 1.0)
    t, step = np.linspace(0.0, math.asinh(farthest / unit), 2001, retstep=True)
    x = unit * np.sinh(t)
    near = (1.0 - share) / math.sqrt(2.0 * math.pi) * np.exp(-0.5 * x**2)
    far = share * reach / (math.pi * (reach**2 + x**2))
    score = x * (near + 2.0 * far / (reach**2 + x**2)) / (near + far)
    whole = score**2 * (near + far) * unit * np.cosh(t)  # nothing at both ends
    return float(2.0 * step * whole.sum())


def normal_variance(sigma: float, map_sigma: float, blurred2: float, outliers: tuple[float, float]) -> float:
    """Variance that a normal reading of the same information has.

    Parameters
    ----------
    sigma, map_sigma : float
        Of reading and map [unit].
    blurred2 : float
        Variance by the place within a cell [unit^2].
    outliers : share of them, and their scale
    """
    share, scale = outliers
    white = sigma**2 + blurred2
    reach = scale * math.hypot(sigma, map_sigma) / math.sqrt(white)
    return white / mixture_information(share, float(f"{reach:.3g}"))


def _readings(
    model: ErrorModel,
    epochs: Sequence[Epoch],
    track: tuple[FloatArray, FloatArray],
    blur_cells: float,
    outliers: tuple[float, float],
) -> list[list[_Reading]]:
    """What the readings of each epoch say of the state, at the true position."""
    found: list[list[_Reading]] = [[] for _ in epochs]
    share, scale = outliers
    for chart in model.maps:
        slopes = patch_slope(chart, *track)
        known = np.isfinite(chart.sample(*track))
        blur2, bias = (blur_cells * chart.cell_m) ** 2, model.bias_index(chart.kind)
        for k, epoch in enumerate(epochs):
            for reading in epoch.measurements:
                if reading.kind == chart.kind and known[k]:
                    sensitivity = np.zeros(model.size)
                    sensitivity[:2] = -slopes[k]  # the error is indicated minus true
                    sensitivity[bias : bias + 2] = 1.0
                    blurred2 = blur2 * float(slopes[k] @ slopes[k])
                    variance = normal_variance(reading.sigma, chart.sigma, blurred2, (share, scale))
                    found[k].append(_Reading(sensitivity, variance))
    return found


def patch_slope(chart: Map, lat_deg: FloatArray, lon_deg: FloatArray) -> FloatArray:
    """Slope of the bilinear patch at positions: what `Map.sample` has there, not smoothed as in `Map.gradient`.

    Parameters
    ----------
    chart : Map
    lat_deg, lon_deg : (n,) [deg]

    Returns
    -------
    (n, 2) [unit/m]
        North and east; zero off the map and beside a void, where the patch has none.
    """
    slopes = np.zeros((np.size(lat_deg), 2))
    inside = np.flatnonzero(chart.covers(lat_deg, lon_deg))
    row, col = (axis[inside] for axis in chart.cells(lat_deg, lon_deg))
    for part in _near(row, col, np.arange(inside.size)):
        at = inside[part]
        window = chart.around(lat_deg[at], lon_deg[at], 3.0 * chart.cell_m)
        slopes[at] = _window_slope(window, lat_deg[at], lon_deg[at])
    return slopes


def _near(row: FloatArray, col: FloatArray, part: NDArray[np.intp]) -> Iterator[NDArray[np.intp]]:
    """The indices of a part in smaller parts, each within a rectangle of WINDOW_CELLS cells."""
    if not part.size:
        return
    tall, wide = (float(np.ptp(axis[part])) for axis in (row, col))
    if (tall + 1.0) * (wide + 1.0) <= WINDOW_CELLS:
        yield part
        return
    axis = row[part] if tall > wide else col[part]
    low = axis < 0.5 * (axis.min() + axis.max())
    yield from _near(row, col, part[low])
    yield from _near(row, col, part[~low])


def _window_slope(chart: Map, lat_deg: FloatArray, lon_deg: FloatArray) -> FloatArray:
    """`patch_slope` of positions that lie on a map with its values in memory."""
    row, col = chart.cells(lat_deg, lon_deg)
    rows, cols = chart.shape
    i = np.clip(row, 0.0, rows - 2.0).astype(np.intp)
    j = np.clip(col, 0.0, cols - 2.0).astype(np.intp)
    u, v = row - i, col - j
    corners = [chart.values[i + a, j + b].astype(np.float64) for a in (0, 1) for b in (0, 1)]
    by_col = (1.0 - u) * (corners[1] - corners[0]) + u * (corners[3] - corners[2])
    by_row = (1.0 - v) * (corners[2] - corners[0]) + v * (corners[3] - corners[1])
    step = 0.1 * chart.cell_m
    slopes = np.empty((row.size, 2))
    for axis, (north, east) in enumerate(((step, 0.0), (0.0, step))):
        ahead, behind = (chart.cells(*shift(lat_deg, lon_deg, sign * north, sign * east)) for sign in (1.0, -1.0))
        row_per_m, col_per_m = ((after - before) / (2.0 * step) for after, before in zip(ahead, behind, strict=True))
        slopes[:, axis] = by_row * row_per_m + by_col * col_per_m
    slopes[~np.isfinite(slopes).all(axis=1)] = 0.0
    return slopes


def _true_track(name: str, rec: Recording) -> tuple[FloatArray, FloatArray]:
    """True latitude and longitude at every epoch [deg]; StateError without truth."""
    if not rec.has_truth:
        raise StateError(f"{rec.name}: the {name} needs the true track, the columns true_lat_deg and true_lon_deg")
    error = rec.ins_error_m()
    known = np.isfinite(error).all(axis=1)
    if not known.any():
        raise StateError(f"{rec.name}: the {name} needs the true track, but no epoch has both of its columns")
    filled = np.stack([np.interp(rec.time_s, rec.time_s[known], error[known, axis]) for axis in (0, 1)])
    return shift(rec.lat_deg, rec.lon_deg, -filled[0], -filled[1])


def _grade(name: str, rec: Recording, ins: InsGrade | None) -> InsGrade:
    """What is known of the INS."""
    grade = ins if ins is not None else rec.ins
    if grade is None:
        grade = InsGrade()
        warnings.warn(
            f"{rec.name}: nothing is said about the INS; the {name} assumes "
            f"position_sigma_m = {grade.position_sigma_m:g}, velocity_sigma_mps = {grade.velocity_sigma_mps:g}, "
            f"position_walk_m_per_sqrt_s = {grade.position_walk_m_per_sqrt_s:g}",
            DataWarning,
            stacklevel=4,
        )
    return grade


def _check_kinds(rec: Recording, charts: tuple[Map, ...], epochs: Sequence[Epoch]) -> None:
    """Raise DataError when there is nothing to compare."""
    measured = sorted({reading.kind for epoch in epochs for reading in epoch.measurements})
    mapped = sorted({chart.kind for chart in charts})
    if not set(measured) & set(mapped):
        has = f"holds readings of kind {', '.join(measured)}" if measured else "holds no reading"
        raise DataError(f"{rec.name}: {has}, expected at least one of kind {' or '.join(mapped)}")
