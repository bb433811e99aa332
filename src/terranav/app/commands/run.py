"""terranav run: one estimator over one recording."""

from __future__ import annotations

from typing import Annotated

import typer

from terranav.app.commands import options


@options.reads_maps
def run(
    context: typer.Context,
    *,
    recording: options.Recording,
    maps: options.Maps = None,
    estimator: Annotated[str, typer.Option(metavar="NAME", help="See `terranav estimators`.")] = "marginalized",
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="A setting of the estimator. Repeatable."),
    ] = None,
    smooth: Annotated[
        bool,
        typer.Option(
            "--smooth", help="Also smooth: every epoch in the light of all readings (marginalized, pointmass)."
        ),
    ] = False,
    seed: options.Seed = 0,
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
    """Run one estimator over a recording, beside the INS alone, and say how well it did."""
    from terranav.app.flying import Wanted, conclude, fly, with_baseline
    from terranav.app.given import Given, folder_for, settings_from
    from terranav.app.mapping import geoids_from

    grids = geoids_from(geoid or ())
    given = Given(recording, maps or (), map_options, ins, drift, drift_seed, first)
    asked = _smoothed(estimator) if smooth else estimator
    wanted = Wanted(folder_for(out), as_json, since, context.obj, asked, smooth)
    methods = with_baseline([estimator], settings_from(settings or ()))
    return conclude(fly(*given.read(), methods=methods, seed=seed, wanted=wanted, geoid=grids), wanted)


def _smoothed(estimator: str) -> str:
    """Name of the smoothed result, once it is known that there can be one."""
    from terranav.experiment.smooth import check_smoothed, smoothed_name

    check_smoothed(estimator)
    return smoothed_name(estimator)
