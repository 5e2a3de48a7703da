"""What has been cut behaves like a slit, and what is tied together again like tissue never cut."""

from functools import cache

import numpy as np
import pytest
from meshes import box, irregular_box

from bench.cuts.random_strokes import random_stroke, shuffled_box
from bench.cuts.strokes import results_along
from cutting_trainer.cutting.method_interface import CASES
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.tissue_sim.elasticity.compliance import solve_static
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.mesh.topology import CUT

pytestmark = pytest.mark.long

MATERIAL = Material(10000.0, 0.3, 1000.0)
CELLS, SIZE = (24, 8, 16), 0.0025
LENGTH, WIDTH, HEIGHT = (cells * SIZE for cells in CELLS)
MIDDLE, DEPTH = LENGTH / 2, HEIGHT / 2


def cut_model(mesh: TetMesh, path: np.ndarray) -> tuple[ElasticModel, np.ndarray]:
    """Cuts along a path, the model following batch by batch; also how often each case was met."""
    model = ElasticModel(mesh, MATERIAL)
    method = make_method(CuttingSettings())
    cases = np.zeros(len(CASES), np.int64)
    for result in results_along(method, mesh, path):
        if not result.delta.empty:
            model.update(mesh.apply(result.delta))
        cases += result.report.cases
    return model, cases


def notched(nodes: np.ndarray, tets: np.ndarray, x: float, depth: float) -> ElasticModel:
    """A block notched by the blade from above, across its width, in eight steps."""
    way = np.linspace(-0.3 * WIDTH, 1.3 * WIDTH, 9)
    path = np.array([[[x, y, 1.2 * HEIGHT], [x, y, HEIGHT - depth]] for y in way])
    return cut_model(TetMesh(nodes, tets), path)[0]


@cache
def with_slit(layers: int) -> tuple[float, float, float]:
    """The ordered block meshed with a slit in its middle, some layers deep, loaded."""
    nodes, tets = box(CELLS, SIZE)
    bottom = HEIGHT - (layers - 0.5) * SIZE
    on = (abs(nodes[:, 0] - MIDDLE) < 1e-9) & (nodes[:, 2] > bottom)
    twin = np.arange(len(nodes))
    twin[on] = len(nodes) + np.arange(on.sum())
    right = nodes[tets].mean(axis=1)[:, 0] > MIDDLE
    mesh = TetMesh(np.concatenate([nodes, nodes[on]]), np.where(right[:, None], twin[tets], tets))
    flat = (abs(mesh.rest[mesh.triangles][:, :, 0] - MIDDLE) < 1e-9).all(axis=1)
    mesh.set_kinds(mesh.triangles.copy(), np.where(flat, CUT, 0).astype(np.uint8))
    return pulled(ElasticModel(mesh, MATERIAL))


def pulled(model: ElasticModel) -> tuple[float, float, float]:
    """Area of the slit [m^2], force [N] and volume of the opening [m^3] at 1 % of stretch."""
    mesh = model.mesh
    x = mesh.rest[:, 0]
    far = x > LENGTH - 1e-9
    u = np.zeros_like(mesh.rest)
    u[far, 0] = 0.01 * LENGTH
    free = np.repeat(~far & (x > 1e-9), 3)
    u += solve_static(model, free, -model.force(u))
    lips = mesh.triangles[mesh.triangle_kind == CUT]
    corners = mesh.rest[lips]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    opening = -float(np.einsum('ij,ij->', u[lips].mean(axis=1), areas))
    area = float(np.linalg.norm(areas, axis=1).sum()) / 2
    return area, float(model.force(u)[far, 0].sum()), opening


