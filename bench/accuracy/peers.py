"""The trainer's tissue beside other libraries' soft bodies: one beam, one mesh, one run.

Run `python -m bench.accuracy.peers` where bench/requirements-peers.txt is installed.
A beam is clamped at one end and loaded at the other; every solver starts it at rest, lets it swing
out under the same damping, and is timed then. A peer that is not installed is said to be so.
"""

import argparse
import contextlib
import json
import os
import platform
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec

import numpy as np
from numpy.typing import NDArray
from rich import box as borders
from rich.console import Console
from rich.table import Table

from bench.accuracy.peer_beam import Beam, Result, Solver, make_beam, measure, stable_step
from bench.accuracy.peer_solvers import MujocoFlex, NewtonTetrahedra
from bench.accuracy.problems import material
from bench.common.clock import keep
from cutting_trainer.tissue_sim.contact.coupling import NO_SPRINGS
from cutting_trainer.tissue_sim.elasticity.models import MODELS, ElasticModel, ModelName
from cutting_trainer.tissue_sim.motion.integrators import Integrator

Floats = NDArray[np.float64]

RATIOS, RESOLUTIONS = (0.3, 0.47), (3, 7, 12)


class Own:
    """The trainer's tissue with symplectic Euler, the load as a push before each step, from Python.

    Args:
        at: the beam.
        name: of the model.
    """

    def __init__(self, at: Beam, name: ModelName) -> None:
        self._model = ElasticModel(at.mesh, material(at.problem.solid), name)
        self._inverse = np.repeat(np.where(at.mesh.fixed == 1, 0.0, 1.0 / self._model.mass), 3)
        self.dt = stable_step(self._model, self._inverse)
        self._push = self.dt * at.load.ravel() * self._inverse
        self._integrator = Integrator('symplectic_euler', 0.0, 0.0)
        self._spring, self._operands = NO_SPRINGS, self._model.operands()
        self._u, self._v = np.zeros_like(self._push), np.zeros_like(self._push)

    def step(self, count: int) -> None:
        m = self._model
        for _ in range(count):
            self._v += self._push
            self._integrator.step(
                self._operands, self._inverse, m.diagonal, self._spring, self._u, self._v,
                self.dt, 1,
            )  # fmt: skip

    def slow(self, factor: float) -> None:
        self._v *= factor

    def displacement(self) -> Floats:
        return self._u.reshape(-1, 3)


@dataclass(frozen=True)
class Entry:
    """A line of the table.

    Attributes:
        name: of the solver.
        package: on PyPI; empty: the trainer.
        module: that it is imported as.
        make: gives it a beam.
        does: description of a step.
        cut: whether the body can be cut.
    """

    name: str
    package: str
    module: str
    make: Callable[[Beam], Solver]
    does: str
    cut: str


_FLEX = 'no: bodies and elements are compiled into the model; welds can be switched off'
_TETRAHEDRA = 'no: finalize() makes the arrays of tetrahedra; nothing changes them'


def _own(name: ModelName) -> Entry:
    does = 'a force, symplectic Euler'
    return Entry(name, '', 'tissue_sim', lambda at: Own(at, name), does, 'yes, while it moves')


def entries() -> list[Entry]:
    """Return all lines, the trainer's first."""
    return [
        *(_own(name) for name in MODELS),
        Entry(
            'flex, Euler', 'mujoco-core', 'mujoco', lambda at: MujocoFlex(at, 'Euler'),
            'a force (St. Venant-Kirchhoff), symplectic Euler', _FLEX,
        ),
        Entry(
            'flex, discrete', 'mujoco-core', 'mujoco', lambda at: MujocoFlex(at, 'discrete'),
            'implicit in velocity and place, conjugate gradients', _FLEX,
        ),
        Entry(
            'semi-implicit', 'newton', 'newton', lambda at: NewtonTetrahedra(at, block=False),
            'a force (neo-Hookean, single precision), symplectic Euler', _TETRAHEDRA,
        ),
        Entry(
            'VBD', 'newton', 'newton', lambda at: NewtonTetrahedra(at, block=True),
            'implicit, ten sweeps of block descent (neo-Hookean, single precision)', _TETRAHEDRA,
        ),
    ]  # fmt: skip


