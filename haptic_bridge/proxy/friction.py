"""Dry friction of the proxy: it sticks to a point of the tissue until the friction cone lets it go.

The tool sticks to a material point by a spring along the surface: the coupling spring and the
tissue in series. Where the spring pulls more than the normal force allows, the point comes after
the tool, by just as much that it does not (Salisbury and Zilles 1994; Harwin and Melder 2002). The
point does not move while the tool sticks, so nothing drifts (Hayward and Armstrong 2000), and what
moves it takes energy out: friction never feeds the hand.

The sphere rests over that point, not over the tip. Its depth there gives the normal force.
"""

import numpy as np

from cutting_trainer.haptic_bridge.proxy.record_type import record_type
from cutting_trainer.haptic_bridge.proxy.surface import Geometry
from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.node_common.vectors import norm
from cutting_trainer.tissue_sim.contact.friction import Friction

STICK = record_type(
    [
        ('sliding_friction', 'f8'),  # coefficient while the tool slides; 0: no friction
        ('static_friction', 'f8'),  # coefficient up to which it sticks
        ('stiffness', 'f8'),  # [N/m] along the surface; 0: unknown
        ('placed', 'b1'),  # the anchor is valid
        ('sliding', 'b1'),
        ('anchor', 'f8', (3,)),  # [m] centre of the sphere over the point to which it sticks
        ('offset', 'f8', (3,)),  # [m] from the tip to the anchor, along the surface
        ('force', 'f8', (3,)),  # [N] of friction on the tool
    ]
)


@inner
def aim(stick: np.ndarray, tip: np.ndarray, normal: np.ndarray) -> None:
    """Compute the offset from the tip [m] to the anchor, square to a unit normal, shapes (3,)."""
    s = stick[0]
    along = 0.0
    for i in range(3):
        along += normal[i] * (s.anchor[i] - tip[i])
    for i in range(3):
        s.offset[i] = s.anchor[i] - tip[i] - along * normal[i]


@inner
def follow(
    stick: np.ndarray, surface: Geometry, change: float, nodes: np.ndarray, weights: np.ndarray
) -> None:
    """Move the anchor with the surface.

    Args:
        stick: record of STICK, shape (1,).
        surface: of the tissue.
        change: of the blend between its start and its end.
        nodes, weights: of the touched points, shape (c,).
    """
    anchor = stick[0].anchor
    for c in range(len(nodes)):
        if weights[c] != 0.0:
            for i in range(3):
                moved = surface.end[nodes[c], i] - surface.start[nodes[c], i]
                anchor[i] += change * weights[c] * moved


@kernel(nogil=True)
def drag(
    stick: np.ndarray, tip: np.ndarray, normal: np.ndarray, pushed: float, stiffness: float
) -> None:
    """Compute the force of friction; where the tool slides, bring the anchor after it.

    Args:
        stick: record of STICK, shape (1,).
        tip: [m], shape (3,).
        normal: outward unit normal, shape (3,).
        pushed: normal force, 0 or more [N].
        stiffness: along the surface [N/m].
    """
    s = stick[0]
    aim(stick, tip, normal)
    pulled = stiffness * norm(s.offset)
    holds = (s.sliding_friction if s.sliding else s.static_friction) * pushed
    s.sliding = pulled > holds
    if s.sliding:
        kept = s.sliding_friction * pushed / pulled
        for i in range(3):
            s.anchor[i] -= (1.0 - kept) * s.offset[i]
            s.offset[i] *= kept
    for i in range(3):
        s.force[i] = stiffness * s.offset[i]


def split_stiffness(stiffness: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the stiffness without its part along the surface, and that part [N/m].

    Args:
        stiffness: K = k n n^T - n g^T + t (I - n n^T), g along the surface [N/m], shape (3, 3).
        normal: n, a unit vector, shape (3,).
    """
    along = max(float(np.trace(stiffness) - normal @ stiffness @ normal) / 2, 0.0)
    return stiffness - along * (np.eye(3) - np.outer(normal, normal)), along


def make_stick(friction: Friction) -> np.ndarray:
    """Return the friction of a tool that touches nothing: record of STICK, shape (1,)."""
    stick = np.zeros(1, STICK)
    stick['sliding_friction'], stick['static_friction'] = friction.sliding, friction.static
    return stick


@inner
def release(stick: np.ndarray) -> None:
    """Let go: the next touch sticks where it happens. Record of STICK, shape (1,)."""
    s = stick[0]
    s.placed = s.sliding = False
    s.offset[:] = 0.0
    s.force[:] = 0.0
