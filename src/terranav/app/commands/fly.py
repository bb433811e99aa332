"""terranav fly: an aircraft without GNSS to try live mode on."""

from __future__ import annotations

import contextlib
import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from terranav.app.commands import options

if TYPE_CHECKING:
    from terranav.live.testbed.flight import Flight
    from terranav.maps.map import Map

_GNSS, _VEHICLE = "GNSS and its troubles", "The vehicle"


@options.reads_maps
def fly(
    *,
    maps: options.Maps = None,
    minutes: Annotated[float, typer.Option(metavar="MIN", help="How long.")] = 20.0,
    outs: Annotated[
        list[str] | None,
        typer.Option(
            "--out",
            metavar="LINK",
            help="Where the vehicle speaks MAVLink, and listens: udpout:HOST:PORT, udpin:[HOST:]PORT, tcp:HOST:PORT, "
            "tcpin:[HOST:]PORT or serial:DEVICE[:BAUD]. Repeatable; udpout:127.0.0.1:14550 unless given.",
        ),
    ] = None,
    speed: Annotated[float, typer.Option(metavar="X", help="Times real time; 0 is as fast as it goes.")] = 1.0,
    wait: Annotated[bool, typer.Option("--wait", help="Take off when somebody is connected on every link.")] = False,
    seed: options.Seed = 0,
    record: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Write the truth (truth.csv, a recording) and what was sent (telemetry.tlog)."
        ),
    ] = None,
    gnss_off: Annotated[
        float | None,
        typer.Option(
            metavar="S", rich_help_panel=_GNSS, help="GNSS is lost; at 120 s, or never where it is jammed or spoofed."
        ),
    ] = None,
    jam_at: Annotated[
        float | None,
        typer.Option(metavar="S", rich_help_panel=_GNSS, help="GNSS is jammed: noisy, and 12 s later gone."),
    ] = None,
    spoof_at: Annotated[
        float | None, typer.Option(metavar="S", rich_help_panel=_GNSS, help="GNSS is pulled away from here on.")
    ] = None,
    spoof_mps: Annotated[float, typer.Option(metavar="V", rich_help_panel=_GNSS, help="How fast, in m/s.")] = 2.0,
    autopilot: Annotated[
        str,
        typer.Option(
            "--as",
            metavar="WHAT",
            rich_help_panel=_VEHICLE,
            help="px4 or ardupilot: what it sends, and which fixes it takes.",
        ),
    ] = "px4",
    reports: Annotated[
        str,
        typer.Option(
            metavar="WHAT", rich_help_panel=_VEHICLE, help="own (what its filter knows) or ins (its INS, uncorrected)."
        ),
    ] = "own",
    ins: Annotated[
        str,
        typer.Option(
            metavar="INS",
            rich_help_panel=_VEHICLE,
            help="Its INS: navigation, tactical, industrial, three numbers or a .toml file, as for terranav run; by "
            "default a calibrated one that drifts by 1 to 3 km in 18 minutes.",
        ),
    ] = "",
    clearance: Annotated[
        float,
        typer.Option(metavar="M", rich_help_panel=_VEHICLE, help="Planned height above the highest ground nearby."),
    ] = 150.0,
    wind: Annotated[float, typer.Option(metavar="V", rich_help_panel=_VEHICLE, help="Mean wind, in m/s.")] = 5.0,
    system: Annotated[int, typer.Option(metavar="ID", rich_help_panel=_VEHICLE, help="Its MAVLink system.")] = 1,
    sign_key: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            rich_help_panel=_VEHICLE,
            help="Key of 32 bytes, raw or hexadecimal: sign what is sent, refuse what is not signed. The date of the "
            "flight is then today's.",
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
    map_options: options.MapOptions,
) -> int:
    """Fly a small aircraft over real terrain behind a MAVLink front; GNSS is lost on the way, and fixes are welcome."""
    import asyncio

    from terranav.app.console import OK, STOPPED, show_json
    from terranav.app.given import ins_from
    from terranav.core.checks import finite
    from terranav.live.signing import read_key
    from terranav.live.testbed.flight import Flight
    from terranav.live.testbed.front import Front, addresses
    from terranav.live.testbed.settings import FlightSettings

    links = addresses(outs or ["udpout:127.0.0.1:14550"])
    told: dict[str, Any] = {
        "minutes": minutes, "seed": seed, "autopilot": autopilot, "reports": reports, "clearance_m": clearance,
        "wind_mps": wind, "system_id": system, "spoof_mps": spoof_mps,
        "jam_at_s": math.inf if jam_at is None else jam_at,
        "spoof_at_s": math.inf if spoof_at is None else spoof_at,
    }  # fmt: skip
    troubled = jam_at is not None or spoof_at is not None
    told["gnss_off_s"] = (math.inf if troubled else 120.0) if gnss_off is None else gnss_off
    if ins:
        told["grade"] = ins_from("--ins", ins)
    if sign_key is not None:
        told |= {"sign_key": read_key(sign_key), "start_us": time.time_ns() // 1000}
    settings = FlightSettings(**told)
    finite("speed", speed, minimum=0.0, maximum=10_000.0)
    folder = _folder(record)
    flight = Flight(_ground(maps or (), map_options), settings, record=folder is not None)
    status = _Status(flight)
    with contextlib.ExitStack() as files:
        stream = None if folder is None else files.enter_context((folder / "telemetry.tlog").open("wb"))
        front = Front(flight, links, speed=speed, tlog=stream)
        stopped = False
        try:
            asyncio.run(front.run(status, wait=wait))
        except KeyboardInterrupt:
            stopped = True
        finally:
            status.clear()
    written = {} if folder is None else _written(flight, folder)
    facts = flight.facts()
    if as_json:
        show_json({**facts, "stopped": stopped, "files": written})
    else:
        _show(flight, facts, written)
    return STOPPED if stopped else OK


def _folder(record: Path | None) -> Path | None:
    """The folder of --record, made and tried."""
    from terranav.app.given import folder_for
    from terranav.core.errors import ConfigError

    try:
        return folder_for(record)
    except ConfigError as error:
        raise ConfigError(str(error).replace("--out", "--record", 1)) from None


def _ground(paths: Sequence[Path], map_options: options.MapOptions) -> Map:
    """The one map that is flown over; the sample unless another is given."""
    from terranav.app.given import open_maps
    from terranav.core.errors import ConfigError
    from terranav.maps.sample_dem import sample_map

    if len(paths) > 1:
        raise ConfigError(f"--map is given {len(paths)} times, expected one map of terrain to fly over")
    return open_maps(paths, map_options)[0] if paths else sample_map()


def _written(flight: Flight, folder: Path) -> dict[str, str]:
    """Write the truth; the files by what they are."""
    from terranav.io.recordings import write_recording

    if flight.time_us:
        write_recording(flight.recording(), folder / "truth.csv")
    return {"truth": str(folder / "truth.csv"), "telemetry": str(folder / "telemetry.tlog")}


class _Status:
    """How it goes, on stderr: one line that is written over on a terminal, else one a minute of flight."""

    def __init__(self, flight: Flight) -> None:
        self._flight, self._shown, self._next_us, self._next_s = flight, 0, 60_000_000, 0.0

    def __call__(self) -> None:
        """After a tick."""
        if sys.stderr.isatty():
            if time.monotonic() >= self._next_s:
                self._next_s = time.monotonic() + 0.5
                text = self._text()[:118]
                sys.stderr.write("\r" + text.ljust(self._shown))
                sys.stderr.flush()
                self._shown = len(text)
        elif self._flight.time_us >= self._next_us:
            self._next_us += 60_000_000
            sys.stderr.write(self._text() + "\n")

    def _text(self) -> str:
        from terranav.app.words import distance, duration

        now = self._flight.facts()
        without = f", without fixes {distance(now['without_fixes_last_m'])}" if now["fixes_used"] else ""
        gnss = "on" if now["gnss"] else "off"
        return (
            f"{duration(now['flown_s'])}: own position {distance(now['own_last_m'])} off{without}; "
            f"{distance(now['off_track_last_m'])} beside the track; GNSS {gnss}; fixes {now['fixes_used']} used, "
            f"{now['fixes_rejected']} rejected"
        )

    def clear(self) -> None:
        """Take the line away."""
        if self._shown:
            sys.stderr.write("\r" + " " * self._shown + "\r")
            sys.stderr.flush()
            self._shown = 0


def _show(flight: Flight, facts: dict[str, Any], written: dict[str, str]) -> None:
    """The summary, and the verdict in one line."""
    from terranav.app.console import show, show_pairs
    from terranav.app.words import distance, duration

    told = flight.settings
    lost = f"GNSS for {duration(told.gnss_off_s)}" if math.isfinite(told.gnss_off_s) else "GNSS to the end"
    if math.isfinite(told.jam_at_s):
        lost += f", jammed after {duration(told.jam_at_s)}"
    if math.isfinite(told.spoof_at_s):
        lost += f", pulled away at {told.spoof_mps:g} m/s after {duration(told.spoof_at_s)}"
    heard = ", ".join(f"{count} {name}" for name, count in sorted(facts["heard"].items())) or "nothing"
    low = facts["lowest_m"]
    ground = (
        f"lowest {distance(low)} above the ground" if low > 0.0 else "INTO THE GROUND: a real one would have crashed"
    )
    show_pairs([
        ("flown", f"{duration(facts['flown_s'])} over {flight.chart.name}, seed {told.seed}, {lost}; {ground}"),
        ("heard", heard),
        ("fixes", f"{facts['fixes_used']} used, {facts['fixes_rejected']} rejected, {facts['fix_resets']} resets"),
        *written.items(),
    ])  # fmt: skip
    show(f"\n{verdict(facts)}")


def verdict(facts: dict[str, Any]) -> str:
    """One line: how far off the vehicle was, with the fixes and without."""
    from terranav.app.words import distance

    track = f"within {distance(facts['off_track_p95_m'])} of the planned track"
    own = f"own position wrong by {distance(facts['own_p95_m'])} (95 %), {distance(facts['own_last_m'])} at the end"
    if not facts["fixes_used"]:
        return f"without fixes: {own}; {track}"
    without = f"{distance(facts['without_fixes_p95_m'])}, {distance(facts['without_fixes_last_m'])}"
    return f"with fixes: {own} (without: {without}); {track}"
