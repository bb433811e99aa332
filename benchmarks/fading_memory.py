"""The fading-memory recursion on 201 x 201 cells: alone from a sampled field, and with the map sampled."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.lattice import AXIS, GEOGRAPHIC, SIDE, SIZE, _blended
from benchmarks.limits import byte_ns, fetch_ns
from benchmarks.timing import Limit, Peer, Row, least_ns
from terranav.kernels.fading_memory import fade, recall

FloatArray = NDArray[np.float64]

VALUE, WEIGHT, ALPHA = 480.0, 0.01, 0.985


def rows() -> list[Row]:
    rng = np.random.default_rng(1)
    values = rng.normal(500.0, 100.0, (SIDE, SIDE)).astype(np.float32)
    before, after, room = rng.uniform(0.0, 1e3, (SIZE, SIZE)), np.empty((SIZE, SIZE)), np.empty((SIZE, SIZE))
    field = _blended(values, GEOGRAPHIC)
    flat = field.ravel(), VALUE, WEIGHT, ALPHA, before.ravel(), after.ravel()
    frame, given = np.stack([GEOGRAPHIC.row, GEOGRAPHIC.col]), (VALUE, WEIGHT)

    def in_place(out: FloatArray, sampled: FloatArray) -> FloatArray:
        np.subtract(VALUE, sampled, out=room)
        np.multiply(room, room, out=room)
        np.multiply(room, WEIGHT, out=room)
        np.multiply(before, ALPHA, out=out)
        return np.add(out, room, out=out)

    def plain(sampled: FloatArray) -> FloatArray:
        return np.asarray(ALPHA * before + WEIGHT * (VALUE - sampled) ** 2)

    fade(*flat)
    np.testing.assert_allclose(after, plain(field), rtol=1e-12)
    recall(values, frame, (AXIS, AXIS), given, ALPHA, before, after)
    np.testing.assert_allclose(after, plain(field), rtol=1e-9)
    scratch = np.empty_like(after)
    least = least_ns(
        {
            "fade": lambda: fade(*flat),
            "plain": lambda: plain(field),
            "in place": lambda: in_place(scratch, field),
            "recall": lambda: recall(values, frame, (AXIS, AXIS), given, ALPHA, before, after),
            "sampled": lambda: plain(_blended(values, GEOGRAPHIC)),
        },
        SIZE * SIZE,
        repeats=40,
    )
    moved = 24 * byte_ns(24 * SIZE * SIZE)
    alone = (Peer("numpy", least["plain"], 10.0, reached=3.5), Peer("numpy without new arrays", least["in place"]))
    looked_up = Limit("24 bytes and 2 fetches", moved + 2 * fetch_ns(SIDE, SIZE / 4), 1.3)
    return [
        Row("fading memory 201 x 201, field given", "cell", least["fade"], alone, Limit("24 bytes", moved, 1.3)),
        Row(
            "fading memory 201 x 201, map sampled",
            "cell",
            least["recall"],
            (Peer("numpy", least["sampled"], 5.0),),
            looked_up,
        ),
    ]
