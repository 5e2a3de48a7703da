"""Masses of nodes, and diagonals and norms of their rows of the stiffness."""

import numpy as np

from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.tissue_sim.elasticity.tensor_mass import shape_gradients
from cutting_trainer.tissue_sim.mesh.topology import of_region


@kernel
def gather_incident_rows(links, rest, nodes, constants, relative, densities, mass, diagonal, norms):
    """Compute masses, diagonal and norms of plain elements' rows at some nodes.

    Args:
        links: connectivity.
        rest: rest positions [m], shape (n, 3).
        nodes: which, shape (r,).
        constants: lambda [Pa], mu [Pa].
        relative: stiffness by region, relative to these.
        densities: by region [kg/m^3].
        mass: output [kg] (thesis eq. 4.2), shape (>= n,).
        diagonal: output [N/m], shape (>= 3 n,).
        norms: output, sums of the Frobenius norms of the element blocks K_ij of row i [N/m];
            element rotations do not change them, shape (>= n,).
    """
    lame_lambda, lame_mu = constants[0], constants[1]
    g = np.empty((4, 3))
    for node in nodes:
        mass[node] = 0.0
        norms[node] = 0.0
        for i in range(3):
            diagonal[3 * node + i] = 0.0
        corner = links.first_corner[node]
        while corner >= 0:
            a = corner % 4
            volume = shape_gradients(rest, links.tetrahedra, corner // 4, g)
            mass[node] += 0.25 * of_region(links, corner // 4, densities) * volume
            volume *= of_region(links, corner // 4, relative)
            dot = volume * lame_mu * (g[a, 0] * g[a, 0] + g[a, 1] * g[a, 1] + g[a, 2] * g[a, 2])
            both = volume * (lame_lambda + lame_mu)
            for i in range(3):
                diagonal[3 * node + i] += both * g[a, i] * g[a, i] + dot
            for b in range(4):
                dot = g[a, 0] * g[b, 0] + g[a, 1] * g[b, 1] + g[a, 2] * g[b, 2]
                square = 0.0
                for i in range(3):
                    for k in range(3):
                        value = lame_lambda * g[a, i] * g[b, k] + lame_mu * g[b, i] * g[a, k]
                        if i == k:
                            value += lame_mu * dot
                        square += value * value
                norms[node] += volume * np.sqrt(square)
            corner = links.corner_next[corner]


@kernel
def assembled_norms(tensors, links, nodes, norms):
    """Compute the sums of Frobenius norms of the assembled 3x3 blocks of some rows.

    Args:
        tensors: a `tensor_mass.Tensors`.
        links: connectivity.
        nodes: which rows, shape (r,).
        norms: output [N/m], shape (>= n,).
    """
    seen = np.empty(256, np.int64)
    for which in range(len(nodes)):
        node = nodes[which]
        d = tensors.diagonal[node]
        total = np.sqrt(d[0] ** 2 + d[3] ** 2 + d[5] ** 2 + 2 * (d[1] ** 2 + d[2] ** 2 + d[4] ** 2))
        number = 0
        corner = links.first_corner[node]
        while corner >= 0:
            for b in range(4):
                other = links.tetrahedra[corner // 4, b]
                new = other != node
                for k in range(number):
                    if seen[k] == other:
                        new = False
                if new:
                    total += _edge_norm(tensors, max(node, other), min(node, other))
                    if number < 256:
                        seen[number] = other
                        number += 1
            corner = links.corner_next[corner]
        norms[node] = total


@inner
def _edge_norm(tensors, high, low):
    for slot in range(tensors.start[high], tensors.start[high] + tensors.used[high]):
        if tensors.columns[slot] == 3 * low:
            square = 0.0
            for i in range(9):
                square += tensors.blocks[9 * slot + i] ** 2
            return np.sqrt(square)
    return 0.0
