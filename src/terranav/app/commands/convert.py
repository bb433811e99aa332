"""terranav convert: any table made a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from terranav.app.commands import options


def convert(
    table: Annotated[Path, typer.Argument(metavar="TABLE", help="Survey, cruise or log: any delimited text.")],
    columns: Annotated[Path, typer.Option(metavar="FILE", help="Columns file (.toml): names, units, time, signs.")],
    out: Annotated[Path, typer.Option(metavar="FILE", help="The recording to write: .csv or .parquet.")],
    as_json: options.Json = False,
) -> int:
    """Turn a table into a recording."""
    from terranav.app.console import OK, show_json, show_pairs, working
    from terranav.app.listing import recording_facts, recording_pairs
    from terranav.io.recordings import write_recording
    from terranav.io.tables import convert_table

    with working(f"reading {table.name}"):
        rec = convert_table(table, columns)
        write_recording(rec, out)
    if as_json:
        show_json({**recording_facts(rec), "file": str(out)})
    else:
        show_pairs([*recording_pairs(rec), ("written to", str(out))])
    return OK
