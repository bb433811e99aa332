"""What files and estimators are, for `map info`, `convert`, `simulate`, `estimators` and the notebook."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from terranav.app.words import coordinate, distance, duration, number

if TYPE_CHECKING:
    from rich.table import Table as RichTable

    from terranav.core.recording import Recording


def recording_facts(rec: Recording) -> dict[str, Any]:
    """What is in a recording."""
    readings = {key: int(np.isfinite(rec.columns[key]).sum()) for key in rec.readings}
    return {
        "name": rec.name,
        "epochs": len(rec),
        "duration_s": float(rec.time_s[-1] - rec.time_s[0]),
        "readings": readings,
        "has_truth": rec.has_truth,
        "ins": None if rec.ins is None else vars(rec.ins),
        "south_deg": float(rec.lat_deg.min()),
        "west_deg": float(rec.lon_deg.min()),
        "north_deg": float(rec.lat_deg.max()),
        "east_deg": float(rec.lon_deg.max()),
        "source": dict(rec.source),
    }


def recording_pairs(rec: Recording) -> list[tuple[str, str]]:
    """The same in words."""
    facts = recording_facts(rec)
    readings = ", ".join(f"{key} ({count})" for key, count in facts["readings"].items()) or "none"
    pairs = [
        ("recording", f"{rec.name}: {len(rec)} epochs, {duration(facts['duration_s'])}"),
        ("readings", readings),
        ("extent", extent(facts["south_deg"], facts["west_deg"], facts["north_deg"], facts["east_deg"])),
        ("truth", "known" if rec.has_truth else "not known"),
    ]
    if rec.ins is not None:
        pairs.append(("INS", ", ".join(f"{key} {value}" for key, value in vars(rec.ins).items() if value)))
    return pairs


def map_pairs(facts: Mapping[str, Any]) -> list[tuple[str, str]]:
    """`Map.info` in words."""
    unit, box = facts["unit"], facts["extent_deg"]
    return [
        ("map", f"{facts['name']}: {facts['kind']} [{unit}], sigma {facts['sigma']:g} {unit}"),
        ("grid", f"{facts['rows']} x {facts['cols']} cells of {distance(facts['cell_m'])}, {facts['crs']}"),
        ("extent", extent(box["south"], box["west"], box["north"], box["east"])),
        ("values", f"{facts['min']:g} to {facts['max']:g} {unit}, mean {number(facts['mean'], 4)}"),
        (
            "roughness",
            f"{number(facts['roughness'], 3)} {unit} from cell to cell, std {number(facts['std'], 3)} {unit}",
        ),
        ("voids", f"{facts['voids']} cells ({100 * facts['void_fraction']:.1f} %)"),
        ("datum", facts["datum"] or "not stated"),
        ("source", facts["source"] or "not stated"),
        *[("suspicious", text) for text in facts["suspicious"]],
    ]


def extent(south: float, west: float, north: float, east: float) -> str:
    """A box of latitudes and longitudes in words."""
    return (
        f"{coordinate(south, 'N', 'S', 4)} to {coordinate(north, 'N', 'S', 4)}, "
        f"{coordinate(west, 'E', 'W', 4)} to {coordinate(east, 'E', 'W', 4)}"
    )


def described_estimators() -> list[dict[str, str]]:
    """Each estimator's name and the first sentence of its module."""
    from importlib.util import find_spec

    from terranav.experiment.registry import estimators

    found = []
    for name in estimators():
        spec = next(spec for home in ("filters", "matchers") if (spec := find_spec(f"terranav.{home}.{name}")))
        found.append({"name": name, "about": _summary(spec.origin)})
    return found


def estimators_table(found: Sequence[Mapping[str, str]]) -> RichTable:
    """The estimators as a table for the terminal."""
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("estimator", no_wrap=True, style="bold")
    table.add_column("what it is")
    for entry in found:
        table.add_row(entry["name"], entry["about"])
    return table


def _summary(path: str | None) -> str:
    """First line of a module's docstring, without importing the module."""
    import ast
    from pathlib import Path

    text = ast.get_docstring(ast.parse(Path(path).read_text(encoding="utf-8"))) if path else None
    return text.splitlines()[0] if text else ""
