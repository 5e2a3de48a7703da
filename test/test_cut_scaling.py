"""A cut costs what it touches, however large the tissue is around it."""

import numpy as np
import pytest

from bench.speed.cut import BLOCKS, stroke_costs

pytestmark = pytest.mark.long


def test_the_same_stroke_costs_the_same_in_a_hundred_times_larger_mesh() -> None:
    """Cutting, adjacency, tensors, masses and frequency bound, by batch, in one run.

    The claim is a factor of 1.5 on an idle machine (`./trainer bench speed cut`); a pass over the
    mesh of 200,000 tetrahedra would cost a factor above 10.
    """
    small, large = (stroke_costs(BLOCKS[name], repeats=3) for name in ('2,000', '200,000'))
    np.testing.assert_array_equal(small.cut, large.cut)
    assert small.cut.sum() > 200
    assert len(small.batch) >= 8
    ratio = float(np.median(large.batch) / np.median(small.batch))
    print(f'a batch costs {ratio:.2f} times as much in the large mesh')
    assert ratio < 3
