"""Backward Euler by conjugate gradients on the same tensors: no matrix, nothing to factorise.

With h the step, the velocity at its end solves

    ((1 + h alpha) M + (h^2 + h beta) K + h^2 W^T A W) v = M v_0 + h (W^T A (p - W u_0) - f(u_0))

K is the stiffness with the rotations at the start of the step. A is the secant of the coupling
spring at the end of the step, p the tool's end of it, W the weighted mean of its nodes. Each tool
has its own. The solution is repeated until A fits it: a contact that opens, or a blade that yields,
does so at the end of the step as well.
"""

import numpy as np

from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.tissue_sim.contact.coupling import (
    HOLD,
    PUSH,
    forces_of_springs,
    spring_force,
    spring_stretch,
    start_of_work,
    work_of_springs,
)
from cutting_trainer.tissue_sim.elasticity.elastic_force import internal_force, stiffness_product

_SECANTS = 6


@inner(error_model='numpy')
def _secant(mode, normal, scalars, stretch, matrix):
    """Compute the symmetric matrix that maps this stretch to the force of the spring.

    Args:
        mode, normal, scalars: of the spring, see `coupling.Springs`.
        stretch: [m], shape (3,).
        matrix: in: the last one; output [N/m], shape (3, 3).

    Returns:
        Largest change of an entry, as a share of the spring's stiffness.
    """
    force = np.empty(3)
    spring_force(mode, stretch, normal, scalars, force)
    n, k = normal, scalars[0]
    along = across = within = length = pull = 0.0
    for i in range(3):
        along += stretch[i] * n[i]
        length += stretch[i] * stretch[i]
        pull += force[i] * force[i]
    for i in range(3):
        across += (stretch[i] - along * n[i]) ** 2
        within += force[i] * (stretch[i] - along * n[i])
    side = front = 0.0
    if mode == PUSH and along < 0.0:
        front = k
        if scalars[2] > 0.0:
            front = 0.0
            for i in range(3):
                front += force[i] * n[i] / along
        side = within / across if across > 0.0 else k
    elif mode == HOLD:
        front = side = np.sqrt(pull / length) if length > 0.0 else k
    change = 0.0
    for i in range(3):
        for j in range(3):
            value = (front - side) * n[i] * n[j] + (side if i == j else 0.0)
            change = max(change, abs(value - matrix[i, j]))
            matrix[i, j] = value
    return change / max(k, 1e-300)


@inner(error_model='numpy')
def _product(operands, spans, inverse_mass, springs, matrices, factors, x, out):
    """Compute the left-hand side times x, at the moving nodes; `factors`: of M, K and springs."""
    stiffness_product(operands, x, out)
    tools = springs.modes.shape[0]
    means = np.zeros((tools, 3))
    for t in range(tools):
        for c in range(springs.nodes.shape[1]):
            for i in range(3):
                means[t, i] += springs.weights[t, c] * x[3 * springs.nodes[t, c] + i]
    for s in range(spans.shape[0]):
        for i in range(3 * spans[s, 0], 3 * spans[s, 1]):
            if inverse_mass[i] > 0.0:
                out[i] = factors[1] * out[i] + factors[0] / inverse_mass[i] * x[i]
            else:
                out[i] = 0.0
    for t in range(tools):
        for c in range(springs.nodes.shape[1]):
            for i in range(3):
                at = 3 * springs.nodes[t, c] + i
                if inverse_mass[at] > 0.0:
                    weight = factors[2] * springs.weights[t, c]
                    for j in range(3):
                        out[at] += weight * matrices[t, i, j] * means[t, j]


@inner(error_model='numpy')
def _solve(
    operands, spans, inverse_mass, springs, matrices, factors, inverse, b, x, r, p, q, least, most
):
    """Run conjugate gradients from x until the residual, weighted by the diagonal, is `least`."""
    _product(operands, spans, inverse_mass, springs, matrices, factors, x, q)
    rho = 0.0
    p[:] = 0.0
    for s in range(spans.shape[0]):
        for i in range(3 * spans[s, 0], 3 * spans[s, 1]):
            r[i] = b[i] - q[i]
            p[i] = inverse[i] * r[i]
            rho += r[i] * p[i]
    for iteration in range(most):
        if rho <= least:
            return iteration
        _product(operands, spans, inverse_mass, springs, matrices, factors, p, q)
        curvature = 0.0
        for s in range(spans.shape[0]):
            for i in range(3 * spans[s, 0], 3 * spans[s, 1]):
                curvature += p[i] * q[i]
        if not curvature > 0.0:
            return iteration
        step = rho / curvature
        after = 0.0
        for s in range(spans.shape[0]):
            for i in range(3 * spans[s, 0], 3 * spans[s, 1]):
                x[i] += step * p[i]
                r[i] -= step * q[i]
                after += inverse[i] * r[i] * r[i]
        for s in range(spans.shape[0]):
            for i in range(3 * spans[s, 0], 3 * spans[s, 1]):
                p[i] = inverse[i] * r[i] + after / rho * p[i]
        rho = after
    return most


