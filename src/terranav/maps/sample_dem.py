"""A real terrain map that needs no file of the user's and no network."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np

from terranav.core.errors import DataError
from terranav.maps.map import Map


def sample_map() -> Map:
    """The Jacksboro fault (Tennessee) digital elevation model that matplotlib ships: 344 x 403 cells of 3 arcsec.

    The values are whole metres of the USGS National Elevation Dataset, thinned to 3 arcsec; their 1-sigma of 3 m is
    the dataset's own accuracy (2.4 m, Gesch 2007) with the rounding and the thinning. Heights refer to NAVD 88,
    horizontal positions to NAD 83, taken as WGS-84 (they differ by a metre or so).

    The terrain is real; the labelled latitudes, kept here, seem to lie one map height (0.28667 degrees) too far north:
    the highest cell would else be Cross Mountain (1077 m at 36.19833 N, 84.23056 W) within a cell. Move the map south
    by that much before comparing it with the real place.

    Raises
    ------
    DataError
        matplotlib is not installed, or without its sample data.
    """
    spec = find_spec("matplotlib")  # finds the package without importing it
    folder = Path(spec.origin).parent if spec is not None and spec.origin else Path()
    path = folder / "mpl-data" / "sample_data" / "jacksboro_fault_dem.npz"
    if not path.is_file():
        raise DataError(
            f"{path.name}: not found among matplotlib's sample data, expected an installed matplotlib with it"
        )
    with np.load(path) as data:
        values = data["elevation"]
        # The first row is the northern one, though the file calls its edge ymin (36.733) and the other ymax (36.446).
        # xmax - xmin is 403 dx and the edges lie on half cells of the 3 arcsec raster: they are the outer edges of
        # cells centred on whole multiples of 3 arcsec (pixel-is-area).
        west, north = float(data["xmin"]), float(max(data["ymin"], data["ymax"]))
        transform = (float(data["dx"]), 0.0, west, 0.0, -float(data["dy"]), north)
    return Map(
        values=values,
        transform=transform,
        crs="EPSG:4326",
        kind="terrain",
        unit="m",
        sigma=3.0,
        datum="NAVD 88",
        source="USGS National Elevation Dataset, by way of matplotlib's jacksboro_fault_dem.npz",
        name="jacksboro",
    )
