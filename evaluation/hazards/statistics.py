"""Rates with Wilson's intervals, medians with bootstrap intervals, and McNemar's exact test."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

Z = 1.959963984540054
"""97.5 % quantile of the normal distribution."""
RESAMPLES = 2000


def wilson(hits: int, n: int) -> tuple[float, float]:
    """95 % interval of a rate, after Wilson."""
    if n == 0:
        return 0.0, 1.0
    p, z2 = hits / n, Z * Z
    centre = (p + z2 / (2 * n)) / (1 + z2 / n)
    half = Z * math.sqrt(p * (1 - p) / n + z2 / (4 * n * n)) / (1 + z2 / n)
    return max(0.0, centre - half), min(1.0, centre + half)


def bootstrap_median(values: Sequence[float], seed: int = 0) -> tuple[float, float]:
    """95 % interval of the median, by resampling; (0, 0) without values."""
    if not len(values):
        return 0.0, 0.0
    v = np.asarray(values, dtype=np.float64)
    random = np.random.default_rng(seed)
    medians = np.median(v[random.integers(0, len(v), (RESAMPLES, len(v)))], axis=1)
    low, high = np.percentile(medians, [2.5, 97.5])
    return float(low), float(high)


def mcnemar(a: Sequence[bool], b: Sequence[bool]) -> tuple[int, int, float]:
    """How often only a is right, how often only b is, and the two-sided exact p-value of McNemar's test."""
    only_a = sum(x and not y for x, y in zip(a, b, strict=True))
    only_b = sum(y and not x for x, y in zip(a, b, strict=True))
    n, k = only_a + only_b, min(only_a, only_b)
    if n == 0:
        return 0, 0, 1.0
    tail = sum(math.comb(n, i) for i in range(k + 1)) / 2**n
    return only_a, only_b, min(1.0, 2.0 * tail)
