"""Kernels of the blade's edge, with its force law (`_resist`): where it slips through the tissue,
and how the tissue takes it along.
"""

from typing import NamedTuple

import numpy as np

from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.node_common.vectors import cross, differences, dot, norm, sum_of, weighted_sum
from cutting_trainer.tissue_sim.contact.blade_edge import (
    KNOT_POINTS,
    edge_box,
    edge_direction,
    edge_knots,
    edge_line,
    split_way,
)
from cutting_trainer.tissue_sim.contact.crack import (
    borne_share,
    bound_run,
    next_tooth,
    note_run,
    places_at_rest,
)
from cutting_trainer.tissue_sim.contact.facing import (
    TINY,
    Held,
    Law,
    across,
    hold,
    settled,
    to_edge,
)
from cutting_trainer.tissue_sim.contact.fracture import (
    BLADE_THICKNESS,
    KNOTS,
    add_strip,
    faces_near,
    look_ahead,
)
from cutting_trainer.tissue_sim.contact.immersion import (
    POINTS,
    SETTLED,
    SHARES,
    immerse,
    lag_behind,
    rest_length,
    shares_inside,
)

WHOLE = POINTS / 2
"""Points in the tissue at which their springs are as stiff as the coupling: half of the edge. Each
has the same stiffness however many there are, else a spring that goes in or out would take energy
from the others or give it to them."""
_MAX_SLIPS = 12
_MAX_FREE_SLIP = BLADE_THICKNESS / 2
"""[m] by which the edge slips along a cut before what is ahead of it is looked up again."""
_BEYOND = 1e-5
"""[m] beyond the end of the edge, where the tip looks for uncut tissue."""


class Pull(NamedTuple):
    """How the device pulls the edge.

    Attributes:
        force: on the tissue [N], shape (3,).
        torque: the same about the tip of the device's edge [N m], shape (3,).
        limit: largest force of the edge as it is pulled, or would as it is moved [N].
        torque_limit: largest torque about the tip in the same way [N m].
        line: lag of the tip, and how much more the root lags [m], shape (2, 3).
        lag: mean distance in the tissue [m].
        paid, rubbed: work of cutting and of friction [J].
        swept: area of uncut tissue that the edge has gone through [m^2].
        held: whether spine or flat carry tissue along anywhere.
        forces: of each point on the tissue [N], shape (POINTS, 3).
        limits: largest force of each point, in the same way as `limit` [N], shape (POINTS,).
    """

    force: np.ndarray
    torque: np.ndarray
    limit: float
    torque_limit: float
    line: np.ndarray
    lag: float
    paid: float
    rubbed: float
    swept: float
    held: bool
    forces: np.ndarray
    limits: np.ndarray


@inner
def no_pull():
    """Return the `Pull` of an edge in the air."""
    line, forces, limits = np.zeros((2, 3)), np.zeros((POINTS, 3)), np.zeros(POINTS)
    force, torque = np.zeros(3), np.zeros(3)
    return Pull(force, torque, 0.0, 0.0, line, 0.0, 0.0, 0.0, 0.0, False, forces, limits)


