"""What the haptic bridge says of the tool, checked on its way into the simulation."""

from typing import Any

import numpy as np

from tissue_sim.contact import State, ToolContact
from tissue_sim.mesh import TetMesh
from tissue_sim.refusals import MessageError, require_frame

_VECTORS = ('weights', 'device', 'proxy', 'point', 'normal', 'blade_root', 'blade_tip')
_FARTHEST = 10.0
_SOFTEST, _STIFFEST, _LARGEST = 1.0, 1e5, 0.1
"""[N/m] of the coupling: a scene has a tenth of it at most; [m] of the proxy."""


def tool_contact(message: Any, mesh: TetMesh) -> ToolContact:
    """A contact for the core.

    Args:
        message: a `Contact` message as received, from anybody, or what a recorded frame has of it:
            the same fields, but for the header.
        mesh: the tissue. A message about another topology than its own, which a cut has just
            changed, has no nodes of it: they may be others by now, or gone.

    Raises:
        MessageError: one sentence that says which field is wrong.
    """
    if hasattr(message, 'header'):
        _check_header(message.header)
    if message.state > State.INSIDE:
        raise MessageError('no such state', f'state {message.state} is none of 0, 1, 2')
    for name in _VECTORS:
        values = getattr(message, name)
        if not (np.abs(values) <= _FARTHEST).all():  # a NaN is not
            text = f'{name} {values.tolist()} is not finite or beyond {_FARTHEST:g}'
            raise MessageError('not finite or too far', text)
    if not _SOFTEST <= message.coupling_stiffness <= _STIFFEST:
        stiffness, range_ = message.coupling_stiffness, f'{_SOFTEST:g} to {_STIFFEST:g} N/m'
        raise MessageError(
            'stiffness out of range', f'coupling_stiffness {stiffness} is not in {range_}'
        )
    if not 0 <= message.proxy_radius <= _LARGEST:
        text = f'proxy_radius {message.proxy_radius} is not in 0 to {_LARGEST} m'
        raise MessageError('radius out of range', text)
    current = message.topology == mesh.topology
    if message.state == State.TOUCHING or message.weights.any():
        if current and message.nodes.max() >= mesh.node_count:
            text = f'nodes {message.nodes.tolist()} go beyond the {mesh.node_count} nodes'
            raise MessageError('index out of range', text)
        if abs(message.weights.sum() - 1) > 1e-6 or message.weights.min() < -1e-6:
            text = f'weights {message.weights.tolist()} are not barycentric'
            raise MessageError('weights that are none', text)
        if abs(np.linalg.norm(message.normal) - 1) > 1e-6:
            text = f'normal {message.normal.tolist()} is not a unit vector'
            raise MessageError('normal that is none', text)
    # A node of two touched triangles stands there twice.
    nodes, slots = np.unique(message.nodes.astype(np.int64), return_inverse=True)
    weights = np.bincount(slots, message.weights, len(nodes))
    if not current:
        weights[:] = 0.0
    return ToolContact(
        state=State(message.state),
        topology=message.topology,
        nodes=nodes[weights > 0],
        weights=weights[weights > 0],
        device=message.device,
        offset=message.proxy - message.point,
        normal=message.normal,
        stiffness=message.coupling_stiffness,
        radius=message.proxy_radius,
        blade_root=message.blade_root,
        blade_tip=message.blade_tip,
        sequence=message.sequence,
    )


def _check_header(header: Any) -> None:
    require_frame('tool/contact', header.frame_id)
    if header.stamp.nanosec >= 1_000_000_000:
        raise MessageError('no such time', f'stamp has {header.stamp.nanosec} nanoseconds')
