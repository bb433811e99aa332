"""terranav plan: commands for before the flight."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from terranav.app.commands import options

if TYPE_CHECKING:
    from terranav.maps.map import Map
    from terranav.planning.suitability import Suitability

app = typer.Typer(help="Plan: where a fix is possible, and how good.", no_args_is_help=False)


@app.callback()
def about() -> None:
    """Plan: where a fix is possible, and how good."""


@app.command()
def suitability(
    file: Annotated[
        Path, typer.Argument(metavar="MAP", help="Any GDAL raster or NetCDF/GMT grid, a folder of tiles, or sample.")
    ],
    *,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the picture and the GeoTIFFs.")],
    sensor_sigma: Annotated[float, typer.Option(metavar="S", help="1-sigma of a reading, in the kind's unit.")] = 5.0,
    rate: Annotated[float, typer.Option(metavar="HZ", help="Readings a second.")] = 1.0,
    speed: Annotated[float, typer.Option(metavar="MPS", help="Ground speed, in m/s.")] = 60.0,
    ins: Annotated[
        str, typer.Option(metavar="INS", help="Grade, such as tactical, or three numbers, or a TOML file.")
    ] = "tactical",
    distance: Annotated[float, typer.Option(metavar="KM", help="Length of a leg, in km.")] = 10.0,
    headings: Annotated[int, typer.Option(metavar="N", help="Headings, evenly around from north.")] = 8,
    limit: Annotated[float, typer.Option(metavar="M", help="Largest 1-sigma that is good enough, in m.")] = 50.0,
    block: Annotated[int, typer.Option(metavar="CELLS", help="Side of a block of the answer.")] = 4,
    anchor: Annotated[str, typer.Option(metavar="WHERE", help="Legs end or start at their place: end, start.")] = "end",
    readings_a_cell: Annotated[
        int, typer.Option(metavar="N", help="Of a faster sensor so many are followed one by one; fewer are quicker.")
    ] = 4,
    kind: Annotated[str, typer.Option(metavar="KIND", help="terrain, bathymetry, gravity or magnetic.")] = "terrain",
    sigma: Annotated[float | None, typer.Option(metavar="S", help="1-sigma error of the map.")] = None,
    map_correlation: Annotated[
        float | None, typer.Option(metavar="M", help="Correlation length of the map's error, in m; else 2.5 cells.")
    ] = None,
    crs: Annotated[str | None, typer.Option(metavar="CRS", help="For a file that states none.")] = None,
    variable: Annotated[str | None, typer.Option(metavar="NAME", help="NetCDF variable or raster band.")] = None,
    unit: Annotated[str | None, typer.Option(metavar="UNIT", help="Unit of the values, such as ft.")] = None,
    positive_down: Annotated[bool, typer.Option("--positive-down", help="The file holds depths: negate them.")] = False,
    as_json: options.Json = False,
) -> int:
    """Say where on a map terrain-aided navigation works: the bound of a straight leg at each place and heading."""
    from terranav.app.console import OK, show_json, working
    from terranav.app.given import ins_from, one_map
    from terranav.core.checks import finite
    from terranav.planning import suitability as planning

    finite("--limit", limit, above=0.0)
    settings = planning.LegSettings(
        sensor_sigma, rate, speed, 1000.0 * distance, headings, block, anchor, readings_a_cell
    )
    grade = ins_from("--ins", ins)
    _folder(out)
    chart = one_map(
        file, kind=kind, sigma=sigma, correlation_m=map_correlation, crs=crs, variable=variable, unit=unit,
        positive_down=positive_down,
    )  # fmt: skip
    with working("flying every leg"):
        found = planning.suitability(chart, grade, settings)
    files = _write(found, chart, limit, out)
    facts = _facts(found, chart, limit, files)
    if as_json:
        show_json(facts)
    else:
        _show(facts)
    return OK


def _folder(out: Path) -> None:
    """Make the folder; one line when that cannot be."""
    from terranav.core.errors import ConfigError

    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as problem:
        raise ConfigError(f"--out: {out} cannot be made a folder ({problem.strerror})") from None


def _write(found: Suitability, chart: Map, limit_m: float, out: Path) -> dict[str, str]:
    """The picture, and the grids as two GeoTIFFs in longitude and latitude."""
    from terranav.app.style import png
    from terranav.app.suitability_figure import suitability_map
    from terranav.io.raster_out import Layer, write_layers

    picture, grids, by_heading = out / "suitability.png", out / "suitability.tif", out / "sigma_by_heading.tif"
    layers = [
        Layer("1-sigma on the best heading", found.best_m, "m"),
        Layer("1-sigma on the median heading", found.median_m, "m"),
        Layer("1-sigma on the worst heading", found.worst_m, "m"),
        Layer("best heading", found.best_heading_deg, "deg"),
        Layer("roughness: rms slope", found.roughness, f"{chart.unit}/m"),
        Layer("spread: standard deviation", found.spread, chart.unit),
        Layer("correlation length", found.correlation_m, "m"),
        Layer("entropy", found.entropy_bits, "bit"),
        Layer("self-similarity", found.self_similarity, "1"),
    ]
    legs = [
        Layer(f"1-sigma on heading {heading:g} deg", grid, "m")
        for heading, grid in zip(found.headings_deg.tolist(), found.sigma_m, strict=True)
    ]
    write_layers(grids, layers, found.transform, "EPSG:4326", force=True)
    write_layers(by_heading, legs, found.transform, "EPSG:4326", force=True)
    picture.write_bytes(png(suitability_map(found, chart, limit_m)))
    return {"picture": str(picture), "grids": str(grids), "by_heading": str(by_heading)}


def _facts(found: Suitability, chart: Map, limit_m: float, files: dict[str, str]) -> dict[str, Any]:
    """Everything in numbers."""
    from dataclasses import asdict

    import numpy as np

    def spread(values: Any) -> dict[str, float]:
        known = np.asarray(values)[np.isfinite(values)].astype(np.float64)
        low, middle, high = np.percentile(known, [5, 50, 95]) if known.size else (np.nan,) * 3
        return {"p05": float(low), "median": float(middle), "p95": float(high)}

    return {
        "map": {"name": chart.name, "kind": chart.kind, "unit": chart.unit, "sigma": chart.sigma},
        "map_correlation_m": chart.error_length_m,
        "settings": asdict(found.settings),
        "ins": asdict(found.ins),
        "block_m": found.block_m,
        "rows": int(found.lat_deg.size),
        "cols": int(found.lon_deg.size),
        "covered": float(np.isfinite(found.best_m).mean()),
        "limit_m": limit_m,
        "trusted_m": found.trusted_m,
        "within_limit": found.share_within(limit_m),
        "sigma_m": {name: spread(getattr(found, f"{name}_m")) for name in ("best", "median", "worst")},
        "roughness": spread(found.roughness),
        "spread": spread(found.spread),
        "correlation_m": spread(found.correlation_m),
        "entropy_bits": spread(found.entropy_bits),
        "self_similarity": spread(found.self_similarity),
        "files": files,
    }


def _show(facts: dict[str, Any]) -> None:
    """A few lines for people."""
    from terranav.app.console import show_pairs
    from terranav.app.words import distance, number, percent

    within, sigma, legs = facts["within_limit"], facts["sigma_m"], facts["settings"]
    told = f"{facts['limit_m']:g} m"
    size = f"{facts['rows']} x {facts['cols']} of {distance(facts['block_m'])}, {percent(facts['covered'])} with a leg"
    spread = ", ".join(f"{name} heading {distance(sigma[name]['median'])}" for name in ("best", "median", "worst"))
    show_pairs(
        [
            ("map", f"{facts['map']['name']} ({facts['map']['kind']})"),
            ("legs", f"{legs['distance_m'] / 1000:g} km at {legs['speed_mps']:g} m/s, {legs['headings']} headings"),
            ("blocks", size),
            ("works", f"1-sigma within {told} on every heading over {percent(within['worst'])} of them"),
            ("", f"on the best heading over {percent(within['best'])}"),
            ("1-sigma", f"median block: {spread}"),
            ("trust", f"beyond {distance(facts['trusted_m'])}, a quarter of a cell, expect more than is told here"),
            ("slope", f"{number(facts['roughness']['median'], 3)} {facts['map']['unit']}/m in the median block"),
            ("likeness", f"{number(facts['self_similarity']['median'])} to the most alike place (1: the same)"),
            ("picture", facts["files"]["picture"]),
            ("grids", facts["files"]["grids"]),
            ("headings", facts["files"]["by_heading"]),
        ]
    )