@kernel
def follow_device(edge, strips, device, moved, tissue, law):
    """Let the edge slip after the device's edge, and return its `Pull`.

    Args:
        edge: `Edge`, changed.
        strips: `Strips`, changed.
        device: points of the device's edge [m], shape (POINTS, 3).
        moved: motion of these points [m], shape (POINTS, 3).
        tissue: `Tissue`.
        law: `Law`.
    """
    direction, piece = edge_direction(device)
    lag_behind(edge, device)
    immerse(edge, device, tissue)
    paid, rubbed, swept, limit = 0.0, 0.0, 0.0, -1.0
    facing = across(law.facing, direction)
    if sum_of(edge.spans) == 0.0:
        strips.counts[0], strips.counts[1], edge.running[0], edge.running[1] = 0, 0, 0.0, 0.0
        return no_pull()
    law = _law_now(law, rest_length(edge, tissue))
    low, high = edge_box(edge, device)
    faces = faces_near(tissue.positions, tissue.opened, strips, low, high, direction)
    fresh, limits = np.empty(POINTS, np.bool_), np.empty(POINTS)
    blade = Held(direction, facing, piece, np.zeros(POINTS))
    costs, shares, places = np.empty((POINTS, 3)), np.empty(POINTS), edge.points
    for _ in range(_MAX_SLIPS):
        if law.crack > 0.0:
            places = places_at_rest(edge, tissue)
        points, spans = edge.points.copy(), edge.spans.copy()
        limit = _slip(edge, strips, device, faces, blade, law, fresh, limits, costs)
        if limit >= 0.0:
            break
        after = edge.points.copy()
        immerse(edge, device, tissue)
        shares_inside(edge, tissue, points, after, spans, shares)
        cut = weighted_sum(shares, costs[:, 0])
        if law.crack > 0.0:
            cut *= note_run(edge, points, places, tissue, fresh)
        paid, rubbed = paid + cut, rubbed + weighted_sum(shares, costs[:, 1])
        swept += weighted_sum(shares, costs[:, 2])
        if sum_of(edge.spans) == 0.0:
            break
    ways, arms = differences(device, edge.points), np.empty(POINTS)
    for i in range(POINTS):
        arms[i] = SHARES[i] * (POINTS * piece)
    middle = weighted_sum(edge.spans, arms) / max(sum_of(edge.spans), TINY)
    if limit < 0.0:
        _resist(edge, ways.copy(), faces, blade, law, fresh, limits)
    half = next_tooth(edge, ways, fresh, limits, piece, law).half
    held = hold(edge, ways, blade, law, limits)
    limit, torque_limit = sum_of(limits) + half, weighted_sum(limits, arms) + half * middle
    most = limits.copy()
    # As it is pulled now, or will be if the device moves on.
    _resist(edge, moved.copy(), faces, blade, law, fresh, limits)
    half = next_tooth(edge, moved, fresh, limits, piece, law).half
    hold(edge, ways, blade, law, limits)
    limit = max(limit, sum_of(limits) + half)
    torque_limit = max(torque_limit, weighted_sum(limits, arms) + half * middle)
    for i in range(POINTS):
        most[i] = max(most[i], limits[i])
    scale = limit / max(sum_of(most), TINY)
    force, torque, forces = np.zeros(3), np.zeros(3), np.zeros((POINTS, 3))
    arm, pull, turn = np.empty(3), np.empty(3), np.empty(3)
    for i in range(POINTS):
        most[i] *= scale
        back = dot(ways[i], facing)
        held_back = settled(-back, piece, law) if back < 0.0 else 0.0
        for c in range(3):
            pull[c] = law.stiffness * edge.spans[i] * ways[i, c]
            if back < 0.0:
                pull[c] += edge.spans[i] * held_back * facing[c]
            force[c] += pull[c]
            forces[i, c] = pull[c]
            arm[c] = arms[i] * direction[c]
        cross(arm, pull, turn)
        for c in range(3):
            torque[c] += turn[c]
    line, mean = edge_line(edge.spans, ways)
    lag = norm(mean)
    return Pull(
        force, torque, limit, torque_limit, line, lag, paid, rubbed, swept, held, forces, most
    )


