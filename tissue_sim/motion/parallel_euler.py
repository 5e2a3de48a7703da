"""Euler's steps by several threads, which share parts of the rows, domains and elements.

The forces of each part go to an array of its own. Then those of some nodes are added up, in the
order of the parts, and the nodes are moved. So the bits depend neither on the number of threads and
processors nor on their load, but they are not those of `explicit.euler_steps`.
"""

import os
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from threading import Lock
from typing import Any, NamedTuple

import numpy as np

from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.tissue_sim.contact.coupling import (
    Springs,
    forces_of_springs,
    start_of_work,
    work_of_springs,
)
from cutting_trainer.tissue_sim.contact.cut_contact import CutContacts, meet, subtract_pulls
from cutting_trainer.tissue_sim.elasticity.adaptive_law import Law
from cutting_trainer.tissue_sim.elasticity.coarse_rows import lead_far_nodes, put_coarse_forces
from cutting_trainer.tissue_sim.elasticity.elastic_force import Operands, elastic_force
from cutting_trainer.tissue_sim.elasticity.rotation import LANES
from cutting_trainer.tissue_sim.motion.division import (
    MAX_PARTS,
    Division,
    division_of,
    of_part,
    parts_of,
)
from cutting_trainer.tissue_sim.motion.explicit import (
    copy_nodes,
    look_ahead,
    pull_by_springs,
    step_of_euler,
)
from cutting_trainer.tissue_sim.motion.integrators import Integrator, IntegratorName
from cutting_trainer.tissue_sim.motion.phases import claim, finish, make_board, wait_for_end

PARALLEL: tuple[IntegratorName, ...] = ('symplectic_euler', 'euler')
"""Integrators that several threads share."""
MAX_THREADS = MAX_PARTS
_BLOCK = 256
"""Nodes that are moved at once: their forces stay in the first cache."""
_COPY, _AHEAD, _FAR, _FORCE, _PULL, _MOVE, _MEET = range(7)
"""Kinds of phases; those from `_FAR` on belong to a step."""


class Account(NamedTuple):
    """Account of the work of the springs, t of them.

    Attributes:
        pulls, last: see `coupling.work_of_springs`, shapes (t, 3) and (t, 2, 3).
        work: on the tissue [J], shape (1,).
    """

    pulls: np.ndarray
    last: np.ndarray
    work: np.ndarray


@inner(error_model='numpy')
def _operands_of(operands, division, part):
    """Return the operands of a part, without load and coarse unknowns."""
    law, begins = operands.law, division.chunks.begins
    own = Law(
        law.domains, law.elements, law.tolerance, division.counters[part],
        division.candidates[LANES * begins[part] : LANES * begins[part + 1]],
        law.implicit, law.domain_bounds, law.element_bounds,
    )  # fmt: skip
    return Operands(
        operands.rows, operands.domains, operands.elements, operands.rotating,
        of_part(division.rows, part), of_part(division.domains, part),
        of_part(division.reach, part), of_part(division.chunks, part),
        operands.local, own, operands.load, operands.coarse,
    )  # fmt: skip


@inner(error_model='numpy')
def _add_parts(forces, givers, load, a, b, out):
    """Add the forces of some parts at some coordinates, less the load."""
    for part in range(forces.shape[0]):
        if givers >> part & 1:
            for i in range(b - a):
                out[i] += forces[part, a + i]
    for i in range(min(b, load.shape[0]) - a):
        out[i] -= load[a + i]


