"""Large maps on the command line: only what the vehicle may be over is read."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine

from terranav.app import given
from terranav.app.cli import main
from terranav.core.earth import offset_m, shift
from terranav.core.ins_grade import InsGrade
from terranav.core.recording import Recording
from terranav.io import rasters
from terranav.maps.map import Map
from tests.app.conftest import Flight


def track(lat_deg: list[float], lon_deg: list[float]) -> Recording:
    n = len(lat_deg)
    columns = {"time_s": 100.0 * np.arange(n), "lat_deg": np.array(lat_deg), "lon_deg": np.array(lon_deg)}
    return Recording({**columns, "alt_m": np.zeros(n)}, ins=InsGrade(100.0, 1.0, 0.0))


def test_the_box_holds_every_place_that_the_ins_may_be_over() -> None:
    rec = track([46.0, 46.2, 46.1], [8.0, 8.4, 8.9])
    south, west, north, east = given.reach_box(rec)
    margin = given.REACH * np.hypot(100.0, 200.0) + given.MARGIN_M  # 200 s at 1 m/s
    for place in ((south, 8.0), (north, 8.0)):
        nearest = 46.0 if place[0] == south else 46.2
        assert abs(offset_m(nearest, 8.0, *place)[0]) == pytest.approx(margin, rel=1e-6)
    assert offset_m(north, west, north, 8.0)[1] == pytest.approx(margin, rel=1e-3)
    for heading in np.linspace(0.0, 2.0 * np.pi, 13):
        lat, lon = shift(rec.lat_deg, rec.lon_deg, margin * np.cos(heading), margin * np.sin(heading))
        assert ((lat >= south - 1e-9) & (lat <= north + 1e-9) & (lon >= west - 1e-9) & (lon <= east + 1e-9)).all()


def test_the_box_crosses_the_antimeridian_and_gives_up_longitude_at_a_pole() -> None:
    _, west, _, east = given.reach_box(track([10.0, 10.0], [179.8, -179.9]))
    assert 179.6 < west < 179.8
    assert 180.1 < east < 180.3
    assert given.reach_box(track([89.5, 89.99], [10.0, 20.0]))[1:] == (-180.0, 90.0, 179.999999)


def test_a_large_map_is_read_around_the_track(
    flight: Flight, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[object] = []
    opened = rasters.open_map
    monkeypatch.setattr(given, "WHOLE_CELLS", 1000)
    monkeypatch.setattr(given, "MARGIN_M", 300.0)
    monkeypatch.setattr(given, "REACH", 3.0)

    def watched(path: Path, **options: Any) -> Map:
        asked.append(options.get("box"))
        return opened(path, **options)

    monkeypatch.setattr(rasters, "open_map", watched)
    arguments = ["run", *flight.arguments, "--estimator", "pointmass", "--ins", "100,0.2,0.1", "--json"]
    assert main(arguments) == 0
    part = json.loads(capsys.readouterr().out)
    monkeypatch.setattr(given, "WHOLE_CELLS", 2**24)
    assert main(arguments) == 0
    whole = json.loads(capsys.readouterr().out)
    assert asked[0] is not None
    assert asked[1] is None
    sizes = [int(summary["maps"][0]["rows"]) * int(summary["maps"][0]["cols"]) for summary in (part, whole)]
    assert sizes[0] < 0.8 * sizes[1]
    assert part["metrics"]["drms_m"] == pytest.approx(whole["metrics"]["drms_m"], rel=0.02)


LIMITED = """
import resource, sys
from terranav.app.cli import main
import rasterio, pyproj, numba, scipy.ndimage
resource.setrlimit(resource.RLIMIT_AS, (3 * 2**30, 3 * 2**30))
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="limits on the address space are tested on Linux")
def test_too_little_memory_is_one_line_with_the_figure_needed(flight: Flight, tmp_path: Path) -> None:
    file, side = tmp_path / "wide.tif", 40_000
    profile = {
        "driver": "GTiff", "dtype": "float32", "crs": "EPSG:4326", "tiled": True, "SPARSE_OK": True, "BIGTIFF": True,
        "transform": Affine(1e-5, 0.0, -84.4, 0.0, -1e-5, 36.75),
    }  # fmt: skip
    with rasterio.open(file, "w", count=1, height=side, width=side, **profile):
        pass
    arguments = ["run", "--recording", flight.recording, "--map", file, "--estimator", "ins", "--ins", "3000"]
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, *map(str, arguments)], capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith(
        f"terranav: error: {file}: map of 40000 x 40000 cells: needs 17.9 GiB of memory, but "
    )
    assert done.stderr.count("\n") == 1
