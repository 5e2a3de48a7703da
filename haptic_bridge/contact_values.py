"""Result of one tick of the force path: the commanded wrench and the reported contact.

The kernel of a tick writes the bytes of the message `Contact`.
"""

from typing import NamedTuple

import numpy as np

from cutting_trainer.haptic_bridge.proxy.record_type import record_type
from cutting_trainer.node_common.cdr_codec import ContactCodec
from cutting_trainer.node_common.kernels import inner
from cutting_trainer.node_common.rejections import TISSUE_FRAME
from cutting_trainer.tissue_sim.contact.tool import ToolMode

_CODEC = ContactCodec(TISSUE_FRAME)
CONTACT = record_type(_CODEC.record_fields())
"""The message `Contact`, by its fields."""
_SECOND_NS = 1_000_000_000
_OPEN, _CLOSED = ToolMode.OPEN_GRASPER.value, ToolMode.CLOSED_GRASPER.value


class Tick(NamedTuple):
    """Command and contact report of one tick.

    Attributes:
        wrench: force [N] and torque [N m] on the hand, as `WrenchStampedCodec` takes them.
        message: `Contact` in CDR bytes.
        contact_stamp_ns: its stamp, that of the device pose that the contact stems from.
        fault: reason to enter FAULT, which the caller must then do; '' when nothing is wrong.
    """

    wrench: tuple[float, ...]
    message: bytes
    contact_stamp_ns: int
    fault: str

    @property
    def contact(self) -> tuple[float, ...]:
        """Return the values of the contact, as `ContactCodec` takes them."""
        return _CODEC.decode(self.message).values


def make_report(stiffness: float, radius: float, number: int = 0) -> np.ndarray:
    """Return a contact without a touch: dtype CONTACT, shape (1,).

    Args:
        stiffness: of the coupling [N/m].
        radius: of the tool [m].
        number: of the tool, by its place in the list of the scene.
    """
    empty = _CODEC.encode(0, (0,) * sum(count for _, _, count in _CODEC.layout))
    # The numbers of a message are aligned from the end of its first four bytes on.
    room = np.zeros(8 + len(empty), np.uint8)[4 : 4 + len(empty)]
    room[:] = np.frombuffer(empty, np.uint8)
    report = room.view(CONTACT)
    report['coupling_stiffness'], report['proxy_radius'] = stiffness, radius
    report['tool'] = number
    return report


@inner
def pack(
    state: np.ndarray,
    proxy: np.ndarray,
    used: bool,
    time: int,
    revision: int,
    topology: int,
    enabled: bool,
    report: np.ndarray,
) -> None:
    """Write tool and touch to a contact; of a proxy that is not used, all is zero.

    Args:
        state: dtype `force_kernels.STATE`, shape (1,).
        proxy: dtype `proxy.kernels.STATE`, shape (1,).
        used: whether there is a proxy in this tick.
        time: stamp of the device pose [ns].
        revision, topology: of the newest surface.
        enabled: whether force is wanted; without it, jaws let go.
        report: dtype CONTACT, shape (1,); written.
    """
    s, t, c = state[0], proxy[0], report[0]
    c.seconds, c.nanoseconds = time // _SECOND_NS, time % _SECOND_NS
    c.sequence, c.state, c.revision, c.topology = s.sequence, s.contact, revision, topology
    c.mode = _OPEN if s.mode == _CLOSED and not enabled else s.mode
    for k in range(9):
        c.nodes[k] = max(t.nodes[k], 0) if used else 0
        c.weights[k] = t.weights[k] if used else 0.0
    for k in range(3):
        c.device[k], c.external_force[k] = s.tip[k], s.external[k]
        c.proxy[k] = s.tip[k] - s.external[k] / c.coupling_stiffness
        c.point[k] = c.proxy[k] + (t.contact[k] - t.position[k]) if used else 0.0
        c.normal[k] = t.normal[k] if used else 0.0
        c.blade_root[k], c.blade_tip[k] = s.blade[0, k], s.blade[1, k]
        c.blade_facing[k] = s.facing[k]
