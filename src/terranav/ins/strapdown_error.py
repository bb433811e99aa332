"""Error states of a strapdown INS whose attitude is known: tilt, heading, gyro and accelerometer biases."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from terranav.core.ins_grade import InsGrade
from terranav.core.records import Epoch

FloatArray = NDArray[np.float64]


def initial_covariance(ins: InsGrade) -> FloatArray:
    """(9, 9) of tilt north and east, heading, gyro biases, accelerometer biases."""
    raise NotImplementedError


def transition(ins: InsGrade, before: Epoch, after: Epoch) -> tuple[FloatArray, FloatArray]:
    """Transition and noise (13, 13) of position, velocity and the nine states above."""
    raise NotImplementedError
