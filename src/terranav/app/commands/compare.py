"""terranav compare: several estimators over the same epochs, of a recording or of a scenario."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from terranav.app.commands import options


@options.reads_maps
def compare(
    context: typer.Context,
    *,
    scenario: Annotated[
        Path | None, typer.Argument(metavar="[SCENARIO.toml]", help="Simulate this flight instead of --recording.")
    ] = None,
    recording: options.OptionalRecording = None,
    maps: options.Maps = None,
    estimator: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Repeatable; the scenario's, or all of them, unless given."),
    ] = None,
    seed: options.OptionalSeed = None,
    out: options.Out = None,
    as_json: options.Json = False,
    since: options.Since = 0.0,
    first: options.First = None,
    ins: options.Ins = "",
    drift: options.Drift = "",
    drift_seed: options.DriftSeed = 0,
    geoid: options.Geoids = None,
    map_options: options.MapOptions,
) -> int:
    """Run several estimators over the same epochs and show them side by side."""
    from terranav.app.flying import Wanted, conclude, fly, fly_scenario, with_baseline
    from terranav.app.given import Given, folder_for
    from terranav.app.mapping import geoids_from
    from terranav.core.errors import ConfigError
    from terranav.experiment.registry import estimators

    grids = geoids_from(geoid or ())
    if scenario is not None and recording is None:
        from terranav.experiment.scenario import Scenario

        unused: dict[str, object] = {"--map": maps, "--geoid": geoid, "--ins": ins, "--drift": drift, "--first": first}
        unused |= {f"--map-{key}": values for key, values in map_options.items()}
        for option, value in unused.items():
            if value:
                raise ConfigError(f"{option} goes with --recording, but {scenario} says it itself; expected it there")
        flight = Scenario.from_toml(scenario)
        wanted = Wanted(folder_for(out), as_json, since, context.obj)
        return conclude(fly_scenario(flight, estimator or [], seed, wanted), wanted)
    if recording is None or scenario is not None:
        raise ConfigError("compare needs a scenario file or --recording FILE, and not both")
    wanted = Wanted(folder_for(out), as_json, since, context.obj)
    given = Given(recording, maps or (), map_options, ins, drift, drift_seed, first)
    methods = with_baseline(estimator or estimators())
    return conclude(fly(*given.read(), methods=methods, seed=seed or 0, wanted=wanted, geoid=grids), wanted)
