"""What is asked around one place of a large tissue is answered by the nodes around it."""

import numpy as np
import pytest
from meshes import box

from cutting_trainer.tissue_sim.elasticity import compliance
from cutting_trainer.tissue_sim.elasticity.compliance import PointCompliance, solve_static
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, TopologyDelta
from cutting_trainer.tissue_sim.motion.stability import FrequencyBound

CELLS, SIZE = (18, 18, 9), 0.004


def held(cells: tuple[int, int, int]) -> tuple[ElasticModel, np.ndarray]:
    nodes, tets = box(cells, SIZE)
    mesh = TetMesh(nodes, tets, nodes[:, 2] < 1e-9)
    model = ElasticModel(mesh, Material(5000.0, 0.45, 1060.0), 'linear_smoothed')
    return model, np.repeat(np.where(mesh.fixed == 1, 0.0, 1.0 / model.mass), 3)


def large() -> tuple[ElasticModel, np.ndarray]:
    model, inverse = held(CELLS)
    assert model.mesh.node_count > 1.5 * compliance.PATCH
    return model, inverse


def test_the_compliance_of_a_patch_is_just_below_that_of_the_tissue() -> None:
    model, inverse = large()
    rest = model.mesh.rest
    up = np.array([[0.0, 0.0, 1.0]])
    middle = rest.max(axis=0) * [0.5, 0.5, 1.0]
    point = PointCompliance()
    for shift in (0.0, 0.004):  # a tool that goes on starts from what it knew
        nodes = np.argsort(np.linalg.norm(rest - middle - [shift, 0, 0], axis=1))[:3]
        load = np.zeros_like(rest)
        load[nodes] = up / 3
        exact = float((solve_static(model, inverse > 0, load)[nodes] @ up[0]).mean())
        for _ in range(12):
            found = point.estimate(model, inverse > 0, nodes, np.full(3, 1 / 3), up)[0, 0]
        assert 0.95 * exact < found <= exact


def test_a_sliver_in_a_large_tissue_raises_the_bound_as_a_search_of_the_whole_does() -> None:
    model, inverse = large()
    mesh = model.mesh
    bound = FrequencyBound(model, inverse)
    before = bound.omega
    middle = int(np.argmin(np.linalg.norm(mesh.rest[mesh.tetrahedra].mean(axis=1) - 0.03, axis=1)))
    parents = mesh.tetrahedra[middle].astype(np.int64)
    children = np.tile(parents, (4, 1))
    children[range(4), range(4)] = mesh.node_count
    delta = TopologyDelta(
        node_parents=parents[None],
        node_weights=np.array([[0.01, 0.33, 0.33, 0.33]]),
        removed_tetrahedra=np.array([middle]),
        tetrahedra=children,
        outer_faces=np.zeros(4, np.uint8),
    )
    touched = mesh.apply(delta)
    model.update(touched)
    inverse = np.repeat(np.where(mesh.fixed == 1, 0.0, 1.0 / model.mass), 3)
    bound.limit(touched.nodes, inverse)
    whole = FrequencyBound(model, inverse).omega
    assert whole > 1.2 * before
    assert bound.omega == pytest.approx(whole, rel=0.02)


@pytest.mark.parametrize('cells', [(8, 8, 6), CELLS])
def test_a_compliance_outlives_cuts_and_stays_below_the_true_one(
    cells: tuple[int, int, int],
) -> None:
    """A blade that cuts in every frame would else begin with nothing each time."""
    model, inverse = held(cells)
    mesh = model.mesh
    rest = mesh.rest.copy()
    middle = rest.max(axis=0) * [0.5, 0.5, 1.0]
    nodes = np.argsort(np.linalg.norm(rest - middle, axis=1))[:3]
    weights = np.full(3, 1 / 3)
    far = np.linalg.norm(rest[mesh.tetrahedra].mean(axis=1) - middle, axis=1)
    kept = PointCompliance()
    for cut in range(4):
        for _ in range(3 if cut == 0 else 1):
            found = kept.estimate(model, inverse > 0, nodes, weights, np.eye(3))
        anew = PointCompliance().estimate(model, inverse > 0, nodes, weights, np.eye(3))
        exact = PointCompliance(200).estimate(model, inverse > 0, nodes, weights, np.eye(3))
        least = np.linalg.eigvalsh(exact - found).min()
        assert least > -1e-6 * np.linalg.norm(exact)
        error, without = (1 - np.trace(value) / np.trace(exact) for value in (found, anew))
        assert error < 0.1
        assert cut == 0 or error < 0.5 * without
        assert kept.calls == (3 if cut == 0 else 1)
        gone = np.flatnonzero((far > 0.012) & (far < 0.014))[cut : cut + 1]
        model.update(mesh.apply(TopologyDelta(removed_tetrahedra=gone)))
        inverse = np.repeat(np.where(mesh.fixed == 1, 0.0, 1.0 / model.mass), 3)
        far = np.linalg.norm(mesh.rest[mesh.tetrahedra].mean(axis=1) - middle, axis=1)


def test_a_compliance_that_ran_away_in_a_large_tissue_begins_anew() -> None:
    model, inverse = large()
    nodes, up = np.array([model.mesh.rest.sum(axis=1).argmax()]), np.array([[0.0, 0.0, 1.0]])
    given = model, inverse > 0, nodes, np.ones(1), up
    point, other = PointCompliance(), PointCompliance()
    expected = other.estimate(*given)
    point.estimate(*given)
    point._x[:, 3 * nodes] = np.nan
    assert point.estimate(*given) == compliance.MAX_COMPLIANCE
    np.testing.assert_array_equal(point.estimate(*given), expected)
