"""Rotations and stresses of many deformation gradients at once, in vector lanes.

A chunk holds LANES gradients in one array, slot by slot: a loop over lanes has neither branches nor
calls, and runs on vector registers. Two kernels compute R and R^T F: with a function for it they
took five times as long.

The rotation R of F is the nearest one. It follows F from evaluation to evaluation by Newton steps
on the quaternion. Where the Newton matrix is not positive
definite (near or through inversion), a gradient step keeps it a proper rotation. Mueller et al.
2016, A robust method to extract the rotational part of deformations; Kugelstadt et al. 2018, Fast
corotated FEM using operator splitting.
"""

import math

import numpy as np

from cutting_trainer.node_common.kernels import inner

LANES = 64
"""Deformation gradients in a chunk."""
SLOTS = 16
"""Slots of a chunk: F by rows, then V P; quaternion; 2 mu V; lambda V; last half angle, then
energy."""
ROTATION = 9
SHEAR = 13
VOLUMETRIC = 14
TURN = ENERGY = 15
SAFE_MATH = {'contract', 'reassoc', 'arcp', 'nsz'}
"""Reorderings that preserve NaN and infinity."""
ORDERED_MATH = {'contract', 'arcp', 'nsz'}
"""Reorderings for short sums over scattered values, which vector gathers would only slow down."""


@inner(fastmath=SAFE_MATH, error_model='numpy')
def rotation_step(chunk):
    """Advance all rotations by one step towards those of the gradients.

    With B = R^T F the step is w = (tr(B) I - sym(B))^-1 axial(B), half of it in the quaternion.
    Slot TURN gets |w / 2|^2, or 1 where the Newton matrix was not positive definite.

    Args:
        chunk: slots of a chunk, shape (SLOTS LANES,).
    """
    L = LANES
    E = chunk[0 : SLOTS * L]
    for b in range(L):
        qw, qx, qy, qz = E[b + 9 * L], E[b + 10 * L], E[b + 11 * L], E[b + 12 * L]
        f00, f01, f02 = E[b], E[b + L], E[b + 2 * L]
        f10, f11, f12 = E[b + 3 * L], E[b + 4 * L], E[b + 5 * L]
        f20, f21, f22 = E[b + 6 * L], E[b + 7 * L], E[b + 8 * L]
        r00 = 1.0 - 2.0 * (qy * qy + qz * qz)
        r01 = 2.0 * (qx * qy - qw * qz)
        r02 = 2.0 * (qx * qz + qw * qy)
        r10 = 2.0 * (qx * qy + qw * qz)
        r11 = 1.0 - 2.0 * (qx * qx + qz * qz)
        r12 = 2.0 * (qy * qz - qw * qx)
        r20 = 2.0 * (qx * qz - qw * qy)
        r21 = 2.0 * (qy * qz + qw * qx)
        r22 = 1.0 - 2.0 * (qx * qx + qy * qy)
        b00, b01 = r00 * f00 + r10 * f10 + r20 * f20, r00 * f01 + r10 * f11 + r20 * f21
        b02, b10 = r00 * f02 + r10 * f12 + r20 * f22, r01 * f00 + r11 * f10 + r21 * f20
        b11, b12 = r01 * f01 + r11 * f11 + r21 * f21, r01 * f02 + r11 * f12 + r21 * f22
        b20, b21 = r02 * f00 + r12 * f10 + r22 * f20, r02 * f01 + r12 * f11 + r22 * f21
        b22 = r02 * f02 + r12 * f12 + r22 * f22
        g0, g1, g2 = b21 - b12, b02 - b20, b10 - b01
        h00, h11, h22 = b11 + b22, b00 + b22, b00 + b11
        h01, h02, h12 = (b01 + b10) * -0.5, (b02 + b20) * -0.5, (b12 + b21) * -0.5
        c00, c01, c02 = h11 * h22 - h12 * h12, h02 * h12 - h01 * h22, h01 * h12 - h02 * h11
        c11, c12, c22 = h00 * h22 - h02 * h02, h01 * h02 - h00 * h12, h00 * h11 - h01 * h01
        determinant = h00 * c00 + h01 * c01 + h02 * c02
        size = math.sqrt(
            b00 * b00 + b01 * b01 + b02 * b02 + b10 * b10 + b11 * b11 + b12 * b12
            + b20 * b20 + b21 * b21 + b22 * b22
        ) + 1e-30  # fmt: skip
        # Positive definite by a margin relative to the norm: else the step would be as large as
        # its error.
        least = min(h00, min(c22 / size, determinant / (size * size)))
        newton = 0.5 / determinant
        gradient = 0.35 / size
        good = least > 0.05 * size
        w0 = (c00 * g0 + c01 * g1 + c02 * g2) * newton if good else gradient * g0
        w1 = (c01 * g0 + c11 * g1 + c12 * g2) * newton if good else gradient * g1
        w2 = (c02 * g0 + c12 * g1 + c22 * g2) * newton if good else gradient * g2
        tw = qw - qx * w0 - qy * w1 - qz * w2
        tx = qw * w0 + qx + qy * w2 - qz * w1
        ty = qw * w1 + qy + qz * w0 - qx * w2
        tz = qw * w2 + qz + qx * w1 - qy * w0
        s = 1.0 / math.sqrt(tw * tw + tx * tx + ty * ty + tz * tz)
        E[b + 9 * L] = tw * s
        E[b + 10 * L] = tx * s
        E[b + 11 * L] = ty * s
        E[b + 12 * L] = tz * s
        E[b + 15 * L] = w0 * w0 + w1 * w1 + w2 * w2 if good else 1.0


