"""terranav locate: where on a whole map was this recorded?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from terranav.app.commands import options


def locate(
    given: Annotated[Path | None, typer.Argument(metavar="RECORDING", help="Recording: .csv or .parquet.")] = None,
    *,
    recording: options.OptionalRecording = None,
    maps: options.Maps = None,
    first: options.First = None,
    span: Annotated[
        str, typer.Option("--span", metavar="FROM,TO", help="Use only these seconds; one left out is the end: 600,.")
    ] = "",
    heading_sigma: Annotated[
        str,
        typer.Option(metavar="DEG", help="1-sigma of the heading, or unknown; by default what the INS lets expect."),
    ] = "",
    scale_sigma: Annotated[
        str, typer.Option(metavar="PERCENT", help="1-sigma of lengths along the track; by default likewise.")
    ] = "",
    offset_sigma: Annotated[
        str, typer.Option(metavar="M", help="1-sigma of the offset common to all readings, or unknown.")
    ] = "unknown",
    sigma: Annotated[
        float | None, typer.Option(metavar="S", help="1-sigma of a reading, instead of what the recording says.")
    ] = None,
    certain: Annotated[float, typer.Option(metavar="P", help="Probability that counts as found.")] = 0.99,
    most_places: Annotated[
        int, typer.Option(metavar="N", help="The search stops where more cells and headings fit; more takes longer.")
    ] = 20_000,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder for the picture and the JSON.")] = None,
    as_json: options.Json = False,
    ins: options.Ins = "",
    drift: options.Drift = "",
    drift_seed: options.DriftSeed = 0,
    map_kind: options.MapKinds = None,
    map_sigma: options.MapSigmas = None,
    map_correlation: options.MapCorrelations = None,
    map_crs: options.MapCrs = None,
    map_variable: options.MapVariables = None,
    map_unit: options.MapUnits = None,
) -> int:
    """Find a profile of a minute or more anywhere on a map, without any prior position; say whether it is the one."""
    from terranav.app.console import INCOMPLETE, OK, show_json, working
    from terranav.app.given import Given, folder_for, open_maps
    from terranav.app.locating import Typed, facts, looked_for, one_map, show_search
    from terranav.core.errors import ConfigError

    path = given or recording
    if path is None or (given is not None and recording is not None):
        raise ConfigError(f"RECORDING is given {'twice' if path else 'not at all'}, expected one file")
    map_options = {
        "kind": map_kind, "sigma": map_sigma, "correlation": map_correlation, "crs": map_crs,
        "variable": map_variable, "unit": map_unit,
    }  # fmt: skip
    folder = folder_for(out)
    rec, _, told = Given(path, (), {}, ins, drift, drift_seed, first).read()
    chart = one_map(open_maps(maps or (), map_options))
    typed = Typed(span, heading_sigma, scale_sigma, offset_sigma, sigma, certain, most_places)
    with working("looking everywhere"):
        search = looked_for(rec, chart, told, typed)
    files: dict[str, str] = {}
    if folder is not None:
        from terranav.app.console import as_json as text_of
        from terranav.app.locate_figure import locate_picture
        from terranav.app.style import png

        (folder / "locate.png").write_bytes(png(locate_picture(search)))
        (folder / "locate.json").write_text(text_of(facts(search)) + "\n", encoding="utf-8")
        files = {"picture": str(folder / "locate.png"), "JSON": str(folder / "locate.json")}
    if as_json:
        show_json({**facts(search), "files": files})
    else:
        show_search(search, files)
    return OK if search.found.complete else INCOMPLETE
