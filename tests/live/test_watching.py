"""`terranav live --monitor`: a false or lost GNSS is told, an honest one is not; the same again from a checkpoint."""

from __future__ import annotations

import json
import math
import struct
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("jsbsim")

from terranav.app.cli import main
from terranav.app.living import gnss_line
from terranav.core.errors import ConfigError
from terranav.core.records import Epoch, Estimate, Prior, Status
from terranav.integrity.gnss import GnssStatus
from terranav.live.book import Book
from terranav.live.engine import Engine
from terranav.live.heard import Gnss
from terranav.live.recorder import FIXES, RECEIVED, chained, facts_of
from terranav.live.records import Fix, Packet, Remark
from terranav.live.settings import LiveSettings
from terranav.live.testbed.flight import Flight
from terranav.live.testbed.settings import FlightSettings
from terranav.live.watching import Watching, reading_of
from tests.live.flights import GRADE, chart, digest, flown

INS = FlightSettings().grade
PULL_AT_S, PULL_MPS, JAM_AT_S = 20.0, 2.0, 10.0


def watching(**more: Any) -> LiveSettings:
    """The reckoning of the test bed's INS, watched."""
    return LiveSettings(**{"ins_source": "position", "ins": INS, "monitor": True, **more})


@cache
def packets(**told: Any) -> tuple[Packet, ...]:
    """What the test bed sends, its INS reported."""
    flight = Flight(chart(), FlightSettings(**{"gnss_off_s": math.inf, "reports": "ins", **told}))
    return tuple(Packet(stamp_us, 0, frame) for stamp_us, frame in flight)


def pulled() -> tuple[Packet, ...]:
    return packets(minutes=1.25, spoof_at_s=PULL_AT_S, spoof_mps=PULL_MPS)


@cache
def heard(flight: tuple[Packet, ...]) -> tuple[list[Fix], list[Remark], dict[str, Any]]:
    """All that a watching engine says of packets, and its facts at the end."""
    engine = Engine(watching(), [chart()])
    fixes, remarks = flown(engine, list(flight))
    return fixes, remarks, engine.facts["monitor"]


def said(remarks: list[Remark]) -> list[Remark]:
    return [one for one in remarks if one.key == "gnss"]


def test_a_pull_at_2_mps_is_flagged_before_300_m() -> None:
    fixes, remarks, facts = heard(pulled())
    alarms = [one for one in said(remarks) if one.level == "warning"]
    assert len(alarms) == facts["alarms"] == 1
    assert alarms[0].text.startswith("GNSS spoofed: GNSS ")
    off_m = PULL_MPS * (facts["first_alarm"]["at_s"] - PULL_AT_S)
    assert 0.0 < off_m < 150.0
    last = fixes[-1].gnss
    assert last is not None
    assert last.status is GnssStatus.SPOOFED
    assert last.difference_m > last.threshold_m


def test_an_honest_gnss_raises_no_alarm() -> None:
    fixes, remarks, facts = heard(packets(minutes=1.25))
    assert facts["alarms"] == 0
    assert facts["first_alarm"] is None
    assert {one.level for one in said(remarks)} == {"info"}
    told = [one.gnss.status for one in fixes if one.gnss is not None]
    assert len(told) == len(fixes) > 650
    assert told.count(GnssStatus.CONSISTENT) > 0.9 * len(told)


@pytest.mark.parametrize(
    ("trouble", "why"), [({"jam_at_s": JAM_AT_S}, "the receiver has no fix"), ({"gnss_off_s": JAM_AT_S}, "no fix")]
)
def test_a_jammed_or_lost_gnss_is_flagged(trouble: dict[str, float], why: str) -> None:
    fixes, remarks, facts = heard(packets(minutes=0.6, **trouble))
    alarms = [one for one in said(remarks) if one.level == "warning"]
    assert alarms[-1].text.startswith("GNSS jammed: no GNSS position for")
    assert why in alarms[-1].text
    assert fixes[-1].gnss is not None
    assert fixes[-1].gnss.status is GnssStatus.JAMMED
    assert JAM_AT_S < facts["first_alarm"]["at_s"] < JAM_AT_S + 25.0


