"""Standard normal numbers, 1e5 at once: by counter, beside numpy's generator."""

from __future__ import annotations

import numpy as np
from scipy.stats import kstest

from benchmarks.limits import multiply_add_ns
from benchmarks.timing import Limit, Peer, Row, least_ns
from terranav.filters._normals import standard_normal

COUNT = 100_000
OPERATIONS = 66  # a number: for two, Philox takes 62 and Box-Muller 69, each on a whole register


def rows() -> list[Row]:
    rng = np.random.default_rng(1)
    for numbers in (standard_normal(rng, (COUNT,)), rng.standard_normal(COUNT)):
        if kstest(numbers, "norm").pvalue < 1e-3:  # no two generators give the same numbers: both must be normal
            raise AssertionError("the numbers are not normal")
    least = least_ns(
        {"ours": lambda: standard_normal(rng, (COUNT,)), "numpy": lambda: rng.standard_normal(COUNT)},
        COUNT,
        repeats=60,
    )
    limit = Limit("its operations, half a multiply-add each", 0.5 * OPERATIONS * multiply_add_ns(), 1.4)
    return [Row("normal numbers, 1e5", "number", least["ours"], (Peer("numpy Generator", least["numpy"], 8.0),), limit)]
