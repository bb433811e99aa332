"""A slice of benchmarks/fuzz_live.py, and messages that hypothesis makes up: nothing raises, all said is sound."""

from __future__ import annotations

from typing import Any

import pytest
from benchmarks.fuzz_live import READ, SENTENCES, fuzz, unsound, whole
from hypothesis import HealthCheck, given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from terranav.live.engine import Engine
from terranav.live.mavlink_in import MavlinkIn
from terranav.live.nmea_in import NmeaIn
from terranav.live.records import Packet
from tests.live.flights import Flight, chart, settings
from tests.live.test_nmea_in import line


def test_five_thousand_damaged_messages() -> None:
    counts, failures = fuzz(5_000, seed=99)
    assert failures == []
    assert counts["fixes"] > 100
    assert counts["messages"] == 5_000


class _Drawn:
    """Stands in for random.Random: any header."""

    def randrange(self, stop: int) -> int:
        return stop - 1


@given(number=st.sampled_from(READ), payload=st.binary(min_size=1, max_size=60), own=st.booleans())
def test_any_content_with_a_right_checksum_is_read(number: int, payload: bytes, own: bool) -> None:
    drawn: Any = _Drawn()
    heard = MavlinkIn().heard(whole(number, payload, drawn, own=own))
    assert heard is not None
    for text in heard.rejected:
        assert len(text.splitlines()) == 1
    for word in heard.words:
        assert "inf" not in repr(word)
        # a receiver without a fix has no place; nothing else may be no number
        assert "nan" not in repr(word) or type(word).__name__ == "Gnss"


@given(kind=st.sampled_from(SENTENCES), fields=st.lists(st.text("0123456789.-ANESWVTM,ex", max_size=9), max_size=16))
def test_any_sentence_with_a_right_checksum_is_read(kind: str, fields: list[str]) -> None:
    heard = NmeaIn().heard(line(",".join([kind, *fields])))
    for word in heard.words if heard is not None else ():
        assert "inf" not in repr(word)
        assert "nan" not in repr(word)


@pytest.fixture(scope="module")
def flying() -> tuple[bytes, int]:
    """An engine in flight, as bytes, and the host's stamp."""
    engine = Engine(settings(), [chart()])
    packets = Flight(seconds=8.0).packets()
    for packet in packets:
        engine.feed(packet)
    return engine.checkpoint(), packets[-1].stamp_us


_PIECES = st.one_of(
    st.binary(max_size=80),
    st.builds(
        lambda number, payload: whole(number, payload, _Drawn(), own=True),  # type: ignore[arg-type]
        st.sampled_from(READ),
        st.binary(min_size=1, max_size=60),
    ),
    st.text("$!GPADTMHELO,*0123456789.-", max_size=80).map(str.encode),
)


@hypothesis_settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(_PIECES, st.integers(-(2**40), 2**40), st.integers(0, 3)), max_size=40))
def test_an_engine_in_flight_takes_anything(flying: tuple[bytes, int], pieces: list[tuple[bytes, int, int]]) -> None:
    data, stamp_us = flying
    engine = Engine.resumed(settings(), [chart()], data)
    for piece, late_us, link in pieces:
        for said in engine.feed(Packet(stamp_us + late_us, link, piece)):
            assert not unsound(said)
    assert engine.facts["packets"] >= 400 + len(pieces)
