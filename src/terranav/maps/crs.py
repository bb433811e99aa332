"""Between latitude and longitude and the coordinates of a map, in any CRS that PROJ knows."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terranav.core.errors import DataError

FloatArray = NDArray[np.float64]

# Coordinates in these are longitude and latitude within the accuracy of any map; they need no PROJ.
_PLAIN = frozenset({"EPSG:4326", "OGC:CRS84", "EPSG:4979", "EPSG:4269", "EPSG:4258"})


class Projection:
    """Map coordinates (x, y) of positions and back.

    Parameters
    ----------
    crs : str
        Anything that pyproj takes.

    Attributes
    ----------
    geographic : bool
        x is a longitude [deg].
    plain : bool
        x and y are WGS-84 longitude and latitude [deg] as they stand.
    """

    def __init__(self, crs: str) -> None:
        self.crs = crs
        self.geographic = self.plain = crs.upper() in _PLAIN
        if not self.plain:
            self._connect()

    def _connect(self) -> None:
        from pyproj import CRS, Transformer
        from pyproj.exceptions import ProjError

        try:
            target = CRS.from_user_input(self.crs)
            if len(target.axis_info) < 2 or not (target.is_geographic or target.is_projected):
                raise DataError(
                    f"crs {self.crs!r} is not on the Earth's surface, expected a geographic or projected CRS"
                )
            self._forward: Any = Transformer.from_crs("EPSG:4326", target, always_xy=True)
        except ProjError as error:
            reason = " ".join(str(error).split())
            raise DataError(f"unknown crs {self.crs!r}, expected a name like 'EPSG:4326' ({reason})") from None
        self.geographic = bool(target.is_geographic) and target.axis_info[0].unit_name == "degree"
        if self.geographic:  # one without a shift against WGS-84, in degrees from Greenwich, is used as it stands
            lon, lat = np.array([-100.0, 0.0, 12.0, 140.0]), np.array([40.0, 0.0, 50.0, -35.0])
            x, y = self._forward.transform(lon, lat)
            self.plain = bool(np.abs([x - lon, y - lat]).max() < 1e-9)

    def forward(self, lat_deg: FloatArray, lon_deg: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Map x, y of positions; infinite where the projection has none."""
        if self.plain:
            return lon_deg, lat_deg
        x, y = self._forward.transform(lon_deg, lat_deg)
        return x, y

    def inverse(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Latitude and longitude [deg] of map coordinates."""
        if self.plain:
            return y, x
        lon, lat = self._forward.transform(x, y, direction="INVERSE")
        return lat, lon


@lru_cache(maxsize=64)
def projection(crs: str) -> Projection:
    """The Projection of a CRS; made once."""
    return Projection(crs)
