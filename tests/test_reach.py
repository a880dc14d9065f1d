"""Which probes reach a point: the cut axes against asking every box."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from refract_core.kernels.compile import kernel
from refract_core.probes.reach import Reach, next_of, piece_of, reach_of

F64 = NDArray[np.float64]


@kernel
def _walk(cuts: F64, sets: NDArray[np.int64], p: F64, out: NDArray[np.int64]) -> int:
    i, j, m = piece_of(cuts, 0, p[0]), piece_of(cuts, 1, p[1]), piece_of(cuts, 2, p[2])
    count = 0
    k = next_of(sets, i, j, m, 0)
    while k >= 0:
        out[count] = k
        count += 1
        k = next_of(sets, i, j, m, k + 1)
    return count


def reaching(reach: Reach, p: F64) -> list[int]:
    out = np.empty(512, np.int64)
    count = _walk(reach.cuts, reach.sets, p, out)
    return out[:count].tolist()


@pytest.mark.parametrize("count", [0, 1, 2, 31, 32, 33, 256])
def test_a_point_finds_the_boxes_that_hold_it_in_order(count: int) -> None:
    rng = np.random.default_rng(count)
    centre, half = rng.uniform(-5, 5, (count, 3)), rng.uniform(0.1, 3, (count, 3))
    low, high = centre - half, centre + half
    reach = reach_of(low, high)
    for p in rng.uniform(-7, 7, (200, 3)):
        inside = [k for k in range(count) if (low[k] <= p).all() and (p < high[k]).all()]
        assert reaching(reach, p) == inside


def test_boxes_that_share_faces_and_infinite_ones() -> None:
    inf = np.inf
    low = np.array([[0.0, 0, 0], [1, 0, 0], [-inf, -inf, -inf], [inf, inf, inf]])
    high = np.array([[1.0, 1, 1], [2, 1, 1], [inf, inf, inf], [inf, inf, inf]])
    reach = reach_of(low, high)
    assert reaching(reach, np.array([0.5, 0.5, 0.5])) == [0, 2]
    assert reaching(reach, np.array([1.0, 0.5, 0.5])) == [1, 2]
    assert reaching(reach, np.array([9.0, 0.5, 0.5])) == [2]
