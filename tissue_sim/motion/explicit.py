"""Explicit time steps of M u'' + (alpha M + beta K) u' + K u = f; K u is any model's force.

Damping costs no force evaluation of its own: the force is taken at u + beta v.
"""

import numpy as np

from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.tissue_sim.contact.coupling import (
    forces_of_springs,
    start_of_work,
    subtract_springs,
    work_of_springs,
)
from cutting_trainer.tissue_sim.contact.cut_contact import meet, subtract_pulls
from cutting_trainer.tissue_sim.elasticity.elastic_force import internal_force

# Slices begin at 0: a possibly negative index would prevent vectorisation.


@inner(error_model='numpy')
def copy_nodes(intervals, source, target):
    """Copy the coordinates of some nodes."""
    for s in range(intervals.shape[0]):
        a, b = 3 * intervals[s, 0], 3 * intervals[s, 1]
        for i in range(a, b):
            target[i] = source[i]


@inner(error_model='numpy')
def look_ahead(q, u, v, beta):
    """Write u + beta v."""
    for i in range(q.shape[0]):
        q[i] = u[i] + beta * v[i]


@inner(error_model='numpy')
def step_of_euler(u, v, q, f, inverse_mass, alpha, beta, dt, symplectic):
    """Compute a step, and q = u + beta v for the next, while the data are in the cache."""
    for i in range(u.shape[0]):
        before = v[i]
        after = before + dt * (-f[i] * inverse_mass[i] - alpha * before)
        place = u[i] + dt * (after if symplectic else before)
        u[i], v[i], q[i] = place, after, place + beta * after


@inner(error_model='numpy')
def pull_by_springs(springs, at, u, q, f, forces, last, symplectic):
    """Subtract the springs' forces from f at a moment of the frame; return their work [J]."""
    subtract_springs(springs, at, u if symplectic else q, f, forces)
    if not symplectic:
        # Of the springs alone: their damping force does no work on the tissue.
        forces_of_springs(springs, at, u, forces)
    return work_of_springs(springs, forces, u, last)


@inner(error_model='numpy')
def _stage(f, inverse_mass, u, v, us, vs, du, dv, alpha, share, ahead):
    for i in range(f.shape[0]):
        a = -f[i] * inverse_mass[i] - alpha * vs[i]
        w = vs[i]
        du[i] += share * w
        dv[i] += share * a
        us[i] = u[i] + ahead * w
        vs[i] = v[i] + ahead * a


@kernel(error_model='numpy')
def euler_steps(
    operands, spans, inverse_mass, damping, springs, faces, u, v, work, dt, first, steps, total,
    symplectic,
):  # fmt: skip
    """Compute steps of Euler's methods: v by its rate at the start of the step, u by the v at start
    or end.

    Forward Euler (thesis 4.4.1) is unstable for any undamped spring, so the coupling springs get
    the tissue's beta.

    Args:
        operands: of the model, see `elastic_force.Operands`.
        spans: intervals of moving nodes, shape (s, 2).
        inverse_mass: by coordinate, 0 where fixed [1/kg], shape (3 n,).
        damping: alpha [1/s] and beta [s].
        springs: of the tools, see `coupling.Springs`.
        faces: contacts of cut faces, see `cut_contact.CutContacts`.
        u, v: displacement [m] and velocity [m/s], changed in place, shape (3 n,).
        work: scratch, shape (6, >= 3 n).
        dt: step [s].
        first, steps, total: number of the first step, how many, and how many a frame has.
        symplectic: whether u uses the new v; else the old one (forward Euler).

    Returns:
        Work of the springs on the tissue [J].
    """
    alpha, beta = damping[0], damping[1]
    q, f = work[2, : u.shape[0]], work[3, : u.shape[0]]
    tools = springs.modes.shape[0]
    forces, last = np.zeros((tools, 3)), np.zeros((tools, 2, 3))
    done = start_of_work(springs, u, last)
    copy_nodes(operands.reach, u, q)
    for s in range(spans.shape[0]):
        a, b = 3 * spans[s, 0], 3 * spans[s, 1]
        look_ahead(q[a:b], u[a:b], v[a:b], beta)
    for step in range(first, first + steps):
        internal_force(operands, q, f, np.int64(1))
        if faces.at.shape[0] > 0:
            subtract_pulls(faces, f)
        if tools > 0:
            done += pull_by_springs(springs, step / total, u, q, f, forces, last, symplectic)
        for s in range(spans.shape[0]):
            a, b = 3 * spans[s, 0], 3 * spans[s, 1]
            step_of_euler(
                u[a:b], v[a:b], q[a:b], f[a:b], inverse_mass[a:b], alpha, beta, dt, symplectic
            )
        if faces.at.shape[0] > 0:
            meet(faces, u, v, q, beta, dt)
    if tools > 0:
        forces_of_springs(springs, (first + steps) / total, u, forces)
        done += work_of_springs(springs, forces, u, last)
    return done


@kernel(error_model='numpy')
def rk4_steps(
    operands, spans, inverse_mass, damping, springs, faces, u, v, work, dt, first, steps, total
):
    """Compute steps of the classical fourth-order Runge-Kutta method on u and v together.

    Thesis 4.4.3, with the velocity updated by its own stages. Arguments and result: see
    `euler_steps`.
    """
    alpha, beta = damping[0], damping[1]
    size = u.shape[0]
    us, vs, q = work[0, :size], work[1, :size], work[2, :size]
    f, du, dv = work[3, :size], work[4, :size], work[5, :size]
    tools = springs.modes.shape[0]
    forces, last = np.zeros((tools, 3)), np.zeros((tools, 2, 3))
    done = start_of_work(springs, u, last)
    copy_nodes(operands.reach, u, q)
    for step in range(first, first + steps):
        for s in range(spans.shape[0]):
            a, b = 3 * spans[s, 0], 3 * spans[s, 1]
            us[a:b] = u[a:b]
            vs[a:b] = v[a:b]
            du[a:b] = 0.0
            dv[a:b] = 0.0
        for stage in range(4):
            for s in range(spans.shape[0]):
                a, b = 3 * spans[s, 0], 3 * spans[s, 1]
                look_ahead(q[a:b], us[a:b], vs[a:b], beta)
            internal_force(operands, q, f, np.int64(1))
            if faces.at.shape[0] > 0:
                subtract_pulls(faces, f)
            if tools > 0:
                at = (step + (0.0 if stage == 0 else 1.0 if stage == 3 else 0.5)) / total
                subtract_springs(springs, at, us, f, forces)
                if stage == 0:
                    done += work_of_springs(springs, forces, u, last)
            share = dt / 6.0 if stage == 0 or stage == 3 else dt / 3.0
            ahead = dt if stage == 2 else 0.5 * dt
            for s in range(spans.shape[0]):
                a, b = 3 * spans[s, 0], 3 * spans[s, 1]
                _stage(
                    f[a:b], inverse_mass[a:b], u[a:b], v[a:b], us[a:b], vs[a:b], du[a:b], dv[a:b],
                    alpha, share, ahead,
                )  # fmt: skip
        for s in range(spans.shape[0]):
            a, b = 3 * spans[s, 0], 3 * spans[s, 1]
            u[a:b] += du[a:b]
            v[a:b] += dv[a:b]
        if faces.at.shape[0] > 0:
            meet(faces, u, v, q, beta, dt)
    if tools > 0:
        forces_of_springs(springs, (first + steps) / total, u, forces)
        done += work_of_springs(springs, forces, u, last)
    return done
