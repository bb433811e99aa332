"""What the tests of the live engine share: a flight of messages, settings, and everything that an engine says."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from benchmarks.live_messages import HOST_US, Flight, chart

from terranav.core.ins_grade import InsGrade
from terranav.core.records import Estimate
from terranav.live.engine import Engine
from terranav.live.records import Fix, Packet, Remark
from terranav.live.settings import LiveSettings

__all__ = ["GRADE", "HOST_US", "Flight", "chart", "digest", "flown", "settings"]

GRADE = InsGrade(100.0, 0.7, 0.5, 0.02)


def settings(**more: Any) -> LiveSettings:
    """What the tests tell the engine unless they say otherwise."""
    return LiveSettings(**{"ins": GRADE, **more})


def flown(engine: Engine, packets: list[Packet]) -> tuple[list[Fix], list[Remark]]:
    """Everything that an engine says of packets."""
    said = [one for packet in packets for one in engine.feed(packet)]
    return [one for one in said if isinstance(one, Fix)], [one for one in said if isinstance(one, Remark)]


def digest(fixes: list[Fix]) -> str:
    """Bits of fixes as text: equal when all numbers are."""
    return repr([replace(fix, estimate=_plain(fix.estimate)) for fix in fixes])


def _plain(estimate: Estimate) -> Any:
    return replace(estimate, ins_error_m=estimate.ins_error_m.tobytes(), cov_m2=estimate.cov_m2.tobytes())  # type: ignore[arg-type]
