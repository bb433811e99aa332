"""What a log holds and how a replay went, in words and as figures."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from terranav.app.outcome import BASELINE
from terranav.app.words import HONEST_SHARE, distance, duration, moment, percent

if TYPE_CHECKING:
    from terranav.app.outcome import Outcome
    from terranav.experiment.replay import Denied
    from terranav.io.logs import Log

#: aided is called held where its 95th percentile is less than this share of the unaided one
HELD_SHARE = 0.5
#: an error that GNSS itself has: a dead reckoning this good needs no map
GNSS_GRADE_M = 20.0


@dataclass(frozen=True)
class Flight:
    """One span without GNSS and what came of it."""

    denied: Denied
    outcome: Outcome


@dataclass(frozen=True)
class Score:
    """How a replay went, over all of its spans.

    Attributes
    ----------
    held_m, unaided_m : float
        95th percentile of the distance from the withheld GNSS, with the map and without [m]; NaN without truth.
    end_m, unaided_end_m : float
        The same distances at the end, the largest over the spans [m].
    duration_s : float
        Without GNSS [s].
    usable : float
        Share of epochs at which a fix was offered as usable; NaN where no integrity monitor watched.
    contained_95 : float
        Share of epochs with the truth inside the claimed 95 % ellipse.
    misleading : int
        Usable fixes farther from the truth than their protection level.
    """

    held_m: float
    unaided_m: float
    end_m: float
    unaided_end_m: float
    duration_s: float
    usable: float
    contained_95: float
    misleading: int


def score(flights: Sequence[Flight]) -> Score:
    """Pool the spans, every epoch alike."""
    name = flights[0].outcome.main
    results = [flight.outcome.results[name] for flight in flights]
    errors = [np.hypot(*result.error_m.T) for result in results]
    alone = [flight.outcome.ins_distance_m for flight in flights]
    known = np.concatenate([np.isfinite(error) for error in errors])
    inside = [flight.outcome.metrics(name) for flight in flights]
    counted = np.array([figures["n"] for figures in inside], dtype=np.float64)
    share = np.array([figures["contained_95"] for figures in inside])
    beyond = [result.usable & (error > result.protection_m) for result, error in zip(results, errors, strict=True)]
    watched = any(result.watched for result in results)
    return Score(
        held_m=_percentile(errors),
        unaided_m=_percentile(alone),
        end_m=_last(errors),
        unaided_end_m=_last(alone),
        duration_s=sum(flight.denied.end_s - flight.denied.start_s for flight in flights),
        usable=float(np.mean(np.concatenate([result.usable for result in results]))) if watched else math.nan,
        contained_95=float(np.nansum(share * counted) / counted.sum()) if known.any() else math.nan,
        misleading=int(sum(np.count_nonzero(one) for one in beyond)),
    )


def _percentile(parts: Sequence[np.ndarray[Any, Any]]) -> float:
    """The 95th percentile of what is known of all of them."""
    values = np.concatenate(list(parts))
    values = values[np.isfinite(values)]
    return float(np.percentile(values, 95.0)) if values.size else math.nan


def _last(parts: Sequence[np.ndarray[Any, Any]]) -> float:
    """The largest of the last known values."""
    ends = [part[np.isfinite(part)][-1] for part in parts if np.isfinite(part).any()]
    return float(max(ends)) if ends else math.nan


def verdict(flights: Sequence[Flight]) -> str:
    """One line: did the map hold the position, for how long, and what would have been without."""
    figures = score(flights)
    end = "; ".join(text for text in (_held(flights, figures), *_doubts(flights, figures)) if text)
    return end


def _held(flights: Sequence[Flight], figures: Score) -> str:
    """The first clauses of the verdict."""
    name = flights[0].outcome.main
    spans = f" in {len(flights)} spans" if len(flights) > 1 else ""
    usable = f"; usable {percent(figures.usable)}" if math.isfinite(figures.usable) else ""
    if not math.isfinite(figures.held_m):
        outcome = flights[-1].outcome
        return (
            f"no score: no GNSS position to check against; ended {distance(outcome.final_correction_m(name))} from "
            f"the unaided position, known to {distance(outcome.final_claim_m(name))} (95 %) by its own claim, status "
            f"{outcome.status_at_end(name).replace('_', ' ')}{usable}"
        )
    within = f"within {distance(figures.held_m)} for {duration(figures.duration_s)}{spans} (95 % of the time{usable})"
    alone = f"unaided {distance(figures.unaided_m)}, {distance(figures.unaided_end_m)} at the end"
    if name == BASELINE:
        return f"unaided {within}"
    if figures.held_m < HELD_SHARE * figures.unaided_m:
        return f"held {within}; {alone}"
    if figures.unaided_m < GNSS_GRADE_M:
        return f"nothing to hold: {alone}; with the map {within}"
    helped = "hardly helped" if figures.held_m < figures.unaided_m else "made worse"
    return f"{helped}: {within}; {alone}"


def _doubts(flights: Sequence[Flight], figures: Score) -> list[str]:
    """What takes away from the verdict."""
    name = flights[0].outcome.main
    doubts = []
    for i, flight in enumerate(flights, start=1):
        end = flight.outcome.status_at_end(name)
        if end in ("lost", "off_map"):
            doubts.append(f"ended {end.replace('_', ' ')}{f' in span {i}' if len(flights) > 1 else ''}")
    if figures.contained_95 < HONEST_SHARE:
        doubts.append(f"its 95 % ellipse held the truth only {percent(figures.contained_95)} of the time")
    if figures.misleading:
        doubts.append(f"{figures.misleading} usable fixes were beyond their protection level")
    if flights[0].denied.optimistic:
        columns = ", ".join(flights[0].denied.seen_with_gnss)
        doubts.append(f"optimistic: {columns} made with GNSS, or may be; the honest test is --drift-nmph 1")
    return doubts


def digest(flights: Sequence[Flight]) -> str:
    """SHA-256 over the verdict and the bits of every result: equal for two replays exactly when they agree."""
    mixed = hashlib.sha256(verdict(flights).encode())
    for flight in flights:
        for result in flight.outcome.results.values():
            mixed.update(result.digest().encode())
    return mixed.hexdigest()


def log_pairs(log: Log) -> list[tuple[str, str]]:
    """What the log holds and what is missing, as names and texts."""
    from terranav.io.logs.facts import WORDS

    facts, rec = log.facts, log.recording
    step = float(np.median(np.diff(rec.time_s))) if len(rec) > 1 else math.nan
    rate = f" at {1.0 / step:.3g} Hz" if step > 0 else ""
    pairs = [("log", f"{facts['file']}: {facts['format']}, {duration(facts['duration_s'])}, {len(rec)} epochs{rate}")]
    holds = [
        f"{WORDS[role]} {part['rate_hz']:.3g} Hz" if part["rate_hz"] else WORDS[role]
        for role, part in facts.get("series", {}).items()
    ] or [f"{key} at {percent(share)} of the epochs" for key, share in facts["readings"].items()]
    truth = facts["truth"]["known"]
    pairs.append(("holds", ", ".join([*holds, f"truth at {percent(truth)} of the epochs" if truth else "no truth"])))
    return pairs + [("note", remark) for remark in log.remarks]


def denied_pairs(flights: Sequence[Denied]) -> list[tuple[str, str]]:
    """When GNSS is off, how it navigates then, and what is to be said of that."""
    spans = ", ".join(f"{moment(one.start_s)} to {moment(one.end_s)}" for one in flights)
    seen = f" ({', '.join(flights[0].seen_with_gnss)} made with GNSS, or may be)" if flights[0].optimistic else ""
    pairs = [("GNSS off", spans), ("by", f"{flights[0].by.name}: {flights[0].by.told}{seen}")]
    remarks = dict.fromkeys(remark for one in flights for remark in one.remarks)
    return pairs + [("note", remark) for remark in remarks]


def as_json(log: Log, flights: Sequence[Flight], command: str) -> dict[str, Any]:
    """Everything that a machine wants to know of a replay; the arrays are in the result files."""
    from terranav import __version__

    first = flights[0]
    return {
        "terranav": __version__,
        "command": command,
        "verdict": verdict(flights),
        "digest": digest(flights),
        "score": asdict(score(flights)),
        "log": log.facts,
        "remarks": list(dict.fromkeys((*log.remarks, *(text for one in flights for text in one.denied.remarks)))),
        "gnss_off_s": [[flight.denied.start_s, flight.denied.end_s] for flight in flights],
        "by": first.denied.by.name,
        "seen_with_gnss": list(first.denied.seen_with_gnss),
        "optimistic": first.denied.optimistic,
        "spans": [flight.outcome.as_json() for flight in flights],
    }