@kernel
def carry_edge(edge, strips, device, moved, positions, law):
    """Move the edge with the tissue.

    The edge is rigid: tissue that slides along it takes it along by no more than friction and tip
    do, or a hand that slices (Atkins). Else the tissue that heaps up before a blade would lift the
    edge out.

    Args:
        edge: `Edge`, changed.
        strips: `Strips`, changed.
        device, moved: as for `follow_device`.
        positions: nodes now, of the same mesh as at the last `follow_device` [m], shape (n, 3).
        law: `Law`.

    Returns:
        Motion of tip and root relative to the tip with the tissue [m], shape (2, 3), and the work
        of friction [J].
    """
    direction, piece = edge_direction(device)
    deeper = 0.0
    if edge.spans[0] > 0.0:
        deeper = law.at_tip[edge.region[0]] / edge.spans.sum() / law.stiffness
    ways, rubbed, first, last = np.zeros((POINTS, 3)), 0.0, -1, 0
    for i in range(POINTS):
        if edge.spans[i] == 0.0:
            continue
        first, last = i if first < 0 else first, i
        carried = np.zeros(3)
        for k in range(4):
            for c in range(3):
                carried[c] += edge.weights[i, k] * positions[edge.corners[i, k], c]
        held, pulled = split_way(device[i] - edge.points[i], direction)
        sliced, pushed = split_way(moved[i], direction)
        ratio = sliced / pushed if pushed > 0.0 else 0.0
        grip = law.friction[edge.region[i]] * piece / law.stiffness
        most = max(max(held, grip), ratio * pulled)
        stretch = dot(device[i] - carried, direction)
        kept = min(max(stretch, -max(most, grip + deeper)), most)
        rubbed += 0.5 * law.stiffness * edge.spans[i] * (stretch**2 - kept**2)
        ways[i] = carried - edge.points[i]
        edge.points[i] = carried + (stretch - kept) * direction
    line, _ = edge_line(edge.spans, ways)
    for k in range(KNOTS):
        share = min(max(SHARES[KNOT_POINTS[k]], SHARES[first]), SHARES[last])
        way = line[0] + share * line[1]
        way -= dot(way, direction) * direction
        for s in range(strips.counts[0]):
            for c in range(3):
                strips.knots[s, 0, k, c] += way[c]
                strips.knots[s, 1, k, c] += way[c]
    return line, rubbed


@kernel
def gather_loads(edge, loads):
    """Return the nodes around the edge, ascending, and the share of the load on each.

    Args:
        edge: `Edge`.
        loads: of the points, shape (POINTS,).
    """
    nodes, shares, count = np.empty(4 * POINTS, np.int64), np.empty(4 * POINTS), 0
    for i in range(POINTS):
        if edge.spans[i] == 0.0:
            continue
        for k in range(4):
            node = edge.corners[i, k]
            at = count
            while at > 0 and nodes[at - 1] >= node:
                at -= 1
            if at == count or nodes[at] != node:
                for j in range(count, at, -1):
                    nodes[j], shares[j] = nodes[j - 1], shares[j - 1]
                nodes[at], shares[at], count = node, 0.0, count + 1
            shares[at] += loads[i] * edge.weights[i, k]
    return nodes[:count].copy(), shares[:count].copy()


@inner
def _law_now(law, longer):
    """Return the law with toughness by area now, where the edge is longer at rest by a factor."""
    toughness = longer * law.toughness
    return Law(
        law.stiffness,
        toughness,
        law.friction,
        law.facing,
        law.compliance,
        law.at_tip,
        law.crack,
        law.rigidity,
    )


