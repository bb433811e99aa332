"""terranav replay: a log flown once more, without GNSS and with a map."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from terranav.app.commands import options

_CUT, _WHEELS = "When GNSS is taken away, and what then", "A car, a boat"


@options.reads_maps
def replay(
    context: typer.Context,
    log: Annotated[
        Path,
        typer.Argument(
            metavar="LOG", help="ArduPilot .BIN, .tlog, PX4 .ulg, ROS bag, NMEA, phone CSV, or a recording."
        ),
    ],
    *,
    maps: options.Maps = None,
    gnss_off: Annotated[
        str,
        typer.Option(
            metavar="WHEN",
            rich_help_panel=_CUT,
            help="Seconds since the log began; take-off; or spans START-END,START-END. By default take-off where there "
            "is one, else the start.",
        ),
    ] = "auto",
    by: Annotated[
        str,
        typer.Option(
            metavar="WAY",
            rich_help_panel=_CUT,
            help="How it navigates then: velocity, airspeed, position, imu or drift; by default what the log has that "
            "GNSS had the least part in.",
        ),
    ] = "auto",
    drift: Annotated[
        str,
        typer.Option(
            metavar="INS",
            rich_help_panel=_CUT,
            help="Put the drift of such an INS on the true track: navigation, tactical, industrial; or initial sigma "
            "in m, velocity sigma in m/s, walk in m/sqrt(s), such as 5,0.4,0.3; or a .toml file with a table \\[ins].",
        ),
    ] = "",
    drift_nmph: Annotated[
        float | None,
        typer.Option(metavar="N", rich_help_panel=_CUT, help="The drift of an INS of N nautical miles an hour (CEP)."),
    ] = None,
    drift_seed: Annotated[int, typer.Option(metavar="N", rich_help_panel=_CUT, help="Which drift to draw.")] = 0,
    ins: options.Ins = "",
    ground_vehicle: Annotated[
        bool,
        typer.Option(
            "--ground-vehicle",
            rich_help_panel=_WHEELS,
            help="It stays on the ground: its barometer tells the height of the terrain.",
        ),
    ] = False,
    mount_height: Annotated[
        float, typer.Option(metavar="M", rich_help_panel=_WHEELS, help="Of the barometer above the ground.")
    ] = 1.0,
    estimator: Annotated[str, typer.Option(metavar="NAME", help="Method; see: terranav estimators.")] = "marginalized",
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Setting of the estimator. Repeatable."),
    ] = None,
    rate: Annotated[float, typer.Option(metavar="HZ", help="Epochs a second, at most, of a log.")] = 10.0,
    spacing: Annotated[
        float,
        typer.Option(
            metavar="CELLS",
            help="Use a reading once it has moved so much of the finest map's cell since the last; 0 uses all.",
        ),
    ] = 0.5,
    columns: Annotated[
        Path | None, typer.Option(metavar="FILE", help="LOG is a table: its columns file, as for terranav convert.")
    ] = None,
    seed: options.Seed = 0,
    out: options.Out = None,
    as_json: options.Json = False,
    geoid: options.Geoids = None,
    map_options: options.MapOptions,
) -> int:
    """Take GNSS away from a log, and say whether matching with a map would have held the position."""
    from terranav.app.console import working
    from terranav.app.given import folder_for, ins_from, open_maps, settings_from
    from terranav.app.mapping import geoids_from
    from terranav.app.replay import Typed, open_any, spans_from
    from terranav.app.replay import replay as replayed
    from terranav.core.checks import finite
    from terranav.core.errors import ConfigError
    from terranav.experiment.replay import Withheld
    from terranav.experiment.replay_ways import Flown, nautical_miles_an_hour

    if drift and drift_nmph is not None:
        raise ConfigError("--drift and --drift-nmph are both given, expected one")
    stated = ins_from("--drift", drift) if drift else None
    if drift_nmph is not None:
        stated = nautical_miles_an_hour(finite("--drift-nmph", drift_nmph, minimum=0.0))
    if stated is not None and by not in ("auto", "drift"):
        raise ConfigError(f"--by is {by!r} and a drift is given, expected one of them")
    flown = Flown(stated, drift_seed, ins_from("--ins", ins) if ins else None)
    height = finite("--mount-height", mount_height)
    withheld = Withheld(spans_from(gnss_off), by, flown, height if ground_vehicle else None)
    spacing_cells = finite("--spacing", spacing, minimum=0.0)
    told = settings_from(settings or ())
    typed = Typed(withheld, estimator, told, seed, spacing_cells, geoids_from(geoid or ()), folder_for(out), as_json,
                  context.obj)  # fmt: skip
    with working(f"reading {log.name}"):
        opened = open_any(log, rate_hz=finite("--rate", rate, above=0.0), columns=columns, imu=by == "imu")
    return replayed(opened, open_maps(maps or (), map_options), typed)
