"""Routes and keep-out areas as files: GeoJSON in and out, KML, and QGroundControl's .plan."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

import terranav as tn
from terranav.app.cli import main
from terranav.io.raster_out import write_map
from terranav.io.routes import RouteFile, read_keep_out, write_geojson, write_kml, write_plan
from terranav.maps.sample_dem import sample_map

RING = [[-84.26, 36.53], [-84.2, 36.53], [-84.2, 36.59], [-84.26, 36.59], [-84.26, 36.53]]
HOLE = [[-84.24, 36.55], [-84.22, 36.55], [-84.22, 36.57], [-84.24, 36.57], [-84.24, 36.55]]


def written(folder: Path, data: Any) -> Path:
    file = folder / "area.geojson"
    file.write_text(data if isinstance(data, str) else json.dumps(data))
    return file


def polygon(*rings: Any) -> dict[str, Any]:
    return {"type": "Polygon", "coordinates": list(rings)}


def test_areas_and_their_holes_are_read(tmp_path: Path) -> None:
    feature = {"type": "Feature", "properties": {"name": "range"}, "geometry": polygon(RING, HOLE)}
    several = {"type": "MultiPolygon", "coordinates": [[RING], [HOLE]]}
    found = read_keep_out(written(tmp_path, {"type": "FeatureCollection", "features": [feature]}))
    assert [(area[0], len(area[1])) for area in found] == [("range", 2)]
    assert set(map(tuple, np.round(found[0][1][0], 6).tolist())) == {(lat, lon) for lon, lat in RING}
    assert [len(area[1]) for area in read_keep_out(written(tmp_path, several))] == [1, 1]
    with pytest.warns(tn.DataWarning, match="holds no polygon"):
        assert read_keep_out(written(tmp_path, {"type": "FeatureCollection", "features": []})) == []


@pytest.mark.parametrize(
    "data",
    [
        "not json", {"type": "Nonsense"}, [1, 2], polygon([[0.0, 1.0]]),
        polygon([[0.0, "x"], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]]),
        polygon([[0.0, 95.0], [1.0, 95.0], [1.0, 96.0], [0.0, 95.0]]),
    ],
)  # fmt: skip
def test_malformed_areas_name_the_file(tmp_path: Path, data: Any) -> None:
    file = written(tmp_path, data)
    with pytest.raises(tn.DataError) as error:
        read_keep_out(file)
    assert str(error.value).startswith(f"{file}: ")
    assert "\n" not in str(error.value)


def test_the_three_formats_hold_the_same_route(tmp_path: Path) -> None:
    lat, lon = np.linspace(36.5, 36.6, 5), np.linspace(-84.3, -84.2, 5)
    points = np.stack([lat[[0, 2, 4]], lon[[0, 2, 4]], np.full(3, 900.0)], axis=1)
    route = RouteFile(
        "hop",
        lat,
        lon,
        np.full(5, 900.0),
        np.full(5, 12.0),
        np.linspace(0.0, 1e4, 5),
        points,
        400.0,
        {"extra": 0.1},
        60.0,
    )
    write_geojson(route, tmp_path / "r.geojson")
    write_kml(route, tmp_path / "r.kml")
    areas = read_keep_out(written(tmp_path, polygon(RING)))
    write_plan(route, areas, tmp_path / "r.plan")
    shape = json.loads((tmp_path / "r.geojson").read_text())
    line = next(one for one in shape["features"] if one["geometry"]["type"] == "LineString")
    np.testing.assert_allclose(
        np.array(line["geometry"]["coordinates"])[:, :2], np.stack([lon, lat], axis=1), atol=1e-6
    )
    assert line["properties"]["extra"] == 0.1
    text = (tmp_path / "r.kml").read_text()
    root = ElementTree.fromstring(text[text.index("<kml") :])
    assert root.tag == "{http://www.opengis.net/kml/2.2}kml"
    assert "-84.3,36.5" in text
    plan = json.loads((tmp_path / "r.plan").read_text())
    assert (plan["fileType"], plan["version"], plan["mission"]["version"]) == ("Plan", 1, 2)
    items = [item for item in plan["mission"]["items"] if item["command"] == 16]
    assert [item["params"][4:7] for item in items[-3:]] == [
        [36.5, -84.3, 900.0],
        [36.55, -84.25, 900.0],
        [36.6, -84.2, 900.0],
    ]
    assert all(set(item) >= {"autoContinue", "command", "doJumpId", "frame", "params", "type"} for item in items)
    assert len(plan["geoFence"]["polygons"]) == 1


def test_a_route_keeps_out_and_an_end_inside_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dem, area = tmp_path / "dem.tif", written(tmp_path, polygon(RING))
    write_map(sample_map(), dem)
    out = ["--map", str(dem), "--out", str(tmp_path), "--keep-out", str(area)]
    assert main(["plan", "route", "36.5,-84.3", "36.65,-84.1", *out, "--extra", "40"]) == 0
    shape = json.loads((tmp_path / "route.geojson").read_text())
    line = next(one for one in shape["features"] if one["geometry"]["type"] == "LineString")
    for lon, lat, *_ in line["geometry"]["coordinates"]:
        assert not (-84.26 < lon < -84.2 and 36.53 < lat < 36.59)
    capsys.readouterr()
    assert main(["plan", "route", "36.55,-84.22", "36.65,-84.1", *out]) == 2
    said = capsys.readouterr().err
    assert said == "terranav: error: route start 36.55,-84.22 lies in the keep-out area 'area 1'\n"