@inner(fastmath=SAFE_MATH, error_model='numpy')
def stress(chunk, unit):
    """Replace F by V P: P = R (2 mu e + lambda tr(e) I), e = sym(R^T F) - I.

    Slot ENERGY gets V (mu e : e + lambda tr(e)^2 / 2).

    Args:
        chunk: slots of a chunk, shape (SLOTS LANES,).
        unit: 1 for deformation gradients F; 0 for displacement gradients under constant rotations,
            in which P is linear.
    """
    L = LANES
    E = chunk[0 : SLOTS * L]
    for b in range(L):
        qw, qx, qy, qz = E[b + 9 * L], E[b + 10 * L], E[b + 11 * L], E[b + 12 * L]
        f00, f01, f02 = E[b], E[b + L], E[b + 2 * L]
        f10, f11, f12 = E[b + 3 * L], E[b + 4 * L], E[b + 5 * L]
        f20, f21, f22 = E[b + 6 * L], E[b + 7 * L], E[b + 8 * L]
        r00 = 1.0 - 2.0 * (qy * qy + qz * qz)
        r01 = 2.0 * (qx * qy - qw * qz)
        r02 = 2.0 * (qx * qz + qw * qy)
        r10 = 2.0 * (qx * qy + qw * qz)
        r11 = 1.0 - 2.0 * (qx * qx + qz * qz)
        r12 = 2.0 * (qy * qz - qw * qx)
        r20 = 2.0 * (qx * qz - qw * qy)
        r21 = 2.0 * (qy * qz + qw * qx)
        r22 = 1.0 - 2.0 * (qx * qx + qy * qy)
        b00, b01 = r00 * f00 + r10 * f10 + r20 * f20, r00 * f01 + r10 * f11 + r20 * f21
        b02, b10 = r00 * f02 + r10 * f12 + r20 * f22, r01 * f00 + r11 * f10 + r21 * f20
        b11, b12 = r01 * f01 + r11 * f11 + r21 * f21, r01 * f02 + r11 * f12 + r21 * f22
        b20, b21 = r02 * f00 + r12 * f10 + r22 * f20, r02 * f01 + r12 * f11 + r22 * f21
        b22 = r02 * f02 + r12 * f12 + r22 * f22
        shear = E[b + 13 * L]
        pressure = E[b + 14 * L] * (b00 + b11 + b22 - 3.0 * unit)
        half = 0.5 * shear
        s00, s11 = shear * (b00 - unit) + pressure, shear * (b11 - unit) + pressure
        s22 = shear * (b22 - unit) + pressure
        s01, s02, s12 = half * (b01 + b10), half * (b02 + b20), half * (b12 + b21)
        E[b + 15 * L] = 0.5 * (
            s00 * (b00 - unit) + s11 * (b11 - unit) + s22 * (b22 - unit)
            + s01 * (b01 + b10) + s02 * (b02 + b20) + s12 * (b12 + b21)
        )  # fmt: skip
        E[b] = r00 * s00 + r01 * s01 + r02 * s02
        E[b + L] = r00 * s01 + r01 * s11 + r02 * s12
        E[b + 2 * L] = r00 * s02 + r01 * s12 + r02 * s22
        E[b + 3 * L] = r10 * s00 + r11 * s01 + r12 * s02
        E[b + 4 * L] = r10 * s01 + r11 * s11 + r12 * s12
        E[b + 5 * L] = r10 * s02 + r11 * s12 + r12 * s22
        E[b + 6 * L] = r20 * s00 + r21 * s01 + r22 * s02
        E[b + 7 * L] = r20 * s01 + r21 * s11 + r22 * s12
        E[b + 8 * L] = r20 * s02 + r21 * s12 + r22 * s22


