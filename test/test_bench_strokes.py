"""A session of many strokes stays in bounds: mesh, memory, slots; and packing changes no force."""

import numpy as np
import pytest
from numba import njit

from bench.speed.strokes import Session, array_bytes, measure
from bench.speed.strokes_report import MAX_RATIO, Row, ratios
from cutting_trainer.tissue_sim.elasticity.nodal_smoothing import (
    NodalSmoothing,
    SmoothingDomains,
    add_linear_smoothed_forces,
)
from cutting_trainer.tissue_sim.elasticity.tensor_mass import TensorMass, Tensors, packed, put_rows
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh

pytestmark = pytest.mark.long

STROKES = 30


@pytest.fixture(scope='module')
def cut() -> tuple[Session, list[Row]]:
    """A small tissue after some strokes; `measure` holds its mesh against what a cut must keep."""
    session = Session(600, seed=3)
    return session, list(measure(session, STROKES, 10))


def test_many_strokes_leave_a_sound_mesh_and_memory_in_proportion(
    cut: tuple[Session, list[Row]],
) -> None:
    session, rows = cut
    first, last = rows[0], rows[-1]
    assert [row.strokes for row in rows] == [0, 10, 20, 30]
    assert session.simulation.elements_cut > 2 * STROKES
    assert last.tetrahedra > 1.2 * first.tetrahedra
    assert last.substeps <= 1.3 * first.substeps  # growth of 1.1, and the tool on lighter nodes
    _, memory = ratios(rows)
    print(f'{last.tetrahedra} tetrahedra, {last.loose} loose, memory by element {memory:.2f}')
    assert memory <= MAX_RATIO


def test_slots_are_bounded_by_what_lives_in_them(cut: tuple[Session, list[Row]]) -> None:
    session, _ = cut
    mesh, n = session.simulation.mesh, session.simulation.mesh.node_count
    assert len(mesh.links.tetrahedra) <= 2 * len(mesh.tetrahedra) + 64
    assert len(mesh.links.triangles) <= 2 * (4 * len(mesh.tetrahedra) + 64)
    rows = session.simulation.model.tensor_mass
    assert rows is not None
    assert rows._filled[0] <= 9 * int(rows.tensors.used[:n].sum()) // 8 + 1024


def test_rows_are_packed_when_they_lie_too_far_apart() -> None:
    """Rows that grow again and again leave gaps behind; these do not add up."""
    mesh = Session(600).simulation.mesh
    rows = TensorMass(mesh, 1.0, 1.0)
    n = mesh.node_count
    for _ in range(200):
        rows.tensors.room[:n] = 0  # every row has outgrown its place
        rows.update(np.arange(n))
        assert rows._filled[0] <= 9 * int(rows.tensors.used[:n].sum()) // 8 + 1024
    assert len(rows.tensors.columns) <= 8 * int(rows.tensors.used[:n].sum()) + 16384


def test_packing_changes_no_force(cut: tuple[Session, list[Row]]) -> None:
    mesh = cut[0].simulation.mesh
    n = mesh.node_count
    u = np.random.default_rng(0).standard_normal(3 * n)
    for values in (cut[0].simulation.model.tensor_mass, NodalSmoothing(mesh, 1.0, 1.0)):
        assert values is not None
        before = product(values, mesh, u)
        t: Tensors | SmoothingDomains = (
            values.tensors if isinstance(values, TensorMass) else values._domains
        )
        name = 'blocks' if isinstance(t, Tensors) else 'vectors'
        far = np.array([10**9])
        columns, numbers = packed(t.start, t.used, t.room, n, t.columns, getattr(t, name), far)
        used = t.used[:n]
        assert far[0] == used.sum()
        np.testing.assert_array_equal(t.start[:n], np.concatenate([[0], np.cumsum(used)[:-1]]))
        tight = t._replace(**{'columns': columns, name: numbers})
        if isinstance(values, TensorMass):
            values.tensors = tight
        else:
            values._domains = tight
        np.testing.assert_array_equal(product(values, mesh, u), before)


def product(values: TensorMass | NodalSmoothing, mesh: TetMesh, u: np.ndarray) -> np.ndarray:
    f, whole = np.zeros_like(u), np.array([[0, mesh.node_count]])
    add = put_rows if isinstance(values, TensorMass) else add_linear_smoothed_forces
    njit(add)(values.operands, whole, u, f)
    return f


def test_arrays_are_counted_once_however_they_are_held() -> None:
    values = np.zeros(1000)

    class Holder:
        def __init__(self) -> None:
            self.inner = {'view': values[10:], 'pair': (values, [values.reshape(10, -1)])}

    assert array_bytes([Holder(), values]) == values.nbytes
