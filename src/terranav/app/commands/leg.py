"""terranav plan leg: how well the position will be known along one straight leg."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from terranav.app.commands import options

if TYPE_CHECKING:
    from terranav.core.recording import Recording
    from terranav.planning.bound import Bound

STOPS = 6  # places along the leg that are shown, its ends among them


def leg(
    start: Annotated[str, typer.Argument(metavar="A", help="Start as lat,lon; put -- before a negative latitude.")],
    end: Annotated[str, typer.Argument(metavar="B", help="End as lat,lon.")],
    *,
    file: Annotated[
        Path,
        typer.Option("--map", metavar="FILE", help="Any GDAL raster or NetCDF/GMT grid, a folder of tiles, or sample."),
    ],
    sensor_sigma: Annotated[float, typer.Option(metavar="S", help="1-sigma of a reading, in the kind's unit.")] = 5.0,
    rate: Annotated[float, typer.Option(metavar="HZ", help="Readings a second.")] = 1.0,
    speed: Annotated[float, typer.Option(metavar="MPS", help="Ground speed, in m/s.")] = 60.0,
    ins: Annotated[
        str, typer.Option(metavar="INS", help="Grade, such as tactical, or three numbers, or a TOML file.")
    ] = "tactical",
    kind: Annotated[str, typer.Option(metavar="KIND", help="terrain, bathymetry, gravity or magnetic.")] = "terrain",
    sigma: Annotated[float | None, typer.Option(metavar="S", help="1-sigma error of the map.")] = None,
    crs: Annotated[str | None, typer.Option(metavar="CRS", help="For a file that states none.")] = None,
    variable: Annotated[str | None, typer.Option(metavar="NAME", help="NetCDF variable or raster band.")] = None,
    unit: Annotated[str | None, typer.Option(metavar="UNIT", help="Unit of the values, such as ft.")] = None,
    as_json: options.Json = False,
) -> int:
    """Say how well the position will be known along a straight leg: the forecast, places that look alike included."""
    from terranav.app.console import OK, show_json, working
    from terranav.app.given import ins_from, one_map, place_from
    from terranav.planning.bound import bound
    from terranav.planning.forecast import forecast, leg_recording
    from terranav.planning.suitability import LegSettings

    ends = place_from("A", start), place_from("B", end)
    settings = LegSettings(sensor_sigma, rate, speed)
    grade = ins_from("--ins", ins)
    chart = one_map(file, kind=kind, sigma=sigma, crs=crs, variable=variable, unit=unit)
    rec = leg_recording(chart, *ends, grade, settings)
    with working("flying the leg"):
        found, lowest = forecast(rec, chart, grade), bound(rec, chart, grade)
    facts = {
        "map": {"name": chart.name, "kind": chart.kind, "unit": chart.unit, "sigma": chart.sigma},
        "sensor": {"sigma": sensor_sigma, "rate_hz": rate, "speed_mps": speed},
        **_facts(rec, found, lowest),
    }
    if as_json:
        show_json(facts)
    else:
        _show(facts)
    return OK


def _facts(rec: Recording, found: Bound, lowest: Bound) -> dict[str, Any]:
    """Everything in numbers."""
    import numpy as np

    from terranav.core.earth import offset_m

    north, east = offset_m(rec.lat_deg[0], rec.lon_deg[0], rec.lat_deg, rec.lon_deg)
    told, least = (np.sqrt(np.linalg.eigvalsh(one.cov_m2)[:, -1]) for one in (found, lowest))
    return {
        "length_m": float(np.hypot(north[-1], east[-1])),
        "distance_m": np.hypot(north, east).tolist(),
        "sigma_m": told.tolist(),
        "drms_m": found.drms_m.tolist(),
        "bound_m": least.tolist(),
    }


def _show(facts: dict[str, Any]) -> None:
    """A few lines for people."""
    import numpy as np

    from terranav.app.console import show_pairs
    from terranav.app.words import distance

    way, told, least = (np.array(facts[key]) for key in ("distance_m", "sigma_m", "bound_m"))
    stops = [round(k) for k in np.linspace(0, way.size - 1, min(STOPS, way.size))]
    lines = [(distance(way[k]), f"{distance(told[k])} (bound {distance(least[k])})") for k in stops]
    show_pairs(
        [
            ("map", f"{facts['map']['name']} ({facts['map']['kind']})"),
            ("leg", f"{distance(facts['length_m'])} at {facts['sensor']['speed_mps']:g} m/s"),
            ("1-sigma", "as forecast, along the longest axis"),
            *lines,
        ]
    )
