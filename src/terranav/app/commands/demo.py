"""terranav demo: a flight over real terrain that loses GNSS, with nothing to prepare."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from terranav.app.commands import options


def demo(
    context: typer.Context,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the results and the report.")] = Path(
        "terranav-demo"
    ),
    seed: options.OptionalSeed = None,
    as_json: options.Json = False,
) -> int:
    """Fly over real terrain, lose GNSS, and correct the INS from the map with several methods."""
    from terranav.app.flying import Wanted, conclude, fly_scenario
    from terranav.app.given import folder_for
    from terranav.experiment.demo import demo_scenario

    wanted = Wanted(folder_for(out), as_json, command=context.obj)
    return conclude(fly_scenario(demo_scenario(), [], seed, wanted), wanted)
