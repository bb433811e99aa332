"""terranav doctor: is all there that live navigation needs, and what must be set?"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from terranav.app.commands import options

if TYPE_CHECKING:
    from terranav.live.doctor import Finding


@options.reads_maps
def doctor(
    *,
    links: Annotated[
        list[str] | None, typer.Option("--in", metavar="LINK", help="As for terranav live. Repeatable.")
    ] = None,
    maps: options.Maps = None,
    seconds: Annotated[float, typer.Option(metavar="S", help="How long to listen.")] = 10.0,
    by: Annotated[
        str, typer.Option(metavar="WAY", help="As for terranav live: velocity, position or airspeed.")
    ] = "velocity",
    system: Annotated[
        int | None, typer.Option(metavar="ID", help="MAVLink system to hear; else the first one.")
    ] = None,
    sign_key: Annotated[Path | None, typer.Option(metavar="FILE", help="Hear only what is signed with it.")] = None,
    as_json: options.Json = False,
    geoid: options.Geoids = None,
    map_options: options.MapOptions,
) -> int:
    """Check the link, message rates, altimeter, clocks, map cover, datum and autopilot; say what to set."""
    import asyncio

    from terranav.app.given import open_maps
    from terranav.app.mapping import geoids_from
    from terranav.live.doctor import examined
    from terranav.live.links import inputs
    from terranav.live.plan import Plan
    from terranav.live.settings import LiveSettings
    from terranav.live.signing import read_key

    plan = Plan(inputs(links or ()), stop_after_s=seconds, key=None if sign_key is None else read_key(sign_key))
    settings = LiveSettings(ins_source=by, system_id=system, geoid=geoids_from(geoid or ()) or None)
    charts = open_maps(maps or (), map_options)
    return told(asyncio.run(examined(plan, settings, charts)), as_json=as_json)


def told(found: Sequence[Finding], *, as_json: bool) -> int:
    """Show the findings; 0 where nothing is missing, 1 otherwise."""
    from terranav.app.console import INCOMPLETE, OK, show, show_json

    missing = any(one.state == "missing" for one in found)
    if as_json:
        rows = [{"name": one.name, "state": one.state, "text": one.text, "advice": one.advice} for one in found]
        show_json({"ready": not missing, "findings": rows})
        return INCOMPLETE if missing else OK
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for head in ("", "", "found", "what to do"):
        table.add_column(head, overflow="fold")
    colours = {"ok": "green", "warning": "yellow", "missing": "red"}
    for one in found:
        table.add_row(one.name, f"[{colours[one.state]}]{one.state}[/]", one.text, one.advice)
    show(table)
    warnings = sum(one.state == "warning" for one in found)
    show("not ready" if missing else f"ready, {warnings} warnings" if warnings else "ready")
    return INCOMPLETE if missing else OK
