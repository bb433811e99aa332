"""Large maps and folders of tiles on the command line: windows of them are read, and memory is asked for first."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
import rasterio
from rasterio.transform import Affine

from terranav.app.cli import main
from terranav.io import rasters
from terranav.io.raster_out import write_map
from terranav.io.rasters import open_map
from tests.app.conftest import Flight


def drms(capsys: pytest.CaptureFixture[str], *arguments: str) -> float:
    assert main(["run", *arguments, "--estimator", "pointmass", "--ins", "100,0.2,0.1", "--json"]) == 0
    return float(json.loads(capsys.readouterr().out)["metrics"]["drms_m"])


def test_a_large_map_and_a_folder_of_its_tiles_give_what_the_map_in_memory_gives(
    flight: Flight, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    expected = drms(capsys, *flight.arguments)
    chart = open_map(flight.map, crs="EPSG:4326")
    south, west, north, east = chart.bounds_deg
    lat, lon = 0.5 * (south + north), 0.5 * (west + east)
    folder = tmp_path / "tiles"
    folder.mkdir()
    for name, box in (("a", (south, west, lat, lon)), ("b", (south, lon, lat, east)), ("c", (lat, west, north, east))):
        write_map(chart.crop(*box), folder / f"{name}.tif")
    at = flight.arguments.index(str(flight.map))
    tiled = [*flight.arguments[:at], str(folder), *flight.arguments[at + 1 :]]
    assert drms(capsys, *tiled) == pytest.approx(expected, abs=0.01)
    monkeypatch.setattr(rasters, "LARGE_CELLS", 1000)
    assert drms(capsys, *flight.arguments) == pytest.approx(expected, abs=0.01)


LIMITED = """
import resource, sys
from terranav.app.cli import main
import rasterio, pyproj, numba, scipy.ndimage
resource.setrlimit(resource.RLIMIT_AS, (3 * 2**30, 3 * 2**30))
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="limits on the address space are tested on Linux")
def test_a_map_larger_than_the_memory_is_flown_over_and_refused_where_all_of_it_is_needed(
    flight: Flight, tmp_path: Path
) -> None:
    file, side = tmp_path / "wide.tif", 60_000
    profile = {
        "driver": "GTiff", "dtype": "float32", "crs": "EPSG:4326", "tiled": True, "SPARSE_OK": True, "BIGTIFF": True,
        "transform": Affine(1e-5, 0.0, -84.4, 0.0, -1e-5, 36.75),
    }  # fmt: skip
    with rasterio.open(file, "w", count=1, height=side, width=side, **profile):
        pass
    arguments = ["run", "--recording", str(flight.recording), "--map", str(file), "--ins", "300"]

    def run(estimator: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-c", LIMITED, *arguments, "--estimator", estimator, "--json"]
        return subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)

    done = run("pointmass")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["maps"][0]["rows"] == side
    convert = ["map", "convert", str(file), str(tmp_path / "all.nc")]  # a .tif goes out in pieces
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, *convert], capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert f"map of {side} x {side} cells: needs 26.8 GiB of memory, but " in done.stderr.splitlines()[-1]
