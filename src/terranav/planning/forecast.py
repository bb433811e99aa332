"""What the navigator will make of a track, wrong valleys and all: the expected error of the best estimator.

The Cramer-Rao bound (`planning.bound`) takes the map for a plane at the true position. Over the error that remains the
ground is none, and elsewhere it may look the same. The forecast takes the map as it is.

Let x be the true path of the INS error and x' one drawn from the posterior, given the readings y. Both are draws from
the same posterior, so the second moment of x' - x is twice the least mean squared error, exactly. Given x, the
expectation of the posterior at x' over readings is

    E p(x' | y) = p(x') integral of p(y | x) p(y | x') / p(y) dy.

Where p(y), how likely these readings are anywhere, is taken as even over the readings that matter, normal noise of
covariance R leaves an overlap of densities, and the prior of the difference d = x' - x has twice the covariance:

    p(d) ~ N(d; 0, 2 P0) exp(-1/4 (h(x + d) - h(x))' R^-1 (h(x + d) - h(x))).

That is the posterior of a navigator whose INS errors have twice the variance and whose readings are those of the truth,
without noise, over relief divided by sqrt(2). So it is flown once in that world, and half the second moment of d
is the forecast. Over a plane it is the bound. Where slopes vary along the track with wave number k it is the bound's
variance s^2 times 1 + k^2 s^2, as the error of the best estimator is to that order. Of two places d apart that misfit
by D (the exponent is -D/4) it makes d^2 e^(-D/4) / (2 + 2 e^(-D/4)), right at D = 0 and within a fifth up to D = 10;
beyond, the rare flight that ends in the wrong one is counted too low, by half at D = 16.

States, noise and outliers are those of `marginalized`, and so is the filter; what it learns of its noise and of
the INS is left out. Outliers cost what they cost the bound.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.random import SeedSequence
from numpy.typing import NDArray

from terranav.core.checks import finite
from terranav.core.earth import metres_per_degree, offset_of, shift, wrap_longitude
from terranav.core.errors import ConfigError, DataError
from terranav.core.ins_grade import InsGrade
from terranav.core.recording import Recording
from terranav.core.records import Epoch, Prior
from terranav.filters._cloud import prior_covariance
from terranav.filters.marginalized import Marginalized
from terranav.maps.map import Map
from terranav.planning._route_sensing import Sensing
from terranav.planning.bound import NO_BIAS, Asked, Bound, asked_of, check_noise, normal_variance, patch_slope
from terranav.planning.suitability import LegSettings

FloatArray = NDArray[np.float64]

REPEATS = 4  # clouds whose moments are averaged
REACH_SIGMAS = 6.0  # of the map that is kept about the track
_ROOT = math.sqrt(2.0)


@dataclass(frozen=True, eq=False)
class Forecast(Bound):
    """Expected covariance of the navigator's position error after the readings of each epoch, as `Bound` holds it."""


def forecast(
    rec: Recording,
    maps: Sequence[Map] | Map,
    ins: InsGrade | None = None,
    *,
    prior: Prior | None = None,
    bias_sigma: Mapping[str, float] = NO_BIAS,
    outlier_share: float = Marginalized.outlier_share,
    outlier_scale: float = Marginalized.outlier_scale,
    blur_cells: float = Marginalized.blur_cells,
    seed: int = 0,
    repeats: int = REPEATS,
) -> Forecast:
    """Expected squared error of the navigator along the true track of a recording.

    It costs about `repeats` runs of `marginalized`. Arguments and errors are those of `planning.bound`, but for

    Parameters
    ----------
    seed : int
        Of the clouds.
    repeats : int
        How many of them, >= 1; one leaves a few percent of chance in a 1-sigma.

    Returns
    -------
    Forecast
    """
    check_noise("forecast", bias_sigma, outlier_share, outlier_scale, blur_cells)
    finite("forecast seed", seed, minimum=0.0)
    if isinstance(repeats, bool) or not isinstance(repeats, int) or repeats < 1:
        raise ConfigError(f"forecast repeats is {repeats!r}, expected a whole number >= 1")
    asked = asked_of("forecast", rec, maps, ins)
    start = prior_covariance(prior or Prior.from_ins(asked.ins))
    charts = tuple(_relief(chart, asked, start) for chart in asked.charts)
    navigator = Marginalized(
        charts,
        _doubled(asked.ins),
        outlier_share=outlier_share,
        outlier_scale=outlier_scale,
        blur_cells=_ROOT * blur_cells,
        registration_cells=0.0,
        adapt_noise=False,
        adapt_walk=False,
        bias_sigma=bias_sigma,
    )
    epochs = _noiseless(asked, charts, (float(outlier_share), float(outlier_scale)), blur_cells)
    wide = Prior(np.zeros(2), 2.0 * start)
    moments = [_flown(navigator, wide, epochs, one) for one in SeedSequence(int(seed)).spawn(repeats)]
    return Forecast(np.array([epoch.time_s for epoch in epochs]), 0.5 * np.mean(moments, axis=0))


