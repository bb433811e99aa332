"""terranav reproduce: the papers' studies run again, the papers' figures beside ours."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from terranav.app.commands import options


def reproduce(
    context: typer.Context,
    paper: Annotated[
        list[str] | None, typer.Argument(metavar="[000..004|all]...", help="Number of a paper, several, or all.")
    ] = None,
    *,
    runs: Annotated[int, typer.Option(metavar="N", help="Monte Carlo runs of each case, at least 2.")] = 50,
    seed: options.Seed = 0,
    maps: Annotated[
        list[Path] | None,
        typer.Option("--map", metavar="FILE", help="Use this map in place of the papers' default ones. Repeatable."),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(metavar="N", help="How much runs at the same time; one a core unless given. Same figures."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Write tables, figures, their data and an HTML summary into this folder; terranav-reproduce for 'all' "
            "unless given.",
        ),
    ] = None,
    as_json: options.Json = False,
    map_kind: options.MapKinds = None,
    map_sigma: options.MapSigmas = None,
    map_crs: options.MapCrs = None,
    map_variable: options.MapVariables = None,
    map_unit: options.MapUnits = None,
) -> int:
    """Run the studies of the five papers again: their figures beside ours, and a verdict on every claim."""
    from terranav.app.given import folder_for, open_maps
    from terranav.app.reproducing import DEFAULT_FOLDER, Task, chosen, conclude
    from terranav.core.checks import finite
    from terranav.core.errors import ConfigError
    from terranav.experiment.montecarlo import Threads
    from terranav.experiment.papers.outcome import Setup

    wanted = paper or ["all"]
    numbers = chosen(wanted)
    count = int(finite("--runs", runs, minimum=2))
    first_seed = int(finite("--seed", seed, minimum=0))
    at_once = (os.cpu_count() or 1) if workers is None else int(finite("--workers", workers, minimum=1))
    processes = min(len(numbers), at_once)
    map_options = {
        "kind": map_kind, "sigma": map_sigma, "crs": map_crs, "variable": map_variable, "unit": map_unit
    }  # fmt: skip
    idle = [key for key, values in map_options.items() if values and not maps]
    if idle:
        raise ConfigError(f"--map-{idle[0]} is given without --map, expected the map that it is about")
    setup = Setup(count, first_seed, open_maps(maps or (), map_options), Threads(at_once // processes))
    folder = folder_for(Path(DEFAULT_FOLDER) if out is None and "all" in wanted else out)
    return conclude(Task(numbers, setup, folder, as_json, context.obj, processes))
