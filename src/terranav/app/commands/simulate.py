"""terranav simulate: a scenario flown, its recording written."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from terranav.app.commands import options


def simulate(
    scenario: Annotated[Path, typer.Argument(metavar="SCENARIO.toml", help="What to fly.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the recording.")],
    seed: options.OptionalSeed = None,
    file_format: Annotated[str, typer.Option("--format", metavar="csv|parquet", help="Kind of file.")] = "csv",
    as_json: options.Json = False,
) -> int:
    """Fly a scenario and write what its sensors recorded, the truth beside it."""
    from terranav.app.console import OK, show_json, show_pairs, working
    from terranav.app.given import folder_for
    from terranav.app.listing import recording_facts, recording_pairs
    from terranav.core.errors import ConfigError
    from terranav.experiment import simulate as simulation
    from terranav.experiment.scenario import Scenario
    from terranav.io.recordings import write_recording

    if file_format not in ("csv", "parquet"):
        raise ConfigError(f"--format is {file_format!r}, expected csv or parquet")
    flight = Scenario.from_toml(scenario)
    folder = folder_for(out) or out
    with working("flying"):
        rec = simulation.simulate(flight, seed=seed)
    path = folder / f"{rec.name}.{file_format}"
    write_recording(rec, path)
    if as_json:
        show_json({**recording_facts(rec), "file": str(path)})
    else:
        show_pairs([*recording_pairs(rec), ("written to", str(path))])
    return OK
