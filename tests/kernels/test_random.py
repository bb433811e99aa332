"""Normal numbers by counter: known answers, the same bits everywhere, and the statistics of independent normals.

Seeds are fixed. Each statistic's threshold is one that true normal numbers would pass with all but a 1e-3 chance.
"""

from __future__ import annotations

import math
import os
import platform
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from terranav.filters._normals import standard_normal
from terranav.kernels.random import BLOCK, box_muller, normal_pairs, normals, philox

FloatArray = NDArray[np.float64]
KEYS = (0, 1, 0x9E3779B97F4A7C15)
ALL_ONES = 2**64 - 1


def drawn(key: int, count: int) -> FloatArray:
    out = np.empty(count)
    normals(np.uint64(key), out)
    return out


def philox_in_integers(key: int, counter: int) -> int:
    """Salmon et al. 2011 in whole numbers of Python, words as in section 3.1 and figure 3."""
    k = [key & 0xFFFFFFFF, key >> 32]
    x = [(counter >> (32 * i)) & 0xFFFFFFFF for i in range(4)]
    for _ in range(10):
        p, q = 0xD2511F53 * x[0], 0xCD9E8D57 * x[2]
        x = [(q >> 32) ^ x[1] ^ k[0], q & 0xFFFFFFFF, (p >> 32) ^ x[3] ^ k[1], p & 0xFFFFFFFF]
        k = [(k[0] + 0x9E3779B9) & 0xFFFFFFFF, (k[1] + 0xBB67AE85) & 0xFFFFFFFF]
    return sum(word << (32 * i) for i, word in enumerate(x))


def bits_of(key: int, counter: int) -> int:
    low, high = philox(np.uint64(key), np.uint64(counter & ALL_ONES), np.uint64(counter >> 64))
    return int(low) | int(high) << 64


