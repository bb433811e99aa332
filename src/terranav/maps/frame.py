"""From metres north and east of a place to the rows and columns of a map, without a projection in the inner loop."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terranav.core.earth import ECCENTRICITY_SQ, SEMI_MAJOR_M, shifted

FloatArray = NDArray[np.float64]
DEGREE = math.pi / 180.0


@dataclass(frozen=True, slots=True)
class LocalFrame:
    """Fractional row and column of the place n metres north and e metres east of an origin (`core.earth.shift`).

    Attributes
    ----------
    row, col : (6,) float64
        Coefficients of [1, n, e, n^2, n e, e^2] [cells, cells/m, cells/m^2]; (0.0, 0.0) is the centre of the first
        cell. For an INS error (en, ee) the true place is at n = -en, e = -ee.
    """

    row: FloatArray
    col: FloatArray

    def cells(self, north_m: ArrayLike, east_m: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Fractional rows and columns at displacements that broadcast [m]."""
        n, e = np.asarray(north_m, dtype=np.float64), np.asarray(east_m, dtype=np.float64)
        r, c = self.row, self.col
        rows = r[0] + n * (r[1] + r[3] * n + r[4] * e) + e * (r[2] + r[5] * e)
        cols = c[0] + n * (c[1] + c[3] * n + c[4] * e) + e * (c[2] + c[5] * e)
        return rows, cols


def geographic_frame(lat_deg: float, lon_deg: float, inverse: tuple[float, ...]) -> LocalFrame:
    """Frame of a map in longitude and latitude: the Taylor series of `core.earth.shift` to second order.

    With M and P the metres in a degree of latitude and longitude, and primes for d/dlat,
    dlat = n/M - n^2 M'/(2 M^3) and dlon = e/P - n e P'/(2 M P^2), where (N cos lat)' = -M_r sin lat and
    M_r' = 3 e^2 M_r sin lat cos lat / (1 - e^2 sin^2 lat), M_r being the meridian radius of curvature.

    What is left out grows as the cube of the distance and towards the poles: within 5 km 1 cm at 80 degrees of latitude
    and 6 cm at 86, within 20 km 0.6 m and 3.8 m. In cells that may be more than one, where cells are 2 m wide.

    Parameters
    ----------
    lat_deg, lon_deg : float [deg]
    inverse : 6 floats
        (col, row) of cell centres from (lon, lat) [cells/deg]: col = i0 lon + i1 lat + i2, row = i3 lon + i4 lat + i5.
    """
    lat = math.radians(lat_deg)
    sin, cos = math.sin(lat), math.cos(lat)
    w2 = 1.0 - ECCENTRICITY_SQ * sin * sin
    prime_vertical = SEMI_MAJOR_M * DEGREE / math.sqrt(w2)  # m in a degree
    per_lat, per_lon = prime_vertical * (1.0 - ECCENTRICITY_SQ) / w2, prime_vertical * cos
    n, e = 1.0 / per_lat, 1.0 / per_lon
    nn = -1.5 * DEGREE * ECCENTRICITY_SQ * sin * cos / w2 * n * n
    ne = 0.5 * DEGREE * sin * e * e
    lon_1, lat_1, start, lon_2, lat_2, start_2 = inverse
    row = [lon_2 * lon_deg + lat_2 * lat_deg + start_2, lat_2 * n, lon_2 * e, lat_2 * nn, lon_2 * ne, 0.0]
    col = [lon_1 * lon_deg + lat_1 * lat_deg + start, lat_1 * n, lon_1 * e, lat_1 * nn, lon_1 * ne, 0.0]
    return LocalFrame(np.array(row), np.array(col))


def fitted_frame(
    lat_deg: float,
    lon_deg: float,
    step_m: float,
    cells: Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]],
) -> LocalFrame:
    """Frame of a map in any CRS: central differences over nine places `step_m` apart.

    Parameters
    ----------
    lat_deg, lon_deg : float [deg]
    step_m : float [m]
    cells : function of (lat_deg, lon_deg), both (9,), that gives fractional rows and columns
    """
    row, col = cells(*_stencil(lat_deg, lon_deg, step_m))

    def coefficients(f: FloatArray) -> FloatArray:
        scaled = np.array(
            [
                f[0] * step_m**2,
                0.5 * (f[1] - f[2]) * step_m,
                0.5 * (f[3] - f[4]) * step_m,
                0.5 * (f[1] + f[2]) - f[0],
                0.25 * (f[5] - f[6] - f[7] + f[8]),
                0.5 * (f[3] + f[4]) - f[0],
            ]
        )
        out: FloatArray = scaled / step_m**2
        return out

    return LocalFrame(row=coefficients(row), col=coefficients(col))


def _stencil(lat_deg: float, lon_deg: float, step_m: float) -> tuple[FloatArray, FloatArray]:
    """A place; those one step north, south, east and west of it; and north-east, north-west, south-east, south-west."""
    lats, away = [], []
    for north in (0.0, step_m, -step_m):  # how far a step east goes depends on the latitude alone
        lat, lon = shifted(lat_deg, lon_deg, north, step_m)
        lats.append(lat)
        away.append((lon - lon_deg + 180.0) % 360.0 - 180.0)
    here, up, down = lats
    along, above, below = away
    east = np.array([0.0, 0.0, 0.0, along, -along, above, -above, below, -below])
    return np.array([here, up, down, here, here, up, up, down, down]), lon_deg + east
