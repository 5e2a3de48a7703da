"""The force gate: what a `ForceSample` says, and whether it can be believed."""

import math
from typing import NamedTuple

import numpy as np

from haptic_bridge.chain import INSIDE
from haptic_bridge.wire import ForceSampleCodec, Sample
from tissue_sim.refusals import MessageError
from tissue_sim.replica import FARTHEST

LARGEST_FORCE = 1e3
"""[N]. A simulation that diverges exceeds it long before it overflows."""
LARGEST_STIFFNESS = 1e6
"""[N/m] in each direction: of bone, as far as a hand can tell."""
_LARGEST_COUNT = 2**63 - 1
_AT = ForceSampleCodec.fields


class TissueSample(NamedTuple):
    """One frame's reaction on the tool, see `ForceSample.msg`.

    Attributes:
        step, revision, topology: of the simulation.
        sequence: of the contact that it answers.
        time: stamp of that contact [ns].
        state: NONE, TOUCHING or INSIDE.
        position: of the tool [m], shape (3,).
        force: [N], shape (3,).
        stiffness: [N/m], shape (3, 3).
        resistance: largest force that the blade transmits [N].
    """

    step: int
    revision: int
    topology: int
    sequence: int
    time: int
    state: int
    position: np.ndarray
    force: np.ndarray
    stiffness: np.ndarray
    resistance: float

    @classmethod
    def read(cls, sample: Sample) -> 'TissueSample':
        """Takes a decoded message apart."""
        step, revision, topology, sequence, seconds, nanoseconds, state = sample.values[:7]
        position, force, stiffness = (
            np.array(sample.values[_AT[name]]) for name in ('position', 'force', 'stiffness')
        )
        return cls(
            int(step),
            int(revision),
            int(topology),
            int(sequence),
            int(seconds) * 1_000_000_000 + int(nanoseconds),
            int(state),
            position,
            force,
            stiffness.reshape(3, 3),
            sample.values[_AT['resistance']][0],
        )

    @property
    def problem(self) -> MessageError | None:
        """Why it cannot be believed; None if it can."""
        for name, size, most, unit in (
            ('force', math.hypot(*self.force), LARGEST_FORCE, 'N'),
            ('stiffness', np.abs(self.stiffness).max(), LARGEST_STIFFNESS, 'N/m'),
            ('position', np.abs(self.position).max(), FARTHEST, 'm'),
            ('resistance', self.resistance, LARGEST_FORCE, 'N'),
            ('state', self.state, INSIDE, ''),
            ('topology', self.topology, _LARGEST_COUNT, ''),
        ):
            if not 0 <= size <= most:  # a NaN is not
                text = (
                    f'of frame {self.step} the {name} is {size:g} {unit}, not finite or not from '
                    f'0 to {most:g} {unit}'
                )
                return MessageError(f'{name} that cannot be believed', ' '.join(text.split()))
        return None