def test_an_inflated_accuracy_is_no_position() -> None:
    """What a receiver says that is off by more than 50 m is as good as nothing."""
    watched, book = Watching.of(INS), Book()
    for second in range(12):
        word = Gnss(3, 47.0, 9.0, None, 80.0, None)
        verdict = watched.step(*epoch_at(float(second)), (float(second), word), book)
    assert verdict.status is GnssStatus.JAMMED
    assert "its sigma is 80 m (limit 50 m)" in verdict.reasons[0]


def test_no_fix_depends_on_the_monitor() -> None:
    engine = Engine(watching(monitor=False), [chart()])
    fixes, _ = flown(engine, list(pulled()[:2000]))
    assert digest(fixes) == digest([replace(fix, gnss=None) for fix in heard(pulled())[0][: len(fixes)]])
    assert len(fixes) > 200
    assert engine.facts["monitor"] is None
    assert "gnss" not in facts_of(fixes[0])


def test_a_checkpoint_goes_on_with_the_same_verdicts() -> None:
    flight = list(pulled())
    half = round(0.6 * len(flight))
    first = Engine(watching(), [chart()])
    fixes, remarks = flown(first, flight[:half])
    second = Engine.resumed(watching(), [chart()], first.checkpoint())
    more, later = flown(second, flight[half:])
    whole, all_remarks, facts = heard(pulled())
    assert digest([*fixes, *more]) == digest(whole)
    assert [*remarks, *later] == all_remarks
    assert second.facts["monitor"] == facts


def test_a_run_with_and_one_without_the_monitor_do_not_mix() -> None:
    checkpoint = Engine(watching(), [chart()]).checkpoint()
    with pytest.raises(ConfigError, match="other settings"):
        Engine.resumed(watching(monitor=False), [chart()], checkpoint)


def test_the_digest_tells_verdicts_apart() -> None:
    fix = heard(pulled())[0][-1]
    assert fix.gnss is not None
    other = replace(fix, gnss=replace(fix.gnss, difference_m=math.nextafter(fix.gnss.difference_m, 0.0)))
    digests = {chained(bytes(32), one) for one in (fix, other, replace(fix, gnss=None))}
    assert len(digests) == 3


def test_the_command_says_it_writes_it_and_replays_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("f.tlog").write_bytes(b"".join(struct.pack(">Q", one.stamp_us) + one.data for one in pulled()[:2000]))
    told = ("--map", "sample", "--by", "position", "--ins", "tactical", "--speed", "0", "--monitor")
    assert main(["live", "--in", "file:f.tlog", *told, "--record", "run", "--out", "json:out.jsonl", "--json"]) == 0
    first = json.loads(capsys.readouterr().out)
    lines = [json.loads(line) for line in Path("run", FIXES).read_text(encoding="utf-8").splitlines()]
    sent = [json.loads(line) for line in Path("out.jsonl").read_text(encoding="utf-8").splitlines()]
    assert [line["gnss"] for line in lines] == [line["gnss"] for line in sent]
    assert set(lines[-1]["gnss"]) == {"status", "difference_m", "threshold_m"}
    assert lines[-1]["gnss"]["status"] == first["engine"]["monitor"]["status"]
    assert main(["live", "--in", f"file:run/{RECEIVED}", *told]) == 0
    shown = capsys.readouterr()
    assert f"digest     {first['digest']}" in shown.out
    assert "GNSS       " + gnss_line(first["engine"]["monitor"])[:20] in shown.out
    assert "GNSS is compared with the map and with the vehicle's position" in shown.err


def test_the_summary_says_since_when_and_how_far() -> None:
    facts = heard(pulled())[2]
    line = gnss_line(
        {**facts, "reasons": ["GNSS is 112 m east of the map-aided position (limit 83 m)"], "since_s": 560.0}
    )
    assert line == ("spoofed since 9 min 20 s: 112 m east of the map-aided position (limit 83 m)")
    assert gnss_line({**facts, "status": "consistent"}).endswith("; 1 alarm at 46 s (spoofed)")
    assert "; 2 alarms, the first at 46 s" in gnss_line({**facts, "alarms": 2})
    assert gnss_line({"status": "unknown", "since_s": None, "reasons": ["no GNSS heard yet"], "first_alarm": None}) == (
        "unknown: no GNSS heard yet; no alarm"
    )


