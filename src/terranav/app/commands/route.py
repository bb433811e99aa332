"""terranav plan route: a route between two places along which the map tells where the vehicle is."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from terranav.app.commands import options

if TYPE_CHECKING:
    from terranav.maps.map import Map
    from terranav.planning._route_judge import Line
    from terranav.planning.route import Route, RouteSettings

_MAP, _FLIGHT, _HEIGHT = "How the map is read", "The vehicle", "Heights (maps of terrain and seabed)"

Metres = float | None


def route(
    start: Annotated[str, typer.Argument(metavar="A", help="Start as lat,lon; put -- before a negative latitude.")],
    end: Annotated[str, typer.Argument(metavar="B", help="End as lat,lon.")],
    *,
    file: Annotated[
        Path,
        typer.Option("--map", metavar="FILE", help="Any GDAL raster or NetCDF/GMT grid, a folder of tiles, or sample."),
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the route's files and the picture.")],
    limit: Annotated[
        Metres, typer.Option(metavar="M", help="Largest 1-sigma, in m: the shortest route within it. Else: the lowest.")
    ] = None,
    extra: Annotated[
        Metres, typer.Option(metavar="PERCENT", help="Most extra length; 15, and 100 with a limit, unless given.")
    ] = None,
    start_sigma: Annotated[float, typer.Option(metavar="M", help="1-sigma of the position at A, in m.")] = 10.0,
    settle: Annotated[float, typer.Option(metavar="KM", help="The 1-sigma counts from so far on.")] = 0.0,
    keep_out: Annotated[
        list[Path] | None, typer.Option(metavar="FILE", help="GeoJSON polygons to keep out of. Repeatable.")
    ] = None,
    keep_out_margin: Annotated[float, typer.Option(metavar="M", help="Kept from these, in m.")] = 0.0,
    sensor_sigma: Annotated[float, typer.Option(metavar="S", help="1-sigma of a reading, in the kind's unit.")] = 5.0,
    rate: Annotated[float, typer.Option(metavar="HZ", help="Readings a second.")] = 1.0,
    ins: Annotated[
        str, typer.Option(metavar="INS", help="Grade, such as tactical, or three numbers, or a TOML file.")
    ] = "tactical",
    speed: Annotated[float, typer.Option(metavar="MPS", rich_help_panel=_FLIGHT, help="Ground speed, in m/s.")] = 60.0,
    turn_radius: Annotated[
        Metres, typer.Option(metavar="M", rich_help_panel=_FLIGHT, help="That of a bank of 25 degrees unless given.")
    ] = None,
    clearance: Annotated[
        float, typer.Option(metavar="M", rich_help_panel=_HEIGHT, help="Least height above ground, in m.")
    ] = 150.0,
    climb: Annotated[
        float, typer.Option(metavar="DEG", rich_help_panel=_HEIGHT, help="Steepest climb and descent, in degrees.")
    ] = 5.0,
    ceiling: Annotated[
        Metres, typer.Option(metavar="M", rich_help_panel=_HEIGHT, help="Largest altitude, in the map's datum.")
    ] = None,
    altimeter_range: Annotated[
        Metres, typer.Option(metavar="M", rich_help_panel=_HEIGHT, help="Higher above ground there is no reading.")
    ] = None,
    kind: Annotated[
        str, typer.Option(metavar="KIND", rich_help_panel=_MAP, help="terrain, bathymetry, gravity or magnetic.")
    ] = "terrain",
    sigma: Annotated[
        float | None, typer.Option(metavar="S", rich_help_panel=_MAP, help="1-sigma error of the map.")
    ] = None,
    crs: Annotated[
        str | None, typer.Option(metavar="CRS", rich_help_panel=_MAP, help="For a file that states none.")
    ] = None,
    variable: Annotated[
        str | None, typer.Option(metavar="NAME", rich_help_panel=_MAP, help="NetCDF variable or raster band.")
    ] = None,
    unit: Annotated[
        str | None, typer.Option(metavar="UNIT", rich_help_panel=_MAP, help="Unit of the values, such as ft.")
    ] = None,
    as_json: options.Json = False,
) -> int:
    """Plan a route from A to B along which the map tells where the vehicle is: 1-sigma under a limit, or the lowest."""
    from terranav.app.console import INCOMPLETE, OK, complain, show_json, working
    from terranav.app.given import folder_for, ins_from, one_map, place_from
    from terranav.io.routes import read_keep_out
    from terranav.planning.route import RouteSettings, plan_route

    ends = place_from("A", start), place_from("B", end)
    settings = RouteSettings(
        limit, None if extra is None else extra / 100.0, start_sigma, 1000.0 * settle, sensor_sigma, rate, speed,
        turn_radius, clearance, climb, ceiling, altimeter_range, keep_out_margin,
    )  # fmt: skip
    grade = ins_from("--ins", ins)
    areas = [area for path in keep_out or () for area in read_keep_out(path)]
    folder_for(out)
    chart = one_map(file, kind=kind, sigma=sigma, crs=crs, variable=variable, unit=unit)
    with working("looking for a route"):
        found = plan_route(chart, *ends, settings, grade, keep_out=areas)
    facts = {**_facts(found, chart), "files": _write(found, chart, areas, out)}
    if as_json:
        show_json(facts)
    else:
        _show(facts, settings)
    for doubt in _doubts(found, facts):
        complain(doubt, "warning")
    return OK if found.kept else INCOMPLETE


def _write(found: Route, chart: Map, areas: Sequence[Any], out: Path) -> dict[str, str]:
    """All files; their names."""
    import numpy as np

    from terranav.app.route_figure import route_picture
    from terranav.app.style import png
    from terranav.io import routes as files
    from terranav.planning.route import waypoints_of

    line, names = found.line, {}
    told = files.RouteFile(
        "route", line.lat_deg, line.lon_deg, line.altitude_m, line.sigma_m, line.distance_m, waypoints_of(found),
        float(line.ground_m[0]), {"length_m": round(line.length_m, 1), "largest_sigma_m": round(line.top_m, 2)},
        found.settings.speed_mps, chart.kind == "bathymetry",
    )  # fmt: skip
    for name, suffix, write in (("geojson", "geojson", files.write_geojson), ("kml", "kml", files.write_kml)):
        names[name] = str(out / f"route.{suffix}")
        write(told, names[name])
    if np.isfinite(told.waypoints).all():
        names["plan"] = str(out / "route.plan")
        files.write_plan(told, areas, names["plan"])
    names["picture"] = str(out / "route.png")
    Path(names["picture"]).write_bytes(png(route_picture(found, chart, areas)))
    return names


def _facts(found: Route, chart: Map) -> dict[str, Any]:
    """Everything in numbers."""
    from dataclasses import asdict

    return {
        "map": {"name": chart.name, "kind": chart.kind, "unit": chart.unit, "sigma": chart.sigma, "datum": chart.datum},
        "settings": {**asdict(found.settings), "turn_radius_m": found.settings.radius_m, "extra": found.settings.share},
        "ins": asdict(found.ins),
        "limit_kept": found.kept,
        "extra": found.extra,
        "route": _of(found.line),
        "straight": {**_of(found.straight), "barred": list(found.straight.barred)},
        "labels": found.labels,
        "search_coarse": found.coarse,
    }


def _of(line: Line) -> dict[str, Any]:
    """A line in numbers."""
    import numpy as np

    worst = int(np.argmax(line.sigma_m))
    above = line.altitude_m - line.ground_m
    return {
        "length_m": line.length_m,
        "largest_sigma_m": line.top_m,
        "final_sigma_m": line.sigma_m[-1],
        "worst_at_km": line.distance_m[worst] / 1000.0,
        "corners_deg": line.corners_deg,
        "highest_m": line.altitude_m.max(),
        "highest_above_ground_m": above.max(),
        "steepest_deg": line.steepest_deg,
    }


def _doubts(found: Route, facts: dict[str, Any]) -> list[str]:
    """What the planner should know."""
    doubts, settings = [], found.settings
    top = facts["route"]["largest_sigma_m"]
    if not found.kept:
        doubts.append(
            f"--limit {settings.limit_m:g}: no route within it was found; the best has a 1-sigma of {top:.1f} m "
            f"at most, with {100 * found.extra:.0f} % more length, and is what was written"
        )
    reach, above = settings.altimeter_range_m, found.line.altitude_m - found.line.ground_m
    if reach is not None and (above > reach).any():
        doubts.append(
            f"--altimeter-range {reach:g}: {100 * (above > reach).mean():.0f} % of the route is higher above ground at "
            f"the steepest climb of {settings.climb_deg:g} degrees, and has no reading there"
        )
    return doubts


def _show(facts: dict[str, Any], settings: RouteSettings) -> None:
    """A few lines for people."""
    from terranav.app.console import show_pairs
    from terranav.app.words import distance, percent

    line, straight = facts["route"], facts["straight"]
    barred = f"; it {' and '.join(straight['barred'])}" if straight["barred"] else ""
    heights = f"up to {line['highest_m']:.0f} m, {distance(line['highest_above_ground_m'])} above ground, "
    heights += f"climbing {line['steepest_deg']:.1f} deg at most"
    asked = f"1-sigma within {settings.limit_m:g} m" if settings.limit_m else "the lowest 1-sigma"
    show_pairs(
        [
            ("map", f"{facts['map']['name']} ({facts['map']['kind']})"),
            ("asked", f"{asked}, for at most {percent(settings.share)} more length"),
            ("route", f"{distance(line['length_m'])}, {percent(facts['extra'], 1)} more than straight"),
            ("1-sigma", f"at most {distance(line['largest_sigma_m'])}, at km {line['worst_at_km']:.1f}"),
            (
                "straight",
                f"at most {distance(straight['largest_sigma_m'])}, at km {straight['worst_at_km']:.1f}{barred}",
            ),
            *([("heights", heights)] if facts["map"]["kind"] in ("terrain", "bathymetry") else []),
            *[(name, path) for name, path in facts["files"].items()],
        ]
    )
