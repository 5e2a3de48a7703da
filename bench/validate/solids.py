"""Blocks between plates, and a sphere on a layer."""

import math
import time
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from bench.accuracy.footprint import BLOCK, CELLS, MATERIAL, Press, block
from bench.accuracy.law_problems import Case as Loading
from bench.accuracy.law_problems import lifted, settled, solved_reference, unstructured_block
from bench.accuracy.law_reference import LawBlock
from bench.accuracy.sphere_contact import Layer, sneddon, thickness_factor
from bench.validate.case import Result
from cutting_trainer.node_common.errors import MeshError
from cutting_trainer.tissue_sim.contact.tool_spring import ContactName
from cutting_trainer.tissue_sim.elasticity.compliance import solve_static
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import MODELS, ElasticModel, ModelName
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh

Floats = NDArray[np.float64]

CUBE, STRAINS = 0.08, (0.05, 0.125, 0.1825)
"""Edge of the Truth Cube [m], and its nominal strains."""
CUBE_NU = 0.49
CUBE_EDGES = (0.016, 0.0115)
BOX, BOX_NU, BOX_EDGES = (0.03, 0.03, 0.01), 0.3, (0.005, 0.0033)
"""Size of the half-pressed box [m], its Poisson's ratio, mean edges of its meshes [m]."""
SPHERE_RADIUS, SPHERE_DEPTH = 0.004, 0.001
SPHERE_EDGES = (9.1, 6.2, 3.6)
"""Meshes of `footprint.CELLS` [mm]."""
SPHERE_PLACE = (0.052, 0.049)
_SEED = 1


@cache
def _pressed(
    size: tuple[float, float, float], strain: float, nu: float
) -> tuple[Loading, LawBlock]:
    motion = partial(lifted, height=size[2], most=-strain)
    loading = Loading(f'{strain:g}', size, motion, steps=max(2, round(strain * 12)))
    return loading, solved_reference(loading, nu, 0.0, 3 if strain > 0.3 else 4)


def _compare(
    quantity: str, loading: Loading, exact: LawBlock, nu: float, edge: float, model: ModelName,
    *, field: bool,
) -> list[Result]:  # fmt: skip
    """Return error of the force and, if asked for, of the field, of a model."""
    mesh = unstructured_block(loading, edge, _SEED)
    count = len(mesh.tetrahedra)
    force = exact.force(loading.motion, 1.0)
    height = loading.size[2]
    published = abs(force) / height / _strain(loading)
    start = time.thread_time()
    try:
        if model.startswith('linear'):
            elastic, u, found = _linear(loading, mesh, nu, model)
        else:
            elastic, u, found = settled(loading, mesh, nu, 0.0, model=model)
    except MeshError as error:
        cpu = time.thread_time() - start
        note = f'no equilibrium: {error}'
        return [Result(quantity, model, count, 'N', published, None, None, cpu, note)]
    cpu = time.thread_time() - start
    ratio = found / force
    results = [
        Result(
            f'force, {quantity}', model, count, 'N', published, published * ratio, ratio - 1, cpu
        )
    ]
    if field:
        error = _field_error(elastic, exact, u)
        results.append(Result(f'field, {quantity}', model, count, '', 0.0, error, error, cpu))
    return results


def _linear(
    loading: Loading, mesh: TetMesh, nu: float, model: ModelName
) -> tuple[ElasticModel, Floats, float]:
    """Return what `settled` does, of a linear model by one solution."""
    elastic = ElasticModel(mesh, Material(5400.0, nu, 1060.0), model)
    held = mesh.fixed == 1
    u = np.where(held[:, None], loading.motion(mesh.rest, 1.0), 0.0)
    u = u + solve_static(elastic, np.repeat(~held, 3), -elastic.force(u))
    rate = loading.motion(mesh.rest, 1.0)
    return elastic, u, float((elastic.force(u) * rate)[held].sum())


def _strain(loading: Loading) -> float:
    return float(loading.name)


def _field_error(elastic: ElasticModel, exact: LawBlock, u: np.ndarray) -> float:
    """Return the L2 norm of the difference over that of the reference."""
    right = exact.at(elastic.mesh.rest)
    weight = elastic.mass[:, None]
    return float(np.sqrt((weight * (u - right) ** 2).sum() / (weight * right**2).sum()))


def run_cube(quick: bool) -> list[Result]:
    """Return force and field of the Truth Cube at its published strains."""
    results = []
    for edge in CUBE_EDGES[: 1 if quick else None]:
        for strain in STRAINS:
            loading, exact = _pressed((CUBE,) * 3, strain, CUBE_NU)
            for model in MODELS:
                name = f'strain {100 * strain:g} %'
                results += _compare(name, loading, exact, CUBE_NU, edge, model, field=True)
    return results


def run_box(quick: bool) -> list[Result]:
    """Return the force of the box that is pressed to half of its height."""
    results = []
    for edge in BOX_EDGES[: 1 if quick else None]:
        loading, exact = _pressed(BOX, 0.5, BOX_NU)
        for model in MODELS:
            results += _compare('pressed to half', loading, exact, BOX_NU, edge, model, field=False)
    return results


def run_sphere(quick: bool) -> list[Result]:
    """Return the force of a sphere 1 mm deep in a layer, by model and contact."""
    width = math.sqrt(BLOCK[0] * BLOCK[1] / math.pi)
    layer = Layer(BLOCK[2], width, MATERIAL.youngs_modulus, MATERIAL.poissons_ratio)
    exact = sneddon(layer, SPHERE_RADIUS, SPHERE_DEPTH)
    exact *= thickness_factor(layer, SPHERE_RADIUS, SPHERE_DEPTH)
    ways: tuple[tuple[ModelName, ContactName], ...] = (
        ('linear', 'footprint'), ('linear_smoothed', 'triangle'), ('linear_smoothed', 'footprint'),
    )  # fmt: skip
    results = []
    for edge in SPHERE_EDGES[: 1 if quick else None]:
        mesh = block(CELLS[edge])
        for model, contact in ways:
            start = time.thread_time()
            press = Press(mesh, contact, model)
            found = float(press.forces(SPHERE_PLACE, SPHERE_RADIUS, (SPHERE_DEPTH,))[0])
            cpu = time.thread_time() - start
            count = len(mesh.tetrahedra)
            name = f'1 mm deep, contact {contact}'
            error = found / exact - 1
            label = model if contact == 'footprint' else f'{model}, {contact}'
            results.append(Result(name, label, count, 'N', exact, found, error, cpu))
    return results
