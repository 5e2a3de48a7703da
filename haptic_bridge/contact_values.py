"""Records of one tick of the force path: the commanded wrench and the reported contact."""

from typing import NamedTuple

import numpy as np

from cutting_trainer.haptic_bridge.proxy.record_type import record_type
from cutting_trainer.haptic_bridge.proxy.surface import Surface
from cutting_trainer.node_common.kernels import inner

CONTACT = record_type(
    [
        ('nodes', 'i8', (9,)),
        ('weights', 'f8', (9,)),
        ('device', 'f8', (3,)),
        ('proxy', 'f8', (3,)),
        ('point', 'f8', (3,)),
        ('normal', 'f8', (3,)),
        ('external_force', 'f8', (3,)),
        ('coupling_stiffness', 'f8'),
        ('blade', 'f8', (2, 3)),
        ('proxy_radius', 'f8'),
        ('blade_facing', 'f8', (3,)),
    ]
)
"""Fields of `Contact` from the nodes on; all of 8 bytes."""


class Tick(NamedTuple):
    """Command and contact report of one tick.

    Attributes:
        wrench: force [N] and torque [N m] on the hand, as `WrenchStampedCodec` takes them.
        contact: as `ContactCodec` takes it.
        contact_stamp_ns: stamp of the device pose that the contact stems from.
        fault: reason to enter FAULT, which the caller must then do; '' when nothing is wrong.
    """

    wrench: tuple[float, ...]
    contact: tuple[float, ...]
    contact_stamp_ns: int
    fault: str


class ContactReport:
    """Packs the contact of a tick.

    Args:
        stiffness: of the coupling [N/m].
        radius: of the tool [m].
        number: of the tool, by its place in the list of the scene.

    Attributes:
        record: of `pack`, dtype CONTACT, shape (1,).
    """

    def __init__(self, stiffness: float, radius: float, number: int = 0) -> None:
        self._number = number
        self.record = np.zeros(1, CONTACT)
        self.record['coupling_stiffness'], self.record['proxy_radius'] = stiffness, radius
        self._nodes = self.record['nodes'][0]
        numbers = self.record.view(np.float64)[len(self._nodes) :]
        self._numbers, self._facing = numbers[:-3], numbers[-3:]

    def values(
        self, sequence: int, state: int, surface: Surface | None, mode: int
    ) -> tuple[float, ...]:
        """Return the values of a contact, in the order of `ContactCodec`.

        Args:
            sequence: of the tick.
            state: NONE, TOUCHING or INSIDE.
            surface: the newest of the tissue.
            mode: of the tool, one of `ToolMode`.
        """
        revision, topology = (surface.revision, surface.topology) if surface is not None else (0, 0)
        return (
            sequence,
            state,
            revision,
            topology,
            *self._nodes.tolist(),
            *self._numbers.tolist(),
            self._number,
            mode,
            *self._facing.tolist(),
        )


@inner
def pack(state: np.ndarray, proxy: np.ndarray, used: bool, contact: np.ndarray) -> None:
    """Write tool and touch to a contact; of a proxy that is not used, all is zero."""
    s, t, c = state[0], proxy[0], contact[0]
    for k in range(9):
        c.nodes[k] = max(t.nodes[k], 0) if used else 0
        c.weights[k] = t.weights[k] if used else 0.0
    for k in range(3):
        c.device[k], c.external_force[k] = s.tip[k], s.external[k]
        c.proxy[k] = s.tip[k] - s.external[k] / c.coupling_stiffness
        c.point[k] = c.proxy[k] + (t.contact[k] - t.position[k]) if used else 0.0
        c.normal[k] = t.normal[k] if used else 0.0
        c.blade[0, k], c.blade[1, k] = s.blade[0, k], s.blade[1, k]
        c.blade_facing[k] = s.facing[k]