def test_a_notch_cut_along_faces_is_the_slit_that_the_mesh_could_have_been_made_with() -> None:
    nodes, tets = box(CELLS, SIZE)
    cut = pulled(notched(nodes, tets, MIDDLE, DEPTH))
    np.testing.assert_allclose(cut, with_slit(CELLS[2] // 2), rtol=1e-8)


@pytest.mark.parametrize(('aside', 'deeper'), [(0.2, 0.0), (0.37, 0.3), (0.5, 0.3)])
def test_a_notch_cut_through_elements_opens_like_a_slit_to_two_per_cent(
    aside: float, deeper: float
) -> None:
    """Against another mesh of the same resolution, made with its slit, at the same area of slit.

    Where the front ends inside elements it goes to points of their faces: the notch is up to half
    an edge deeper or less deep than the blade went, and its area says by how much.
    """
    nodes, tets = irregular_box(CELLS, SIZE, 1, jitter=0.1)
    model = notched(nodes, tets, MIDDLE + aside * SIZE, DEPTH + deeper * SIZE)
    area, force, opening = pulled(model)
    assert area == pytest.approx(WIDTH * (DEPTH + deeper * SIZE), abs=0.45 * WIDTH * SIZE)
    slits = np.array([with_slit(layers) for layers in range(7, 11)])
    assert force == pytest.approx(np.interp(area, slits[:, 0], slits[:, 1]), rel=0.02)
    assert opening == pytest.approx(np.interp(area, slits[:, 0], slits[:, 2]), rel=0.02)
    whole = pulled(ElasticModel(TetMesh(nodes, tets), MATERIAL))[1]
    assert force < 0.75 * whole


def tied(model: ElasticModel) -> tuple[np.ndarray, ElasticModel]:
    """Number of each node with copies at one place made one, and the mesh that this closes."""
    mesh = model.mesh
    rest, number = np.unique(mesh.rest, axis=0, return_inverse=True)
    number = number.ravel()
    return number, ElasticModel(TetMesh(rest, number[mesh.tetrahedra]), MATERIAL)


def tied_stiffness(model: ElasticModel, number: np.ndarray) -> np.ndarray:
    """Stiffness of the cut tissue under the constraint that copies move together [N/m]."""
    row = (3 * number[:, None] + np.arange(3)).ravel()
    out = np.zeros((row.max() + 1, row.max() + 1))
    np.add.at(out, (row[:, None], row), model.dense())
    return out


def partial_cut(seed: int) -> tuple[ElasticModel, np.ndarray]:
    """A small irregular block with a cut of some kind that may end inside."""
    rng = np.random.default_rng(seed)
    nodes, tets = shuffled_box(np.array([3, 3, 2]), 0.005, 0.15, rng)
    kind = ('plane', 'arc', 'twist')[seed % 3]
    return cut_model(TetMesh(nodes, tets), random_stroke(kind, nodes, 0.005, rng))


SEEDS = (0, 1, 3, 4, 5, 6, 7, 8, 9, 11)


@cache
def cut_cases() -> dict[int, np.ndarray]:
    return {seed: partial_cut(seed)[1] for seed in SEEDS}


def test_the_cuts_that_are_tied_below_hold_every_case() -> None:
    met = sum(cut_cases().values(), np.zeros(len(CASES), np.int64))
    assert all(met[CASES.index(name)] > 0 for name in 'ABCDEFGH'), dict(
        zip(CASES, met, strict=True)
    )


@pytest.mark.parametrize('seed', SEEDS)
def test_tied_lips_give_the_solution_of_the_uncut_refined_mesh(seed: int) -> None:
    model, _ = partial_cut(seed)
    number, whole = tied(model)
    rest = whole.mesh.rest
    assert len(rest) < model.mesh.node_count
    free = np.repeat(rest[:, 2] > 1e-9, 3)
    load = np.where(rest[:, 2] > rest[:, 2].max() - 1e-9, 1.0, 0.0)[:, None] * [1e-3, 0.0, -2e-3]
    solution = np.zeros(len(free))
    stiffness = tied_stiffness(model, number)[np.ix_(free, free)]
    solution[free] = np.linalg.solve(stiffness, load.ravel()[free])
    expected = np.zeros(len(free))
    expected[free] = np.linalg.solve(whole.dense()[np.ix_(free, free)], load.ravel()[free])
    np.testing.assert_allclose(solution, expected, atol=1e-10 * np.abs(expected).max())


@pytest.mark.parametrize('seed', SEEDS)
def test_tied_lips_pass_the_patch_test(seed: int) -> None:
    model, _ = partial_cut(seed)
    number, whole = tied(model)
    rest = whole.mesh.rest
    gradient = np.random.default_rng(seed).normal(size=(3, 3)) * 0.01
    affine = (rest @ gradient.T).ravel()
    free = np.ones(len(rest), bool)
    free[whole.mesh.triangles] = False
    assert free.any()
    free = np.repeat(free, 3)
    stiffness = tied_stiffness(model, number)
    load = -stiffness[np.ix_(free, ~free)] @ affine[~free]
    inner = np.linalg.solve(stiffness[np.ix_(free, free)], load)
    np.testing.assert_allclose(inner, affine[free], atol=1e-10 * np.abs(affine).max())
