"""Options that several commands share: one spelling and one help text each."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

MAP_PANEL, INS_PANEL = "How the maps are read", "The INS"

Recording = Annotated[Path, typer.Option("--recording", metavar="FILE", help="Recording: .csv or .parquet.")]
Maps = Annotated[
    list[Path] | None,
    typer.Option("--map", metavar="FILE", help="Map: any GDAL raster or NetCDF/GMT grid. Repeatable."),
]
MapKinds = Annotated[
    list[str] | None,
    typer.Option(
        "--map-kind",
        metavar="KIND",
        rich_help_panel=MAP_PANEL,
        help="terrain (default), bathymetry, gravity or magnetic; once for all maps, or one for each in their order.",
    ),
]
MapSigmas = Annotated[
    list[float] | None,
    typer.Option(
        "--map-sigma", metavar="S", rich_help_panel=MAP_PANEL, help="1-sigma error of the map, in the kind's unit."
    ),
]
MapCorrelations = Annotated[
    list[float] | None,
    typer.Option(
        "--map-correlation",
        metavar="M",
        rich_help_panel=MAP_PANEL,
        help="Correlation length of the map's error, in m; 2.5 cells unless given.",
    ),
]
MapCrs = Annotated[
    list[str] | None,
    typer.Option(
        "--map-crs", metavar="CRS", rich_help_panel=MAP_PANEL, help="For a file that states none: EPSG:32633."
    ),
]
MapVariables = Annotated[
    list[str] | None,
    typer.Option("--map-variable", metavar="NAME", rich_help_panel=MAP_PANEL, help="NetCDF variable or raster band."),
]
MapUnits = Annotated[
    list[str] | None,
    typer.Option("--map-unit", metavar="UNIT", rich_help_panel=MAP_PANEL, help="Unit of the values, such as ft."),
]
Ins = Annotated[
    str,
    typer.Option(
        "--ins",
        metavar="INS",
        rich_help_panel=INS_PANEL,
        help="What the estimators are told of the INS, instead of what the recording says: navigation, tactical, "
        "industrial; or initial sigma in m, velocity sigma in m/s, walk in m/sqrt(s), such as 500,0.5,1; or a .toml "
        "file with a table \\[ins].",
    ),
]
Drift = Annotated[
    str,
    typer.Option(
        "--drift",
        metavar="INS",
        rich_help_panel=INS_PANEL,
        help="Make a test of a recording whose position is true: add the error of such an INS (spelled as for --ins).",
    ),
]
DriftSeed = Annotated[
    int, typer.Option("--drift-seed", metavar="N", rich_help_panel=INS_PANEL, help="Which drift to draw.")
]
Seed = Annotated[int, typer.Option("--seed", metavar="N", help="Same seed, same bits.")]
Out = Annotated[
    Path | None,
    typer.Option("--out", metavar="DIR", help="Write the results, pictures and an HTML report into this folder."),
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")]
Since = Annotated[float, typer.Option("--since", metavar="S", help="Leave the first S seconds out of the figures.")]
First = Annotated[
    float | None, typer.Option("--first", metavar="S", help="Use only the first S seconds of the recording.")
]
OptionalRecording = Annotated[
    Path | None, typer.Option("--recording", metavar="FILE", help="Recording: .csv or .parquet.")
]
OptionalSeed = Annotated[
    int | None, typer.Option("--seed", metavar="N", help="Same seed, same bits; the scenario's own unless given.")
]
