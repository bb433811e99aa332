"""Routes and keep-out areas as files: GeoJSON in and out (RFC 7946), KML 2.2 and QGroundControl's .plan out.

The .plan is that of QGroundControl's developer guide, 'Plan File Format': file version 1, mission version 2, geofence
and rally points version 2, every waypoint a SimpleItem of MAV_CMD_NAV_WAYPOINT with an altitude above mean sea level.
"""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from terranav.core.errors import DataError, DataWarning
from terranav.io.files import existing_file, replacing

FloatArray = NDArray[np.float64]
Area = tuple[str, Sequence[FloatArray]]  # a name, and rings (n, 2) of latitude and longitude [deg], closed

WHAT = "a GeoJSON file with polygons to keep out of"
_WGS84 = ("crs84", "epsg:4326", "epsg::4326")
_WAYPOINT, _FRAME_GLOBAL, _ALTITUDE_ABSOLUTE = 16, 0, 2
_FIXED_WING, _SUBMARINE, _PX4, _ARDUPILOT = 1, 12, 12, 3
_KML = "http://www.opengis.net/kml/2.2"


@dataclass(frozen=True, eq=False)
class RouteFile:
    """What is written of a route.

    Attributes
    ----------
    name : str
    lat_deg, lon_deg, altitude_m, sigma_m, distance_m : (n,)
        Along the route; altitudes above the map's datum, NaN for none.
    waypoints : (m, 3)
        Latitude, longitude [deg] and altitude [m] of what an autopilot is given.
    ground_m : float
        At the start; NaN for none.
    facts : mapping
        Properties of the line: plain JSON values.
    speed_mps : float
    submarine : bool
    """

    name: str
    lat_deg: FloatArray
    lon_deg: FloatArray
    altitude_m: FloatArray
    sigma_m: FloatArray
    distance_m: FloatArray
    waypoints: FloatArray
    ground_m: float
    facts: Mapping[str, Any]
    speed_mps: float
    submarine: bool = False


def read_keep_out(path: str | Path) -> list[Area]:
    """Polygons of a GeoJSON file; a MultiPolygon becomes one area for each of its polygons.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    list of (name, rings)
        The outer ring (n, 2) of latitude and longitude [deg] and those of its holes, as they stand in the file.

    Raises
    ------
    DataError
        Naming the file, the place in it and what was expected.

    Warns
    -----
    DataWarning
        A file without any polygon.
    """
    file = existing_file(path, WHAT)
    try:
        data = json.loads(file.read_text(encoding="utf-8-sig"))
    except json.JSONDecodeError as problem:
        raise DataError(f"{file}: is no JSON, {problem.msg} in line {problem.lineno}, expected {WHAT}") from None
    except (UnicodeDecodeError, RecursionError, OSError) as problem:
        raise DataError(f"{file}: cannot be read ({type(problem).__name__}), expected {WHAT}") from None
    areas = list(_areas(_Spot(file), data, "", 0))
    if not areas:
        warnings.warn(f"{file}: holds no polygon, so nothing is kept out of", DataWarning, stacklevel=2)
    return areas


@dataclass(frozen=True)
class _Spot:
    """A place in a file, for messages."""

    file: Path
    at: str = ""

    def __getitem__(self, key: str | int) -> _Spot:
        step = f"[{key}]" if isinstance(key, int) else f".{key}" if self.at else key
        return _Spot(self.file, self.at + step)

    def wrong(self, value: object, expected: str) -> DataError:
        text = json.dumps(value, default=str)
        shown = text if len(text) <= 60 else f"{text[:57]}..."
        return DataError(f"{self.file}: {self.at or 'the whole'} is {shown}, expected {expected}")


def _areas(spot: _Spot, data: Any, name: str, depth: int) -> Iterator[Area]:
    """Areas of any GeoJSON object."""
    if not isinstance(data, dict):
        raise spot.wrong(data, "a GeoJSON object")
    _check_crs(spot, data)
    kind = data.get("type")
    if kind in ("FeatureCollection", "GeometryCollection") and depth < 20:
        key = "features" if kind == "FeatureCollection" else "geometries"
        members = data.get(key)
        if not isinstance(members, list):
            raise spot[key].wrong(members, "a list")
        for number, member in enumerate(members):
            yield from _areas(spot[key][number], member, name or f"area {number + 1}", depth + 1)
    elif kind == "Feature" and depth < 20:
        own = data.get("properties")
        told = own.get("name", data.get("id")) if isinstance(own, dict) else data.get("id")
        geometry = spot["geometry"]
        yield from _areas(geometry, data.get("geometry"), str(told) if told is not None else name, depth + 1)
    elif kind == "Polygon":
        yield name or "area 1", _rings(spot["coordinates"], data.get("coordinates"))
    elif kind == "MultiPolygon":
        parts = data.get("coordinates")
        if not isinstance(parts, list):
            raise spot["coordinates"].wrong(parts, "a list of polygons")
        for number, part in enumerate(parts):
            yield name or f"area {number + 1}", _rings(spot["coordinates"][number], part)
    else:
        raise spot["type"].wrong(kind, "Polygon or MultiPolygon, in a Feature or a FeatureCollection or by itself")


