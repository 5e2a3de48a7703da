"""Explicit time steps of M u'' + (alpha M + beta K) u' + K u = f; K u is any model's force.

Damping costs no force evaluation of its own: the force is taken at u + beta v. All kernels have one
signature, that of `euler_steps`.
"""

import numpy as np
from numba import njit

from tissue_sim.coupling import force_of_spring, spring_work, start_of_work, subtract_spring
from tissue_sim.elasticity import internal_force


@njit(cache=True, error_model='numpy')
def euler_steps(
    operands, spans, inverse_mass, damping, spring, u, v, work, dt, first, steps, total
):
    """Forward Euler (thesis 4.4.1): u and v by their rates at the start of the step.

    The coupling spring is damped with the tissue's beta: forward Euler makes any spring without
    damping swing up.

    Args:
        operands: of the model, see `elasticity.Operands`.
        spans: intervals of nodes that move, shape (s, 2).
        inverse_mass: by coordinate, 0 where fixed [1/kg], shape (3 n,).
        damping: alpha [1/s] and beta [s].
        spring: the coupling, see `coupling.Spring`.
        u, v: displacement [m] and velocity [m/s], changed in place, shape (3 n,).
        work: scratch, shape (6, >= 3 n).
        dt: step [s].
        first, steps, total: number of the first step, how many, and how many a frame has.

    Returns:
        Work of the spring on the tissue [J].
    """
    alpha, beta = damping[0], damping[1]
    q, f = work[2, : u.shape[0]], work[3, : u.shape[0]]
    force, last = np.zeros(3), np.zeros((2, 3))
    done = start_of_work(spring, u, last)
    q[:] = u
    for step in range(first, first + steps):
        for s in range(spans.shape[0]):
            for i in range(3 * spans[s, 0], 3 * spans[s, 1]):
                q[i] = u[i] + beta * v[i]
        internal_force(operands, q, f, 1)
        if spring.mode != 0:
            subtract_spring(spring, step / total, q, f, force)
            # Of the spring alone: what its damping takes away, the tissue has not been given.
            force_of_spring(spring, step / total, u, force)
            done += spring_work(spring, force, u, last)
        for s in range(spans.shape[0]):
            for i in range(3 * spans[s, 0], 3 * spans[s, 1]):
                w = v[i]
                v[i] += dt * (-f[i] * inverse_mass[i] - alpha * w)
                u[i] += dt * w
    if spring.mode != 0:
        force_of_spring(spring, (first + steps) / total, u, force)
        done += spring_work(spring, force, u, last)
    return done


@njit(cache=True, error_model='numpy')
def symplectic_euler_steps(
    operands, spans, inverse_mass, damping, spring, u, v, work, dt, first, steps, total
):
    """Symplectic Euler: v by its rate at the start of the step, u by the new v.

    Arguments and result: see `euler_steps`.
    """
    alpha, beta = damping[0], damping[1]
    q, f = work[2, : u.shape[0]], work[3, : u.shape[0]]
    force, last = np.zeros(3), np.zeros((2, 3))
    done = start_of_work(spring, u, last)
    q[:] = u
    for step in range(first, first + steps):
        for s in range(spans.shape[0]):
            for i in range(3 * spans[s, 0], 3 * spans[s, 1]):
                q[i] = u[i] + beta * v[i]
        internal_force(operands, q, f, 1)
        if spring.mode != 0:
            subtract_spring(spring, step / total, u, f, force)
            done += spring_work(spring, force, u, last)
        for s in range(spans.shape[0]):
            for i in range(3 * spans[s, 0], 3 * spans[s, 1]):
                v[i] += dt * (-f[i] * inverse_mass[i] - alpha * v[i])
                u[i] += dt * v[i]
    if spring.mode != 0:
        force_of_spring(spring, (first + steps) / total, u, force)
        done += spring_work(spring, force, u, last)
    return done


@njit(cache=True, error_model='numpy')
def rk4_steps(operands, spans, inverse_mass, damping, spring, u, v, work, dt, first, steps, total):
    """The classical fourth-order Runge-Kutta method on u and v together.

    Thesis 4.4.3, with the velocity updated by its own stages. Arguments and result: see
    `euler_steps`.
    """
    alpha, beta = damping[0], damping[1]
    size = u.shape[0]
    us, vs, q = work[0, :size], work[1, :size], work[2, :size]
    f, du, dv = work[3, :size], work[4, :size], work[5, :size]
    force, last = np.zeros(3), np.zeros((2, 3))
    done = start_of_work(spring, u, last)
    us[:] = u
    vs[:] = v
    q[:] = u
    for step in range(first, first + steps):
        for s in range(spans.shape[0]):
            for i in range(3 * spans[s, 0], 3 * spans[s, 1]):
                us[i] = u[i]
                vs[i] = v[i]
                du[i] = 0.0
                dv[i] = 0.0
        for stage in range(4):
            for s in range(spans.shape[0]):
                for i in range(3 * spans[s, 0], 3 * spans[s, 1]):
                    q[i] = us[i] + beta * vs[i]
            internal_force(operands, q, f, 1)
            if spring.mode != 0:
                at = (step + (0.0 if stage == 0 else 1.0 if stage == 3 else 0.5)) / total
                subtract_spring(spring, at, us, f, force)
                if stage == 0:
                    done += spring_work(spring, force, u, last)
            share = dt / 6.0 if stage == 0 or stage == 3 else dt / 3.0
            ahead = dt if stage == 2 else 0.5 * dt
            for s in range(spans.shape[0]):
                for i in range(3 * spans[s, 0], 3 * spans[s, 1]):
                    a = -f[i] * inverse_mass[i] - alpha * vs[i]
                    w = vs[i]
                    du[i] += share * w
                    dv[i] += share * a
                    us[i] = u[i] + ahead * w
                    vs[i] = v[i] + ahead * a
        for s in range(spans.shape[0]):
            for i in range(3 * spans[s, 0], 3 * spans[s, 1]):
                u[i] += du[i]
                v[i] += dv[i]
    if spring.mode != 0:
        force_of_spring(spring, (first + steps) / total, u, force)
        done += spring_work(spring, force, u, last)
    return done