@kernel(error_model='numpy')
def implicit_steps(
    operands, spans, inverse_mass, damping, springs, diagonal, tolerance,
    u, v, work, dt, first, steps, total,
):  # fmt: skip
    """Compute steps of backward Euler, linearised about the start of each step.

    Arguments not named here: see `explicit.euler_steps`.

    Args:
        diagonal: of the stiffness of plain elements [N/m], shape (3 n,).
        tolerance: of the residual, relative to the loads.
        work: scratch, shape (7, >= 3 n).

    Returns:
        Work of the springs on the tissue [J].
    """
    alpha, beta = damping[0], damping[1]
    size = u.shape[0]
    b, x, r = work[0, :size], work[1, :size], work[2, :size]
    p, q, f, inverse = work[3, :size], work[4, :size], work[5, :size], work[6, :size]
    factors = np.array([1.0 + dt * alpha, dt * dt + dt * beta, dt * dt])
    tools = springs.modes.shape[0]
    nodes, weights, ends, anchors = springs.nodes, springs.weights, springs.ends, springs.anchors
    stretch, forces, matrices = np.empty(3), np.zeros((tools, 3)), np.zeros((tools, 3, 3))
    last = np.zeros((tools, 2, 3))
    done = start_of_work(springs, u, last)
    for s in range(spans.shape[0]):
        for i in range(3 * spans[s, 0], 3 * spans[s, 1]):
            free = inverse_mass[i] > 0.0
            inverse[i] = (
                1.0 / (factors[0] / inverse_mass[i] + factors[1] * diagonal[i]) if free else 0.0
            )
    x[:] = v
    for step in range(first, first + steps):
        at = (step + 1) / total
        q[:] = u  # the force moves far nodes, which are not part of the state
        internal_force(operands, q, f, 3)
        for attempt in range(_SECANTS):
            if tools > 0:
                # Estimated stretches at the end of the step.
                for i in range(size):
                    q[i] = u[i] + dt * x[i]
                change = 0.0
                for t in range(tools):
                    spring_stretch(nodes, weights, ends, anchors, t, at, q, stretch)
                    law = springs.modes[t], springs.normals[t], springs.scalars[t]
                    change = max(change, _secant(*law, stretch, matrices[t]))
                if attempt > 0 and change < 1e-6:
                    break
                for t in range(tools):
                    spring_stretch(nodes, weights, ends, anchors, t, at, u, stretch)
                    for i in range(3):
                        forces[t, i] = 0.0
                        for j in range(3):
                            forces[t, i] += matrices[t, i, j] * stretch[j]
            scale = 0.0
            for s in range(spans.shape[0]):
                for i in range(3 * spans[s, 0], 3 * spans[s, 1]):
                    if inverse_mass[i] > 0.0:
                        momentum, impulse = v[i] / inverse_mass[i], dt * f[i]
                        b[i] = momentum - impulse
                        scale += inverse[i] * (momentum * momentum + impulse * impulse)
                    else:
                        b[i] = 0.0
            for t in range(tools):
                for c in range(springs.nodes.shape[1]):
                    for i in range(3):
                        k = 3 * springs.nodes[t, c] + i
                        if inverse_mass[k] > 0.0:
                            load = dt * springs.weights[t, c] * forces[t, i]
                            b[k] += load
                            scale += inverse[k] * load * load
            _solve(
                operands, spans, inverse_mass, springs, matrices, factors, inverse, b, x, r, p, q,
                tolerance * tolerance * scale, 4 * 250,
            )  # fmt: skip
            if tools == 0:
                break
        if tools > 0:
            for i in range(size):
                q[i] = u[i] + dt * x[i]
            forces_of_springs(springs, at, q, forces)
            for t in range(tools):
                last[t, 0] = forces[t]
            done += work_of_springs(springs, forces, q, last)
        for s in range(spans.shape[0]):
            for i in range(3 * spans[s, 0], 3 * spans[s, 1]):
                v[i] = x[i]
                u[i] += dt * v[i]
    return done
