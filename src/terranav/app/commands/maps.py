"""terranav map: commands about maps."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from terranav.app.commands import options

app = typer.Typer(help="Look at maps.", no_args_is_help=False)


@app.callback()
def about() -> None:
    """Look at maps."""


@app.command()
def info(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Any GDAL raster or NetCDF/GMT grid.")],
    *,
    kind: Annotated[str, typer.Option(metavar="KIND", help="terrain, bathymetry, gravity or magnetic.")] = "terrain",
    sigma: Annotated[float | None, typer.Option(metavar="S", help="1-sigma error, in the kind's unit.")] = None,
    crs: Annotated[str | None, typer.Option(metavar="CRS", help="For a file that states none.")] = None,
    variable: Annotated[str | None, typer.Option(metavar="NAME", help="NetCDF variable or raster band.")] = None,
    unit: Annotated[str | None, typer.Option(metavar="UNIT", help="Unit of the values, such as ft.")] = None,
    as_json: options.Json = False,
) -> int:
    """Say what a map covers, how fine and how rough it is, and what looks suspicious."""
    from terranav.app.console import OK, show_json, show_pairs
    from terranav.app.listing import map_pairs
    from terranav.io.rasters import open_map

    facts = open_map(file, kind=kind, sigma=sigma, crs=crs, variable=variable, unit=unit).info()
    if as_json:
        show_json(facts)
    else:
        show_pairs(map_pairs(facts))
    return OK
