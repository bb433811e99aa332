"""The real rasters beside the repository, and an independent way to sample them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray
from pyproj import Transformer

LOCAL_METRES = "+proj=aeqd +lat_0=20 +lon_0=-157 +datum=WGS84"  # for the grids that do not say where they are


@dataclass(frozen=True)
class RealMap:
    path: str
    options: dict[str, Any] = field(default_factory=dict)
    variable: str = "z"

    def reference(self, folder: Path) -> tuple[NDArray[np.float64], Any, str]:
        """Values (NaN where void), rasterio transform and CRS, all from GDAL."""
        file = str(folder / self.path)
        name = f'netcdf:"{file}":{self.variable}' if file.endswith(".nc") else file
        with rasterio.open(name) as raster:
            values = raster.read(1, masked=True).astype(np.float64).filled(np.nan)
            values = values * raster.scales[0] + raster.offsets[0]
            crs = self.options.get("crs") or (raster.crs.to_wkt() if raster.crs else "EPSG:4326")
            return values, raster.transform, crs


_EGM = {"kind": "gravity", "variable": "gravity_disturbance_approx"}
REAL_MAPS = [
    *(RealMap(f"srtm/{name}.hgt") for name in ("N47E009", "N47E010", "N48E009", "N48E010")),
    RealMap("srtm/n46_e008_3arc_v2.tif"),
    RealMap("srtm/s36_e149_3arc_v2.tif"),
    RealMap("dted/n00_e006_3arc_v2.dt1"),
    RealMap("wisconsin_helicopter/land_surface_100m.tif"),
    RealMap("gmt/tut_relief.nc"),
    RealMap("gmt/topo_32.nc"),
    RealMap("gmt/Kilauea.utm.nc"),
    RealMap("gmt/AK_gulf_grav.nc", {"kind": "gravity"}),
    RealMap("gmt/mb.par.surf.1km.sq.nc", {"kind": "bathymetry", "crs": LOCAL_METRES}),
    RealMap("gmt/grav.V18.par.surf.1km.sq.nc", {"kind": "gravity", "crs": LOCAL_METRES}),
    *(
        RealMap(f"gravity/egm2008_2p5min_{name}.nc", _EGM, "gravity_disturbance_approx")
        for name in ("alps_s_germany", "jacksboro_tn", "n_atlantic_ew0007", "wisconsin_ne")
    ),
    RealMap("ship_ew0007/relief15s_45-48N_46-41W.nc", {"kind": "bathymetry"}),
]


def place(affine: Any, down: NDArray[np.float64], across: NDArray[np.float64]) -> Any:
    """What an affine makes of points, the first coordinate first."""
    return (
        affine.a * across + affine.b * down + affine.c,
        affine.d * across + affine.e * down + affine.f,
    )


def bilinear_reference(
    values: NDArray[np.float64], transform: Any, crs: str, lat: NDArray[np.float64], lon: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Plain numpy: project, find the four cells, weigh; a void counts only where its weight is not nought."""
    x, y = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(lon, lat)
    col, row = place(~transform, y, x)
    row, col = row - 0.5, col - 0.5
    for axis, size in ((row, values.shape[0]), (col, values.shape[1])):  # places meant to lie on cells or edges
        near = np.abs(axis - np.round(axis)) < 1e-6
        axis[near] = np.round(axis[near])
        axis[(axis < 0) | (axis > size - 1)] = np.nan
    out = np.zeros(row.shape)
    known = np.isfinite(row) & np.isfinite(col)
    for r, wr in ((np.floor(row), 1 - row % 1), (np.floor(row) + 1, row % 1)):
        for c, wc in ((np.floor(col), 1 - col % 1), (np.floor(col) + 1, col % 1)):
            used = known & (wr * wc > 0)
            out[used] += (wr * wc)[used] * values[r[used].astype(int), c[used].astype(int)]
    out[~known] = np.nan
    return out
