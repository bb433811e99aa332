"""A live run on the terminal: what was typed, remarks as they come, one quiet line of status, the summary."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from terranav.app.console import INCOMPLETE, OK, complain, one_line, show_json, show_pairs
from terranav.app.given import ins_from
from terranav.app.words import duration, moment, percent
from terranav.core.errors import ConfigError

if TYPE_CHECKING:
    from terranav.live.plan import Plan
    from terranav.live.records import Remark
    from terranav.live.settings import LiveSettings
    from terranav.maps.geoid import Geoid
    from terranav.maps.map import Map

_LEVELS = {"info": "note", "warning": "warning", "error": "error"}
_WIDE = 118


@dataclass(frozen=True)
class Told:
    """The options that make the settings of the engine, as typed."""

    by: str
    ins: str
    start: str
    wind: str
    system: int | None
    estimator: str
    estimator_settings: Mapping[str, Any]
    seed: int
    rate_hz: float
    sigma: Mapping[str, float]
    geoids: Sequence[Geoid]
    monitor: bool = False

    def settings(self) -> LiveSettings:
        """The settings; ConfigError for what cannot be."""
        from terranav.live.settings import LiveSettings

        return LiveSettings(
            ins_source=self.by,
            ins=ins_from("--ins", self.ins) if self.ins else None,
            start_deg=_pair("--start", self.start) if self.start else None,
            wind_mps=_pair("--wind", self.wind),
            estimator=self.estimator,
            estimator_settings=self.estimator_settings,
            seed=self.seed,
            system_id=self.system,
            rate_hz=self.rate_hz,
            sigma=self.sigma,
            geoid=list(self.geoids) or None,
            monitor=self.monitor,
        )


def _pair(option: str, text: str) -> tuple[float, float]:
    """Two numbers."""
    try:
        first, second = (float(part) for part in text.split(","))
    except ValueError:
        raise ConfigError(f"{option} is {text!r}, expected two numbers such as 47.1,9.4") from None
    return first, second


def sigmas_from(texts: Sequence[str]) -> dict[str, float]:
    """1-sigma of sensors from texts such as 'laser_altitude_m=0.5'."""
    found: dict[str, float] = {}
    for text in texts:
        name, _, value = text.partition("=")
        try:
            found[name.strip()] = float(value)
        except ValueError:
            raise ConfigError(f"--sigma is {text!r}, expected NAME=M such as laser_altitude_m=0.5") from None
    return found


def fly_live(plan: Plan, settings: LiveSettings, charts: tuple[Map, ...], *, as_json: bool) -> int:
    """Run until it is stopped or a file ends; the exit status."""
    from terranav.live.running import Live

    line = StatusLine()
    taken = any(address.wire == "stdout" for address in plan.outputs)

    async def run() -> dict[str, Any]:
        running = Live(plan, settings, charts, on_remark=line.remark, on_status=line.status)
        return await running.run()

    try:
        facts = asyncio.run(run())
    finally:
        line.clear()
    if as_json and not taken:
        show_json(facts)
    else:
        _show(list(summary(facts)), to_stderr=taken)
    whole = not facts["recording_failed"] and not facts["faults"]
    return OK if whole else INCOMPLETE


def check_once(plan: Plan, settings: LiveSettings, charts: tuple[Map, ...], *, as_json: bool) -> int:
    """Listen for a while and say what is missing; the exit status."""
    from terranav.app.commands.doctor import told
    from terranav.live.doctor import examined

    return told(asyncio.run(examined(plan, settings, charts)), as_json=as_json)


class StatusLine:
    """One line on stderr that is written over while the run goes on; none where stderr is no terminal."""

    def __init__(self) -> None:
        self._shown = 0

    def status(self, facts: Mapping[str, Any]) -> None:
        """Show how it goes."""
        if not sys.stderr.isatty():
            return
        text = in_one_line(facts)[:_WIDE]
        sys.stderr.write("\r" + text.ljust(self._shown))
        sys.stderr.flush()
        self._shown = len(text)

    def remark(self, remark: Remark) -> None:
        """Say what is remarked on in a line of its own."""
        self.clear()
        complain(remark.text, _LEVELS.get(remark.level, remark.level))

    def clear(self) -> None:
        """Take the line away."""
        if self._shown:
            sys.stderr.write("\r" + " " * self._shown + "\r")
            sys.stderr.flush()
            self._shown = 0


def in_one_line(facts: Mapping[str, Any]) -> str:
    """How the run goes."""
    engine = facts["engine"]
    sent = sum(output["sent"] for output in facts["outputs"].values())
    parts = [
        duration(facts["duration_s"]),
        engine["status"] or "nothing to navigate by yet",
        f"usable {percent(_share(facts))}",
        f"sent {sent}",
    ]
    if engine["monitor"]:
        parts.append(f"GNSS {engine['monitor']['status']}")
    if engine["withheld"]:
        parts.append(f"withheld: {engine['withheld'][0]}")
    if facts["since_measured"]:
        parts.append(f"latency {facts['since_measured']['p95_ms']:.0f} ms")
    return one_line(", ".join(parts))


def _share(facts: Mapping[str, Any]) -> float:
    share = facts["usable_share"]
    return float("nan") if share is None else float(share)


def summary(facts: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """What came of the run, as names and texts."""
    engine = facts["engine"]
    rate = facts["packets"] / facts["duration_s"] if facts["duration_s"] > 0 else float("nan")
    heard = f"{facts['packets']} packets in {duration(facts['duration_s'])}, {rate:.0f} a second"
    for key in ("lost", "duplicates", "damaged"):
        heard += f", {engine[key]} {key}" if engine[key] else ""
    for key in ("dropped", "refused", "faults"):
        heard += f", {facts[key]} {key}" if facts[key] else ""
    yield "heard", heard
    last = engine["status"] or "nothing to navigate by"
    yield "fixes", f"{facts['fixes']}, usable {percent(_share(facts), 1)}; at the end {last}"
    if engine["monitor"]:
        yield "GNSS", gnss_line(engine["monitor"])
    for name, output in facts["outputs"].items():
        held = ", ".join(
            f"{count} {reason}" for reason, count in sorted(output["held"].items(), key=lambda one: -one[1])
        )
        yield "sent", f"{output['sent']} to {name}" + (f"; held: {held}" if held else "")
    if facts["answers"]:
        yield "answers", ", ".join(f"{count} {what}" for what, count in facts["answers"].items())
    for name, key in (("latency", "since_measured"), ("of it here", "since_arrived")):
        delay = facts[key]
        if delay:
            figures = ", ".join(f"{part} {delay[f'{part}_ms']:.1f} ms" for part in ("p50", "p95", "p99"))
            yield name, f"{figures} over {delay['of']} usable fixes"
    if facts["recording_failed"]:
        yield "recording", facts["recording_failed"]
    yield "digest", facts["digest"]


def gnss_line(said: Mapping[str, Any]) -> str:
    """What the GNSS monitor says at the end, and how often it raised an alarm."""
    since = "" if said["since_s"] is None else f" since {moment(said['since_s'])}"
    line = f"{said['status']}{since}: {'; '.join(said['reasons']).removeprefix('GNSS is ')}"
    first = said["first_alarm"]
    if first is None:
        return f"{line}; no alarm"
    if said["alarms"] == 1 and said["status"] == first["status"]:
        return line
    count = f"{said['alarms']} alarms, the first" if said["alarms"] > 1 else "1 alarm"
    return f"{line}; {count} at {moment(first['at_s'])} ({first['status']})"


def _show(pairs: list[tuple[str, str]], *, to_stderr: bool) -> None:
    """Print the summary; to stderr where stdout carries the fixes."""
    if not to_stderr:
        show_pairs(pairs)
        return
    for name, text in pairs:
        complain(f"{name}: {text}", "note")
