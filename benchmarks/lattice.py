"""Bilinear sampling of a 201 x 201 lattice of places in metres, on the three kinds of map that the kernel knows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from benchmarks.limits import byte_ns, fetch_ns, multiply_add_ns
from benchmarks.timing import Limit, Peer, Row, least_ns
from terranav.kernels.lattice import bilinear_lattice
from terranav.maps.frame import LocalFrame

FloatArray = NDArray[np.float64]

SIDE, SIZE, CELL = 601, 201, 30.0
AXIS = CELL * (np.arange(SIZE, dtype=np.float64) - SIZE // 2)
STEP = 1.0 / CELL
# cells of a map in degrees at 47 north whose geometric mean is the lattice's step
GEOGRAPHIC = LocalFrame(
    np.array([300.3, -0.826 * STEP, 0.0, 1e-9, 0.0, 0.0]), np.array([300.4, 0.0, 1.21 * STEP, 0.0, 6e-9, 0.0])
)
OWN = LocalFrame(np.array([300.3, -STEP, 0.0, 0.0, 0.0, 0.0]), np.array([300.4, 0.0, STEP, 0.0, 0.0, 0.0]))
# the convergence of the meridians turns a map in a transverse Mercator projection by up to two degrees
PROJECTED = LocalFrame(
    np.array([300.3, -STEP, 0.03 * STEP, 2e-9, -3e-9, 2e-9]), np.array([300.4, 0.03 * STEP, STEP, 1e-9, 3e-9, 1e-9])
)


def rows() -> list[Row]:
    values = np.random.default_rng(1).normal(500.0, 100.0, (SIDE, SIDE)).astype(np.float32)
    near = fetch_ns(SIDE, SIZE / 4)
    bound = 8 * byte_ns(8 * SIZE * SIZE)
    return [
        _row(values, GEOGRAPHIC, "in degrees", Limit("2 fetches", 2 * near + bound, 1.3), 6.0),
        _row(
            values,
            OWN,
            "of its own cells",
            Limit("4 conversions, 4 multiply-adds", 8 * multiply_add_ns() + bound, 1.3),
            4.0,
        ),
        _row(values, PROJECTED, "projected", Limit("4 fetches", 4 * near + bound, 1.3), 4.0),
    ]


def _row(values: NDArray[np.float32], frame: LocalFrame, name: str, limit: Limit, goal: float) -> Row:
    ours = np.empty((SIZE, SIZE))
    peers = {"numpy": _slices if frame is OWN else _blended if frame is GEOGRAPHIC else _gathered, "scipy": _scipy}
    bilinear_lattice(values, frame.row, frame.col, -AXIS, -AXIS, ours)
    for peer in peers.values():
        np.testing.assert_allclose(ours, peer(values, frame), rtol=1e-9, atol=1e-9)
    least = least_ns(
        {
            "ours": lambda: bilinear_lattice(values, frame.row, frame.col, -AXIS, -AXIS, ours),
            "numpy": lambda: peers["numpy"](values, frame),
            "scipy": lambda: _scipy(values, frame),
        },
        SIZE * SIZE,
        repeats=25,
    )
    told = (Peer("numpy", least["numpy"], goal), Peer("scipy map_coordinates", least["scipy"]))
    return Row(f"bilinear lattice 201 x 201, map {name}", "cell", least["ours"], told, limit)


def _scipy(values: NDArray[np.float32], frame: LocalFrame) -> FloatArray:
    """map_coordinates, the places included."""
    row, col = frame.cells(-AXIS[:, None], -AXIS[None, :])
    out: FloatArray = map_coordinates(values, [row, col], order=1, output=np.float64)
    return out


def _slices(values: NDArray[np.float32], frame: LocalFrame) -> FloatArray:
    """The map's own grid: four slices with constant weights."""
    row, col = frame.cells(-AXIS[0], -AXIS[-1])  # of the northernmost, westernmost place
    i, j = int(row), int(col)
    u, v = float(row) - int(row), float(col) - int(col)
    window = values[i : i + SIZE + 1, j : j + SIZE + 1].astype(np.float64)
    wide = (1.0 - v) * window[:, :-1] + v * window[:, 1:]
    out: FloatArray = ((1.0 - u) * wide[:-1] + u * wide[1:])[:, ::-1]
    return out


def _blended(values: NDArray[np.float32], frame: LocalFrame) -> FloatArray:
    """Constant rows: two rows blended, two columns of them taken."""
    r, c, n = frame.row, frame.col, -AXIS
    row = r[0] + n * (r[1] + r[3] * n)
    col = (c[0] + n * (c[1] + c[3] * n))[:, None] + np.multiply.outer(c[2] + c[4] * n, -AXIS)
    i, j = row.astype(np.intp), col.astype(np.intp)
    u, v = (row - i)[:, None], col - j
    first, past = int(j.min()), int(j.max()) + 2
    blend = (1.0 - u) * values[i, first:past] + u * values[i + 1, first:past]
    j += (past - first) * np.arange(SIZE)[:, None] - first
    west = blend.take(j)
    out: FloatArray = west + v * (blend.take(j + 1) - west)
    return out


def _gathered(values: NDArray[np.float32], frame: LocalFrame) -> FloatArray:
    """Four neighbours by their number in the flat map."""
    row, col = frame.cells(-AXIS[:, None], -AXIS[None, :])
    i, j = row.astype(np.intp), col.astype(np.intp)
    u, v, flat, at = row - i, col - j, values.ravel(), i * SIDE + j
    low = (1.0 - v) * flat.take(at) + v * flat.take(at + 1)
    high = (1.0 - v) * flat.take(at + SIDE) + v * flat.take(at + SIDE + 1)
    out: FloatArray = (1.0 - u) * low + u * high
    return out
