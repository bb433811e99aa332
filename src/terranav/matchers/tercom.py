"""TERCOM, terrain contour matching: the whole profile is laid over the map at every position error of a search grid.

Baker and Clem, Terrain Contour Matching (TERCOM) Primer, ASP-TR-77-61 (1977), with the metrics MAD and MSD; the batch
correlator that papers/004 compares with. The INS error is taken as constant over the profile, its readings as errors
about the map.

The surface is made a probability. With s_k^2 = sensor^2 + map^2 of reading k, d_k the reading less the map, and weights
w_k of mean one in proportion to 1/s_k^2 (MSD) or 1/s_k (MAD), for equal s and n independent readings

    MSD = mean(w_k d_k^2),  log p = -(n/2) MSD / (c s^2) + log prior
    MAD = mean(w_k |d_k|),  log p = -n sqrt(2/pi) MAD / (sqrt(c) s) + log prior

MSD's is the Gaussian likelihood. MAD's is a Laplace likelihood of scale s sqrt(pi/2) rather than of the s/sqrt(2) that
has the same variance: its curvature over Gaussian noise is then 2/pi of the Gaussian one's, which is the efficiency of
least absolute deviations, so the covariance is that of the estimate (over Laplace noise it errs on the wide side).

n and c are discounts. Readings in one map cell share its error (`maps.noise`), and residuals that are correlated
along the track (lag-one correlation r beyond the 95 % band of white ones) count as (1 - r)/(1 + r) each. Residuals at
the best place whose variance is c > 1 times the told one make every variance c times larger.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import repeat
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from terranav.core.checks import finite, unknown_name
from terranav.core.earth import shift
from terranav.core.errors import ConfigError, DataError
from terranav.core.records import Candidates, Measurement, Prior, Profile
from terranav.kernels.tercom import correlation_surface
from terranav.maps.map import Map
from terranav.maps.noise import reading_sigma
from terranav.matchers._peaks import Surface, best_place, candidates, zoomed

FloatArray = NDArray[np.float64]

LEAST_VALID = 0.8  # share of a profile's points that must lie on the map
LEAST_READINGS = 4  # two errors, one offset, and one more to judge by
MOST_ZOOMS = 3
FINEST = 16  # a narrow prior makes the step at most this many times finer than the map


@dataclass(frozen=True)
class Tercom:
    """Terrain contour matching over a rectangular search grid.

    Attributes
    ----------
    maps : tuple of Map
        The profile is matched with the first map of its kind.
    metric : 'msd' or 'mad'
    cell_m : float or None
        Step of the search grid [m]; None is the map's cell. A prior narrower than that makes it finer.
    extent_sigma : float
        Half-width of the search area in sigmas of a Gaussian prior; a uniform prior is searched over the whole of its
        rectangle. Cutting takes variance away: 0.1 % at 4, 2.7 % at 3, and again at each later fix over flat ground.
    sub_cell : bool
        Locate the fix between the points of the grid: by quadratics through 3 x 3 points of the surface, after a second
        search in finer steps where a peak is narrower than the cells. Without, the fix is a mean of grid points, and
        its covariance has the cell^2/12 of that.
    remove_mean : bool
        Compare profile and map each less its mean: indifferent to a constant height offset (barometer, datum).
    max_cells : int
        Most points of the search grid; a larger search area is searched in coarser steps.

    Raises
    ------
    ConfigError
        For a setting out of its range or no map.
    """

    maps: tuple[Map, ...]
    metric: Literal["msd", "mad"] = "msd"
    cell_m: float | None = None
    extent_sigma: float = 4.0
    sub_cell: bool = True
    remove_mean: bool = False
    max_cells: int = 1_000_000

    def __post_init__(self) -> None:
        if not self.maps:
            raise ConfigError("tercom maps is empty, expected at least one map")
        if self.metric not in ("msd", "mad"):
            unknown_name("tercom metric", str(self.metric), ("msd", "mad"))
        if self.cell_m is not None:
            finite("tercom cell_m", self.cell_m, above=0.0)
        finite("tercom extent_sigma", self.extent_sigma, minimum=1.0)
        finite("tercom max_cells", self.max_cells, minimum=100)

    def match(self, prior: Prior, profile: Profile) -> Candidates:
        """Match a profile within a prior.

        Parameters
        ----------
        prior : Prior
            Of the INS error at the profile's last epoch; it is part of the answer's probabilities and covariances.
        profile : Profile
            Four readings or more.

        Returns
        -------
        Candidates
            Distinct minima of the surface, at most 8, best first. The mean, covariance and probability of each are
            those of the part of the search area that lies nearest to it; together they are the moments of the whole.
            `score` is the surface at the minimum. None at all where more than half the prior has no map under it.

        Raises
        ------
        ConfigError
            No map of the profile's kind.
        DataError
            Too few readings.
        """
        surface = self.surface(prior, profile)
        log_prior = self._log_prior(prior, surface)
        share = np.exp(log_prior)
        if share[np.isfinite(surface.score)].sum() <= 0.5 * share.sum():
            return Candidates(np.empty((0, 2)), np.empty((0, 2, 2)), np.empty(0), np.empty(0))
        apart_m = 3.0 * surface.step_m if self.sub_cell else None
        told = float(np.sum(1.0 / _shared_sigma(profile, self._map(profile)) ** 2))
        cost, nis = self._cost(surface, log_prior, profile, told)
        log_p = log_prior - cost * surface.score
        for _ in range(MOST_ZOOMS if self.sub_cell else 0):
            axes = zoomed(surface, log_p)
            if axes is None:
                break
            surface = self._surface_at(*axes, profile)
            log_prior = self._log_prior(prior, surface)
            cost, nis = self._cost(surface, log_prior, profile, told)
            log_p = log_prior - cost * surface.score
        return candidates(surface, log_p, nis, apart_m)

    def surface(self, prior: Prior, profile: Profile) -> Surface:
        """The correlation surface over the search area of a prior; arguments and errors as of `match`."""
        chart, n = self._map(profile), len(profile.epochs)
        if n < LEAST_READINGS:
            raise DataError(f"tercom: the profile has {n} readings, expected at least {LEAST_READINGS}")
        return self._surface_at(*self._axes(prior, chart), profile)

    def _surface_at(self, north: FloatArray, east: FloatArray, profile: Profile) -> Surface:
        """The correlation surface at errors north (p,) and east (q,) [m]."""
        chart = self._map(profile)
        radius = math.hypot(float(np.abs(north).max()), float(np.abs(east).max()))
        land = chart.around(profile.lat_deg, profile.lon_deg, radius)
        frames = np.empty((len(profile.epochs), 2, 6))
        for k, epoch in enumerate(profile.epochs):
            frame = land.local_frame(epoch.lat_deg, epoch.lon_deg, radius)
            frames[k] = frame.row, frame.col
        readings = np.stack([profile.value, self._weights(profile, chart)], axis=1)
        score, valid = np.empty((north.size, east.size)), np.empty((north.size, east.size))
        absolute = self.metric == "mad"
        correlation_surface(land.values, frames, readings, (north, east), absolute, self.remove_mean, score, valid)
        score[valid < LEAST_VALID - 1e-9] = np.nan
        return Surface(north, east, score)

    def _map(self, profile: Profile) -> Map:
        """The first map of the profile's kind."""
        for chart in self.maps:
            if chart.kind == profile.kind:
                return chart
        kinds = ", ".join(chart.kind for chart in self.maps)
        raise ConfigError(f"tercom maps are of kind {kinds}, expected one of the profile's kind {profile.kind!r}")

    def _axes(self, prior: Prior, chart: Map) -> tuple[FloatArray, FloatArray]:
        """INS errors north and east of the search grid, symmetric about the prior's mean."""
        sigma = np.sqrt(np.diag(prior.cov_m2))
        half = (self.extent_sigma if prior.shape == "gaussian" else 3.0) * sigma
        step = chart.cell_m if self.cell_m is None else self.cell_m
        step = max(min(step, 0.7 * float(sigma.min())), step / FINEST)
        while True:
            count = np.maximum(np.ceil(half / step - 1e-9), 2).astype(int)
            if float(2 * count[0] + 1) * float(2 * count[1] + 1) <= self.max_cells:
                break
            step *= 1.1
        if prior.shape == "uniform":
            count = np.maximum((half / step + 1e-9).astype(int), 2)
        axes = [prior.mean_m[i] + step * np.arange(-count[i], count[i] + 1) for i in range(2)]
        return axes[0], axes[1]

    def _weights(self, profile: Profile, chart: Map) -> FloatArray:
        """(n,) weights of the readings, of mean one."""
        variance = profile.sigma**2 + chart.sigma**2
        weight = 1.0 / (variance if self.metric == "msd" else np.sqrt(variance))
        return np.asarray(weight / weight.mean())

    def _log_prior(self, prior: Prior, surface: Surface) -> FloatArray:
        """(p, q) logarithm of the prior density, 0 at its mean."""
        north = surface.north_m[:, None] - prior.mean_m[0]
        east = surface.east_m[None, :] - prior.mean_m[1]
        if prior.shape == "uniform":
            return np.zeros((north.size, east.size))
        a, b, c = np.linalg.inv(prior.cov_m2)[[0, 0, 1], [0, 1, 1]]
        return np.asarray(-0.5 * (a * north * north + 2.0 * b * north * east + c * east * east))

    def _cost(self, surface: Surface, log_prior: FloatArray, profile: Profile, told: float) -> tuple[float, float]:
        """Log-probability that one unit of score costs, and the NIS of the best place (see the module docstring).

        `told` is the information of the readings, sum of 1/sigma^2, with the map's error shared.
        """
        chart = self._map(profile)
        alone = np.sqrt(profile.sigma**2 + chart.sigma**2)
        unit = 0.5 if self.metric == "msd" else math.sqrt(2.0 / math.pi) / float(np.mean(1.0 / alone))
        place = best_place(surface, log_prior - unit * told * surface.score)
        sampled = chart.sample(*shift(profile.lat_deg, profile.lon_deg, -place[0], -place[1]))
        residual = ((profile.value - sampled) / alone)[np.isfinite(sampled)]
        if not residual.size:  # voids between the points of the grid
            return unit * told, math.nan
        if self.remove_mean:
            residual = residual - residual.mean()
        nis = float(np.mean(residual**2))
        free = residual.size - (3 if self.remove_mean else 2)
        spread = max(1.0, nis * residual.size / max(free, 1))
        information = min(told, float(np.sum(1.0 / alone**2)) * _independent(residual))
        return unit * information / (spread if self.metric == "msd" else math.sqrt(spread)), nis


def _shared_sigma(profile: Profile, chart: Map) -> FloatArray:
    """(n,) 1-sigma of each reading with the map's error shared among those of one cell."""
    before = (None, *profile.epochs[:-1])
    readings = [
        Measurement(profile.kind, value, sigma) for value, sigma in zip(profile.value, profile.sigma, strict=True)
    ]
    return np.array([reading_sigma(*each) for each in zip(readings, repeat(chart), before, profile.epochs)])


def _independent(residual: FloatArray) -> float:
    """Share of the readings that counts as independent, from the lag-one correlation of the residuals over sigma.

    Residuals far below the told sigma, of a map and readings without noise, count for no more than they weigh.
    """
    n, power = residual.size, float(residual @ residual)
    if power == 0.0:
        return 1.0
    lag = float(residual[1:] @ residual[:-1]) / power
    if lag <= 2.0 / math.sqrt(n):
        return 1.0
    lag *= min(1.0, power / n)
    return (1.0 - lag) / (1.0 + lag)
