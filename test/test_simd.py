"""Vectors of three in kernels, and what the force kernels that are made of them read and write."""

import numpy as np
import pytest
from numba import njit

from bench.speed.tissue import box, liver_material
from cutting_trainer.tissue_sim.elasticity.elastic_force import internal_force
from cutting_trainer.tissue_sim.elasticity.models import MODELS, ElasticModel, ModelName
from cutting_trainer.tissue_sim.elasticity.nodal_smoothing import NodalSmoothing
from cutting_trainer.tissue_sim.elasticity.simd import (
    add_three,
    load_four,
    load_three,
    plus_product,
    prefetch,
    product,
    put_three,
    spread,
    three,
    total,
    unpack,
)
from cutting_trainer.tissue_sim.elasticity.tensor_mass import TensorMass

pytestmark = pytest.mark.long


@njit
def _rows_times(values, at, x, out):
    """Puts the product of three rows, the last three numbers of `values`, with x."""
    prefetch(values, at + 10**6)
    there = load_three(x, np.uint64(0))
    a = product(load_four(values, at), there)
    b = product(load_four(values, at + np.uint64(3)), there)
    c = product(load_three(values, at + np.uint64(6)), there)
    put_three(out, np.uint64(1), three(total(a), total(b), total(c)))


@njit
def _add_scaled(x, by, out):
    add_three(out, np.uint64(0), plus_product(spread(1.0), load_three(x, np.uint64(0)), spread(by)))
    return unpack(load_three(x, np.uint64(0)))


def test_operations_are_those_of_vectors_of_three() -> None:
    random = np.random.default_rng(0)
    values, x, out = random.standard_normal(12), random.standard_normal(3), np.full(5, 7.0)
    _rows_times(values, np.uint64(3), x, out)
    np.testing.assert_allclose(out[1:4], values[3:].reshape(3, 3) @ x, rtol=1e-14)
    assert out[0] == out[4] == 7.0  # three are written, and no fourth
    out[:] = 7.0
    assert _add_scaled(x, 2.0, out) == tuple(x)
    np.testing.assert_allclose(out[:3], 8.0 + 2.0 * x, rtol=1e-14)
    assert out[3] == out[4] == 7.0


@pytest.mark.parametrize('name', MODELS)
def test_forces_are_put_whatever_was_there(name: ModelName) -> None:
    """Of the whole and of a part; and nothing is written beyond what the part reaches."""
    mesh = box(4000)
    model, n = ElasticModel(mesh, liver_material(), name), mesh.node_count
    u = 1e-4 * np.random.default_rng(0).standard_normal(3 * n)
    expected, f = np.zeros(3 * n), np.full(3 * n, np.nan)
    internal_force(model.operands(), u, expected, 0)
    internal_force(model.operands(), u, f, 0)
    np.testing.assert_array_equal(f, expected)
    nodes = np.arange(n // 8)
    some = model.operands(nodes)
    reached = np.zeros(n, bool)
    for low, high in some.reach:
        reached[low:high] = True
    f[:] = np.nan
    internal_force(some, u, f, 0)
    by_node = f.reshape(-1, 3)
    np.testing.assert_allclose(
        by_node[nodes], expected.reshape(-1, 3)[nodes], atol=1e-12 * np.abs(expected).max()
    )
    assert np.isfinite(by_node[reached]).all()
    assert np.isnan(by_node[~reached]).all()
    assert not reached.all()


def test_arrays_reach_beyond_their_rows() -> None:
    """As the last three numbers of a row are read as four, however the rows have grown."""
    mesh = box(300)
    n = mesh.node_count
    tensors, domains = TensorMass(mesh, 1.0, 1.0), NodalSmoothing(mesh, 1.0, 1.0)
    for number in range(60):
        tensors.tensors.room[:n] = 0  # every row has outgrown its place
        domains._domains.room[:n] = 0
        nodes = np.random.default_rng(number).permutation(n)[: n // (1 + number % 5)]
        for of in (tensors, domains):
            of.update(nodes)
        for rows in (tensors.tensors, domains._domains):
            assert (rows.start[:n] + rows.used[:n]).max() < len(rows.columns)
    model = ElasticModel(mesh, liver_material(), 'linear')
    part = model.part(
        np.arange(20, 60), model.neighbours.around(np.arange(20, 60), 1), np.arange(3)
    )
    assert part is not None
    local = part.operands.local
    assert len(local.blocks) == 9 * local.first[-1] + 1
