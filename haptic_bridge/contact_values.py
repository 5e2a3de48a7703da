"""Records of one tick of the force path: the commanded wrench and the reported contact."""

from typing import Any, NamedTuple

import numpy as np

from cutting_trainer.haptic_bridge.proxy.surface import Surface

_NOWHERE = ([0] * 9, [0.0] * 9, [0.0] * 3, [0.0] * 3)


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


def contact_values(
    sequence: int,
    state: int,
    surface: Surface | None,
    touched: Any,
    tool: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    spring: tuple[float, float],
    mode: int,
) -> tuple[float, ...]:
    """Return the values of a contact, in the order of `ContactCodec`.

    Args:
        sequence: of the tick.
        state: NONE, TOUCHING or INSIDE.
        surface: the newest of the tissue.
        touched: contact of the proxy, or the triangle it approaches; None while it is not used.
        tool: tip [m], shape (3,), force on the tissue [N], shape (3,), blade [m], shape (2, 3),
            direction that its edge faces, shape (3,).
        spring: stiffness of the coupling [N/m], radius of the tool [m].
        mode: of the tool, one of `ToolMode`.
    """
    # Lists: for three numbers an operation of numpy takes ten times as long.
    stiffness, radius = spring
    tip, external = tool[0].tolist(), tool[1].tolist()
    proxy = [t - e / stiffness for t, e in zip(tip, external, strict=True)]
    revision, topology = (surface.revision, surface.topology) if surface is not None else (0, 0)
    nodes, weights, point, normal = _NOWHERE
    if touched is not None:
        nodes = [max(node, 0) for node in touched.nodes.tolist()]
        weights, normal = touched.weights.tolist(), touched.normal.tolist()
        contact, position = touched.contact.tolist(), touched.position.tolist()
        point = [p + (c - q) for p, c, q in zip(proxy, contact, position, strict=True)]
    return (
        sequence,
        state,
        revision,
        topology,
        *nodes,
        *weights,
        *tip,
        *proxy,
        *point,
        *normal,
        *external,
        stiffness,
        *tool[2].ravel().tolist(),
        radius,
        0,  # the tool's number in the list of the scene
        mode,
        *tool[3].tolist(),
    )
