"""Decoding and validation of `ForceSample` messages."""

import math
from typing import NamedTuple

import numpy as np

from cutting_trainer.haptic_bridge.force_kernels import INSIDE
from cutting_trainer.node_common.cdr_codec import ForceSampleCodec, StampedMessage
from cutting_trainer.node_common.rejections import MAX_TOOLS, MessageError
from cutting_trainer.tissue_sim.mesh.replica import MAX_COORDINATE

MAX_FORCE_N = 1e3
"""[N]. A diverging simulation exceeds it long before it overflows."""
MAX_TORQUE_N_M = 1e3
"""[N m] Largest force on a blade of a metre."""
MAX_STIFFNESS_N_M = 1e6
"""[N/m] in each direction: stiffness of bone, the largest that a hand can distinguish."""
_MAX_COUNT = 2**63 - 1
_AT = ForceSampleCodec.fields


class TissueSample(NamedTuple):
    """Reaction on the tool in one frame, see `ForceSample.msg`.

    Attributes:
        step, revision, topology: of the simulation.
        sequence: of the contact that it answers.
        time: stamp of that contact [ns].
        state: NONE, TOUCHING or INSIDE.
        position: of the tool [m], shape (3,).
        force: [N], shape (3,).
        stiffness: [N/m], shape (3, 3).
        resistance: largest force that the blade transmits [N].
        tool: number of the tool that feels it.
        torque: about the end of the blade at its tip [N m], shape (3,).
        torque_resistance: largest torque that the blade transmits [N m].
        immersed: mean and mean square of the places along the blade, from 0 at its tip to 1 at its
            root, that are in the tissue, shape (2,).
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
    tool: int
    torque: np.ndarray
    torque_resistance: float
    immersed: np.ndarray

    @classmethod
    def read(cls, sample: StampedMessage) -> 'TissueSample':
        """Decode a message."""
        step, revision, topology, sequence, seconds, nanoseconds, state = sample.values[:7]
        names = ('position', 'force', 'stiffness', 'torque', 'immersed')
        position, force, stiffness, torque, immersed = (
            np.array(sample.values[_AT[name]]) for name in names
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
            int(sample.values[_AT['tool']][0]),
            torque,
            sample.values[_AT['torque_resistance']][0],
            immersed,
        )

    @property
    def problem(self) -> MessageError | None:
        """Return why the sample is not plausible; None if it is."""
        for name, size, limit, unit in (
            ('force', math.hypot(*self.force), MAX_FORCE_N, 'N'),
            ('stiffness', np.abs(self.stiffness).max(), MAX_STIFFNESS_N_M, 'N/m'),
            ('position', np.abs(self.position).max(), MAX_COORDINATE, 'm'),
            ('resistance', self.resistance, MAX_FORCE_N, 'N'),
            ('torque', math.hypot(*self.torque), MAX_TORQUE_N_M, 'N m'),
            ('torque_resistance', self.torque_resistance, MAX_TORQUE_N_M, 'N m'),
            ('immersed', self.immersed.max(), 1.0, ''),
            ('immersed', self.immersed.min(), 1.0, ''),
            ('state', self.state, INSIDE, ''),
            ('topology', self.topology, _MAX_COUNT, ''),
            ('tool', self.tool, MAX_TOOLS - 1, ''),
        ):
            if not 0 <= size <= limit:  # a NaN is not
                text = (
                    f'of frame {self.step} the {name} is {size:g} {unit}, not finite or not from '
                    f'0 to {limit:g} {unit}'
                )
                return MessageError(f'{name} that cannot be believed', ' '.join(text.split()))
        return None
