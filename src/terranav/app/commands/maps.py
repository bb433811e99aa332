"""terranav map: commands about maps."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from terranav.app.commands import options

app = typer.Typer(help="Look at maps, convert them, fetch their tiles.", no_args_is_help=False)

File = Annotated[
    Path,
    typer.Argument(
        metavar="FILE", help="Any GDAL raster or NetCDF/GMT grid; a folder or 'pattern*' of tiles; or sample."
    ),
]
Kind = Annotated[str, typer.Option(metavar="KIND", help="terrain, bathymetry, gravity or magnetic.")]
Sigma = Annotated[float | None, typer.Option(metavar="S", help="1-sigma error, in the kind's unit.")]
Crs = Annotated[str | None, typer.Option(metavar="CRS", help="For a file that states none.")]
Variable = Annotated[str | None, typer.Option(metavar="NAME", help="NetCDF variable or raster band.")]
Unit = Annotated[str | None, typer.Option(metavar="UNIT", help="Unit of the values, such as ft.")]
PositiveDown = Annotated[bool, typer.Option("--positive-down", help="The file holds depths: negate them.")]
Datum = Annotated[
    str | None,
    typer.Option("--map-datum", metavar="DATUM", help="What its heights count from; wins over what the file says."),
]
Box = Annotated[
    str | None,
    typer.Option("--box", metavar="S,W,N,E", help="Only this part, in degrees; east below west crosses 180."),
]


@app.callback()
def about() -> None:
    """Look at maps, convert them, fetch their tiles."""


@app.command()
def info(
    file: File,
    *,
    kind: Kind = "terrain",
    sigma: Sigma = None,
    crs: Crs = None,
    variable: Variable = None,
    unit: Unit = None,
    positive_down: PositiveDown = False,
    map_datum: Datum = None,
    as_json: options.Json = False,
) -> int:
    """Say what a map covers, how fine and how rough it is, and what looks suspicious."""
    from terranav.app.console import OK, show_json, show_pairs
    from terranav.app.mapping import map_words, opened

    facts = opened(
        file, kind=kind, sigma=sigma, crs=crs, variable=variable, unit=unit, positive_down=positive_down,
        datum=map_datum,
    ).info()  # fmt: skip
    if as_json:
        show_json(facts)
    else:
        show_pairs(map_words(facts))
    return OK


@app.command()
def view(
    file: File,
    *,
    out: Annotated[
        Path | None, typer.Option(metavar="PNG", help="The picture; FILE's name with .png here unless given.")
    ] = None,
    page: Annotated[bool, typer.Option("--page", help="Also a page to move about in, beside the picture.")] = False,
    box: Box = None,
    kind: Kind = "terrain",
    crs: Crs = None,
    variable: Variable = None,
    unit: Unit = None,
    positive_down: PositiveDown = False,
    map_datum: Datum = None,
    as_json: options.Json = False,
) -> int:
    """Draw a map: heights in colour, lit from the north-west."""
    from terranav.app.console import OK, show_json, show_pairs, working
    from terranav.app.mapping import checked_picture, drawn, map_words, opened

    picture = checked_picture(file, out)
    with working(f"drawing {file.name}"):
        part = opened(
            file, box, kind=kind, crs=crs, variable=variable, unit=unit, positive_down=positive_down,
            datum=map_datum,
        )  # fmt: skip
        written, note = drawn(part, picture, page=page)
        facts = part.info()
    if as_json:
        show_json({**facts, "files": written, "note": note or None})
    else:
        shown = ("map", "grid", "extent", "values", "voids", "looked at", "datum")
        pairs = [pair for pair in map_words(facts) if pair[0] in shown]
        show_pairs([*pairs, *([("note", note)] if note else []), ("written to", ", ".join(written))])
    return OK


@app.command()
def convert(
    source: Annotated[Path, typer.Argument(metavar="IN", help="As for info.")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="What to write: .tif, .nc, or .hgt where that is exact.")],
    *,
    box: Box = None,
    force: Annotated[bool, typer.Option("--force", help="Replace OUT where it is there already.")] = False,
    kind: Kind = "terrain",
    sigma: Sigma = None,
    crs: Crs = None,
    variable: Variable = None,
    unit: Unit = None,
    positive_down: PositiveDown = False,
    map_datum: Datum = None,
    datum: Annotated[
        str | None, typer.Option(metavar="TO", help="Bring its heights to this vertical datum, by geoid heights.")
    ] = None,
    geoid: options.Geoids = None,
    as_json: options.Json = False,
) -> int:
    """Write a map, or a part of it, as GeoTIFF or NetCDF: the same values at the same places, in the kind's unit.

    Only --datum makes other values of them. A large map goes to GeoTIFF piece by piece.
    """
    from terranav.app.console import OK, show_json, show_pairs, working
    from terranav.app.mapping import geoids_from, map_words, opened
    from terranav.io.raster_out import check_target, write_map
    from terranav.io.thinning import converted

    check_target(out, force=force)
    grids = geoids_from(geoid or ())
    with working(f"converting {source.name}"):
        part = opened(
            source, box, kind=kind, sigma=sigma, crs=crs, variable=variable, unit=unit,
            positive_down=positive_down, datum=map_datum,
        )  # fmt: skip
        if datum is not None:
            part = converted(part, datum, grids)
        write_map(part, out, force=force)
        facts = part.info()
    if as_json:
        show_json({**facts, "file": str(out)})
    else:
        show_pairs([*map_words(facts), ("written to", str(out))])
    return OK


@app.command()
def fetch(
    template: Annotated[
        str,
        typer.Option(
            metavar="URL", help="Address with {lat}, {lon}, {lat02}, {lon03}, {NS}, {EW} (south-west corner)."
        ),
    ],
    box: Annotated[
        str, typer.Option(metavar="S,W,N,E", help="What to cover, in degrees; east below west crosses 180.")
    ],
    cache: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the tiles; what it has is not fetched again.")],
    *,
    tile_deg: Annotated[float, typer.Option(metavar="D", help="Side of a tile, in degrees.")] = 1.0,
    refresh: Annotated[bool, typer.Option("--refresh", help="Ask again for tiles that did not exist.")] = False,
    attempts: Annotated[int, typer.Option(metavar="N", min=1, help="For each tile.")] = 5,
    timeout: Annotated[float, typer.Option(metavar="S", min=0.1, help="Silence that counts as broken.")] = 30.0,
    as_json: options.Json = False,
) -> int:
    """Download the map tiles that cover a box: checked, resumed where they broke off, asked for once only."""
    from terranav.app.console import OK, show_json, show_pairs, working
    from terranav.app.mapping import fetched_facts, fetched_pairs, required_box
    from terranav.io.fetching import fetch_tiles

    wanted = required_box(box)
    with working("fetching tiles"):
        found = fetch_tiles(
            template, wanted, cache, tile_deg=tile_deg, refresh=refresh, attempts=attempts, timeout_s=timeout
        )
    if as_json:
        show_json(fetched_facts(found, wanted, cache))
    else:
        show_pairs(fetched_pairs(found, wanted, cache))
    return OK
