"""A run that was stopped anywhere goes on with the same bits, from whichever checkpoint is whole."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from terranav.core.errors import ConfigError, DataError
from terranav.live import checkpoints
from terranav.live.recorder import RECEIVED, Recorder
from terranav.live.records import Packet
from terranav.live.session import Session
from tests.live.flights import Flight, chart, settings

PACKETS = Flight(seconds=30.0).packets()
LINKS = ("udpin:14550",)


def interrupted(folder: Path, stop: int, saves: tuple[int, ...]) -> None:
    """Write what a run leaves that was killed after `stop` packets."""
    recorder, session = Recorder(folder, LINKS), Session(settings(), [chart()])
    for number, packet in enumerate(PACKETS[:stop], start=1):
        recorder.packet(packet)
        session.take(packet)
        if number in saves:
            checkpoints.write(folder, *session.saved(recorder.received_bytes))
    recorder.close()


def gone_on(folder: Path, remarks: list[str], rest: list[Packet]) -> tuple[Session, int]:
    """Go on with a run to its end; the session, and the packets that a checkpoint stood for."""
    session = Session(settings(), [chart()])
    resumed = session.resume(folder, remarks)
    for _ in resumed.catch_up(remarks):
        pass
    assert resumed.links == LINKS
    for packet in rest:
        session.take(packet)
    return session, resumed.checkpoint


@pytest.fixture(scope="module")
def whole() -> Session:
    session = Session(settings(), [chart()])
    for packet in PACKETS:
        session.take(packet)
    return session


def same(one: Session, other: Session) -> bool:
    return (one.digest, one.packets, one.fixes, one.usable) == (other.digest, other.packets, other.fixes, other.usable)


def test_a_run_goes_on_from_a_checkpoint_and_its_recording(tmp_path: Path, whole: Session) -> None:
    interrupted(tmp_path, 1200, (600, 1100))
    remarks: list[str] = []
    session, found = gone_on(tmp_path, remarks, PACKETS[1200:])
    assert found == 1100
    assert not remarks
    assert same(session, whole)


@pytest.mark.parametrize("seed", range(3))
def test_a_run_killed_at_a_random_byte_goes_on(tmp_path: Path, whole: Session, seed: int) -> None:
    rng = np.random.default_rng(seed)
    interrupted(tmp_path, 1500, (500, 900))
    file = tmp_path / RECEIVED
    cut = int(rng.integers(file.stat().st_size // 2, file.stat().st_size))
    file.write_bytes(file.read_bytes()[:cut])
    session = Session(settings(), [chart()])
    remarks: list[str] = []
    resumed = session.resume(tmp_path, remarks)
    for _ in resumed.catch_up(remarks):
        pass
    lost = session.packets
    for packet in PACKETS[lost:]:
        session.take(packet)
    assert resumed.end_bytes <= cut
    assert same(session, whole)


@pytest.mark.parametrize("damage", ["cut", "flipped", "alien", "empty"])
def test_a_broken_checkpoint_is_remarked_on_and_the_one_before_is_used(
    tmp_path: Path, whole: Session, damage: str
) -> None:
    interrupted(tmp_path, 1200, (600, 1100))
    newest = max(tmp_path.glob("checkpoint-*"))
    data = bytearray(newest.read_bytes())
    if damage == "cut":
        data = data[: len(data) // 2]
    elif damage == "flipped":
        data[len(data) // 2] ^= 1
    else:
        data = bytearray(b"" if damage == "empty" else b"something else\n\n\n")
    newest.write_bytes(data)
    remarks: list[str] = []
    session, found = gone_on(tmp_path, remarks, PACKETS[1200:])
    assert found == 600
    assert len(remarks) == 1
    assert newest.name in remarks[0]
    assert same(session, whole)


def test_without_any_checkpoint_all_of_the_recording_is_worked_through_again(tmp_path: Path, whole: Session) -> None:
    interrupted(tmp_path, 800, ())
    session, found = gone_on(tmp_path, [], PACKETS[800:])
    assert found == 0
    assert same(session, whole)


def test_a_checkpoint_of_other_settings_is_refused(tmp_path: Path) -> None:
    interrupted(tmp_path, 300, (250,))
    session, remarks = Session(settings(seed=5), [chart()]), list[str]()
    with pytest.raises(ConfigError):
        session.resume(tmp_path, remarks)
    assert "of another run" in remarks[0]


def test_a_checkpoint_newer_than_the_recording_is_left_out(tmp_path: Path) -> None:
    interrupted(tmp_path, 600, (100, 580))
    file = tmp_path / RECEIVED
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    session, remarks = Session(settings(), [chart()]), list[str]()
    assert session.resume(tmp_path, remarks).checkpoint == 100
    assert "the recording ends before it" in remarks[0]


def test_two_are_kept_and_no_part_is_left(tmp_path: Path) -> None:
    for packets in (10, 20, 30):
        checkpoints.write(tmp_path, {"packets": packets}, b"x" * packets)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "checkpoint-000000000020.tncp",
        "checkpoint-000000000030.tncp",
    ]
    assert [facts["packets"] for facts, _ in checkpoints.usable(tmp_path, [])] == [30, 20]


def test_a_folder_without_a_recording_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=RECEIVED):
        Session(settings(), [chart()]).resume(tmp_path, [])