def test_it_is_said_that_an_autopilots_velocity_may_follow() -> None:
    engine = Engine(LiveSettings(monitor=True, ins=GRADE), [chart()])
    remarks = [one for one in engine.feed(pulled()[0]) if isinstance(one, Remark)]
    told = next(one for one in remarks if one.key == "gnss monitor")
    assert told.level == "warning"
    assert "--by airspeed" in told.text
    assert "without --ins" not in told.text
    book = Book()
    Watching.of(GRADE).introduce(LiveSettings(monitor=True), book)
    assert "without --ins that is taken for good to 1 m/s" in book.taken()[0].text


def epoch_at(time_s: float, north_m: float = 0.0) -> tuple[Epoch, Estimate]:
    """An epoch of a vehicle that stands in a field, and an estimate that is not usable."""
    place = (47.0 + north_m / 111_200.0, 9.0)
    nothing = Estimate(time_s, *place, 500.0, np.zeros(2), 1e4 * np.eye(2), Status.SEARCHING)
    return Epoch(time_s, *place, 500.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), nothing


def alarmed(book: Book) -> Watching:
    """A monitor whose GNSS leapt by a kilometre."""
    watched = Watching.of(INS)
    for second in range(20):
        lat = 47.0 + 1e-6 * (second % 3) + (0.01 if second > 10 else 0.0)
        watched.step(*epoch_at(float(second)), (float(second), Gnss(3, lat, 9.0, None, None, None)), book)
    assert watched.state.verdict.status is GnssStatus.SPOOFED
    return watched


def test_an_alarm_outlasts_a_break_of_the_reckoning() -> None:
    book = Book()
    watched = alarmed(book)
    book.taken()
    watched.restart(Prior(np.zeros(2), 800.0**2 * np.eye(2)))
    assert watched.monitor.ins.position_sigma_m == pytest.approx(800.0)
    for second in range(20, 70):
        word = Gnss(3, 47.0 + 1e-6 * (second % 3), 9.0, None, None, None)
        verdict = watched.step(*epoch_at(float(second), 300.0), (float(second), word), book)
        assert second > 45 or verdict.status is GnssStatus.SPOOFED
    assert verdict.status not in (GnssStatus.SPOOFED, GnssStatus.JAMMED)
    assert [one.level for one in book.taken()] == ["info"]
    assert watched.alarms == 1


def test_one_alarm_gives_way_to_the_other_and_counts_once() -> None:
    book = Book()
    watched = alarmed(book)
    for second in range(20, 30):
        watched.step(*epoch_at(float(second)), (float(second), Gnss(1, math.nan, math.nan, None, None, None)), book)
    warnings = [one.text for one in book.taken() if one.level == "warning"]
    assert [text.split(":")[0] for text in warnings] == ["GNSS spoofed", "GNSS jammed"]
    assert watched.alarms == 1
    assert list(book.standing) == ["gnss"]


def test_what_is_not_finite_is_left_out() -> None:
    book, watched = Book(), Watching.of(INS)
    watched.step(*epoch_at(0.0), None, book)
    before = watched.state
    epoch, estimate = epoch_at(1.0)
    watched.step(replace(epoch, lat_deg=math.nan), estimate, None, book)
    usable = replace(estimate, status=Status.CONVERGED, ins_error_m=np.array([math.nan, 0.0]), usable=True)
    watched.step(epoch, usable, None, book)
    assert watched.state is before


def test_a_failure_of_the_monitor_costs_no_fix(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*told: Any) -> Any:
        raise ValueError("no way")

    book, watched = Book(), Watching.of(INS)
    monkeypatch.setattr(type(watched.monitor), "step", fails)
    verdict = watched.step(*epoch_at(0.0), None, book)
    assert verdict.status is GnssStatus.UNKNOWN
    assert book.taken()[0].text == "the GNSS monitor failed: ValueError: no way"


@pytest.mark.parametrize(("fix", "good"), [(0, False), (1, False), (2, False), (3, True), (6, True)])
def test_a_fix_of_three_dimensions_counts(fix: int, good: bool) -> None:
    reading = reading_of(7.0, Gnss(fix, 47.0, 9.0, 500.0, None, (1.0, 2.0)))
    assert (reading.time_s, reading.fix, reading.sigma_m, reading.velocity_mps) == (7.0, good, 3.0, None)


def test_a_setting_that_is_no_switch_is_refused() -> None:
    with pytest.raises(ConfigError, match="monitor is 'yes', expected True or False"):
        LiveSettings(monitor="yes")  # type: ignore[arg-type]