@inner(error_model='numpy')
def settle(chunk, tolerance, most):
    """Iterate the rotations until convergence.

    A rotation at a minimum or saddle of its agreement tr(R^T F) with F would stay there, after half
    a turn for example. It is then moved by half a turn about the axis with the best agreement.

    Args:
        chunk: slots of a chunk, shape (SLOTS LANES,).
        tolerance: of the largest half angle [rad].
        most: largest number of steps.
    """
    for step in range(most):
        rotation_step(chunk)
        largest = 0.0
        for b in range(LANES):
            if chunk[TURN * LANES + b] >= 1.0 and step % 8 == 0:
                _half_turn(chunk, b)
            largest = max(largest, chunk[TURN * LANES + b])
        if largest <= tolerance * tolerance:
            return


@inner
def _half_turn(chunk, lane):
    """Rotate one lane by half a turn about the body axis with the best agreement with F, if that
    helps.
    """
    q = np.empty(4)
    for i in range(4):
        q[i] = chunk[(ROTATION + i) * LANES + lane]
    best = _agreement(chunk, lane, q[0], q[1], q[2], q[3])
    found = 0
    for axis in range(1, 4):
        w, x, y, z = _about(q, axis)
        agreement = _agreement(chunk, lane, w, x, y, z)
        if agreement > best:
            best, found = agreement, axis
    if found:
        w, x, y, z = _about(q, found)
        chunk[(ROTATION + 0) * LANES + lane] = w
        chunk[(ROTATION + 1) * LANES + lane] = x
        chunk[(ROTATION + 2) * LANES + lane] = y
        chunk[(ROTATION + 3) * LANES + lane] = z


@inner
def _about(q, axis):
    if axis == 1:
        return -q[1], q[0], q[3], -q[2]
    if axis == 2:
        return -q[2], -q[3], q[0], q[1]
    return -q[3], q[2], -q[1], q[0]


@inner
def _agreement(chunk, lane, w, x, y, z):
    """Return tr(R^T F) of a quaternion with the gradient of a lane."""
    b, L = lane, LANES
    total = (1.0 - 2.0 * (y * y + z * z)) * chunk[b] + 2.0 * (x * y - w * z) * chunk[b + L]
    total += 2.0 * (x * z + w * y) * chunk[b + 2 * L] + 2.0 * (x * y + w * z) * chunk[b + 3 * L]
    total += (1.0 - 2.0 * (x * x + z * z)) * chunk[b + 4 * L]
    total += 2.0 * (y * z - w * x) * chunk[b + 5 * L] + 2.0 * (x * z - w * y) * chunk[b + 6 * L]
    total += 2.0 * (y * z + w * x) * chunk[b + 7 * L]
    return total + (1.0 - 2.0 * (x * x + y * y)) * chunk[b + 8 * L]
