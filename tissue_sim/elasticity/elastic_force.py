"""Kernels of the elastic force of all models, and their operands."""

from typing import NamedTuple

import numpy as np

from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.tissue_sim.elasticity.adaptive_law import Law, add_law_bounds, add_law_forces
from cutting_trainer.tissue_sim.elasticity.coarse_rows import (
    CoarseRows,
    lead_far_nodes,
    put_coarse_forces,
)
from cutting_trainer.tissue_sim.elasticity.corotational import Elements, add_elements
from cutting_trainer.tissue_sim.elasticity.local_rows import Locality, LocalRows, local_product
from cutting_trainer.tissue_sim.elasticity.nodal_smoothing import (
    SmoothingDomains,
    add_linear_smoothed_forces,
    add_smoothed_forces,
)
from cutting_trainer.tissue_sim.elasticity.tensor_mass import StiffnessRows, put_rows


class Operands(NamedTuple):
    """Operands of the kernels for a model.

    Attributes:
        rows: tensors, or no rows.
        domains: smoothing domains of nodes, or none.
        elements: corotational elements, or none.
        rotating: 1 if domains and elements rotate with the tissue, else 0.
        awake: intervals of nodes whose rows are evaluated, shape (s, 2).
        spans: intervals of evaluated domains: `awake`, and those of further regions at its nodes.
        reach: intervals of nodes read and written by these, shape (s, 2).
        chunks: evaluated chunks of elements, shape (k,).
        local: complete rows of a part with its own numbering of u and f, or none.
        law: of domains and elements, instead of corotation, or none.
        load: forces to subtract from the elastic ones [N], by coordinate; (0,): none.
        coarse: unknowns after the nodes that move far nodes, or none.
    """

    rows: StiffnessRows
    domains: SmoothingDomains
    elements: Elements
    rotating: int
    awake: np.ndarray
    spans: np.ndarray
    reach: np.ndarray
    chunks: np.ndarray
    local: LocalRows
    law: Law
    load: np.ndarray
    coarse: CoarseRows


class ModelPart(NamedTuple):
    """Some nodes with a numbering of their own.

    Attributes:
        place: the nodes and their numbers.
        operands: for the force on them, by these numbers.
    """

    place: Locality
    operands: Operands


@inner(error_model='numpy')
def _begin(operands, u, f):
    """Write the forces of the tensors in all of reach, 0 where there are none."""
    rows, awake, reach = operands.rows, operands.awake, operands.reach
    n = rows.used.shape[0]
    if n == 0 or awake.shape[0] != 1 or awake[0, 1] - awake[0, 0] < n:
        for s in range(reach.shape[0]):
            f[3 * reach[s, 0] : 3 * reach[s, 1]] = 0.0
    put_rows(rows, awake, u, f)


@kernel(error_model='numpy')
def internal_force(operands, u, f, rotation_steps):
    """Compute the elastic force that resists a displacement, less the load of the operands.

    Args:
        operands: of the model; its rotations, if any, follow u.
        u: displacement by coordinate [m], shape (3 n,).
        f: output [N]: exact at nodes with only awake neighbours, 0 or partial elsewhere in reach,
            unchanged beyond, shape (3 n,).
        rotation_steps: iterations of the rotations; negative: until convergence.

    Returns:
        Elastic energy of domains and elements [J]; with a law, that of all if rotation_steps is
        negative.
    """
    lead_far_nodes(operands.coarse, u, 1.0)
    energy = elastic_force(operands, u, f, rotation_steps)
    if operands.load.shape[0] > 0:
        _subtract(operands.load, operands.reach, f)
    put_coarse_forces(operands.coarse, u, f, 1.0)
    return energy


@inner(error_model='numpy')
def _subtract(load, reach, f):
    for s in range(reach.shape[0]):
        for i in range(3 * reach[s, 0], min(3 * reach[s, 1], load.shape[0])):
            f[i] -= load[i]


@inner(error_model='numpy')
def elastic_force(operands, u, f, rotation_steps):
    """Compute `internal_force` without load and coarse unknowns."""
    if operands.local.first.shape[0] > 0:
        local_product(operands.local, u, f)
        return 0.0
    _begin(operands, u, f)
    if operands.law.domains.shape[0] > 0:
        return add_law_forces(
            operands.law, operands.domains, operands.elements, operands.awake, operands.spans,
            operands.chunks, u, f, rotation_steps,
        )  # fmt: skip
    energy = 0.0
    if operands.domains.used.shape[0] > 0 and not operands.rotating:
        add_linear_smoothed_forces(operands.domains, operands.spans, u, f)
    elif operands.domains.used.shape[0] > 0:
        energy += add_smoothed_forces(operands.domains, operands.spans, u, f, rotation_steps, 1.0)
    if operands.chunks.shape[0] > 0:
        energy += add_elements(operands.elements, operands.chunks, u, f, rotation_steps, 1.0)
    return energy


@kernel(error_model='numpy')
def stiffness_product(operands, x, f):
    """Compute f = K x under the present rotations.

    Args:
        operands: of the model.
        x: by coordinate, shape (3 n,).
        f: output, shape (3 n,).
    """
    lead_far_nodes(operands.coarse, x, 0.0)
    _stiffness_product(operands, x, f)
    put_coarse_forces(operands.coarse, x, f, 0.0)


@inner(error_model='numpy')
def _stiffness_product(operands, x, f):
    _begin(operands, x, f)
    if operands.law.domains.shape[0] > 0:
        add_linear_smoothed_forces(operands.domains, operands.spans, x, f)
        add_law_bounds(
            operands.law, operands.domains, operands.elements, operands.spans, operands.chunks, x, f
        )
        return
    if operands.domains.used.shape[0] > 0 and not operands.rotating:
        add_linear_smoothed_forces(operands.domains, operands.spans, x, f)
    elif operands.domains.used.shape[0] > 0:
        add_smoothed_forces(operands.domains, operands.spans, x, f, 0, 0.0)
    if operands.chunks.shape[0] > 0:
        add_elements(operands.elements, operands.chunks, x, f, 0, 0.0)
