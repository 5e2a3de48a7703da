"""What the haptic bridge says of the tool, checked on its way into the simulation."""

from typing import Any

import numpy as np

from tissue_sim.contact import State, ToolContact


def tool_contact(message: Any, node_count: int) -> ToolContact:
    """A contact for the core.

    Args:
        message: a `Contact` message as received, from anybody, or anything with its fields.
        node_count: of the mesh.

    Raises:
        ValueError: one sentence that says which field is wrong.
    """
    if message.state > State.INSIDE:
        raise ValueError(f'state {message.state} is none of 0, 1, 2')
    for name in ('weights', 'device', 'proxy', 'point', 'normal', 'blade_root', 'blade_tip'):
        values = getattr(message, name)
        if not np.isfinite(values).all() or np.abs(values).max() > 10:
            raise ValueError(f'{name} {values.tolist()} is not finite or beyond 10')
    if not 0 <= message.coupling_stiffness <= 1e5:
        raise ValueError(f'coupling_stiffness {message.coupling_stiffness} is not in 0 to 1e5 N/m')
    if not 0 <= message.proxy_radius <= 0.1:
        raise ValueError(f'proxy_radius {message.proxy_radius} is not in 0 to 0.1 m')
    if message.state == State.TOUCHING or message.weights.any():
        if message.nodes.max() >= node_count:
            raise ValueError(f'nodes {message.nodes.tolist()} go beyond the {node_count} nodes')
        if abs(message.weights.sum() - 1) > 1e-6 or message.weights.min() < -1e-6:
            raise ValueError(f'weights {message.weights.tolist()} are not barycentric')
        if abs(np.linalg.norm(message.normal) - 1) > 1e-6:
            raise ValueError(f'normal {message.normal.tolist()} is not a unit vector')
    # A node of two touched triangles stands there twice.
    nodes, slots = np.unique(message.nodes.astype(np.int64), return_inverse=True)
    weights = np.bincount(slots, message.weights, len(nodes))
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