def _check_crs(spot: _Spot, data: dict[str, Any]) -> None:
    """Raise for the old member 'crs' with anything but longitude and latitude on WGS-84."""
    told = json.dumps(data["crs"]).lower() if data.get("crs") is not None else _WGS84[0]
    if not any(name in told for name in _WGS84):
        raise spot["crs"].wrong(data["crs"], "none: GeoJSON has longitude and latitude on WGS-84")


def _rings(spot: _Spot, data: Any) -> list[FloatArray]:
    """Rings of a polygon as latitude and longitude."""
    if not isinstance(data, list) or not data:
        raise spot.wrong(data, "a list of rings")
    return [_ring(spot[number], ring) for number, ring in enumerate(data)]


def _ring(spot: _Spot, data: Any) -> FloatArray:
    """One closed ring."""
    if not isinstance(data, list) or len(data) < 4:
        raise spot.wrong(data, "a ring of at least four positions, the last like the first")
    for number, position in enumerate(data):
        numbers = position[:2] if isinstance(position, list) else ()
        plain = len(numbers) == 2 and all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in numbers)
        if not plain or not (-180.0 <= position[0] <= 360.0 and -90.0 <= position[1] <= 90.0):
            raise spot[number].wrong(position, "longitude (-180 to 360) and latitude (-90 to 90) in degrees")
    if data[0][:2] != data[-1][:2]:
        raise spot.wrong(data[-1], f"the ring to end where it begins, at {data[0][:2]}")
    return np.array([[position[1], position[0]] for position in data], dtype=np.float64)


def write_geojson(route: RouteFile, path: str | Path) -> None:
    """The line with its 1-sigma, and the waypoints as points; cut at the antimeridian as RFC 7946 3.1.9 asks."""
    parts = _parts(route)
    geometry: dict[str, Any] = {"type": "LineString", "coordinates": parts[0]}
    if len(parts) > 1:
        geometry = {"type": "MultiLineString", "coordinates": parts}
    told = {
        "name": route.name,
        **route.facts,
        "distance_m": _rounded(route.distance_m, 1),
        "sigma_m": _rounded(route.sigma_m, 2),
    }
    features = [{"type": "Feature", "geometry": geometry, "properties": told}]
    for number, (lat, lon, altitude) in enumerate(route.waypoints.tolist()):
        point = {"type": "Point", "coordinates": _position(lat, lon, altitude)}
        features.append({"type": "Feature", "geometry": point, "properties": {"name": f"waypoint {number + 1}"}})
    _write(
        path,
        json.dumps({"type": "FeatureCollection", "features": features}, allow_nan=False, ensure_ascii=False) + "\n",
    )


