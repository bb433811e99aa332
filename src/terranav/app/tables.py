"""The figures of each estimator as rows of text: the same table in the terminal and in the report."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from terranav.app.words import coordinate, distance, duration, number, percent

if TYPE_CHECKING:
    from rich.table import Table as RichTable

    from terranav.app.outcome import Outcome


@dataclass(frozen=True)
class Column:
    """One column: its head, what it means, and its text for one estimator."""

    head: str
    meaning: str
    text: Callable[[Outcome, str], str]


def _figure(key: str, shown: Callable[[float], str]) -> Callable[[Outcome, str], str]:
    return lambda outcome, name: shown(float(outcome.metrics(name)[key]))


def _after_fix(key: str) -> Callable[[Outcome, str], str]:
    return lambda outcome, name: distance(float(outcome.metrics_after_fix(name)[key]))


def _first_fix(outcome: Outcome, name: str) -> str:
    fix_s = outcome.first_fix_s(name)
    return duration(fix_s) if math.isfinite(fix_s) else "never"


def _position(outcome: Outcome, name: str) -> str:
    result = outcome.results[name]
    lat, lon = float(result.lat_deg[-1]), float(result.lon_deg[-1])
    return f"{coordinate(lat, 'N', 'S', 4)} {coordinate(lon, 'E', 'W', 4)}"


_FIX = (
    Column("first fix", "time until it first called itself converged", _first_fix),
    Column("lost", "time it called itself lost", _figure("lost_s", duration)),
)

BOUND = Column(
    "bound",
    "least DRMS from the first fix on that any estimator could have there (Cramer-Rao, for the readings as told)",
    _after_fix("bound_drms_m"),
)
INTEGRITY = (
    Column("HPL", "horizontal protection level: the error exceeds it with at most the declared risk; median of usable "
           "fixes", _figure("protection_m", distance)),
    Column("available", "share of epochs at which a fix was offered as usable", _figure("available", percent)),
)  # fmt: skip

#: for a recording whose true position is known
WITH_TRUTH = (
    Column("DRMS", "root of the mean squared distance from the truth, the search for the first fix included",
           _figure("drms_m", distance)),
    Column("CEP", "half of the epochs are closer than this", _figure("cep_m", distance)),
    Column("R95", "95 % of the epochs are closer than this", _figure("r95_m", distance)),
    Column("max", "farthest from the truth", _figure("max_m", distance)),
    Column("final", "distance from the truth at the end", _figure("final_m", distance)),
    Column("DRMS fixed", "DRMS from the first fix on", _after_fix("drms_m")),
    Column("R95 fixed", "R95 from the first fix on", _after_fix("r95_m")),
    Column("NEES", "mean squared error over the claimed variance: 2 is honest, more is overconfident, less is cautious",
           _figure("nees", number)),
    Column("in 95 %", "share of epochs with the truth inside the claimed 95 % ellipse: 95 % is honest",
           _figure("contained_95", percent)),
    *_FIX,
)  # fmt: skip

#: for a recording without truth
WITHOUT_TRUTH = (
    Column("last position", "where it says it is at the end", _position),
    Column("95 % radius", "half the long axis of the 95 % ellipse it claims at the end",
           lambda outcome, name: distance(outcome.final_claim_m(name))),
    Column("from the INS", "how far it moved the position that the INS indicates at the end",
           lambda outcome, name: distance(outcome.final_correction_m(name))),
    Column("status", "what it calls its position at the end",
           lambda outcome, name: outcome.status_at_end(name).replace("_", " ")),
    *_FIX,
)  # fmt: skip

_EXPENDABLE = ("max", "CEP", "final", "lost", "NEES", "R95", "first fix")
_GAP = 3  # between two columns of the terminal's table


def columns(outcome: Outcome) -> tuple[Column, ...]:
    """The columns that make sense for an outcome."""
    found: tuple[Column, ...] = WITH_TRUTH if outcome.recording.has_truth else WITHOUT_TRUTH
    if outcome.bound is not None:
        after = 1 + next(i for i, column in enumerate(found) if column.head == "DRMS fixed")
        found = (*found[:after], BOUND, *found[after:])
    return (*found, *INTEGRITY) if outcome.watched else found


def rows(outcome: Outcome) -> list[tuple[str, list[str]]]:
    """Each estimator's name and its texts, one per column."""
    return [(name, [column.text(outcome, name) for column in columns(outcome)]) for name in outcome.results]


def facts(outcome: Outcome) -> list[tuple[str, str]]:
    """What was flown, in words: the head of the table and of the report."""
    rec, ins = outcome.recording, outcome.ins
    maps = [
        f"{chart.name}: {chart.kind}, {chart.shape[0]} x {chart.shape[1]} cells of {distance(chart.cell_m)}, "
        f"sigma {chart.sigma:g} {chart.unit}"
        for chart in outcome.maps
    ]
    drift = (
        f"{distance(ins.position_sigma_m)} at the start, {ins.velocity_sigma_mps:g} m/s, "
        f"walk {ins.position_walk_m_per_sqrt_s:g} m/√s (1σ per axis)"
    )
    since = f", the first {duration(outcome.since_s)} left out of the figures" if outcome.since_s else ""
    return [
        *[("map", text) for text in maps],
        (
            "recording",
            f"{rec.name}: {len(rec)} epochs, {duration(outcome.duration_s)}, {outcome.track_km:.1f} km{since}",
        ),
        ("INS", f"{ins.name}: {drift}" if ins.name else drift),
    ]


def rich_table(outcome: Outcome, width: int = 120) -> RichTable:
    """The table for a terminal of so many columns; on a narrow one the least telling figures are left out."""
    from rich import box
    from rich.table import Table

    found = rows(outcome)
    texts = dict(zip([column.head for column in columns(outcome)], zip(*[texts for _, texts in found])))
    room = width - max(len(name) for name in ("estimator", *outcome.results)) - 2

    def needed(heads: Iterable[str]) -> int:
        return sum(max(map(len, (*head.split("\n"), *texts[head.replace("\n", " ")]))) + _GAP for head in heads)

    heads = list(texts)
    if needed(heads) > room:
        heads = [head.replace(" ", "\n", 1) for head in heads]
    for head in _EXPENDABLE:
        if needed(heads) > room and head in heads:
            heads.remove(head)
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, _GAP // 2))
    table.add_column("estimator", no_wrap=True, vertical="bottom")
    for head in heads:
        table.add_column(head, justify="right", vertical="bottom", no_wrap=True)
    for i, (name, _) in enumerate(found):
        cells = [texts[head.replace("\n", " ")][i] for head in heads]
        table.add_row(name, *cells, style="bold" if name == outcome.main else None)
    return table
