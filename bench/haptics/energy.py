"""Energy that each force law gives to the hand or takes from it, by tapping on the liver."""

from dataclasses import dataclass

import numpy as np

from bench.haptics.accuracy import APPROACH_TIME_S, PLACES, Bench, Floats, Motion, wave
from cutting_trainer.session.in_process import TICK_S, LinkSettings
from cutting_trainer.session.scene_loader import load_scene


@dataclass(frozen=True)
class Energy:
    """Net energy from the hand over tapping at 1 Hz.

    Attributes:
        name: of the force.
        trace: by tick [J], shape (k,).
        by_cycle: mean of a cycle [J]; negative: the hand got more than it gave.
        stored: most in a cycle [J].
    """

    name: str
    trace: Floats
    by_cycle: float
    stored: float

    @property
    def figures(self) -> dict[str, str | float]:
        """All but the trace."""
        return {
            'force': self.name,
            'stored_joule': self.stored,
            'net_by_cycle_joule': self.by_cycle,
        }


def energies() -> list[Energy]:
    """Return energies of the 1 kHz simulation, of two forces and of one; without and with delay."""
    bench = Bench(load_scene('liver'))
    motion = Motion('tapping', wave(1.0, -0.003, 0.005), 3.0)
    path = bench.path(motion, PLACES[0])
    late = LinkSettings(delay=0.05)
    forces = {'tissue at 1 kHz': bench.reference(path, cuts=False)}
    for name, link in (('', None), (', 50 ms each way', late)):
        for kind in ('two', 'one'):
            forces[f'{kind} force{"s" * (kind == "two")}{name}'] = bench.rendered(
                path, False, link, forces=kind, max_damping=0.0
            )
    held = bench.rendered(path, False, extrapolation='constant', max_damping=0.0)
    forces['two forces, held (constant)'] = held
    return [_energy(name, path, force) for name, force in forces.items()]


def _energy(name: str, path: Floats, force: Floats) -> Energy:
    moved = np.diff(path, axis=0)
    trace = np.concatenate([[0.0], np.cumsum(-np.einsum('ij,ij->i', force[:-1], moved))])
    cycle, skip = round(1 / TICK_S), round(APPROACH_TIME_S / TICK_S)
    cycles = (len(path) - skip) // cycle
    ends = trace[skip : skip + cycles * cycle + 1 : cycle]
    if len(ends) <= cycles:
        ends = np.append(ends, trace[-1])
    return Energy(
        name, trace, float(np.diff(ends).mean()), float(np.ptp(trace[skip : skip + cycle]))
    )


def energies_table(budget: list[Energy]) -> list[str]:
    """Return lines of the table."""
    lines = ['| force | stored by a tap | net by cycle |', '|---|---:|---:|']
    for e in budget:
        share = 100 * e.by_cycle / e.stored
        effect = 'lost' if share >= 0 else 'made'
        lines.append(f'| {e.name} | {1e3 * e.stored:.2f} mJ | {abs(share):.1f} % {effect} |')
    return lines
