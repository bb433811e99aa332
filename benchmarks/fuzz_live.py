"""Damaged messages by the million: the live engine must take them all.

    python -m benchmarks.fuzz_live --messages 1000000

A plain flight is fed in episodes, each with an engine of its own and other settings; among its messages come damaged
ones, as many as asked for in all: bytes flipped with and without a right checksum, frames cut and drawn out, fields at
their limits, NaN and infinite, other senders, any message of the dialect with random content, NMEA sentences with a
right checksum and wrong fields, random bytes, empty packets, host stamps that step anywhere. Half of the damage comes
as whole packets, half as a stream of bytes through the deframers.

What is counted as a failure: an exception, also one of the navigator's that the engine caught, a fix that is not
finite or of no sigma, a remark that is no single line, facts that are no JSON, a checkpoint that cannot be resumed.
Random content with a right checksum can describe another flight, so that nothing is said here of how right a fix is;
tests/live/test_abuse.py does.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import resource
import struct
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from functools import reduce
from operator import xor
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

from benchmarks.live_messages import Flight, chart
from terranav.live.deframing import Deframer, LineDeframer, crc
from terranav.live.engine import NAVIGATOR_FAULT, Engine
from terranav.live.records import Fix, Packet, Remark
from terranav.live.settings import LiveSettings

EPISODE = 10_000  # damaged messages
SOURCES = ("velocity", "position", "airspeed")
READ = (0, 2, 24, 29, 30, 32, 33, 74, 105, 132, 141)
SENTENCES = ("GPGGA", "GPRMC", "HEHDT", "GPVTG", "VDVBW", "SDDPT", "SDDBT", "PASHR", "GPZDA", "XXABC")
FIELDS = (
    "",
    "A",
    "V",
    "T",
    "N",
    "E",
    "S",
    "W",
    "0",
    "-1",
    "1e999",
    "nan",
    "4717.1",
    "00833.9",
    "092725.00",
    "999999.99",
)
_EXTREMES = {
    "f": (math.nan, math.inf, -math.inf, 0.0, 1e30, -1e30, 1e-40),
    "d": (math.nan, math.inf, -math.inf, 0.0, 1e300, -1e300),
}
_WIDTHS = {"b": 8, "B": 8, "h": 16, "H": 16, "i": 32, "I": 32, "q": 64, "Q": 64}


def whole(number: int, payload: bytes, rng: random.Random, *, own: bool) -> bytes:
    """A MAVLink 2 frame with a right checksum."""
    sender = (1, 1) if own else (rng.randrange(256), rng.randrange(256))
    header = struct.pack("<BBBBBB", len(payload), 0, 0, rng.randrange(256), *sender)
    body = header + struct.pack("<I", number)[:3] + payload
    return b"\xfd" + body + struct.pack("<H", crc(body, dialect.mavlink_map[number].crc_extra))


def any_message(rng: random.Random) -> bytes:
    """A message that is read, or any other of the dialect, with fields at random and at their limits."""
    number = rng.choice(READ) if rng.random() < 0.8 else rng.choice(list(dialect.mavlink_map))
    layout: str = dialect.mavlink_map[number].unpacker.format
    values: list[Any] = []
    for code in layout[1:]:
        if code in _EXTREMES:
            values.append(rng.choice(_EXTREMES[code]) if rng.random() < 0.5 else rng.uniform(-1e4, 1e4))
        elif code in _WIDTHS:
            size = _WIDTHS[code]
            low = -(1 << (size - 1)) if code.islower() else 0
            high = low + (1 << size) - 1
            values.append(rng.choice((low, high, 0)) if rng.random() < 0.3 else rng.randint(low, high))
        elif not code.isdigit():
            return whole(number, rng.randbytes(rng.randrange(1, 60)), rng, own=True)
    try:
        payload = struct.pack(layout, *values)
    except struct.error:
        payload = rng.randbytes(struct.calcsize(layout))
    return whole(
        number,
        payload[: rng.randrange(1, len(payload) + 1)] if rng.random() < 0.1 else payload,
        rng,
        own=rng.random() < 0.8,
    )


def mended(frame: bytes, rng: random.Random) -> bytes:
    """A frame with some bytes of its content changed, and a right checksum."""
    data = bytearray(frame)
    for _ in range(rng.randrange(1, 4)):
        data[rng.randrange(10, max(len(data) - 2, 11))] = rng.randrange(256)
    number = data[7] | data[8] << 8 | data[9] << 16
    data[-2:] = struct.pack("<H", crc(bytes(data[1:-2]), dialect.mavlink_map[number].crc_extra))
    return bytes(data)


def flipped(frame: bytes, rng: random.Random) -> bytes:
    """A frame with bits flipped, cut short or drawn out."""
    data = bytearray(frame)
    for _ in range(rng.randrange(1, 5)):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return (
        bytes(data[: rng.randrange(1, len(data))])
        if rng.random() < 0.3
        else bytes(data) + rng.randbytes(rng.randrange(4))
    )


def sentence(rng: random.Random) -> bytes:
    """An NMEA sentence with a right checksum, mostly, and fields at random."""
    fields = [
        rng.choice(FIELDS) if rng.random() < 0.7 else f"{rng.uniform(-500.0, 500.0):.3f}"
        for _ in range(rng.randrange(16))
    ]
    text = ",".join([rng.choice(SENTENCES), *fields]).encode()
    check = reduce(xor, text) if rng.random() < 0.9 else rng.randrange(256)
    return b"$" + text + b"*%02X" % check


def noise(rng: random.Random) -> bytes:
    """Random bytes, with a beginning that looks like something now and then."""
    return rng.choice((b"", b"\xfd", b"\xfe", b"$", b"!", b"$GPGGA,")) + rng.randbytes(rng.randrange(0, 300))


def damaged(frame: bytes, rng: random.Random) -> bytes:
    """One damaged message; what it is made of is near at hand."""
    makers: tuple[Callable[[], bytes], ...] = (
        lambda: any_message(rng),
        lambda: mended(frame, rng),
        lambda: flipped(frame, rng),
        lambda: sentence(rng),
        lambda: noise(rng),
        lambda: b"",
    )
    return rng.choices(makers, weights=(30, 25, 20, 15, 9, 1))[0]()


def stamp(now_us: int, rng: random.Random) -> int:
    """When it comes in: now, mostly."""
    if rng.random() < 0.995:
        return now_us + rng.randrange(20_000)
    return rng.choice((0, 1, now_us + 3_600_000_000, now_us - 3_600_000_000, 2**62, -(2**62), rng.randrange(2**60)))


def episode(flight: Flight, count: int, rng: random.Random) -> Iterator[Packet]:
    """The flight with `count` damaged messages among its own."""
    frames, lines = Deframer(), LineDeframer()
    packets = flight.packets()
    share = count / len(packets)
    done = 0
    for i, packet in enumerate(packets):
        if rng.random() > 0.05:
            yield packet
        while done < (i + 1) * share and done < count:
            done += 1
            data = damaged(packet.data, rng)
            link = rng.randrange(3) if rng.random() < 0.99 else rng.randrange(-1, 2**31)
            if rng.random() < 0.5:
                yield Packet(stamp(packet.stamp_us, rng), link, data)
                continue
            for whole_one in (*frames.feed(data), *lines.feed(data)):
                yield Packet(stamp(packet.stamp_us, rng), link, whole_one)


def unsound(said: Fix | Remark) -> str:
    """What is wrong with a fix or a remark, or nothing."""
    if isinstance(said, Remark):
        if said.key == NAVIGATOR_FAULT:
            return said.text
        return "" if said.text and len(said.text.splitlines()) == 1 else f"remark {said.text!r}"
    numbers = [
        said.lat_deg,
        said.lon_deg,
        said.alt_m,
        *said.sigma_m,
        *(said.velocity_mps or ()),
        *(said.attitude_deg or ()),
    ]
    sound = all(map(math.isfinite, numbers)) and min(said.sigma_m) > 0.0 and (said.usable or bool(said.withheld))
    return "" if sound else f"fix {said}"


def fuzz(
    messages: int, seed: int, on_episode: Callable[[int, Counter[str]], None] | None = None
) -> tuple[Counter[str], list[str]]:
    """Counts of what happened, and the failures in words; `messages` damaged ones, the plain ones beside them."""
    counts: Counter[str] = Counter()
    failures: list[str] = []
    done = number = 0
    while done < messages:
        rng = random.Random(seed * 1_000_003 + number)
        size = min(EPISODE, messages - done)
        told = LiveSettings(
            ins_source=SOURCES[number % 3],
            start_deg=chart().centre_deg if number % 4 == 3 else None,
            system_id=1 if number % 2 else None,
            spacing_cells=0.0 if number % 5 == 4 else 0.5,
            estimator_settings={"particles": 1000},
            seed=number,
        )
        flight = Flight(seconds=60.0, seed=number, kind=3 * (number % 2), course_deg=37.0 * number)
        _episode(Engine(told, [chart()]), episode(flight, size, rng), told, counts, failures)
        done += size
        number += 1
        if on_episode is not None:
            on_episode(done, counts)
    counts["messages"] = done
    return counts, failures


def _episode(
    engine: Engine, packets: Iterator[Packet], told: LiveSettings, counts: Counter[str], failures: list[str]
) -> None:
    """Feed one episode; resume the engine from a checkpoint now and then."""
    for i, packet in enumerate(packets):
        counts["packets"] += 1
        try:
            said = engine.feed(packet)
            if i % 4001 == 4000:
                engine = Engine.resumed(told, [chart()], engine.checkpoint())
                json.dumps(engine.facts, allow_nan=False)
        except Exception:  # noqa: BLE001 - that is what is looked for
            failures.append(f"packet {packet!r}: {traceback.format_exc()}")
            continue
        for one in said:
            counts["fixes" if isinstance(one, Fix) else "remarks"] += 1
            counts["usable"] += isinstance(one, Fix) and one.usable
            if wrong := unsound(one):
                failures.append(wrong)
    counts["heard"] += sum(one["count"] for one in engine.facts["messages"].values())


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fuzz_live", description=__doc__.split("\n")[0])
    parser.add_argument("--messages", type=int, default=100_000, help="damaged messages")
    parser.add_argument("--seed", type=int, default=1)
    told = parser.parse_args()
    if told.messages < 1 or told.seed < 0:
        parser.error(f"--messages {told.messages} --seed {told.seed}, expected at least 1 and 0")
    began = time.perf_counter()

    def shown(done: int, counts: Counter[str]) -> None:
        if sys.stderr.isatty():
            print(f"\r{done} of {told.messages}", end="", file=sys.stderr, flush=True)

    counts, failures = fuzz(told.messages, told.seed, shown)
    took = time.perf_counter() - began
    for text in failures[:5]:
        print(text)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    print(
        f"{counts['messages']} damaged messages among {counts['packets']} packets (seed {told.seed}), "
        f"{counts['heard']} heard; "
        f"{counts['fixes']} fixes, {counts['usable']} usable, {counts['remarks']} remarks; {len(failures)} failures; "
        f"{took:.0f} s, at most {peak:.0f} MiB"
    )
    raise SystemExit(1 if failures else 0)


if __name__ == "__main__":
    main()