def leg_recording(
    chart: Map, start: tuple[float, float], end: tuple[float, float], ins: InsGrade, settings: LegSettings
) -> Recording:
    """A straight leg as `forecast` and `bound` take it: true positions, and what a perfect sensor would read.

    Of a fast sensor fewer readings are followed, each better by the root of their number.

    Parameters
    ----------
    chart : Map
    start, end : (latitude, longitude) [deg]
    ins : InsGrade
        Its position sigma is that at the start.
    settings : LegSettings
        Its sensor, rate and speed.

    Raises
    ------
    ConfigError
        The ends are no reading apart.
    DataError
        The leg leaves the map.
    """
    away = offset_of(*start, *end)
    length_m = math.hypot(*away)
    if length_m < settings.speed_mps / settings.rate_hz:
        raise ConfigError(f"the leg is {length_m:.0f} m long, expected at least the way between two readings")
    asked = Sensing(chart, ins, settings.sensor_sigma, settings.rate_hz, settings.speed_mps, None)
    sensing = asked.thinned(length_m)
    part = np.minimum(np.arange(math.ceil(length_m / sensing.spacing_m) + 1) * sensing.spacing_m / length_m, 1.0)
    lat, lon = shift(start[0], start[1], part * away[0], part * away[1])
    inside = chart.covers(lat, lon)
    if not inside.all():
        at = int(np.argmin(inside))
        raise DataError(
            f"the leg leaves the map {chart.name} after {part[at] * length_m / 1000.0:.1f} km, at {lat[at]:.4f}, "
            f"{lon[at]:.4f}; expected all of it on the map"
        )
    return sensing.recording(lat, lon)


def _flown(navigator: Marginalized, prior: Prior, epochs: Sequence[Epoch], seeds: SeedSequence) -> FloatArray:
    """Second moment (n, 2, 2) about the truth after each epoch [m^2]."""
    rng = np.random.default_rng(seeds)
    state, out = navigator.init(prior, rng), np.empty((len(epochs), 2, 2))
    for k, epoch in enumerate(epochs):
        state = navigator.step(state, epoch, rng)
        found = navigator.estimate(state)
        out[k] = found.cov_m2 + np.outer(found.ins_error_m, found.ins_error_m)
    return out


def _doubled(ins: InsGrade) -> InsGrade:
    """An INS with errors of twice the variance."""
    sigmas = {one.name: _ROOT * getattr(ins, one.name) for one in fields(ins) if one.name != "name"}
    return replace(ins, **sigmas)


def _relief(chart: Map, asked: Asked, start: FloatArray) -> Map:
    """A map about the track with its relief divided by sqrt(2)."""
    lat, lon = asked.track
    elapsed_s = asked.epochs[-1].time_s - asked.epochs[0].time_s
    sigma = math.sqrt(float(np.linalg.eigvalsh(start)[-1]) + asked.ins.position_growth_m2(0.0, elapsed_s))
    reach = REACH_SIGMAS * _ROOT * sigma + 10.0 * chart.cell_m
    east_of = (lon - lon[0] + 180.0) % 360.0 - 180.0
    per_lat, per_lon = (float(np.min(value)) for value in metres_per_degree(lat))
    high, wide = reach / per_lat, reach / max(per_lon, 1e-6)
    near = chart
    if np.ptp(east_of) + 2.0 * wide < 350.0 and np.abs(lat).max() + high < 90.0:
        west, east = (float(wrap_longitude(lon[0] + side)) for side in (east_of.min() - wide, east_of.max() + wide))
        near = chart.crop(float(lat.min() - high), west, float(lat.max() + high), east)
    values = (near.values / np.float32(_ROOT)).astype(np.float32)
    return replace(near, values=values, correlation_m=chart.error_length_m)


def _noiseless(
    asked: Asked, charts: Sequence[Map], outliers: tuple[float, float], blur_cells: float
) -> tuple[Epoch, ...]:
    """The epochs at their true positions, with readings that are right.

    The sigma of each is such that outliers cost what they cost the bound.
    """
    lat, lon = asked.track
    kinds = {}
    for chart, relief in zip(asked.charts, charts, strict=True):
        slopes = patch_slope(chart, lat, lon)
        blurred2 = (blur_cells * chart.cell_m) ** 2 * np.einsum("ni,ni->n", slopes, slopes)
        kinds[chart.kind] = chart.sigma, relief.sample(lat, lon), blurred2
    made = []
    for k, epoch in enumerate(asked.epochs):
        readings = []
        for reading in epoch.measurements:
            map_sigma, values, blurred2 = kinds.get(reading.kind, (0.0, (), ()))
            if len(values) and math.isfinite(values[k]):
                variance = normal_variance(reading.sigma, map_sigma, float(blurred2[k]), outliers) - float(blurred2[k])
                readings.append(replace(reading, value=float(values[k]), sigma=math.sqrt(variance)))
        made.append(replace(epoch, lat_deg=float(lat[k]), lon_deg=float(lon[k]), measurements=tuple(readings)))
    return tuple(made)
