"""What is recorded reads back, replays to the same bits, and reads up to a cut."""

from __future__ import annotations

import json
import struct
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terranav.core.errors import DataError
from terranav.io.logs.opening import open_log
from terranav.live.mavlink_out import Encoder
from terranav.live.recorder import FIXES, RECEIVED, Recorder, chained
from terranav.live.recordings import MAGIC, header, opened, record, walk
from terranav.live.records import Fix, Packet, Remark
from terranav.live.session import Session
from tests.live.flights import HOST_US, Flight, chart, settings

FLIGHT = Flight(seconds=40.0)


def recorded(folder: Path, packets: list[Packet], links: tuple[str, ...] = ("udpin:14550",)) -> Path:
    recorder = Recorder(folder, links)
    for packet in packets:
        recorder.packet(packet)
    recorder.close()
    return folder / RECEIVED


packets = st.lists(
    st.builds(Packet, st.integers(0, 1 << 62), st.integers(0, 255), st.one_of(st.just(b""), st.binary(max_size=300))),
    max_size=20,
)


@given(packets, st.integers(0, 4000))
def test_a_container_reads_back_and_a_cut_one_up_to_the_cut(some: list[Packet], cut: int) -> None:
    import io

    whole = b"".join(record(packet) for packet in some)
    remarks: list[str] = []
    assert [packet for packet, _ in walk(io.BytesIO(whole), remarks)] == some
    assert not remarks
    part = whole[: min(cut, len(whole))]
    found = list(walk(io.BytesIO(part), remarks))
    assert [packet for packet, _ in found] == some[: len(found)]
    end = found[-1][1] if found else 0
    assert bool(remarks) == (end < len(part))
    assert len(part) - end < 15 + 300


@given(packets.filter(bool), st.integers(0, 10**6), st.integers(1, 255))
def test_a_damaged_container_gives_no_packet_that_was_not_sent(some: list[Packet], at: int, flip: int) -> None:
    import io

    whole = bytearray(b"".join(record(packet) for packet in some))
    whole[at % len(whole)] ^= flip
    found = [packet for packet, _ in walk(io.BytesIO(bytes(whole)), [])]
    assert found == some[: len(found)]
    assert len(found) < len(some)


def test_a_run_replays_from_its_container_to_the_same_bits(tmp_path: Path) -> None:
    sent = [*FLIGHT.packets(), Packet(HOST_US + 41_000_000, 0, b"")]
    first = Session(settings(), [chart()])
    for packet in sent:
        first.take(packet)
    source = opened(recorded(tmp_path / "run", sent))
    assert (source.kind, source.links) == ("received", ("udpin:14550",))
    again = Session(settings(), [chart()])
    for packet in source.packets():
        again.take(packet)
    assert first.fixes > 300
    assert again.digest == first.digest
    assert not source.remarks


def test_one_fix_more_or_one_bit_else_is_another_digest() -> None:
    session = Session(settings(), [chart()])
    fixes = [one for packet in FLIGHT.packets()[:800] for one in session.take(packet) if isinstance(one, Fix)]
    digest = bytes(32)
    for fix in fixes:
        digest = chained(digest, fix)
    assert digest == session.digest
    assert chained(digest, fixes[-1]) != digest
    assert chained(digest, fixes[0]) != chained(digest, fixes[1])


def test_the_tlog_of_a_link_opens_as_a_log_and_holds_the_frames(tmp_path: Path) -> None:
    sent = FLIGHT.packets()
    recorded(tmp_path, [sent[0], *sent[1:], Packet(HOST_US + 60_000_000, 0, b"")])
    source = opened(tmp_path / "link0.tlog")
    assert source.kind == "tlog"
    assert list(source.packets()) == sent
    log = open_log(tmp_path / "link0.tlog")
    assert np.ptp(log.recording.time_s) == pytest.approx(FLIGHT.seconds, abs=0.5)
    assert "radar" in log.facts["altimeters"]


@pytest.mark.parametrize("cut", [1, 8, 20, 41])
def test_a_cut_tlog_reads_up_to_the_cut(tmp_path: Path, cut: int) -> None:
    sent = FLIGHT.packets()[:50]
    recorded(tmp_path, sent)
    file = tmp_path / "link0.tlog"
    file.write_bytes(file.read_bytes()[:-cut])
    source = opened(file)
    found = list(source.packets())
    assert found == sent[: len(found)]
    assert len(found) >= 47
    assert "left out" in source.remarks[0]


def test_a_tlog_damaged_in_the_middle_loses_little(tmp_path: Path) -> None:
    sent = FLIGHT.packets()[:400]
    recorded(tmp_path, sent)
    file = tmp_path / "link0.tlog"
    data = bytearray(file.read_bytes())
    data[4000:4100] = bytes(100)
    file.write_bytes(data)
    source = opened(file)
    found = [packet for packet in source.packets() if packet in sent]
    assert len(found) >= 390


