"""Active region: only nodes that may move are integrated; the others sleep at no cost.

A node sleeps after it has been slow and in balance for a while: its speed, and the speed that the
unbalanced force would give it within a frame, stay below a tolerance. It wakes when that force
grows, when the tool holds it, or when a moving node is near. Sleeping nodes keep their
displacement, so the forces on the others are right. The error is the motion that they miss.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from cutting_trainer.node_common.kernels import kernel
from cutting_trainer.tissue_sim.elasticity.elastic_force import Operands, internal_force
from cutting_trainer.tissue_sim.elasticity.local_rows import Locality
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel
from cutting_trainer.tissue_sim.mesh.adjacency import intervals, without
from cutting_trainer.tissue_sim.mesh.tetra_mesh import Touched, grown

_BLOCK = 4
"""Substeps between two selections while some nodes sleep and no cut has shortened the substeps."""
_BLOCK_AWAKE, _CHOICES_AWAKE = 16, 3
"""If no node sleeps, a new selection would change little: smallest number of substeps between two,
and largest number per frame. A selection costs about four substeps."""
_LEVELS_AROUND_MOVING = 2
"""Distance, in edges, of the neighbours that a moving node keeps awake."""
_CHOICES_TO_SLEEP = 6
"""Selections for which a node is slow before it sleeps."""


@dataclass(frozen=True)
class ActiveSettings:
    """Selection of the active region.

    Attributes:
        mode: off (all nodes move), on, or budget (`nodes` move on their own, the nearest to the
            tool, and all others by a coarse grid, see `FarField`).
        nodes: number of nodes with `budget`.
        tolerance: speed [m/s] below which a node may sleep.
    """

    mode: Literal['off', 'on', 'budget'] = 'off'
    nodes: int = 2000
    tolerance: float = 1e-4


class Region(NamedTuple):
    """Moving nodes.

    Attributes:
        spans: their intervals, shape (s, 2).
        operands: for the force on the nodes.
        around: for the force on the nodes and their neighbours, in the tissue.
        place: numbering of spans and operands, if the nodes are cheaper on their own.
    """

    spans: np.ndarray
    operands: Operands
    around: Operands
    place: Locality | None


@kernel
def _ahead(reach, u, v, beta, out):
    """Write u + beta v, the argument of the force, in some intervals of nodes."""
    for s in range(reach.shape[0]):
        for i in range(3 * reach[s, 0], 3 * reach[s, 1]):
            out[i] = u[i] + beta * v[i]


@kernel
def _measure(f, v, inverse_mass, seconds, tolerance, looked, quiet):
    """Count the selections for which the examined nodes have been slow and in balance."""
    for i in looked:
        speed = gain = 0.0
        for k in range(3 * i, 3 * i + 3):
            speed += v[k] * v[k]
            gain += (f[k] * inverse_mass[k] * seconds) ** 2
        slow = max(speed, gain) < tolerance * tolerance
        quiet[i] = min(quiet[i] + 1, 1000) if slow else 0


def _misses(region: Region, held: np.ndarray) -> bool:
    """Return whether a tool holds a node outside the part."""
    return region.place is not None and bool((region.place.local[held] < 0).any())


class ActiveRegion:
    """Selects the moving nodes, several times a frame.

    Args:
        model: the elastic model.
        settings: of the selection.
        implicit: whether steps are long and involve more than the next neighbours.
    """

    extra = 0
    """Coordinates beside those of the nodes, see `FarField`."""

    def __init__(self, model: ElasticModel, settings: ActiveSettings, *, implicit: bool) -> None:
        self._model = model
        self._settings = settings
        self._implicit = implicit
        self._rings = 4 * _LEVELS_AROUND_MOVING if implicit else _LEVELS_AROUND_MOVING
        n = model.mesh.node_count
        self._quiet = np.zeros(n, np.int64)
        self._awake = self._near = np.arange(n)
        self._region: Region | None = None
        self._moved = np.zeros(n, bool)
        self._scratch = np.zeros((2, 0))

    @property
    def nodes(self) -> np.ndarray:
        """Moving nodes, sorted, shape (a,)."""
        return self._awake

    @property
    def near(self) -> np.ndarray:
        """Moving nodes and their neighbours, sorted, shape (b,)."""
        return self._near

    @property
    def count(self) -> int:
        """Number of moving nodes."""
        return len(self._awake)

    @property
    def whole(self) -> bool:
        """Whether all nodes move unconditionally."""
        return self._settings.mode != 'on'

    def moved(self) -> np.ndarray:
        """Return the nodes moved since the last call, sorted, shape (a,)."""
        n = self._model.mesh.node_count
        self._moved = grown(self._moved, n)
        self._moved[self._awake] = True
        out = np.flatnonzero(self._moved[:n])
        self._moved[:] = False
        return out

    def ahead(self, left: int, total: int, shortened: float) -> int:
        """Return the number of substeps until the next selection.

        Args:
            left, total: substeps that the frame still has, and has in all.
            shortened: ratio of the substep's length before any cut to its present length.
        """
        if self.whole:
            return left
        if self._implicit:
            return 1
        if self.count >= self._model.mesh.node_count:
            return min(max(_BLOCK_AWAKE, -(-total // _CHOICES_AWAKE)), left)
        return min(max(_BLOCK, int(_BLOCK * shortened)), left)

    def choose(
        self,
        u: np.ndarray,
        v: np.ndarray,
        beta: float,
        inverse_mass: np.ndarray,
        held: np.ndarray,
        seconds: float,
        met: tuple[np.ndarray, np.ndarray | None],
    ) -> Region:
        """Select the moving nodes, and stop those that go to sleep.

        Only moving nodes and their neighbours are examined, because the force on others is
        unchanged. The cost does not depend on the size of the tissue.

        Args:
            u: displacement [m], shape (3 n,).
            v: velocity [m/s], changed where nodes go to sleep, shape (3 n,).
            beta: damping in proportion to stiffness [s].
            inverse_mass: by coordinate, 0 where fixed [1/kg], shape (3 n,).
            held: nodes that tools load, shape (h,).
            seconds: duration of a frame [s].
            met: nodes of cut faces in contact, with repeats, shape (c,), and their forces on all
                nodes [N], shape (n, 3), None without any; they sleep together.
        """
        if self.whole:
            operands = self._model.operands()
            return Region(operands.awake, operands, operands, None)
        looked, operands = self._looked(held)
        damped, f = self._room(len(u))
        _ahead(operands.reach, u, v, beta, damped)
        internal_force(operands, damped, f, 1)
        touching, pressed = met
        if pressed is not None:
            near = np.unique(touching)
            f.reshape(-1, 3)[near] -= pressed[near]
        tolerance = self._settings.tolerance
        _measure(f, v, inverse_mass, seconds, tolerance, looked, self._quiet)
        restless = looked[self._quiet[looked] < _CHOICES_TO_SLEEP]
        seeds = np.concatenate([restless, held])
        awake = self._model.neighbours.around(seeds, self._rings)
        if pressed is not None and np.isin(touching, awake).any():
            awake = self._model.neighbours.around(np.concatenate([seeds, touching]), self._rings)
        v.reshape(-1, 3)[without(self._awake, awake)] = 0.0
        region = self._region
        if region is None or not np.array_equal(awake, self._awake) or _misses(region, held):
            region = self._region = self._surround(awake, held)
        self._moved = grown(self._moved, self._model.mesh.node_count)
        self._moved[awake] = True
        return region

    def _looked(self, held: np.ndarray) -> tuple[np.ndarray, Operands]:
        """Return the examined nodes, sorted, and the operands for the force on them."""
        region = self._region
        if region is not None and len(without(np.sort(held), self._near)) == 0:
            return self._near, region.around
        neighbours = self._model.neighbours
        looked = neighbours.around(np.concatenate([self._near, held]), 0)
        whole = len(looked) == self._model.mesh.node_count
        return looked, self._model.operands(None if whole else looked)

    def _surround(self, awake: np.ndarray, held: np.ndarray) -> Region:
        """Make some nodes, sorted, the moving ones, shape (a,)."""
        model = self._model
        level = model.neighbours.levels(awake, 3)
        self._awake, self._near = awake, np.flatnonzero(level <= 1)
        n = model.mesh.node_count
        some = len(awake) < n and not self._implicit
        part = model.part(awake, self._near, held) if some else None
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

    def move(self, nodes: np.ndarray) -> np.ndarray:
        """Return whether nodes move, in their shape."""
        return np.full(nodes.shape, True) if self.whole else np.isin(nodes, self._awake)

    def follow_cut(self, touched: Touched) -> None:
        """Wake the nodes touched by a cut."""
        n, nodes = self._model.mesh.node_count, touched.nodes
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
        """Wake all nodes."""
        self._awake = self._near = np.arange(self._model.mesh.node_count)
        self._quiet[:] = 0
        self._region = None
