"""Nodes on their own move as they do in their tissue."""

import numpy as np
import pytest
from meshes import irregular_box
from test_active_region import palpated

from cutting_trainer.tissue_sim.elasticity.elastic_force import internal_force
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel, ModelName
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, TopologyDelta
from cutting_trainer.tissue_sim.motion.active_region import ActiveSettings
from cutting_trainer.tissue_sim.motion.integrators import IntegratorName

SOFT = Material(3000.0, 0.45, 1000.0)


def test_force_on_nodes_that_were_taken_out_is_that_in_the_tissue_whatever_was_cut() -> None:
    mesh = TetMesh(*irregular_box((5, 4, 3), 0.01, 2))
    model = ElasticModel(mesh, SOFT, 'linear')
    random = np.random.default_rng(1)
    for _ in range(12):
        nodes = np.sort(random.choice(mesh.node_count, random.integers(1, 60), replace=False))
        around = model.neighbours.around(nodes, 1)
        others = random.choice(mesh.node_count, 4, replace=False)
        part = model.part(nodes, around, others)
        assert part is not None
        place = part.place
        assert (place.local[others] >= 0).all()
        numbers = place.local[place.at[::3] // 3]
        np.testing.assert_array_equal(numbers, np.arange(len(numbers)))
        assert {*around, *others} == {*(place.at[::3] // 3)}
        u = random.standard_normal((mesh.node_count, 3))
        f = np.full(len(place.at), np.nan)
        internal_force(part.operands, u.ravel()[place.at], f, 1)
        expected = model.force(u)
        found = f[: 3 * len(nodes)].reshape(-1, 3)
        np.testing.assert_allclose(found, expected[nodes], atol=1e-12 * np.abs(expected).max())
        gone = random.choice(len(mesh.tetrahedra), 5, replace=False)
        model.update(mesh.apply(TopologyDelta(removed_tetrahedra=gone)))


@pytest.mark.parametrize('integrator', ['euler', 'symplectic_euler', 'rk4'])
def test_a_region_on_its_own_moves_as_it_does_in_the_tissue(
    integrator: IntegratorName, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = ActiveSettings('on')
    parts = []
    taken_out = ElasticModel.part

    def part(self: ElasticModel, *given: np.ndarray) -> object:
        parts.append(taken_out(self, *given))
        return parts[-1]

    monkeypatch.setattr(ElasticModel, 'part', part)
    shapes, awake, _ = palpated(settings, 'linear', integrator)
    assert len(parts) > 2
    assert None not in parts
    monkeypatch.setattr(ElasticModel, 'part', lambda *_: None)
    expected, also, _ = palpated(settings, 'linear', integrator)
    np.testing.assert_array_equal(awake, also)
    np.testing.assert_allclose(shapes, expected, atol=1e-10 * np.abs(expected).max())


@pytest.mark.parametrize('model', ['linear_smoothed', 'corotational'])
def test_what_is_more_than_rows_stays_in_the_tissue(model: ModelName) -> None:
    elastic = ElasticModel(TetMesh(*irregular_box((3, 3, 2), 0.01, 2)), SOFT, model)
    nodes = np.arange(3)
    assert elastic.part(nodes, elastic.neighbours.around(nodes, 1), nodes) is None
