"""Kernels of a crack that runs in steps, so that the force on the blade is a sawtooth.

Soft tissue is cut in turns of deformation and sudden growth of the crack. The edge stays while the
force on it is below F + k a / 2: F is the yield force of a steady edge, k the stiffness of tissue
and coupling along the push, a the length of a step. It then goes on by a and bears F - k a / 2
meanwhile, down to which the force falls as it goes. On a linear spring, the hand moves on by a from
tooth to tooth against F in the mean, so that a tooth costs F a: toughness times its area.
"""

from typing import NamedTuple

import numpy as np

from cutting_trainer.node_common.kernels import inner
from cutting_trainer.node_common.vectors import dot, norm
from cutting_trainer.tissue_sim.contact.immersion import SETTLED

_STAYS = 1e9
"""Share of its steady resistance that an edge bears which stays where it is."""


class Tooth(NamedTuple):
    """The next tooth of the force.

    Attributes:
        half: half of its height [N].
        length: by which the edge goes on [m].
        steady: force at which an edge without steps would yield [N].
        pull: on the edge where uncut tissue is ahead [N].
    """

    half: float
    length: float
    steady: float
    pull: float


@inner
def next_tooth(edge, ways, fresh, limits, piece, law):
    """Return the next `Tooth`; one that would take more than all of the cutting force is shorter.

    Args:
        edge: `Edge`.
        ways: from the edge to the device's, or along which it moves [m], shape (p, 3).
        fresh: whether uncut tissue is ahead, shape (p,).
        limits: forces at which points yield [N], shape (p,).
        piece: length that a point stands for [m].
        law: `Law`.
    """
    if law.crack == 0.0:
        return Tooth(0.0, 0.0, 0.0, 0.0)
    push, ahead, whole, steady, friction, pull = np.zeros(3), 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(len(limits)):
        span = edge.spans[i]
        whole += span
        if not fresh[i]:
            continue
        ahead += span
        steady += limits[i]
        friction += law.friction[edge.region[i]] * piece * span
        pull += law.stiffness * span * norm(ways[i])
        for c in range(3):
            push[c] += span * ways[i, c]
    size, stiffness = dot(push, push), 0.0
    if size == 0.0:
        return Tooth(0.0, 0.0, steady, pull)
    for c in range(3):
        stiffness += push[c] * dot(law.rigidity[c], push) / size * ahead / whole
    half = min(0.5 * stiffness * law.crack, steady - friction)
    if half <= 0.0:
        return Tooth(0.0, 0.0, steady, pull)
    return Tooth(half, 2.0 * half / stiffness, steady, pull)


@inner
def borne_share(edge, tooth):
    """Return the share of its steady resistance that the edge bears now, at uncut tissue.

    Args:
        edge: `Edge`, of which `running` changes.
        tooth: `Tooth`.
    """
    if tooth.half == 0.0:
        edge.running[0] = 0.0
        return 1.0
    if edge.running[0] == 0.0:
        if tooth.pull < tooth.steady + tooth.half:
            return _STAYS
        edge.running[0], edge.running[1] = tooth.length, 1.0
    return 1.0 - tooth.half / tooth.steady


@inner
def bound_run(edge, slid, ways, fresh):
    """Bound the slip by the length that the crack has still to run.

    Args:
        edge: `Edge`.
        slid: lengths of the slips [m]; changed, shape (p,).
        ways: the slips [m]; changed, shape (p, 3).
        fresh: whether uncut tissue is ahead, shape (p,).
    """
    slip = _mean(edge.spans, slid, fresh)
    if edge.running[0] == 0.0 or slip == 0.0:
        return
    part = min(edge.running[0] / (slip * edge.running[1]), 1.0)
    for i in range(len(slid)):
        if fresh[i]:
            slid[i] *= part
            ways[i] *= part


@inner
def places_at_rest(edge, tissue):
    """Return where the points of the edge are in the tissue at rest [m], shape (p, 3)."""
    places = np.zeros(edge.points.shape)
    for i in range(len(places)):
        for k in range(4):
            for c in range(3):
                places[i, c] += edge.weights[i, k] * tissue.rest[edge.corners[i, k], c]
    return places


@inner
def note_run(edge, points, places, tissue, fresh):
    """Take the length at rest of a slip from what the crack has still to run.

    The hand goes on by that from tooth to tooth, however the blade compresses the tissue.

    Args:
        edge: `Edge` after the slip, of which `running` changes.
        points, places: of the edge before it, now and at rest [m], shape (p, 3).
        tissue: `Tissue`.
        fresh: whether uncut tissue was ahead, shape (p,).

    Returns:
        Length at rest of the slip over that now.
    """
    after = places_at_rest(edge, tissue)
    rest, now = np.zeros(3), np.zeros(3)
    for c in range(3):
        rest[c] = _mean(edge.spans, after[:, c] - places[:, c], fresh)
        now[c] = _mean(edge.spans, edge.points[:, c] - points[:, c], fresh)
    run, slip = norm(rest), norm(now)
    left = edge.running[0] - run
    edge.running[0] = left if left > SETTLED else 0.0
    if run < SETTLED or slip < SETTLED:
        return 1.0
    edge.running[1] = run / slip
    return run / slip


@inner
def _mean(spans, values, fresh):
    """Return the mean over the part of the edge with uncut tissue ahead."""
    ahead = total = 0.0
    for i in range(len(values)):
        if fresh[i]:
            ahead += spans[i]
            total += spans[i] * values[i]
    return total / ahead if ahead > 0.0 else 0.0
