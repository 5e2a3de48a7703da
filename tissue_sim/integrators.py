"""Fourth-order Runge-Kutta for M u'' + (alpha M + beta K) u' + K u = f.

Thesis 4.4.3, with the velocity updated by its own stages.
"""

import numpy as np
from numba import njit

from tissue_sim.coupling import spring_force
from tissue_sim.tensor_mass import multiply


@njit(cache=True, error_model='numpy')
def rk4_steps(
    operands,
    inverse_mass,
    damping,
    anchor,
    u,
    v,
    work,
    dt,
    steps,
    mode,
    nodes,
    weights,
    ends,
    normal,
    scalars,
):
    """Advances displacement and velocity in place.

    Damping costs no force evaluation of its own: K is applied to u + beta v.

    Args:
        operands: start, used, columns, blocks, diagonal as `TensorMassModel.operands`.
        inverse_mass: by coordinate, 0 where fixed [1/kg], shape (3 n,).
        damping: alpha [1/s] and beta [s].
        anchor: rest position of the coupling's material point [m], shape (3,).
        u, v: displacement [m] and velocity [m/s], shape (3 n,).
        work: scratch, shape (6, >= 3 n).
        dt: step [s].
        steps: how many.
        mode, nodes, weights, normal, scalars: the coupling spring, see `Coupling` and
            `spring_force`.
        ends: its tool's end at the start and at the end of all steps [m], shape (2, 3).
    """
    start, used, columns, blocks, diagonal = operands
    alpha, beta = damping[0], damping[1]
    size = u.shape[0]
    us, vs, q = work[0, :size], work[1, :size], work[2, :size]
    f, du, dv = work[3, :size], work[4, :size], work[5, :size]
    point = np.empty(3)
    spring = np.empty(3)
    for step in range(steps):
        us[:] = u
        vs[:] = v
        du[:] = 0.0
        dv[:] = 0.0
        for stage in range(4):
            for i in range(size):
                q[i] = us[i] + beta * vs[i]
            multiply(start, used, columns, blocks, diagonal, q, f)
            if mode != 0:
                at = (step + (0.0 if stage == 0 else 1.0 if stage == 3 else 0.5)) / steps
                for i in range(3):
                    point[i] = ends[0, i] + at * (ends[1, i] - ends[0, i]) - anchor[i]
                    for c in range(nodes.shape[0]):
                        point[i] -= weights[c] * us[3 * nodes[c] + i]
                spring_force(mode, point, normal, scalars, spring)
                for c in range(nodes.shape[0]):
                    for i in range(3):
                        f[3 * nodes[c] + i] -= weights[c] * spring[i]
            share = dt / 6.0 if stage == 0 or stage == 3 else dt / 3.0
            ahead = dt if stage == 2 else 0.5 * dt
            for i in range(size):
                a = -f[i] * inverse_mass[i] - alpha * vs[i]
                w = vs[i]
                du[i] += share * w
                dv[i] += share * a
                us[i] = u[i] + ahead * w
                vs[i] = v[i] + ahead * a
        for i in range(size):
            u[i] += du[i]
            v[i] += dv[i]
