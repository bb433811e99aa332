"""When a fix was lost, degraded or withheld, and why: what the integrity monitor said, gathered into time spans."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from terranav.app.words import distance, percent, span

if TYPE_CHECKING:
    from terranav.app.outcome import Outcome
    from terranav.experiment.result import Result

MOST_SPANS = 20  # rows that the report shows
LONGEST_GAP_S, LONGEST_GAP = 10.0, 0.03  # a reason that comes back so soon [s, share of the run] gets no new row
#: what changes from epoch to epoch in a reason that stays: figures, their units, points of the compass
_FIGURE = re.compile(
    r"\d+(?:\.\d+)?(?:e[+-]?\d+)?(?: (?:k?m|s|min|h)\b)?(?: (?:north|south)?-?(?:east|west)?\b(?<=[ht]))?"
)


@dataclass(frozen=True, slots=True)
class Span:
    """A stretch of time over which status, offer and reasons stay the same, whatever the figures in their texts.

    Attributes
    ----------
    start_s, end_s : float
        From the first epoch of the run; the end is the next span's start [s].
    status : str
    usable : bool or None
        Whether a fix was offered; None where no integrity monitor watched.
    reasons : tuple of str
        As they stood at the start.
    times : int
        How many spans were gathered into this one; then it was so on and off only.
    """

    start_s: float
    end_s: float
    status: str
    usable: bool | None
    reasons: tuple[str, ...]
    times: int = 1

    @property
    def duration_s(self) -> float:
        """Of the span [s]."""
        return self.end_s - self.start_s

    @property
    def fix(self) -> str:
        """What became of the fix, in words."""
        return {True: "fix usable", False: "fix withheld", None: ""}[self.usable]

    @property
    def when(self) -> str:
        """The time in words."""
        return span(self.start_s, self.end_s) + (f", {self.times} times" if self.times > 1 else "")

    @property
    def key(self) -> tuple[str, bool | None, tuple[str, ...]]:
        """What stays the same over the span."""
        return self.status, self.usable, tuple(_FIGURE.sub("#", text) for text in self.reasons)

    @property
    def why(self) -> str:
        """The reasons in words."""
        return "; ".join(self.reasons)


def spans(result: Result) -> list[Span]:
    """What there is to explain of a run, in the order of time: where there are reasons, or a fix was withheld."""
    watched, time_s = result.watched, (result.time_s - result.time_s[0]).tolist()
    alike: dict[tuple[str, ...], tuple[str, ...]] = {}
    found: list[Span] = []
    key: tuple[Any, ...] | None = None
    for at_s, status, usable, reasons in zip(
        time_s, result.status.tolist(), result.usable.tolist(), result.reasons, strict=True
    ):
        entry = Span(at_s, at_s, status, usable if watched else None, reasons)
        if reasons not in alike:
            alike[reasons] = entry.key[-1]
        now = (status, usable, alike[reasons])
        if now != key:
            if found:
                found[-1] = replace(found[-1], end_s=at_s)
            found.append(entry)
            key = now
    found[-1] = replace(found[-1], end_s=time_s[-1])
    return [entry for entry in found if entry.reasons or entry.usable is False]


def gathered(found: list[Span], gap_s: float) -> list[Span]:
    """The spans with those made one that say the same and lie no farther apart than `gap_s`; by their start."""
    rows: list[Span] = []
    latest: dict[tuple[Any, ...], int] = {}
    for entry in found:
        row = latest.get(entry.key)
        if row is not None and entry.start_s - rows[row].end_s <= gap_s:
            rows[row] = replace(rows[row], end_s=entry.end_s, times=rows[row].times + 1)
        else:
            latest[entry.key] = len(rows)
            rows.append(entry)
    return rows


def longest(found: list[Span], most: int = MOST_SPANS) -> list[Span]:
    """At most so many spans, the longest ones, in the order of time."""
    kept = sorted(found, key=lambda entry: entry.duration_s, reverse=True)[:most]
    return sorted(kept, key=lambda entry: entry.start_s)


def section(outcome: Outcome) -> dict[str, Any] | None:
    """What the report says of the main estimator's integrity; None when there is nothing to say."""
    result = outcome.results[outcome.main]
    found = gathered(spans(result), max(LONGEST_GAP_S, LONGEST_GAP * outcome.duration_s))
    if not (result.watched or found):
        return None
    shown = longest(found)
    rest = len(found) - len(shown)
    return {
        "summary": summary(outcome),
        "spans": [(entry.when, entry.status, entry.fix, entry.why) for entry in shown],
        "more": f"{rest} shorter rows are left out; metrics.json has every span." if rest else "",
    }


def summary(outcome: Outcome) -> str:
    """How often a fix was offered, with what protection level, and whether that held."""
    name = outcome.main
    result, figures = outcome.results[name], outcome.metrics(name)
    if not result.watched:
        return f"No integrity monitor watched {name}."
    if figures["available"] == 0.0:
        return f"{name} offered no fix at all."
    offered = f"{name} offered a fix at {percent(figures['available'])} of the epochs"
    if math.isnan(figures["protection_m"]):
        return f"{offered}."
    text = f"{offered}, with a protection level of {distance(figures['protection_m'])} (median)"
    if math.isnan(figures["misleading"]):
        return f"{text}."
    if figures["misleading"] == 0.0:
        return f"{text}; none of these fixes was farther from the truth than that allows."
    return f"{text}; {percent(figures['misleading'], 1)} of these fixes were farther from the truth than that allows."


def as_json(result: Result) -> list[dict[str, Any]]:
    """Every span with something to explain, for machines."""
    return [
        {
            "from_s": entry.start_s,
            "to_s": entry.end_s,
            "status": entry.status,
            "usable": entry.usable,
            "reasons": list(entry.reasons),
        }
        for entry in spans(result)
    ]