def test_nmea_text_has_the_times_that_it_tells(tmp_path: Path) -> None:
    lines = [
        b"$GPRMC,235959.50,A,4700.00000,N,00900.00000,E,10.0,90.0,311225,,*00",
        b"$SDDPT,12.3,0.5*7F",
        b"$GPGGA,000000.50,4700.00000,N,00900.00000,E,1,08,1.0,400.0,M,,M,,*00",
        b"no sentence",
    ]
    (tmp_path / "a.nmea").write_bytes(b"\r\n".join(lines) + b"\r\n")
    source = opened(tmp_path / "a.nmea")
    found = list(source.packets())
    assert [packet.data for packet in found] == lines[:3]
    assert [packet.stamp_us - found[0].stamp_us for packet in found] == [0, 0, 1_000_000]
    assert found[0].stamp_us == 1_767_225_599_500_000
    assert source.remarks == ["1 lines that are no NMEA sentence were left out"]


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (bytes(100), "only zeros"),
        (b"hello", "expected a recording of terranav live"),
        (b"", "is empty"),
        (b"terranav-received 9\n{}\n", "of another version"),
        (MAGIC + b"not json\n", "does not name the links"),
        (MAGIC + b'{"links": 3}\n', "does not name the links"),
        (MAGIC, "does not name the links"),
    ],
)
def test_files_that_are_no_recording_are_one_line(tmp_path: Path, data: bytes, says: str) -> None:
    file = tmp_path / "file"
    file.write_bytes(data)
    with pytest.raises(DataError, match=says) as error:
        opened(file)
    assert str(file) in str(error.value)
    assert "\n" not in str(error.value)


def test_fixes_remarks_and_what_was_sent_are_there_to_read(tmp_path: Path) -> None:
    recorder, session = Recorder(tmp_path, ("a",)), Session(settings(), [chart()])
    for packet in FLIGHT.packets()[:300]:
        for one in session.take(packet):
            if isinstance(one, Fix):
                recorder.fix(session.packets, one)
            else:
                recorder.remark(one)
    beat = Encoder(1).heartbeat()
    recorder.sent("back", HOST_US, beat)
    recorder.sent("nmea", HOST_US, b"$GPGGA,1*00")
    recorder.close()
    lines = [json.loads(line) for line in (tmp_path / FIXES).read_text(encoding="utf-8").splitlines()]
    assert len(lines) == session.fixes > 0
    assert {"packet", "stamp_us", "lat_deg", "sigma_m", "usable", "withheld"} <= set(lines[0])
    assert "vehicle" in (tmp_path / "remarks.jsonl").read_text(encoding="utf-8")
    assert (tmp_path / "sent.tlog").read_bytes() == struct.pack(">Q", HOST_US) + beat
    assert json.loads((tmp_path / "sent.jsonl").read_text(encoding="utf-8"))["text"] == "$GPGGA,1*00"


def test_going_on_cuts_half_a_line_and_writes_no_fix_twice(tmp_path: Path) -> None:
    session = Session(settings(), [chart()])
    fixes: list[tuple[int, Fix]] = []
    for packet in FLIGHT.packets()[:400]:
        fixes += [(session.packets, one) for one in session.take(packet) if isinstance(one, Fix)]
    recorder = Recorder(tmp_path, ("a",))
    for number, fix in fixes[:10]:
        recorder.fix(number, fix)
    recorder.close()
    whole = (tmp_path / FIXES).read_bytes()
    (tmp_path / FIXES).write_bytes(whole[:-25])
    again = Recorder(tmp_path, ("a",), resume_bytes=len(header(("a",))))
    for number, fix in fixes[5:20]:
        again.fix(number, fix)
    again.close()
    numbers = [json.loads(line)["packet"] for line in (tmp_path / FIXES).read_text(encoding="utf-8").splitlines()]
    assert numbers == [number for number, _ in fixes[:20]]


def test_a_full_disk_costs_the_recording_and_not_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recorder = Recorder(tmp_path, ("a",))
    recorder.packet(FLIGHT.packets()[0])

    class Full:
        def write(self, data: bytes) -> int:
            raise OSError(28, "No space left on device")

        def flush(self) -> None:
            raise OSError(28, "No space left on device")

        close = flush
        name = "full"

    monkeypatch.setitem(recorder._files, RECEIVED, Full())
    for packet in FLIGHT.packets()[:5]:
        recorder.packet(packet)
    recorder.remark(Remark(0, "info", "a", "b"))
    recorder.close()
    assert "No space left on device" in recorder.failed
    assert recorder.failed.endswith("nothing is recorded from here on")


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x", encoding="ascii")
    with pytest.raises(DataError, match="cannot be written"):
        Recorder(tmp_path / "file" / "run", ("a",))


def test_own_messages_of_a_run_open_as_a_log_too(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, ("a",))
    encoder = Encoder(1)
    for second in range(3):
        recorder.sent("back", HOST_US + second * 1_000_000, encoder.heartbeat())
    recorder.close()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = list(opened(tmp_path / "sent.tlog").packets())
    assert len(found) == 3


def test_the_length_of_the_container_is_known_without_looking(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, ("a",))
    for packet in FLIGHT.packets()[:30]:
        recorder.packet(packet)
    length = recorder.received_bytes
    assert length == (tmp_path / RECEIVED).stat().st_size
    recorder.close()
    again = Recorder(tmp_path, ("a",), resume_bytes=length)
    again.packet(FLIGHT.packets()[30])
    assert again.received_bytes == (tmp_path / RECEIVED).stat().st_size > length
    again.close()


def test_a_folder_that_goes_away_ends_the_recording_alone(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "run", ("a",))
    (tmp_path / "run").rename(tmp_path / "gone")
    recorder.packet(FLIGHT.packets()[0])
    recorder.remark(Remark(0, "info", "a", "b"))
    assert recorder.received_bytes > 0
    assert "nothing is recorded from here on" in recorder.failed
    recorder.close()
