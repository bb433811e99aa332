"""Synthetic maps: planes, on which every estimator has a textbook answer, and correlated Gaussian fields."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from terranav.core.checks import finite
from terranav.core.earth import metres_per_degree
from terranav.core.kinds import kind_named
from terranav.maps.map import Map


def _square(
    values: NDArray[np.float64], cell_m: float, centre_deg: tuple[float, float], kind: str, sigma: float
) -> Map:
    """A square map around a place, in longitude and latitude, whose cells are `cell_m` wide at the place."""
    per_lat, per_lon = metres_per_degree(centre_deg[0])
    down, right = cell_m / float(per_lat), cell_m / float(per_lon)
    half = 0.5 * len(values)
    transform = (right, 0.0, centre_deg[1] - half * right, 0.0, -down, centre_deg[0] + half * down)
    return Map(
        values, transform, kind=kind, unit=kind_named(kind).unit, sigma=sigma, source="synthetic", name="synthetic"
    )


def plane_map(
    north_slope: float,
    east_slope: float,
    *,
    height: float = 100.0,
    cells: int = 201,
    cell_m: float = 64.0,
    centre_deg: tuple[float, float] = (0.0, 0.0),
    kind: str = "terrain",
    sigma: float = 1.0,
) -> Map:
    """A plane: height + north_slope * n + east_slope * e at n, e metres from the centre.

    At the equator, the default, that holds within a micrometre per kilometre and unit slope; elsewhere the meridians
    converge and the plane bends by slope * n e tan(lat) / R. Heights and slopes that are dyadic fractions survive
    single precision exactly.

    Parameters
    ----------
    north_slope, east_slope : float [kind's unit per metre]
    height : float [kind's unit]
    cells : int
        Rows, and columns; an odd number puts a cell at the centre.
    cell_m : float [m], > 0
    centre_deg : (latitude, longitude) [deg]
    kind, sigma
        As in `Map`.
    """
    cell_m = finite("cell_m", cell_m, above=0.0)
    at = (np.arange(cells) - 0.5 * (cells - 1)) * cell_m
    return _square(height - north_slope * at[:, None] + east_slope * at, cell_m, centre_deg, kind, sigma)


def gaussian_map(
    rng: np.random.Generator,
    *,
    std: float = 100.0,
    correlation_m: float = 1000.0,
    mean: float = 500.0,
    cells: int = 256,
    cell_m: float = 100.0,
    centre_deg: tuple[float, float] = (45.0, 10.0),
    kind: str = "terrain",
    sigma: float = 1.0,
) -> Map:
    """A Gaussian field with covariance std^2 exp(-(r / correlation_m)^2), periodic in the map's size.

    Drawn by filtering white noise with the square root of the spectrum (Wood and Chan, J. Comput. Graph. Stat. 3,
    1994, for the circulant covariance).

    Parameters
    ----------
    rng : Generator
    std, mean : float [kind's unit]
    correlation_m : float [m], > 0
    cells : int
        Rows, and columns.
    cell_m : float [m], > 0
    centre_deg : (latitude, longitude) [deg]
    kind, sigma
        As in `Map`.
    """
    cell_m = finite("cell_m", cell_m, above=0.0)
    correlation_m = finite("correlation_m", correlation_m, above=0.0)
    away = np.minimum(np.arange(cells), cells - np.arange(cells)) * cell_m / correlation_m
    spectrum = np.fft.rfft2(np.exp(-(away[:, None] ** 2) - away**2)).real
    white = np.fft.rfft2(rng.standard_normal((cells, cells)))
    field = np.fft.irfft2(white * np.sqrt(np.maximum(spectrum, 0.0)), s=(cells, cells))
    return _square(mean + std * field, cell_m, centre_deg, kind, sigma)
