"""Check of incoming `Contact` messages before they enter the simulation."""

from typing import Any

import numpy as np

from cutting_trainer.node_common.rejections import MessageError, require_frame, require_tool
from cutting_trainer.tissue_sim.contact.tool import (
    MIN_RADIUS_M,
    ContactState,
    ToolContact,
    ToolMode,
)
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh

_VECTORS = (
    *('weights', 'device', 'proxy', 'point', 'normal'),
    *('blade_root', 'blade_tip', 'blade_facing'),
)
_MAX_COORDINATE = 10.0
_MIN_STIFFNESS, _MAX_STIFFNESS, _MAX_RADIUS = 1.0, 1e5, 0.1
"""Coupling stiffness [N/m], of which a scene has a tenth at most; proxy radius [m]."""
_MAX_FORCE = 1e6
"""[N] Largest stiffness times the largest coordinate."""


def tool_contact(message: Any, mesh: TetMesh, tool: int = 0) -> ToolContact:
    """Return a checked contact for the simulation.

    Args:
        message: a `Contact` message from any sender, or its record in a frame: the same fields
            without the header.
        mesh: the tissue. The nodes of a message about another topology are dropped: a cut may have
            renumbered or removed them.
        tool: number of the tool that the contact has to be of.

    Raises:
        MessageError: one sentence with the wrong field.
    """
    if hasattr(message, 'header'):
        _check_header(message.header)
    require_tool('Contact', message.tool, tool)
    if message.state > ContactState.INSIDE:
        raise MessageError('no such state', f'state {message.state} is none of 0, 1, 2')
    if message.mode not in list(ToolMode):
        text = f'mode {message.mode} is none of {", ".join(f"{m}" for m in ToolMode)}'
        raise MessageError('no such mode of the tool', text)
    for name in _VECTORS:
        values = getattr(message, name)
        if not (np.abs(values) <= _MAX_COORDINATE).all():  # a NaN is not
            text = f'{name} {values.tolist()} is not finite or beyond {_MAX_COORDINATE:g}'
            raise MessageError('not finite or too far', text)
    if message.blade_facing.any() and abs(np.linalg.norm(message.blade_facing) - 1) > 1e-3:
        text = f'blade_facing {message.blade_facing.tolist()} is neither a unit vector nor zero'
        raise MessageError('no unit vector', text)
    if not _MIN_STIFFNESS <= message.coupling_stiffness <= _MAX_STIFFNESS:
        stiffness, range_ = (
            message.coupling_stiffness,
            f'{_MIN_STIFFNESS:g} to {_MAX_STIFFNESS:g} N/m',
        )
        raise MessageError(
            'stiffness out of range', f'coupling_stiffness {stiffness} is not in {range_}'
        )
    if not MIN_RADIUS_M <= message.proxy_radius <= _MAX_RADIUS:
        range_ = f'{MIN_RADIUS_M:g} to {_MAX_RADIUS:g} m'
        text = f'proxy_radius {message.proxy_radius} is not in {range_}'
        raise MessageError('radius out of range', text)
    if not (np.abs(message.external_force) <= _MAX_FORCE).all():  # a NaN is not
        text = f'external_force {message.external_force.tolist()} is not within {_MAX_FORCE:g} N'
        raise MessageError('force out of range', text)
    current = message.topology == mesh.topology
    if message.state == ContactState.TOUCHING or message.weights.any():
        if current and message.nodes.max() >= mesh.node_count:
            text = f'nodes {message.nodes.tolist()} go beyond the {mesh.node_count} nodes'
            raise MessageError('index out of range', text)
        if abs(message.weights.sum() - 1) > 1e-6 or message.weights.min() < -1e-6:
            text = f'weights {message.weights.tolist()} are not barycentric'
            raise MessageError('invalid weights', text)
        if abs(np.linalg.norm(message.normal) - 1) > 1e-6:
            text = f'normal {message.normal.tolist()} is not a unit vector'
            raise MessageError('invalid normal', text)
    # A node shared by two touched triangles is listed twice.
    nodes, slots = np.unique(message.nodes.astype(np.int64), return_inverse=True)
    weights = np.bincount(slots, message.weights, len(nodes))
    if not current:
        weights[:] = 0.0
    return ToolContact(
        state=ContactState(message.state),
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
        external=message.external_force,
        mode=ToolMode(message.mode),
        blade_facing=message.blade_facing,
    )


def _check_header(header: Any) -> None:
    require_frame('tool/contact', header.frame_id)
    if header.stamp.nanosec >= 1_000_000_000:
        raise MessageError('no such time', f'stamp has {header.stamp.nanosec} nanoseconds')