@pytest.mark.parametrize(
    ("counter", "key", "words"),
    [  # the known answers published with the authors' Random123 library, lowest word first
        ((0, 0, 0, 0), (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
        ((0xFFFFFFFF,) * 4, (0xFFFFFFFF,) * 2, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
        (
            (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
            (0xA4093822, 0x299F31D0),
            (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
        ),
    ],
)
def test_philox_gives_the_published_answers(
    counter: tuple[int, ...], key: tuple[int, int], words: tuple[int, ...]
) -> None:
    whole = sum(word << (32 * i) for i, word in enumerate(counter))
    want = sum(word << (32 * i) for i, word in enumerate(words))
    assert bits_of(key[0] | key[1] << 32, whole) == want
    assert philox_in_integers(key[0] | key[1] << 32, whole) == want


def test_numbers_are_box_muller_of_the_bits() -> None:
    key, pairs = 0x0123456789ABCDEF, 3000
    got = drawn(key, 2 * pairs).reshape(pairs, 2)
    bits = [philox_in_integers(key, i) for i in range(pairs)]
    u = np.array([((b & ALL_ONES) >> 12) + 0.5 for b in bits], dtype=np.longdouble) / 2.0**52
    second = [b >> 64 for b in bits]
    angle = np.array([(b >> 12) / 2.0**52 - 0.5 for b in second], dtype=np.longdouble) * np.longdouble(math.pi / 2.0)
    radius = np.sqrt(-2.0 * np.log(u)) * np.array([-1.0 if b & 1 else 1.0 for b in second])
    swapped = np.array([bool(b & 2) for b in second])
    one, other = radius * np.cos(angle), radius * np.sin(angle)
    want = np.stack([np.where(swapped, other, one), np.where(swapped, one, other)], axis=1)
    assert np.abs((got - want) / np.abs(radius)[:, None]).max() < 1e-13


def test_the_ends_of_the_range() -> None:
    largest = box_muller(np.uint64(0), np.uint64(2**63))  # the middle of the arc: cosine one, sine zero
    assert largest == (pytest.approx(math.sqrt(2.0 * 53.0 * math.log(2.0)), rel=1e-13), 0.0)
    assert largest[0] > 8.5
    least = box_muller(np.uint64(ALL_ONES), np.uint64(2**63))[0]
    assert least == pytest.approx(math.sqrt(2.0 * 2.0**-53), rel=1e-13)
    for first in (0, 1, 2**63 - 1, 2**63, ALL_ONES):
        for second in (0, 1, 2, 3, 2**63, ALL_ONES):
            assert np.isfinite(box_muller(np.uint64(first), np.uint64(second))).all()


@pytest.mark.parametrize("count", [0, 1, 2, 3, 7, 2 * BLOCK - 1, 2 * BLOCK, 2 * BLOCK + 1, 5 * BLOCK + 13])
def test_a_number_depends_on_key_and_index_only(count: int) -> None:
    whole = drawn(5, 6 * BLOCK)
    np.testing.assert_array_equal(drawn(5, count), whole[:count])
    left, right = np.empty(count // 2), np.empty(count // 2)
    normal_pairs(np.uint64(5), 40, left, right)
    np.testing.assert_array_equal(left, whole[80 : 80 + 2 * left.size : 2])
    np.testing.assert_array_equal(right, whole[81 : 81 + 2 * left.size : 2])


def test_the_same_bits_on_many_threads() -> None:
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(lambda key: drawn(key, 20_001), list(range(16)) * 4))
    for i, numbers in enumerate(found):
        np.testing.assert_array_equal(numbers, drawn(i % 16, 20_001))


SCRIPT = """
import numpy as np
from terranav.kernels.random import normals
out = np.empty(2301)
normals(np.uint64(0xFEDCBA9876543210), out)
print(out.tobytes().hex())
"""


@pytest.mark.parametrize("setting", ["NUMBA_CPU_NAME=x86-64-v3", "NUMBA_CPU_NAME=x86-64", "NUMBA_DISABLE_JIT=1"])
def test_the_same_bits_on_other_processors_and_uncompiled(setting: str) -> None:
    if "x86" in setting and platform.machine() not in {"x86_64", "AMD64"}:
        pytest.skip("another family of processors")
    name, value = setting.split("=")
    said = subprocess.run(
        [sys.executable, "-W", "error", "-c", SCRIPT],
        env={**os.environ, name: value},
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert said.strip() == drawn(0xFEDCBA9876543210, 2301).tobytes().hex()


def test_standard_normal_takes_one_draw_from_the_generator() -> None:
    one, other, third = (np.random.default_rng(3) for _ in range(3))
    numbers = standard_normal(one, (101, 3))
    assert numbers.shape == (101, 3)
    np.testing.assert_array_equal(numbers.ravel()[:50], standard_normal(other, (50,)))
    assert one.bit_generator.state == other.bit_generator.state
    third.integers(0, ALL_ONES, dtype=np.uint64, endpoint=True)
    assert one.bit_generator.state == third.bit_generator.state
    assert not np.array_equal(standard_normal(one, (101, 3)), numbers)


@pytest.mark.parametrize("key", KEYS)
def test_moments_one_to_six(key: int) -> None:
    count = 2**22
    numbers = drawn(key, count)
    normal = stats.norm()
    for order in range(1, 7):
        mean, square = normal.moment(order), normal.moment(2 * order)
        z = (np.mean(numbers**order) - mean) / math.sqrt((square - mean**2) / count)
        assert abs(z) < 3.9, order  # 18 of them: 1e-4 each


@pytest.mark.parametrize("key", KEYS)
def test_distribution(key: int) -> None:
    numbers = drawn(key, 2**21)
    assert stats.kstest(numbers, "norm").pvalue > 1e-3
    assert stats.kstest(np.abs(numbers), "halfnorm").pvalue > 1e-3
    counts = np.bincount((stats.norm.cdf(numbers) * 4096).astype(np.int64), minlength=4096)
    assert 5e-4 < stats.chisquare(counts).pvalue < 1.0 - 5e-4  # too even is no chance either


@pytest.mark.parametrize("key", KEYS)
def test_tails(key: int) -> None:
    count = 2**24
    numbers = drawn(key, count)
    for threshold in (3.0, 4.0, 4.5, 5.0):
        for beyond, share in (
            (np.count_nonzero(numbers > threshold), stats.norm.sf(threshold)),
            (np.count_nonzero(numbers < -threshold), stats.norm.sf(threshold)),
        ):
            assert stats.binomtest(int(beyond), count, share).pvalue > 1e-4, threshold


@pytest.mark.parametrize("key", KEYS)
def test_no_serial_correlation(key: int) -> None:
    numbers = drawn(key, 2**20)
    lags = [*range(1, 33), 63, 64, 65, 255, 256, 257, 511, 512, 513, 1023, 1024, 4096, 65536, 2**19]
    for values in (numbers, numbers**2 - 1.0, np.sign(numbers), np.abs(numbers) - math.sqrt(2.0 / math.pi)):
        deviation = values.std() ** 2
        for lag in lags:
            z = np.mean(values[lag:] * values[:-lag]) / deviation * math.sqrt(values.size - lag)
            assert abs(z) < 4.5, lag  # 184 of a key: 7e-6 each


@pytest.mark.parametrize("key", KEYS)
def test_mates_of_a_pair_are_independent(key: int) -> None:
    one, other = drawn(key, 2**22).reshape(-1, 2).T
    cell = [(stats.norm.cdf(part) * 64).astype(np.int64) for part in (one, other)]
    counts = np.bincount(64 * cell[0] + cell[1], minlength=64 * 64)
    assert 5e-4 < stats.chisquare(counts).pvalue < 1.0 - 5e-4
    assert stats.kstest(np.arctan2(other, one) / (2.0 * math.pi) + 0.5, "uniform").pvalue > 1e-3
    assert stats.kstest(0.5 * (one**2 + other**2), "expon").pvalue > 1e-3


@pytest.mark.parametrize("start", KEYS)
def test_streams_of_near_keys_are_independent(start: int) -> None:
    """The keys that follow, and those that differ in one bit."""
    keys = [start, *((start + i) % 2**64 for i in range(1, 33)), *(start ^ (1 << bit) for bit in range(64))]
    streams = np.stack([drawn(key, 2**15) for key in dict.fromkeys(keys)])
    for values in (streams, streams**2 - 1.0):
        unit = values / values.std(axis=1, keepdims=True)
        z = np.abs(unit @ unit.T / math.sqrt(unit.shape[1]))[np.triu_indices(len(unit), 1)]
        assert z.max() < 5.5  # about 4,600 pairs; the squares' tails are a little heavy
        assert abs(np.mean(z < 0.6745) - 0.5) < 4.0 * 0.5 / math.sqrt(z.size)  # half of them within the quartiles
    across = streams.sum(axis=0) / math.sqrt(len(streams))
    assert stats.kstest(across, "norm").pvalue > 1e-3


def test_each_bit_of_philox_is_even_and_every_input_bit_moves_half_of_them() -> None:
    rng = np.random.default_rng(11)
    count = 2000
    flips = np.zeros((192, 128))
    ones = np.zeros(128)
    for _ in range(count // 10):
        key = int(rng.integers(0, ALL_ONES, dtype=np.uint64, endpoint=True))
        for counter in range(10):
            ones += [bits_of(key, counter) >> bit & 1 for bit in range(128)]
    for _ in range(100):
        key = int(rng.integers(0, ALL_ONES, dtype=np.uint64, endpoint=True))
        counter = int(rng.integers(0, 2**40))
        before = bits_of(key, counter)
        for bit in range(192):
            moved = bits_of(key ^ (1 << bit), counter) if bit < 64 else bits_of(key, counter ^ (1 << (bit - 64)))
            flips[bit] += [(moved ^ before) >> at & 1 for at in range(128)]
    assert np.abs(ones - count / 2).max() < 4.6 * math.sqrt(count / 4)
    assert np.abs(flips.sum(axis=1) - 6400.0).max() < 4.6 * math.sqrt(12800.0 / 4.0)
    assert np.abs(flips.sum(axis=0) - 9600.0).max() < 4.6 * math.sqrt(19200.0 / 4.0)
