"""Options that several commands share: one spelling and one help text each."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

MapOptions = Mapping[str, Sequence[Any] | None]  #: as of `terranav.app.given.open_maps`
MAP_PANEL, INS_PANEL = "How the maps are read", "The INS"

Recording = Annotated[Path, typer.Option("--recording", metavar="FILE", help="Recording: .csv or .parquet.")]
Maps = Annotated[
    list[Path] | None,
    typer.Option(
        "--map",
        metavar="FILE",
        help="Map: any GDAL raster or NetCDF/GMT grid, a folder of tiles, or sample. Repeatable.",
    ),
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
MapDatums = Annotated[
    list[str] | None,
    typer.Option(
        "--map-datum",
        metavar="DATUM",
        rich_help_panel=MAP_PANEL,
        help="What the map's heights count from: EGM96, EGM2008, ellipsoid, MLLW...; wins over what the file says.",
    ),
]
Geoids = Annotated[
    list[str] | None,
    typer.Option(
        "--geoid",
        metavar="FILE",
        help="Geoid grid to bring heights from one datum to another; DATUM=FILE where it does not say which it is. "
        "Repeatable.",
    ),
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

#: how maps are read, by the keys of MapOptions
_READ: dict[str, Any] = {
    "kind": MapKinds,
    "sigma": MapSigmas,
    "correlation": MapCorrelations,
    "crs": MapCrs,
    "variable": MapVariables,
    "unit": MapUnits,
    "datum": MapDatums,
}


def reads_maps(command: Callable[..., int]) -> Callable[..., int]:
    """Give a command `--map-kind`, `--map-sigma` and so on, which reach it as its keyword `map_options`: MapOptions."""
    own = inspect.signature(command, eval_str=True)

    @functools.wraps(command)
    def with_options(*given: Any, **others: Any) -> int:
        told = {key: others.pop(f"map_{key}", None) for key in _READ}
        return command(*given, **others, map_options=told)

    kept = [each for name, each in own.parameters.items() if name != "map_options"]
    new = [
        inspect.Parameter(f"map_{key}", inspect.Parameter.KEYWORD_ONLY, default=None, annotation=option)
        for key, option in _READ.items()
    ]
    with_options.__signature__ = own.replace(parameters=[*kept, *new])  # type: ignore[attr-defined]
    with_options.__annotations__ = {each.name: each.annotation for each in (*kept, *new)}
    return with_options
