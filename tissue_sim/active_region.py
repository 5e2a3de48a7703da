"""Which nodes move: those that nothing moves sleep, and cost nothing.

A node sleeps when it has been slow and in balance for a while: its speed, and what the unbalanced
force would make of it within a frame, stay below a tolerance. It wakes when that force grows, when
the tool holds it, or when a node that moves is near. Sleepers hold their displacement, so the
forces on the others are right; what is wrong is the motion that sleepers miss.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numba import njit

from tissue_sim.coupling import FREE, Coupling
from tissue_sim.elasticity import ElasticModel, Operands, internal_force
from tissue_sim.local_rows import Locality
from tissue_sim.mesh import grown
from tissue_sim.rings import intervals, without

_BLOCK = 4
"""Substeps between two choices while some nodes sleep, where no cut has shortened them."""
_BLOCK_AWAKE, _CHOICES_AWAKE = 16, 3
"""While none sleeps, or as many move as may, a new choice would change little: substeps between two
at least, and how many a frame has at most. A choice costs as much as some four substeps."""
_RINGS = 2
"""Neighbours of neighbours that a moving node keeps awake."""
_PATIENCE = 6
"""Choices for which a node is slow before it sleeps."""


@dataclass(frozen=True)
class ActiveSettings:
    """How the active region is chosen.

    Attributes:
        mode: off (all nodes move), on, or budget (at most `nodes`, the nearest to the tool).
        nodes: how many with `budget`.
        tolerance: speed [m/s] below which a node may sleep.
    """

    mode: Literal['off', 'on', 'budget'] = 'off'
    nodes: int = 2000
    tolerance: float = 1e-4


class Region(NamedTuple):
    """Nodes that move.

    Attributes:
        spans: their intervals, shape (s, 2).
        operands: for the force on them.
        around: for the force on them and their neighbours, in the tissue.
        place: if they are cheaper on their own: by whose numbers spans and operands then are.
    """

    spans: np.ndarray
    operands: Operands
    around: Operands
    place: Locality | None


@njit(cache=True)
def _ahead(reach, u, v, beta, out):
    """Puts u + beta v, which the force is taken at, in some intervals of nodes."""
    for s in range(reach.shape[0]):
        for i in range(3 * reach[s, 0], 3 * reach[s, 1]):
            out[i] = u[i] + beta * v[i]


@njit(cache=True)
def _measure(f, v, inverse_mass, seconds, tolerance, looked, quiet):
    """Counts for how many choices the nodes that are looked at have been slow and in balance."""
    for i in looked:
        speed = gain = 0.0
        for k in range(3 * i, 3 * i + 3):
            speed += v[k] * v[k]
            gain += (f[k] * inverse_mass[k] * seconds) ** 2
        slow = max(speed, gain) < tolerance * tolerance
        quiet[i] = min(quiet[i] + 1, 1000) if slow else 0


def _misses(region: Region, coupling: Coupling) -> bool:
    """Whether the tool holds a node that the part lacks."""
    return region.place is not None and bool((region.place.local[coupling.nodes] < 0).any())


class ActiveRegion:
    """Chooses the nodes that move, some times a frame.

    Args:
        model: the elastic model.
        settings: how.
        implicit: whether steps are long, so that more than the next neighbours take part in one.
    """

    def __init__(self, model: ElasticModel, settings: ActiveSettings, *, implicit: bool) -> None:
        self._model = model
        self._settings = settings
        self._implicit = implicit
        self._rings = 4 * _RINGS if implicit else _RINGS
        n = model.mesh.node_count
        self._quiet = np.zeros(n, np.int64)
        self._awake = self._near = np.arange(n)
        self._region: Region | None = None
        self._moved = np.zeros(n, bool)
        self._scratch = np.zeros((2, 0))

    @property
    def nodes(self) -> np.ndarray:
        """The nodes that move, sorted, shape (a,)."""
        return self._awake

    @property
    def count(self) -> int:
        """How many nodes move."""
        return len(self._awake)

    @property
    def whole(self) -> bool:
        """Whether all nodes move, whatever they do."""
        return self._settings.mode == 'off'

    @property
    def held_to(self) -> np.ndarray | None:
        """The nodes that move where the budget holds others, which no force wakes; else None."""
        full = self._settings.mode == 'budget' and self.count >= self._settings.nodes
        return self._awake if full else None

    def moved(self) -> np.ndarray:
        """The nodes that have moved since this was last asked, sorted, shape (a,)."""
        n = self._model.mesh.node_count
        self._moved = grown(self._moved, n)
        self._moved[self._awake] = True
        out = np.flatnonzero(self._moved[:n])
        self._moved[:] = False
        return out

    def ahead(self, left: int, total: int, shortened: float) -> int:
        """Substeps until the next choice.

        Args:
            left, total: substeps that the frame still has, and has in all.
            shortened: length of a substep where nothing was cut over its length now.
        """
        if self._settings.mode == 'off':
            return left
        if self._implicit:
            return 1
        most = self._model.mesh.node_count
        if self._settings.mode == 'budget':
            most = min(most, self._settings.nodes)
        if self.count >= most:
            return min(max(_BLOCK_AWAKE, -(-total // _CHOICES_AWAKE)), left)
        return min(max(_BLOCK, int(_BLOCK * shortened)), left)

    def choose(
        self,
        u: np.ndarray,
        v: np.ndarray,
        beta: float,
        inverse_mass: np.ndarray,
        coupling: Coupling,
        seconds: float,
    ) -> Region:
        """Chooses, and stops the nodes that go to sleep.

        Only nodes that move, and their neighbours, are looked at: the force on others is what it
        was. The cost is theirs, whatever the size of the tissue.

        Args:
            u: displacement [m], shape (3 n,).
            v: velocity [m/s], changed where nodes go to sleep, shape (3 n,).
            beta: damping in proportion to stiffness [s].
            inverse_mass: by coordinate, 0 where fixed [1/kg], shape (3 n,).
            coupling: the tool's spring.
            seconds: duration of a frame [s].
        """
        if self.whole:
            operands = self._model.operands()
            return Region(operands.awake, operands, operands, None)
        looked, operands = self._looked(coupling)
        damped, f = self._room(len(u))
        _ahead(operands.reach, u, v, beta, damped)
        internal_force(operands, damped, f, 1)
        tolerance = self._settings.tolerance
        _measure(f, v, inverse_mass, seconds, tolerance, looked, self._quiet)
        restless = looked[self._quiet[looked] < _PATIENCE]
        seeds = np.concatenate([restless, coupling.nodes])
        awake = self._model.neighbours.around(seeds, self._rings)
        if self._settings.mode == 'budget' and len(awake) > self._settings.nodes:
            candidates, awake = awake, self._nearest(awake, v, coupling)
            # The others sleep: their neighbours may wake them.
            self._quiet[without(candidates, awake)] = _PATIENCE
        v.reshape(-1, 3)[without(self._awake, awake)] = 0.0
        region = self._region
        if region is None or not np.array_equal(awake, self._awake) or _misses(region, coupling):
            region = self._region = self._surround(awake, coupling)
        self._moved = grown(self._moved, self._model.mesh.node_count)
        self._moved[awake] = True
        return region

    def _looked(self, coupling: Coupling) -> tuple[np.ndarray, Operands]:
        """The nodes that are looked at, sorted, and the operands for the force on them."""
        region = self._region
        if region is not None and len(without(np.sort(coupling.nodes), self._near)) == 0:
            return self._near, region.around
        neighbours = self._model.neighbours
        looked = neighbours.around(np.concatenate([self._near, coupling.nodes]), 0)
        whole = len(looked) == self._model.mesh.node_count
        return looked, self._model.operands(None if whole else looked)

    def _surround(self, awake: np.ndarray, coupling: Coupling) -> Region:
        """Takes some nodes as those that move, sorted, shape (a,)."""
        model = self._model
        level = model.neighbours.levels(awake, 3)
        self._awake, self._near = awake, np.flatnonzero(level <= 1)
        n = model.mesh.node_count
        some = len(awake) < n and not self._implicit
        part = model.part(awake, self._near, coupling.nodes) if some else None
        if part is not None:
            around = model.operands_within(level, 1)
            return Region(part.operands.awake, part.operands, around, part.place)
        inner = model.operands() if len(awake) == n else model.operands_within(level, 0)
        outer = inner if len(self._near) == n else model.operands_within(level, 1)
        return Region(intervals(level, 0), inner, outer, None)

    def _room(self, size: int) -> np.ndarray:
        if self._scratch.shape[1] != size:
            self._scratch = np.zeros((2, size))
        return self._scratch

    def _nearest(self, awake: np.ndarray, v: np.ndarray, coupling: Coupling) -> np.ndarray:
        """Of the nodes awake those nearest to the tool; without a tool the fastest; sorted."""
        rest = self._model.mesh.rest
        if coupling.mode == FREE:
            rank = -np.square(v.reshape(-1, 3)[awake]).sum(axis=1)
        else:
            here = coupling.weights @ rest[coupling.nodes]
            rank = np.square(rest[awake] - here).sum(axis=1)
        most = self._settings.nodes
        return np.sort(awake[np.argpartition(rank, most - 1)[:most]])

    def follow_cut(self, nodes: np.ndarray) -> None:
        """Wakes the nodes that a cut touched, shape (r,)."""
        n = self._model.mesh.node_count
        if self.whole:
            self._awake = np.arange(n)
            return
        self._quiet = grown(self._quiet, n)
        self._quiet[nodes] = 0
        awake = np.concatenate([self._awake[self._awake < n], nodes])
        self._awake = self._model.neighbours.around(awake, 0)
        self._near = self._model.neighbours.around(awake, 1)
        self._region = None

    def wake(self) -> None:
        """Wakes all nodes."""
        self._awake = self._near = np.arange(self._model.mesh.node_count)
        self._quiet[:] = 0
        self._region = None
