"""terranav monitor: is the GNSS of a recording or a log to be believed?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from terranav.app.commands import options

if TYPE_CHECKING:
    from terranav.core.recording import Recording


@options.reads_maps
def monitor(
    log: Annotated[Path | None, typer.Argument(metavar="LOG", help="Log of an autopilot or a receiver.")] = None,
    *,
    recording: options.OptionalRecording = None,
    maps: options.Maps = None,
    estimator: Annotated[str, typer.Option(metavar="NAME", help="See `terranav estimators`.")] = "marginalized",
    gnss_sigma: Annotated[float, typer.Option(metavar="M", help="1-sigma of GNSS per horizontal axis, in m.")] = 3.0,
    rate: Annotated[
        float, typer.Option(metavar="R", help="False alarms per flight hour for which the limits are set.")
    ] = 1e-3,
    pull: Annotated[float, typer.Option(metavar="MPS", help="What if: pull GNSS away at this speed, in m/s.")] = 0.0,
    pull_at: Annotated[
        float | None, typer.Option(metavar="S", help="From this time of the recording on; its middle unless given.")
    ] = None,
    pull_towards: Annotated[float, typer.Option(metavar="DEG", help="Towards there, clockwise from north.")] = 90.0,
    seed: options.Seed = 0,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder for the picture and the JSON.")] = None,
    as_json: options.Json = False,
    ins: options.Ins = "",
    drift: options.Drift = "",
    drift_seed: options.DriftSeed = 0,
    by: Annotated[
        str,
        typer.Option(
            metavar="WAY",
            rich_help_panel=options.INS_PANEL,
            help="How a log is navigated: velocity, airspeed, position, imu or drift; by default what GNSS had the "
            "least part in.",
        ),
    ] = "auto",
    ground_vehicle: Annotated[
        bool,
        typer.Option(
            "--ground-vehicle", help="LOG is of a car or a boat: its barometer tells the height of the terrain."
        ),
    ] = False,
    first: options.First = None,
    map_options: options.MapOptions,
) -> int:
    """Compare GNSS with the map-aided position: consistent, suspect, spoofed, jammed or unknown, and the alarms.

    The true position of a recording is the GNSS under test; the indicated one must come from an INS without GNSS, such
    as one that --drift makes up about it. A log is navigated without GNSS as by `terranav replay`.
    """
    from terranav.app.console import OK, show_json, working
    from terranav.app.console import as_json as text_of
    from terranav.app.given import folder_for, open_maps
    from terranav.app.monitoring import Monitored, Typed, facts, read, show_monitored
    from terranav.core.checks import finite
    from terranav.core.errors import ConfigError
    from terranav.core.ins_grade import InsGrade
    from terranav.experiment.gnss import monitor_recording, pulled
    from terranav.experiment.run import run
    from terranav.integrity.gnss import GnssMonitor

    if (log is None) == (recording is None):
        raise ConfigError(f"LOG and --recording are {'both' if log else 'not'} given, expected one of them")
    folder = folder_for(out)
    speed = finite("--pull", pull, minimum=0.0)
    towards = finite("--pull-towards", pull_towards)
    finite("--gnss-sigma", gnss_sigma, above=0.0)
    charts = open_maps(maps or (), map_options)
    finest_m = min((chart.cell_m for chart in charts), default=0.0)
    with working("reading"):
        given_ins = read(log, recording, Typed(ins, drift, drift_seed, by, ground_vehicle, first), finest_m)
    rec, told = given_ins.rec, given_ins.ins
    from_s = _start(rec, pull_at)
    watcher = GnssMonitor(told or rec.ins or InsGrade(), false_alarms_per_h=rate)
    with working("flying"):
        result = run(estimator, rec, charts, seed=seed, ins=told)
        under_test = pulled(rec, speed, from_s, towards) if speed else rec
        watch = monitor_recording(under_test, result, watcher, sigma_m=gnss_sigma)
    found = Monitored(watch, result, watcher, given_ins.told, speed, from_s)
    files: dict[str, str] = {}
    if folder is not None:
        from terranav.app.monitor_figure import monitor_picture
        from terranav.app.style import png

        (folder / "monitor.png").write_bytes(png(monitor_picture(found)))
        (folder / "monitor.json").write_text(text_of(facts(found)) + "\n", encoding="utf-8")
        files = {"picture": str(folder / "monitor.png"), "JSON": str(folder / "monitor.json")}
    if as_json:
        show_json({**facts(found), "files": files})
    else:
        show_monitored(found, files)
    return OK


def _start(rec: Recording, pull_at: float | None) -> float:
    """When the pull begins, on the recording's clock."""
    from terranav.core.checks import finite

    first_s, last_s = float(rec.time_s[0]), float(rec.time_s[-1])
    if pull_at is None:
        return 0.5 * (first_s + last_s)
    return finite("--pull-at", pull_at, minimum=first_s, maximum=last_s)
