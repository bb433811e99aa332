"""Numbers and outcomes in words: what tables, captions and the first line of a report say."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from terranav.app.outcome import Outcome

NOTHING = "–"
#: below this share of epochs inside the claimed 95 % ellipse an estimator is called overconfident
HONEST_SHARE = 0.85


def distance(metres: float) -> str:
    """A length for people: '0.8 m', '45 m', '1.9 km', a dash for NaN."""
    if not math.isfinite(metres):
        return NOTHING
    size = abs(metres)
    if size < 9.95:
        return f"{metres:.1f} m"
    return f"{metres:.0f} m" if size < 999.5 else f"{metres / 1000:.{1 if size < 99950 else 0}f} km"


def duration(seconds: float) -> str:
    """A time span for people: '35 s', '12 min', '1 h 05 min', a dash for NaN."""
    if not math.isfinite(seconds):
        return NOTHING
    if seconds < 119.5:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"


def moment(seconds: float) -> str:
    """A time since the start to the second: '45 s', '3 min 20 s', '1 h 05 min 09 s'."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    minutes = f"{whole // 60 % 60:02d} min" if whole >= 3600 else f"{whole // 60} min"
    hours = f"{whole // 3600} h " if whole >= 3600 else ""
    return f"{hours}{minutes} {whole % 60:02d} s"


def span(start_s: float, end_s: float) -> str:
    """A stretch of time since the start: 'from 3 min 20 s to 4 min 05 s', 'at 45 s' where it is no longer than that."""
    start, end = moment(start_s), moment(end_s)
    return f"at {start}" if start == end else f"from {start} to {end}"


def percent(share: float, digits: int = 0) -> str:
    """A share of one: '94 %', a dash for NaN; one above nothing is never shown as nothing."""
    if not math.isfinite(share):
        return NOTHING
    least = 10.0**-digits
    return f"< {least:g} %" if 0.0 < 100 * share < 0.5 * least else f"{100 * share:.{digits}f} %"


def number(value: float, digits: int = 2) -> str:
    """A plain number with so many significant digits, a dash for NaN."""
    return f"{value:.{digits}g}" if math.isfinite(value) else NOTHING


def coordinate(degrees: float, positive: str, negative: str, digits: int = 2) -> str:
    """A latitude or longitude with its hemisphere: '36.43° N'."""
    return f"{abs(degrees):.{digits}f}° {positive if degrees >= 0 else negative}"


def verdict(outcome: Outcome) -> str:
    """What happened, in one or two sentences that need no knowledge of the field."""
    name = outcome.main
    fix_s = outcome.first_fix_s(name)
    alone = _ins_alone(outcome)
    if not outcome.recording.has_truth:
        return _without_truth(outcome, fix_s)
    if name == "ins":
        return alone[0].upper() + alone[1:] + "."
    if not math.isfinite(fix_s):
        return f"{name} never found its position; {alone}."
    held = outcome.metrics_after_fix(name)
    span_s = outcome.duration_s - fix_s
    end = outcome.status_at_end(name)
    did = "held the position within" if held["r95_m"] < 0.5 * outcome.ins_r95_m(fix_s) else "knew the position only to"
    text = f"{name} {did} {distance(held['r95_m'])} (95 %) for {duration(span_s)}; {alone}."
    if end in ("lost", "off_map"):
        text = f"{name} found its position after {duration(fix_s)} but ended {end.replace('_', ' ')}; {alone}."
    elif outcome.final_error_m(name) > max(outcome.final_ins_error_m, 1.0):
        text = f"{name} made it worse: it ended {distance(outcome.final_error_m(name))} off; {alone}."
    if held["contained_95"] < HONEST_SHARE:
        inside = percent(held["contained_95"])
        text += f" It claims more than it delivers: its 95 % ellipse held the truth only {inside} of the time."
    return text


def _ins_alone(outcome: Outcome) -> str:
    """The clause on the INS without any help."""
    start, end = outcome.initial_ins_error_m, outcome.final_ins_error_m
    if not math.isfinite(end):
        return "the error of the INS alone is not known"
    if math.isfinite(start) and end < 1.2 * start:
        return f"the INS alone was {distance(start)} off at the start and {distance(end)} at the end"
    return f"the INS alone drifted to {distance(end)}"


def _without_truth(outcome: Outcome, fix_s: float) -> str:
    """The verdict on a recording that cannot be checked."""
    name = outcome.main
    if not math.isfinite(fix_s):
        return f"The recording holds no true position to check against; {name} never found its position."
    correction, claim = distance(outcome.final_correction_m(name)), distance(outcome.final_claim_m(name))
    return (
        f"{name} found a position after {duration(fix_s)} and ended {correction} from the INS, known to {claim} (95 %) "
        f"by its own claim, status {outcome.status_at_end(name)}. The recording holds no true position to check it."
    )
