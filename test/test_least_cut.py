"""Least cuts through random meshes, against scipy's maximum flow."""

import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.sparse.csgraph import maximum_flow
from scipy.spatial import Delaunay

from cutting_trainer.cutting.least_cut import connected, least_cut


def random_elements(seed):
    """Return the faces across, costs, sources and sinks of a Delaunay mesh of random points."""
    rng = np.random.default_rng(seed)
    mesh = Delaunay(rng.uniform(size=(60, 3)))
    across = np.full((len(mesh.simplices), 4), -1, np.int64)
    cost = np.ones(across.shape, np.int64)
    for e, others in enumerate(mesh.neighbors):
        for f, other in enumerate(others):
            if other >= 0:
                back = int(np.flatnonzero(mesh.neighbors[other] == e)[0])
                across[e, f] = 4 * other + back
                if other > e:
                    cost[e, f] = cost[other, back] = rng.integers(1, 60)
    middle = mesh.points[mesh.simplices].mean(axis=1)[:, 0]
    return across, cost, middle > 0.75, middle < 0.25


@pytest.mark.parametrize('seed', range(12))
def test_the_cheapest_faces_part_two_sets(seed):
    across, cost, sources, sinks = random_elements(seed)
    kept = least_cut(across, cost, sources, sinks)
    assert kept[sources].all() and not kept[sinks].any()
    e, f = np.nonzero((across >= 0) & kept[:, None])
    opened = ~kept[across[e, f] // 4]
    price = cost[e, f][opened].sum()

    count = len(across)
    one, face = np.nonzero(across >= 0)
    rows = np.concatenate([one, np.full(sources.sum(), count), np.flatnonzero(sinks)])
    columns = np.concatenate(
        [across[one, face] // 4, np.flatnonzero(sources), np.full(sinks.sum(), count + 1)]
    )
    room = np.full(len(rows), 1 << 20, np.int32)
    room[: len(one)] = cost[one, face]
    network = csr_array((room, (rows, columns)), (count + 2, count + 2))
    assert price == maximum_flow(network.tocsr(), count, count + 1).flow_value

    apart = across.copy()
    apart[e[opened], f[opened]] = -1
    apart.ravel()[across[e[opened], f[opened]]] = -1
    assert not connected(apart, sources, sinks)


def test_a_cut_does_not_depend_on_the_order_of_the_elements():
    across, cost, sources, sinks = random_elements(3)
    cost[:] = 1  # many least cuts
    kept = least_cut(across, cost, sources, sinks)
    order = np.random.default_rng(0).permutation(len(across))
    place = np.argsort(order)
    turned = np.where(across >= 0, 4 * place[across // 4] + across % 4, -1)[order]
    again = least_cut(turned, cost[order], sources[order], sinks[order])
    assert (again == kept[order]).all()