def write_kml(route: RouteFile, path: str | Path) -> None:
    """The line and the waypoints, for globes."""
    ElementTree.register_namespace("", _KML)
    root = ElementTree.Element(f"{{{_KML}}}kml")
    document = _child(root, "Document")
    _child(document, "name", route.name)
    style = _child(document, "Style")
    style.set("id", "route")
    line = _child(style, "LineStyle")
    _child(line, "color", "ff9c6300")
    _child(line, "width", "4")
    high = bool(np.isfinite(route.altitude_m).all())
    mark = _child(document, "Placemark")
    _child(mark, "name", route.name)
    _child(mark, "description", "; ".join(f"{key}: {value}" for key, value in route.facts.items()))
    _child(mark, "styleUrl", "#route")
    drawn = _child(mark, "LineString")
    _child(drawn, "tessellate", "1")
    _child(drawn, "altitudeMode", "absolute" if high else "clampToGround")
    points = zip(route.lat_deg.tolist(), route.lon_deg.tolist(), route.altitude_m.tolist(), strict=True)
    _child(drawn, "coordinates", " ".join(_comma(*point) for point in points))
    for number, place in enumerate(route.waypoints.tolist()):
        mark = _child(document, "Placemark")
        _child(mark, "name", str(number + 1))
        point = _child(mark, "Point")
        _child(point, "altitudeMode", "absolute" if high else "clampToGround")
        _child(point, "coordinates", _comma(*place))
    _write(path, ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n")


def write_plan(route: RouteFile, keep_out: Sequence[Area], path: str | Path) -> int:
    """QGroundControl's .plan: the waypoints as a mission, the areas as a geofence.

    Returns
    -------
    int
        How many areas are not in it: a fence polygon has no holes.

    Raises
    ------
    DataError
        A route without altitudes, or a file that cannot be written.
    """
    if not np.isfinite(route.waypoints).all():
        raise DataError(f"{path}: the route has no altitudes, expected those of a map of terrain or seabed")
    items = [_item(number, place) for number, place in enumerate(route.waypoints.tolist(), start=1)]
    whole = [rings[0] for _, rings in keep_out if len(rings) == 1]
    fence = [{"inclusion": False, "polygon": ring[:-1].tolist(), "version": 1} for ring in map(_clockwise, whole)]
    mission = {
        "cruiseSpeed": route.speed_mps,
        "firmwareType": _ARDUPILOT if route.submarine else _PX4,
        "globalPlanAltitudeMode": _ALTITUDE_ABSOLUTE,
        "hoverSpeed": route.speed_mps,
        "items": items,
        "plannedHomePosition": [*route.waypoints[0, :2].tolist(), route.ground_m],
        "vehicleType": _SUBMARINE if route.submarine else _FIXED_WING,
        "version": 2,
    }
    plan = {
        "fileType": "Plan",
        "geoFence": {"circles": [], "polygons": fence, "version": 2},
        "groundStation": "QGroundControl",
        "mission": mission,
        "rallyPoints": {"points": [], "version": 2},
        "version": 1,
    }
    _write(path, json.dumps(plan, indent=4, allow_nan=False) + "\n")
    return len(keep_out) - len(whole)


def _item(number: int, place: Sequence[float]) -> dict[str, Any]:
    """One waypoint."""
    lat, lon, altitude = round(place[0], 8), round(place[1], 8), round(place[2], 1)
    return {
        "AMSLAltAboveTerrain": None,
        "Altitude": altitude,
        "AltitudeMode": _ALTITUDE_ABSOLUTE,
        "autoContinue": True,
        "command": _WAYPOINT,
        "doJumpId": number,
        "frame": _FRAME_GLOBAL,
        "params": [0, 0, 0, None, lat, lon, altitude],
        "type": "SimpleItem",
    }


def _clockwise(ring: FloatArray) -> FloatArray:
    """A closed ring of latitudes and longitudes, clockwise as seen on a map."""
    lat, lon = ring[:, 0], np.unwrap(ring[:, 1], period=360.0)
    area = float(np.sum(lon[:-1] * lat[1:] - lon[1:] * lat[:-1]))
    turned = ring if area < 0.0 else ring[::-1]
    return np.column_stack([turned[:, 0], (turned[:, 1] + 180.0) % 360.0 - 180.0])


def _parts(route: RouteFile) -> list[list[list[float]]]:
    """The line's positions, cut where it crosses the antimeridian, both parts ending on it."""
    parts: list[list[list[float]]] = [[]]
    before: tuple[float, float, float] | None = None
    for lat, lon, altitude in zip(
        route.lat_deg.tolist(), route.lon_deg.tolist(), route.altitude_m.tolist(), strict=True
    ):
        if before is not None and abs(lon - before[1]) > 180.0:
            side = math.copysign(180.0, before[1])
            part = (side - before[1]) / ((lon + 2.0 * side) - before[1])
            at = [one + part * (other - one) for one, other in ((before[0], lat), (before[2], altitude))]
            parts[-1].append(_position(at[0], side, at[1]))
            parts.append([_position(at[0], -side, at[1])])
        parts[-1].append(_position(lat, lon, altitude))
        before = lat, lon, altitude
    return parts


def _position(lat: float, lon: float, altitude: float) -> list[float]:
    """Longitude, latitude, and an altitude where there is one."""
    return [round(lon, 7), round(lat, 7), *([round(altitude, 1)] if math.isfinite(altitude) else [])]


def _comma(lat: float, lon: float, altitude: float) -> str:
    return ",".join(str(number) for number in _position(lat, lon, altitude))


def _rounded(values: FloatArray, digits: int) -> list[float]:
    return [round(value, digits) for value in values.tolist()]


def _child(parent: ElementTree.Element, name: str, text: str | None = None) -> ElementTree.Element:
    child = ElementTree.SubElement(parent, f"{{{_KML}}}{name}")
    child.text = text
    return child


def _write(path: str | Path, text: str) -> None:
    with replacing(path) as aside:
        aside.write_text(text, encoding="utf-8")
