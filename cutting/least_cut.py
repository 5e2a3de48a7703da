"""Least cut through the faces of some elements, between two sets of them."""

import numpy as np

from cutting_trainer.node_common.kernels import inner, kernel


@inner
def _levels(across, room, sources, sinks, level, queue):
    """Number the elements by their steps from the sources, -1 where none leads, up to the first
    sink; return whether there is one.
    """
    level[:] = -1
    end = 0
    for k in range(len(level)):
        if sources[k]:
            level[k] = 0
            queue[end] = k
            end += 1
    at = 0
    while at < end:
        one = queue[at]
        at += 1
        if sinks[one]:
            return True
        for face in range(4):
            other = across[one, face] // 4
            if other >= 0 and level[other] < 0 and room[one, face] > 0:
                level[other] = level[one] + 1
                queue[end] = other
                end += 1
    return False


@inner
def _fill(across, room, sources, sinks, level, tried, way):
    """Send as much as there is room for along shortest ways (Dinic's blocking flow)."""
    tried[:] = 0
    for source in range(len(level)):
        if not sources[source]:
            continue
        depth, one = 0, source
        while True:
            if sinks[one]:
                least = room[way[0] // 4, way[0] % 4]
                for k in range(1, depth):
                    least = min(least, room[way[k] // 4, way[k] % 4])
                for k in range(depth):
                    element, face = way[k] // 4, way[k] % 4
                    other = across[element, face]
                    room[element, face] -= least
                    room[other // 4, other % 4] += least
                depth, one = 0, source
                continue
            while tried[one] < 4:
                face = tried[one]
                other = across[one, face] // 4
                if other >= 0 and level[other] == level[one] + 1 and room[one, face] > 0:
                    break
                tried[one] += 1
            if tried[one] < 4:
                way[depth] = 4 * one + tried[one]
                one = across[one, tried[one]] // 4
                depth += 1
            elif depth > 0:
                depth -= 1
                one = way[depth] // 4
                tried[one] += 1
            else:
                break


@kernel
def least_cut(across, cost, sources, sinks):
    """Return which elements stay with the sources when the cheapest faces are opened.

    Of several least cuts it is the one nearest to the sources, whatever the order of the elements.

    Args:
        across: face 4 e + f behind each face, or -1, shape (k, 4).
        cost: of opening each face, the same from both sides, at least 1, shape (k, 4).
        sources, sinks: elements to be parted, none in both, shape (k,).

    Returns:
        Shape (k,).
    """
    count = len(across)
    room = cost.copy()
    level, queue = np.empty(count, np.int64), np.empty(count, np.int64)
    tried, way = np.empty(count, np.int64), np.empty(count + 1, np.int64)
    while _levels(across, room, sources, sinks, level, queue):
        _fill(across, room, sources, sinks, level, tried, way)
    return level >= 0


@kernel
def connected(across, sources, sinks):
    """Return whether a way leads from one set of elements to another, arguments as `least_cut`."""
    level, queue = np.empty(len(across), np.int64), np.empty(len(across), np.int64)
    return _levels(across, np.ones(across.shape, np.int64), sources, sinks, level, queue)