@inner
def _slip(edge, strips, device, faces, blade, law, fresh, limits, costs):
    """Let the points slip whose springs exceed the resistance.

    Args:
        edge: `Edge`, changed.
        strips: `Strips`, changed.
        device: points of the device's edge [m], shape (POINTS, 3).
        faces, blade, law, fresh, limits: see `_resist`; before the slip.
        costs: output where a point slipped, for each: the work of cutting and that of friction [J],
            the uncut area that was swept [m^2], shape (POINTS, 3).

    Returns:
        The largest force that the edge transmits as it is pulled [N], -1 where a point slipped.
    """
    slid, ways = np.zeros(POINTS), differences(device, edge.points)
    _resist(edge, ways, faces, blade, law, fresh, limits)
    cutting, share = False, 1.0
    if law.crack > 0.0:
        share = borne_share(edge, next_tooth(edge, ways, fresh, limits, blade.piece, law))
    for i in range(POINTS):
        if edge.spans[i] == 0.0:
            continue
        size = max(norm(ways[i]), TINY)
        borne = share * limits[i] if fresh[i] else limits[i]
        slid[i] = max(size - borne / (law.stiffness * edge.spans[i]), 0.0)
        if not fresh[i]:
            slid[i] = min(slid[i], _MAX_FREE_SLIP)
        for c in range(3):
            ways[i, c] *= slid[i] / size
        cutting = cutting or (fresh[i] and slid[i] > SETTLED)
    if slid.max() < SETTLED:
        return sum_of(limits)
    if law.crack > 0.0:
        bound_run(edge, slid, ways, fresh)
    knots = edge_knots(edge, device)
    costs[:] = 0.0
    for i in range(POINTS):
        if edge.spans[i] > 0.0:
            rub = law.friction[edge.region[i]] * blade.piece * edge.spans[i] * slid[i]
            costs[i, 0], costs[i, 1] = limits[i] * slid[i] - rub, rub
            for c in range(3):
                edge.points[i, c] += ways[i, c]
            if fresh[i]:
                area = blade.piece * edge.spans[i] * split_way(ways[i], blade.direction)[1]
                costs[i, 2] = area
    lag_behind(edge, device)
    if cutting:
        add_strip(strips, knots, edge_knots(edge, device))
    else:
        strips.counts[1] = 0
    return -1.0


@inner
def _resist(edge, ways, faces, blade, law, fresh, limits):
    """Find which points meet uncut tissue, and the largest force of each piece of the edge.

    The forces are J l sin(edge, way) + friction, along the ways on which the edge can cut. All
    points in the tissue share the resistance of the tip to going deeper: the edge is rigid.

    Args:
        edge: `Edge`.
        ways: along which the points are pulled [m]; changed as by `look_ahead` and `to_edge`,
            (POINTS, 3).
        faces: `CutFaces`.
        blade: `Held`, of which `shares` change.
        law: `Law`.
        fresh: output, whether uncut tissue is ahead, shape (POINTS,).
        limits: output, forces [N], shape (POINTS,).
    """
    e0, e1, e2 = blade.direction[0], blade.direction[1], blade.direction[2]
    one_sided = dot(blade.facing, blade.facing) > 0.0
    at_tip = 0.0
    tip = law.at_tip[edge.region[0]]
    if tip > 0.0 and edge.spans[0] > 0.0 and _is_tip_fresh(edge, blade, faces):
        at_tip = tip / sum_of(edge.spans)
    for i in range(POINTS):
        fresh[i], limits[i], blade.shares[i] = False, 0.0, 0.0
        if edge.spans[i] == 0.0:
            continue
        fresh[i] = look_ahead(edge.points, ways, i, faces)
        if one_sided and fresh[i]:
            blade.shares[i] = to_edge(ways[i], blade)
        x, y, z = ways[i, 0], ways[i, 1], ways[i, 2]
        a, b, c = y * e2 - z * e1, z * e0 - x * e2, x * e1 - y * e0
        sine = np.sqrt(a * a + b * b + c * c) / max(np.sqrt(x * x + y * y + z * z), TINY)
        cutting = law.toughness[edge.region[i]] * sine if fresh[i] else 0.0
        limits[i] = blade.piece * edge.spans[i] * (cutting + law.friction[edge.region[i]])
        if at_tip > 0.0:
            deeper = -(x * e0 + y * e1 + z * e2) / max(np.sqrt(x * x + y * y + z * z), TINY)
            limits[i] += at_tip * edge.spans[i] * max(deeper, 0.0)


@inner
def _is_tip_fresh(edge, blade, faces):
    """Return whether uncut tissue is ahead of the tip, beyond the half piece that strips have."""
    before, way = np.empty((1, 3)), np.empty((1, 3))
    for c in range(3):
        before[0, c] = edge.points[0, c] - (blade.piece / 2 + _BEYOND) * blade.direction[c]
        way[0, c] = -blade.direction[c]
    return look_ahead(before, way, 0, faces)
