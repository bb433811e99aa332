"""terranav live: hear a vehicle, match its terrain with a map, send it the fix."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from terranav.app.commands import options

_SEND, _WRITE, _RECKON = "What is sent", "What is written", "How the vehicle is reckoned"


@options.reads_maps
def live(
    *,
    links: Annotated[
        list[str] | None,
        typer.Option(
            "--in",
            metavar="LINK",
            help="udpin:[HOST:]PORT, udpout:HOST:PORT, tcp:HOST:PORT, tcpin:[HOST:]PORT, serial:DEVICE[:BAUD] or "
            "file:PATH; MAVLink or NMEA, what comes in tells. Repeatable.",
        ),
    ] = None,
    maps: options.Maps = None,
    outs: Annotated[
        list[str] | None,
        typer.Option(
            "--out",
            metavar="LINK",
            rich_help_panel=_SEND,
            help="back (over the link the vehicle is heard on), a MAVLink link as for --in, nmea+LINK, json:PATH or "
            "json:-, json+udpout:HOST:PORT, ws:[HOST:]PORT. Repeatable; nothing is sent without.",
        ),
    ] = None,
    send: Annotated[
        str,
        typer.Option(
            metavar="WHAT",
            rich_help_panel=_SEND,
            help="px4, ardupilot, gps-input or reset; by default what the autopilot's heartbeat asks for.",
        ),
    ] = "auto",
    rate: Annotated[
        float | None,
        typer.Option(
            metavar="HZ",
            rich_help_panel=_SEND,
            help="Most fixes a second; else 1 for px4 and NMEA, 5 for ardupilot and gps-input, 0.1 for reset.",
        ),
    ] = None,
    max_age: Annotated[
        float, typer.Option(metavar="S", rich_help_panel=_SEND, help="Older measurements are not sent.")
    ] = 1.0,
    correlation: Annotated[
        float,
        typer.Option(
            metavar="S",
            rich_help_panel=_SEND,
            help="How long fixes err alike: each claims so much less that a filter does not count one error twice. 0 "
            "sends the sigma as it is.",
        ),
    ] = 10.0,
    sign_key: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            rich_help_panel=_SEND,
            help="Key of 32 bytes, raw or hexadecimal: sign what is sent, refuse what is not signed.",
        ),
    ] = None,
    record: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            rich_help_panel=_WRITE,
            help="Write all that comes in, every fix, and checkpoints; goes on with the run that is there.",
        ),
    ] = None,
    fresh: Annotated[
        bool, typer.Option("--fresh", rich_help_panel=_WRITE, help="Remove the run in --record, and begin anew.")
    ] = False,
    resume: Annotated[
        bool, typer.Option("--resume", rich_help_panel=_WRITE, help="Insist that there is a run to go on with.")
    ] = False,
    checkpoint: Annotated[
        float, typer.Option(metavar="S", rich_help_panel=_WRITE, help="Time between two checkpoints.")
    ] = 3.0,
    by: Annotated[
        str,
        typer.Option(
            metavar="WAY",
            rich_help_panel=_RECKON,
            help="velocity (of the autopilot), position (the autopilot's, where that is a free inertial one) or "
            "airspeed (and heading).",
        ),
    ] = "velocity",
    start: Annotated[
        str, typer.Option(metavar="LAT,LON", rich_help_panel=_RECKON, help="Where it starts; else where it says it is.")
    ] = "",
    wind: Annotated[
        str, typer.Option(metavar="N,E", rich_help_panel=_RECKON, help="Wind towards north, east in m/s, for airspeed.")
    ] = "0,0",
    system: Annotated[
        int | None,
        typer.Option(metavar="ID", rich_help_panel=_RECKON, help="MAVLink system to hear; else the first one."),
    ] = None,
    ins: options.Ins = "",
    sigmas: Annotated[
        list[str] | None,
        typer.Option(
            "--sigma",
            metavar="NAME=M",
            rich_help_panel=_RECKON,
            help="1-sigma of radar_altitude_m, laser_altitude_m, baro_altitude_m or depth_m. Repeatable.",
        ),
    ] = None,
    monitor: Annotated[
        bool,
        typer.Option(
            "--monitor",
            help="Watch GNSS too: say when it is spoofed or jammed. Best --by airspeed, or --by position of a free "
            "inertial one: an autopilot's velocity follows the GNSS that it fuses.",
        ),
    ] = False,
    estimator: Annotated[str, typer.Option(metavar="NAME", help="Method; see: terranav estimators.")] = "marginalized",
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Setting of the estimator. Repeatable."),
    ] = None,
    epochs: Annotated[float, typer.Option("--epochs", metavar="HZ", help="Most epochs a second.")] = 10.0,
    speed: Annotated[
        float, typer.Option(metavar="X", help="Of a file: 1 as it was recorded, 10, 0 as fast as it goes.")
    ] = 1.0,
    seconds: Annotated[float | None, typer.Option(metavar="S", help="Stop after so long.")] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Only check link, rates, map, datum and autopilot, as terranav doctor does.")
    ] = False,
    seed: options.Seed = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
    geoid: options.Geoids = None,
    map_options: options.MapOptions,
) -> int:
    """Hear a vehicle, match its terrain with a map, send it the fix; Ctrl-C ends the run, and everything is written."""
    from terranav.app.given import open_maps, settings_from
    from terranav.app.living import Told, check_once, fly_live, sigmas_from
    from terranav.app.mapping import geoids_from
    from terranav.live.links import inputs, outputs
    from terranav.live.plan import Plan
    from terranav.live.signing import read_key

    told = Told(by, ins, start, wind, system, estimator, settings_from(settings or ()), seed, epochs,
                sigmas_from(sigmas or ()), geoids_from(geoid or ()), monitor)  # fmt: skip
    plan = Plan(
        inputs(links or ()),
        () if check else outputs(outs or ()),
        send=None if send == "auto" else send,
        folder=None if check else record,
        fresh=fresh,
        speed=speed,
        max_age_s=max_age,
        rate_hz=rate,
        correlation_s=correlation,
        checkpoint_s=checkpoint,
        key=None if sign_key is None else read_key(sign_key),
        stop_after_s=seconds,
    )
    plan.check_resume(resume)
    charts = open_maps(maps or (), map_options)
    if check:
        return check_once(plan, told.settings(), charts, as_json=as_json)
    return fly_live(plan, told.settings(), charts, as_json=as_json)
