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
from tissue_sim.rotation import LANES

_BLOCK = 4
"""Substeps between two choices while some nodes sleep."""
_BLOCK_AWAKE = 16
"""The same while none does, and none can be missed."""
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
    """Intervals of nodes that move, shape (s, 2), and the operands that they need."""

    spans: np.ndarray
    operands: Operands


@njit(cache=True)
def _spread(tetrahedra, marked):
    """Marks all nodes of the elements that have a marked one."""
    before = marked.copy()
    for t in range(tetrahedra.shape[0]):
        any_marked = False
        for i in range(4):
            any_marked = any_marked or before[tetrahedra[t, i]]
        if any_marked:
            for i in range(4):
                marked[tetrahedra[t, i]] = True


@njit(cache=True)
def _measure(f, v, inverse_mass, seconds, tolerance, looked, quiet):
    """Counts for how many choices the nodes that are looked at have been slow and in balance."""
    for i in range(quiet.shape[0]):
        if not looked[i]:
            continue
        speed = gain = 0.0
        for k in range(3 * i, 3 * i + 3):
            speed += v[k] * v[k]
            gain += (f[k] * inverse_mass[k] * seconds) ** 2
        slow = max(speed, gain) < tolerance * tolerance
        quiet[i] = min(quiet[i] + 1, 1000) if slow else 0


@njit(cache=True)
def _chunks(tetrahedra, marked):
    """Which chunks of elements have one with a marked node."""
    out = np.zeros((tetrahedra.shape[0] + LANES - 1) // LANES, np.bool_)
    for t in range(tetrahedra.shape[0]):
        for i in range(4):
            if marked[tetrahedra[t, i]]:
                out[t // LANES] = True
    return np.flatnonzero(out)


def _spans(marked: np.ndarray) -> np.ndarray:
    ends = np.flatnonzero(np.diff(np.concatenate([[False], marked, [False]]).astype(np.int8)))
    return ends.reshape(-1, 2)


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
        self._quiet = np.zeros(model.mesh.node_count, np.int64)
        self._awake = np.ones(model.mesh.node_count, bool)
        self._near = self._awake

    @property
    def count(self) -> int:
        """How many nodes move."""
        return int(self._awake.sum())

    def ahead(self, left: int) -> int:
        """Substeps until the next choice, of some that are left in the frame."""
        if self._settings.mode == 'off':
            return left
        if self._implicit:
            return 1
        return min(_BLOCK_AWAKE if self._awake.all() else _BLOCK, left)

    def choose(
        self,
        damped: np.ndarray,
        v: np.ndarray,
        inverse_mass: np.ndarray,
        coupling: Coupling,
        seconds: float,
    ) -> Region:
        """Chooses, and stops the nodes that go to sleep.

        Only nodes that move, and their neighbours, are looked at: the force on others is what it
        was.

        Args:
            damped: u + beta v, which the force is taken at [m], shape (3 n,).
            v: velocity [m/s], changed where nodes go to sleep, shape (3 n,).
            inverse_mass: by coordinate, 0 where fixed [1/kg], shape (3 n,).
            coupling: the tool's spring.
            seconds: duration of a frame [s].
        """
        n = self._model.mesh.node_count
        whole = self._model.operands()
        if self._settings.mode == 'off':
            return Region(whole.awake, whole)
        tetrahedra = self._model.mesh.tetrahedra
        looked = self._near.copy()
        looked[coupling.nodes] = True
        f = np.empty(3 * n)
        if looked.all():
            internal_force(whole, damped, f, 1)
        else:
            around = looked.copy()
            _spread(tetrahedra, around)
            internal_force(self._needed(looked, around), damped, f, 1)
        tolerance = self._settings.tolerance
        _measure(f, v, inverse_mass, seconds, tolerance, looked, self._quiet)
        awake = self._quiet < _PATIENCE
        awake[coupling.nodes] = True
        for _ in range(self._rings):
            _spread(tetrahedra, awake)
        if self._settings.mode == 'budget' and awake.sum() > self._settings.nodes:
            awake = self._nearest(awake, v, coupling)
            self._quiet[~awake] = _PATIENCE  # they sleep: their neighbours may wake them
        v.reshape(-1, 3)[~awake] = 0.0
        self._awake = awake
        self._near = awake.copy()
        _spread(tetrahedra, self._near)
        if awake.all():
            return Region(whole.awake, whole)
        return Region(_spans(awake), self._needed(awake, self._near))

    def _needed(self, marked: np.ndarray, near: np.ndarray) -> Operands:
        """What the forces on marked nodes need; `near`: they and their neighbours, shape (n,)."""
        chunks = np.zeros(0, np.int64)
        if self._model.rotating:
            chunks = _chunks(self._model.mesh.tetrahedra, marked)
        return self._model.operands(_spans(near), chunks)

    def _nearest(self, awake: np.ndarray, v: np.ndarray, coupling: Coupling) -> np.ndarray:
        """Of the nodes awake those nearest to the tool; without a tool the fastest."""
        rest = self._model.mesh.rest
        if coupling.mode == FREE:
            rank = -np.square(v.reshape(-1, 3)).sum(axis=1)
        else:
            rank = np.square(rest - coupling.weights @ rest[coupling.nodes]).sum(axis=1)
        candidates = np.flatnonzero(awake)
        order = np.argsort(rank[candidates], kind='stable')
        out = np.zeros_like(awake)
        out[candidates[order[: self._settings.nodes]]] = True
        return out

    def follow_cut(self, nodes: np.ndarray) -> None:
        """Wakes the nodes that a cut touched, shape (r,)."""
        n = self._model.mesh.node_count
        quiet = np.zeros(n, np.int64)
        known = min(n, len(self._quiet))
        quiet[:known] = self._quiet[:known]
        quiet[nodes] = 0
        self._quiet = quiet
        self._awake = self._near = np.ones(n, bool)