@inner(error_model='numpy')
def _pull(operands, givers, forces, springs, faces, at, u, q, external, account, symplectic):
    """Write the forces of tools, of cut faces and on coarse unknowns, where there are any."""
    coarse = operands.coarse
    for k in range(coarse.nodes.shape[0]):
        first = coarse.nodes[k]
        external[first : first + 3] = 0.0
        here = givers[first // 3]
        _add_parts(forces, here, operands.load, first, first + 3, external[first : first + 3])
    put_coarse_forces(coarse, q, external, 1.0)
    for tool in range(springs.nodes.shape[0]):
        for node in springs.nodes[tool]:
            external[3 * node : 3 * node + 3] = 0.0
    for contact in range(faces.at.shape[0]):
        for first in faces.at[contact]:
            external[first : first + 3] = 0.0
    subtract_pulls(faces, external)
    pulls, last = account.pulls, account.last
    account.work[0] += pull_by_springs(springs, at, u, q, external, pulls, last, symplectic)


@inner(error_model='numpy')
def _move(
    division, part, load, forces, external, block, inverse_mass, u, v, q, alpha, beta, dt,
    symplectic,
):  # fmt: skip
    spans = of_part(division.moved, part)
    for s in range(spans.shape[0]):
        givers = division.givers[spans[s, 0]]
        for low in range(spans[s, 0], spans[s, 1], _BLOCK):
            a, b = 3 * low, 3 * min(low + _BLOCK, spans[s, 1])
            f = block[: b - a]
            f[:] = external[a:b]
            _add_parts(forces, givers, load, a, b, f)
            step_of_euler(u[a:b], v[a:b], q[a:b], f, inverse_mass[a:b], alpha, beta, dt, symplectic)


@inner
def _kinds(operands, springs, faces):
    """Return the kinds of the phases of a step."""
    is_coarse, meets = operands.coarse.used.shape[0] > 0, faces.at.shape[0] > 0
    kinds, count = np.empty(5, np.int64), 0
    for kind, occurs in (
        (_FAR, is_coarse),
        (_FORCE, True),
        (_PULL, springs.modes.shape[0] > 0 or meets or is_coarse),
        (_MOVE, True),
        (_MEET, meets),
    ):
        if occurs:
            kinds[count] = kind
            count += 1
    return kinds[:count]


@kernel(error_model='numpy', nogil=True)
def parallel_euler_steps(
    number, threads, board, operands, division, forces, account, inverse_mass, damping, springs,
    faces, u, v, work, dt, first, steps, total, symplectic,
):  # fmt: skip
    """Compute steps of Euler's methods together with other threads.

    Args:
        number: of this thread; all others are called with the same further arguments.
        threads: their number.
        board: see `phases`.
        operands, division: of the region that moves.
        forces: scratch: those of each part, shape (p, 3 n).
        account: of the springs, changed.
        inverse_mass, damping, springs, faces, u, v, work, dt, first, steps, total, symplectic: see
            `explicit.euler_steps`.
    """
    alpha, beta = damping[0], damping[1]
    q, external = work[2, : u.shape[0]], work[3, : u.shape[0]]
    parts = parts_of(division)
    block, kinds = np.empty(3 * _BLOCK), _kinds(operands, springs, faces)
    phase = 0
    while phase < _FAR + steps * kinds.shape[0]:
        done, place = divmod(phase - _FAR, kinds.shape[0])
        kind = kinds[place] if phase >= _FAR else phase
        items = 1 if kind == _FAR or kind == _PULL or kind == _MEET else parts
        for turn in range(items):
            item = (number * parts // threads + turn) % items  # first its own
            if not claim(board, phase, item):
                continue
            if kind == _COPY:
                copy_nodes(of_part(division.reach, item), u, q)
                if item == 0:
                    start_of_work(springs, u, account.last)
            elif kind == _AHEAD:
                spans = of_part(division.moved, item)
                for s in range(spans.shape[0]):
                    a, b = 3 * spans[s, 0], 3 * spans[s, 1]
                    external[a:b] = 0.0
                    look_ahead(q[a:b], u[a:b], v[a:b], beta)
            elif kind == _FAR:
                lead_far_nodes(operands.coarse, q, 1.0)
            elif kind == _FORCE:
                elastic_force(_operands_of(operands, division, item), q, forces[item], np.int64(1))
            elif kind == _PULL:
                at = (first + done) / total
                _pull(
                    operands, division.givers, forces, springs, faces, at, u, q, external, account,
                    symplectic,
                )  # fmt: skip
            elif kind == _MOVE:
                _move(
                    division, item, operands.load, forces, external, block, inverse_mass, u, v, q,
                    alpha, beta, dt, symplectic,
                )  # fmt: skip
            else:
                meet(faces, u, v, q, beta, dt)
            finish(board, items)
        phase = wait_for_end(board, phase)


@kernel
def end_of_work(springs, at, u, account):
    """Return the work of the springs on the tissue when the steps are over [J]."""
    forces_of_springs(springs, at, u, account.pulls)
    return account.work[0] + work_of_springs(springs, account.pulls, u, account.last)


class _Team:
    """Threads that compute together, for one simulation at a time.

    Args:
        threads: their number, the caller's included.
    """

    def __init__(self, threads: int) -> None:
        self._threads = threads
        self._lock = Lock()
        self._others = ThreadPoolExecutor(max(threads - 1, 1), 'frames')
        self._known: tuple[Operands, np.ndarray, Division] | None = None
        self._forces = np.zeros((MAX_PARTS, 0))

    def steps(
        self,
        operands: Operands,
        spans: np.ndarray,
        inverse_mass: np.ndarray,
        damping: np.ndarray,
        springs: Springs,
        faces: CutContacts,
        u: np.ndarray,
        v: np.ndarray,
        work: np.ndarray,
        dt: float,
        first: int,
        steps: int,
        total: int,
        symplectic: bool,
    ) -> float:
        """Compute steps; return the work of the springs [J]. Arguments: see `euler_steps`."""
        with self._lock:
            if self._forces.shape[1] < len(u):
                self._forces = np.zeros((MAX_PARTS, len(u)))
            division = self._division(operands, spans, len(u) // 3)
            tools = len(springs.modes)
            account = Account(np.zeros((tools, 3)), np.zeros((tools, 2, 3)), np.zeros(1))
            self._run(
                *(make_board(MAX_PARTS), operands, division, self._forces, account, inverse_mass),
                *(damping, springs, faces, u, v, work, dt, first, steps, total, symplectic),
            )
            return float(end_of_work(springs, (first + steps) / total, u, account))

    def _division(self, operands: Operands, spans: np.ndarray, count: int) -> Division:
        """Return the division of a region, in which the law goes on as if from the beginning."""
        known = self._known
        if known is None or known[0] is not operands or known[1] is not spans:
            known = self._known = operands, spans, division_of(operands, spans, count)
        known[2].counters[:] = 0
        return known[2]

    def _run(self, *given: Any) -> None:
        """Call the kernel in all threads; wait until the steps are computed."""
        others = []
        try:
            for number in range(1, self._threads):
                call = parallel_euler_steps, number, self._threads, *given
                others.append(self._others.submit(*call))
            parallel_euler_steps(0, self._threads, *given)
        except BaseException:
            for other in others:  # they compute all steps, also without the caller
                if not other.cancel():
                    other.result()
            raise
        for other in others:  # one that comes only now finds nothing to do: nobody waits for it
            other.cancel()


_team = cache(_Team)


class ParallelEuler(Integrator):
    """Steps of Euler's methods by several threads, where enough nodes move.

    Args:
        name: of the method, one of `PARALLEL`.
        alpha, beta: Rayleigh damping [1/s], [s].
        threads: their number, 2 or more.

    Attributes:
        min_nodes: moving nodes from which on they share the work: of fewer, one thread computes
            the steps in less time, whatever the number of threads.
    """

    min_nodes = 5000

    def __init__(self, name: IntegratorName, alpha: float, beta: float, threads: int) -> None:
        super().__init__(name, alpha, beta)
        self._threads = threads

    def _euler(self, operands: Operands, spans: np.ndarray, *rest: Any) -> float:
        moving = int(np.sum(spans[:, 1] - spans[:, 0]))
        if moving < self.min_nodes or len(operands.local.first):
            return super()._euler(operands, spans, *rest)
        return _team(self.threads_for(moving)).steps(operands, spans, *rest)

    def threads_for(self, moving: int) -> int:
        """Return how many threads compute the steps of a number of moving nodes.

        On fewer processors so many threads are the fastest, with the same bits.
        """
        processors = len(os.sched_getaffinity(0))
        return min(self._threads, processors) if moving >= self.min_nodes else 1


def make_integrator(
    name: IntegratorName, alpha: float, beta: float, threads: int = 1
) -> Integrator:
    """Return an integrator; one of several threads where these can share its steps.

    Args:
        name: of the method.
        alpha, beta: Rayleigh damping [1/s], [s].
        threads: number that may compute.
    """
    if threads > 1 and name in PARALLEL:
        return ParallelEuler(name, alpha, beta, threads)
    return Integrator(name, alpha, beta)
