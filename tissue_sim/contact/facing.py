"""Kernels of a blade whose edge faces one way: spine and flat carry the tissue along, uncut."""

from typing import NamedTuple

import numpy as np

from cutting_trainer.node_common.kernels import inner
from cutting_trainer.node_common.vectors import dot, norm

TINY = 1e-300
"""Divisor that is no length, where these are 0."""
BLADE_HEIGHT = 5e-3
"""[m] of a scalpel's blade from its edge to its spine."""
_HELD_REACH = 5e-3
"""[m] by which a hand may go on before the largest force of spine and flat is known anew."""
_HELD_SHARE = 0.5
"""Share of a pull against spine or flat above which the blade counts as held."""
_MIN_ACROSS = 1e-3
"""Sine of the angle between edge and facing below which the facing is not believed."""


class Law(NamedTuple):
    """Constants of the law.

    Attributes:
        stiffness: of the spring of a point, for each piece that it stands for [N/m].
        toughness: by region [J/m^2].
        friction: per length, by region [N/m].
        facing: unit vector from the blade's spine to its edge; zero: it cuts all round, shape (3,).
        compliance: by which the spine goes deeper into the tissue than the flat would, by load per
            length [m^2/N].
        at_tip: resistance of the tip to going deeper along the blade, by region [N].
        crack: length by which the edge goes on at once [m]; 0: it goes on steadily.
        rigidity: stiffness of tissue and coupling at the edge [N/m], shape (3, 3); zero: unknown.
    """

    stiffness: float
    toughness: np.ndarray
    friction: np.ndarray
    facing: np.ndarray
    compliance: float
    at_tip: np.ndarray
    crack: float
    rigidity: np.ndarray


class Held(NamedTuple):
    """The blade as it is held, and its hold on the tissue.

    Attributes:
        direction: unit vector from tip to root, shape (3,).
        facing: unit vector across it, from spine to edge; zero: it cuts all round, shape (3,).
        piece: length that a point stands for [m].
        shares: of the pull of each point that is against spine or flat, shape (p,).
    """

    direction: np.ndarray
    facing: np.ndarray
    piece: float
    shares: np.ndarray


@inner
def across(facing, direction):
    """Return the unit vector across a direction nearest to a facing; zero: there is none."""
    part, along = np.empty(3), dot(facing, direction)
    for c in range(3):
        part[c] = facing[c] - along * direction[c]
    size = norm(part)
    for c in range(3):
        part[c] = part[c] / size if size >= _MIN_ACROSS else 0.0
    return part


@inner
def hold(edge, ways, blade, law, limits):
    """Add to the largest forces those of spine and flat, by which nothing yields.

    Args:
        edge: `Edge`.
        ways: from the edge to the device's [m], shape (p, 3).
        blade: `Held`.
        law: `Law`.
        limits: changed, forces [N], shape (p,).

    Returns:
        Whether they carry tissue along anywhere.
    """
    held = False
    for i in range(len(limits)):
        if blade.shares[i] > 0.0:
            stretch = norm(ways[i]) + _HELD_REACH
            limits[i] += law.stiffness * edge.spans[i] * blade.shares[i] * stretch
            held = held or blade.shares[i] > _HELD_SHARE
    return held


@inner
def settled(stretch, piece, law):
    """Return by how much force of a spring falls, because the spine is narrower than the flat.

    The load of the flat is as wide as the elements at a blade are: the mesh knows its settlement.
    That of the spine is deeper by a = compliance / l at first, and by its bound D at last: the
    force f of the spring k is that of k (s - D a f / (D + a f)).

    Args:
        stretch: s, towards the spine, above 0 [m].
        piece: length l of the edge [m].
        law: `Law`.
    """
    k, a, most = law.stiffness, law.compliance / piece, BLADE_HEIGHT / 4
    b = most + k * a * (most - stretch)
    root = np.sqrt(b * b + 4.0 * a * k * stretch * most)
    # Without cancellation, from a = 0 on.
    force = 2.0 * k * stretch * most / (b + root)
    return k * stretch - force


@inner
def to_edge(way, blade):
    """Replace the way on which a point is pulled by that on which the edge can go.

    Across the edge it is towards the edge alone, or aside by as much as it is pulled aside, where
    that is little. Spine and flat do not cut: what is left of the way, the tissue is carried along.

    Args:
        way: [m]; changed, shape (3,).
        blade: `Held`.

    Returns:
        Share of the way that is left.
    """
    whole = dot(way, way)
    along, towards = dot(way, blade.direction), dot(way, blade.facing)
    aside = max(whole - along * along - towards * towards, 0.0)
    ahead, kept, part = max(towards, 0.0), along * along, 0.0
    if ahead > 0.0:
        part = max(1.0 - aside / (ahead * ahead), 0.0)
        kept += ahead * ahead + part * aside
    square = along * along + ahead * ahead + part * part * aside
    scale = kept / max(square, TINY)
    left = 0.0
    for c in range(3):
        onward = along * blade.direction[c] + ahead * blade.facing[c]
        beside = way[c] - along * blade.direction[c] - towards * blade.facing[c]
        after = scale * (onward + part * beside)
        left += (way[c] - after) ** 2
        way[c] = after
    return np.sqrt(left / max(whole, TINY))
