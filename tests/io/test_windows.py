"""Reading a part of a map: the same values as of the whole, and memory for that part alone."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rasterio
import xarray as xr
from rasterio.transform import Affine
from scipy.io import netcdf_file

import terranav as tn
from terranav.io import grids
from terranav.maps.georeference import Box

ROWS, COLS = 40, 60
VALUES = np.random.default_rng(8).uniform(100.0, 900.0, (ROWS, COLS)).astype(np.float32)
VALUES[10, 20] = np.nan
LAT, LON = 46.0 - 0.01 * np.arange(ROWS), 10.0 + 0.01 * np.arange(COLS)
BOXES: tuple[Box, ...] = ((45.7, 10.11, 45.95, 10.42), (45.0, 9.0, 45.92, 10.2), (45.8, 370.3, 45.9, 370.4))


def written(folder: Path, how: str) -> Path:
    file = folder / f"map.{'tif' if how == 'tif' else 'nc'}"
    if how == "tif":
        north_up = Affine(0.01, 0.0, 9.995, 0.0, -0.01, 46.005)
        profile = {"driver": "GTiff", "dtype": "float32", "crs": "EPSG:4326", "transform": north_up, "nodata": -1.0}
        with rasterio.open(file, "w", count=1, height=ROWS, width=COLS, **profile) as raster:
            raster.write(np.nan_to_num(VALUES, nan=-1.0), 1)
            raster.scales, raster.offsets = (0.5,), (10.0,)
    elif how == "gmt3":
        with netcdf_file(file, "w") as raw:
            raw.createDimension("side", 2)
            raw.createDimension("xysize", VALUES.size)
            for name, ends in (("x_range", LON[[0, -1]]), ("y_range", LAT[[-1, 0]])):
                raw.createVariable(name, "d", ("side",))[:] = ends
                raw.variables[name].units = "degrees_east" if name == "x_range" else "degrees_north"
            raw.createVariable("dimension", "i", ("side",))[:] = (COLS, ROWS)
            raw.createVariable("z", "f", ("xysize",))[:] = VALUES.ravel()
    else:
        z = xr.DataArray(VALUES, {"lat": LAT, "lon": LON}, ("lat", "lon"), name="z")
        z = z.transpose() if how == "turned" else z
        z.to_netcdf(file, engine="scipy" if how == "classic" else "h5netcdf")
    return file


@pytest.mark.parametrize("how", ["tif", "cf", "turned", "classic", "gmt3"])
def test_a_box_is_what_crop_would_cut_out(tmp_path: Path, how: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(grids, "STRIP_CELLS", 130)  # so that there is more than one strip
    file = written(tmp_path, how)
    whole = tn.open_map(file)
    expected = 0.5 * VALUES + 10.0 if how == "tif" else VALUES
    np.testing.assert_array_equal(whole.values, expected)
    for box in BOXES:
        part, cut = tn.open_map(file, box=box), whole.crop(*box)
        assert part.values.size < whole.values.size
        assert (part.transform, part.crs) == (cut.transform, cut.crs)
        np.testing.assert_array_equal(part.values, cut.values)
        assert not part.values.flags.writeable


def test_a_box_beside_the_map_says_where_the_map_is(tmp_path: Path) -> None:
    file = written(tmp_path, "tif")
    with pytest.raises(tn.DataError, match=r"map\.tif: box \(10, 10, 11, 11\) misses the map, which spans \(45\.61"):
        tn.open_map(file, box=(10.0, 10.0, 11.0, 11.0))


def test_a_map_does_not_share_memory_with_what_it_was_made_of() -> None:
    values = VALUES.copy()
    chart = tn.Map(values, (0.01, 0.0, 9.995, 0.0, -0.01, 46.005))
    values[:] = 0.0
    np.testing.assert_array_equal(chart.values, VALUES)
    part = VALUES[::2]
    part.setflags(write=False)  # a view: whose memory it shows can still be written to
    assert not np.shares_memory(tn.Map(part, chart.transform).values, part)


LIMITED = """
import resource, sys
import terranav as tn
resource.setrlimit(resource.RLIMIT_AS, (3 * 2**30, 3 * 2**30))
part = tn.open_map(sys.argv[1], box=(45.0, 10.0, 45.1, 10.1))
print(part.shape, float(part.values[60, 70]))
try:
    tn.open_map(sys.argv[1]).values
except tn.ConfigError as error:
    print(error)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="limits on the address space are tested on Linux")
def test_memory_is_taken_for_the_window_and_refused_for_the_whole(tmp_path: Path) -> None:
    side, cell = 40_000, 1e-3
    file = tmp_path / "wide.tif"
    profile = {
        "driver": "GTiff", "dtype": "float32", "crs": "EPSG:4326", "tiled": True, "SPARSE_OK": True, "BIGTIFF": True,
        "transform": Affine(cell, 0.0, 0.0, 0.0, -cell, 60.0),
    }  # fmt: skip
    with rasterio.open(file, "w", count=1, height=side, width=side, **profile) as raster:
        raster.write(np.full((200, 200), 77.0, np.float32), 1, window=((14_850, 15_050), (9_950, 10_150)))
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, file], capture_output=True, text=True, check=True, timeout=120
    )
    first, second = done.stdout.splitlines()
    rows, cols = 102, 102  # centres at half a cell: 100 cells within the box and one beyond on either side
    assert first == f"({rows}, {cols}) 77.0"
    gigabytes = 8 * side**2 / 2**30
    assert second.startswith(f"wide.tif: map of 40000 x 40000 cells: needs {gigabytes:.1f} GiB of memory, but ")