@dataclass(frozen=True)
class Row:
    """Result of an entry on a beam.

    Attributes:
        solver, package, does, cut: see `Entry`; the package with its version.
        poissons_ratio: of the beam [-].
        result: None: there is none.
        sunk: deflection over the reference's [-]; None: it did not come to rest.
        note: why there is no result.
    """

    solver: str
    package: str
    does: str
    cut: str
    poissons_ratio: float
    result: Result | None
    sunk: float | None
    note: str


def absent(entry: Entry) -> str:
    """Return the reason why an entry cannot run here; empty: it can."""
    return '' if find_spec(entry.module) else f'not installed ({entry.package})'


def run(entry: Entry, at: Beam, budget: float) -> Row:
    """Measure an entry; the error of a peer becomes its note.

    Args:
        entry: of the table.
        at: the beam.
        budget: see `measure`.
    """
    note, result, package = absent(entry), None, entry.package
    if not note:
        with contextlib.suppress(PackageNotFoundError):
            package = f'{package} {version(package)}'.strip() if package else ''
        try:
            with redirect_output():
                result = measure(at, entry.make(at), budget)
        except Exception as error:
            if not entry.package:
                raise
            note = f'{type(error).__name__}: {error}'.splitlines()[0]
    nu = at.problem.solid.poissons_ratio
    sunk = result.deflection / at.exact if result and result.deflection is not None else None
    named = (entry.name, package or 'the trainer', entry.does, entry.cut)
    return Row(*named, nu, result, sunk, note)


@contextlib.contextmanager
def redirect_output() -> Iterator[None]:
    """Redirect the output of libraries to standard error, so that the table stays readable."""
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        yield
    finally:
        sys.stdout.flush()
        os.dup2(kept, 1)
        os.close(kept)


def table(rows: list[Row]) -> Table:
    """Return the rows for a terminal."""
    shown = Table(box=borders.SIMPLE_HEAD)
    for name in ('tetrahedra', 'ν', 'solver', 'of', 'step [ms]', 'ns/tet and step'):
        shown.add_column(name, justify='left' if name in ('solver', 'of') else 'right')
    for name in ('s of CPU a simulated s', 'deflection / exact'):
        shown.add_column(name, justify='right')
    for name in ('a step', 'can it be cut'):
        shown.add_column(name)
    for row in rows:
        found = row.result
        figures = [row.note, '', '', '', '']
        if found is not None:
            sunk = 'not reached' if row.sunk is None else f'{row.sunk:.4f}'
            median, low, high = found.cost
            cost = f'{median:.3g} ({low:.3g} to {high:.3g})'
            figures = [f'{1e3 * found.dt:.3g}', cost, f'{found.real_time:.3g}', sunk, row.does]
        size = str(found.tetrahedra) if found else ''
        ratio = f'{row.poissons_ratio:g}'
        shown.add_row(size, ratio, row.solver, row.package, *figures, row.cut)
    return shown


def main() -> None:
    parser = argparse.ArgumentParser(description='The trainer beside other soft bodies.')
    parser.add_argument('--budget', type=float, default=60.0, help='processor time a beam [s]')
    parser.add_argument('--resolutions', type=int, nargs='+', default=RESOLUTIONS)
    parser.add_argument('--ratios', type=float, nargs='+', default=RATIOS)
    parser.add_argument('--only', nargs='+', help='packages or solvers; "trainer": our own')
    parser.add_argument('--json', action='store_true', help='print JSON')
    parser.add_argument('--save', action='store_true', help='keep it in bench/results')
    asked = parser.parse_args()
    chosen = [
        e for e in entries() if not asked.only or {e.name, e.package or 'trainer'} & {*asked.only}
    ]
    rows = []
    for resolution in asked.resolutions:
        for ratio in asked.ratios:
            at = make_beam(ratio, resolution)
            for entry in chosen:
                rows.append(run(entry, at, asked.budget))
                said = rows[-1].note or f'{rows[-1].result}'
                print(f'{entry.name}, ν {ratio:g}: {said}', file=sys.stderr, flush=True)
    report = {
        'when': time.strftime('%Y-%m-%dT%H:%M:%SZ', time.gmtime()),
        'machine': f'{platform.machine()}, Python {platform.python_version()}',
        'load': os.getloadavg(),
        'rows': [asdict(row) for row in rows],
    }
    if asked.json:
        print(json.dumps(report, indent=1))
    else:
        Console(width=None if sys.stdout.isatty() else 200).print(table(rows))
    if asked.save:
        keep(report, 'peers')


if __name__ == '__main__':
    main()
