"""Appearance of a page: the drawn tool, the floor, the first camera, the exercise."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.exercises.scene_schema import BallSettings, ExerciseSettings
from cutting_trainer.haptic_bridge.scene_schema import ToolSettings
from cutting_trainer.viewer.allowed_requests import Bounds
from cutting_trainer.viewer.tool_state import Floats, Moment

Indices = NDArray[np.int64]
Colour = tuple[int, int, int]
"""Red, green, blue, 0 to 255. Those of the cut and of the tools are in `static/colours.js`."""

TISSUE: Colour = (205, 118, 100)
OTHER_TISSUE: Colour = (120, 140, 190)
"""A tissue that is computed again, beside the recorded one."""

METRES_PER_NEWTON = 0.02
"""[m/N] Length of the force's arrow."""
FIELD_OF_VIEW_RAD = 0.9
"""[rad] of the camera, upright."""
TISSUE_SPACING = 1.25
"""Distance of two tissues side by side, over the width of one."""
FLOOR = {'z': 0.0, 'size': 0.3, 'cell': 0.01}
"""[m] height, side and squares of the grid below the tissue."""
_GUIDE_MARGIN_M = 0.2
"""[m] Margin around the tissue within which the hand is guided."""
_MIN_VIEW_M = 0.12
"""[m] Smallest view, however small the tissue: the tool has its own size."""
_SPINE, _THICKNESS = 0.005, 0.0008
"""[m] Width and thickness of the blade as drawn."""
_MAX_TITLE, _MAX_INSTRUCTION = 80, 300
"""Characters that are shown."""
_HANDLE, _RADIUS, _SIDES = 0.07, 0.0035, 24
"""[m] Length and radius of the handle as drawn; its sides."""


def tool_shape(tool: ToolSettings) -> dict[str, Any]:
    """Return the tool in the format of the message `hello`, in the tool frame [m]."""
    shapes = {'blade': blade(tool), 'handle': handle(tool)}
    meshes = {
        name: {'vertices': np.round(vertices, 6).tolist(), 'faces': faces.tolist()}
        for name, (vertices, faces) in shapes.items()
    }
    return {
        **meshes,
        'radius': tool.radius,
        'blade_tip': list(tool.blade_tip),
        'blade_facing': tool.facing().tolist(),
        'cuts': tool.mode == 'scalpel',
    }


def camera(positions: Floats) -> dict[str, Any]:
    """Return the first camera in the format of the message `hello`.

    Args:
        positions: of points that must be in view [m], shape (n, 3).
    """
    position, aim = framing(positions)
    return {
        'position': position.tolist(),
        'target': aim.tolist(),
        'up': [0.0, 0.0, 1.0],
        'fov': FIELD_OF_VIEW_RAD,
    }


def reach(positions: Floats) -> Bounds:
    """Return the box around a tissue in which the hand is guided.

    Args:
        positions: of the tissue [m], shape (n, 3).
    """
    x0, y0, z0 = map(float, positions.min(axis=0) - _GUIDE_MARGIN_M)
    x1, y1, z1 = map(float, positions.max(axis=0) + _GUIDE_MARGIN_M)
    return Bounds((x0, y0, z0), (x1, y1, z1))


def shown_tissue(
    name: str, label: str, colour: Colour = TISSUE, offset: float = 0.0
) -> dict[str, Any]:
    """Return a tissue in the format of the message `hello`.

    Args:
        name: of its meshes.
        label: below it; '': none.
        colour: of the outside, 0 to 255.
        offset: along x [m].
    """
    return {
        'name': name,
        'label': label,
        'colour': colour,
        'offset': [offset, 0.0, 0.0],
    }


def shown_exercise(exercise: ExerciseSettings) -> dict[str, Any] | None:
    """Return an exercise in the format of the message `hello`; None: the scene is none.

    Lumps are hidden from the trainee, and so from the page. Curves, tubes and lesion are those of
    the tissue at rest [m]; start and end are places of the tip.
    """
    if not exercise.title:
        return None

    def ball(settings: BallSettings | None) -> dict[str, Any] | None:
        if settings is None:
            return None
        return {'centre': settings.centre, 'radius': settings.radius}

    return {
        'title': exercise.title[:_MAX_TITLE],
        'instruction': exercise.instruction[:_MAX_INSTRUCTION],
        'targets': [
            {
                'points': np.round(target.corners(), 6).tolist(),
                'margin': target.margin,
                'depth': target.depth,
            }
            for target in exercise.targets
        ],
        'zones': [{'points': zone.points, 'radius': zone.radius} for zone in exercise.zones],
        'lesion': ball(exercise.lesion),
        'start': ball(exercise.start),
        'end': ball(exercise.end),
        'time_limit': exercise.time_limit,
        'force_limit': exercise.force_limit,
    }


def framing(positions: Floats) -> tuple[Floats, Floats]:
    """Return the position of the camera, and its target [m].

    Args:
        positions: of the tissue [m], shape (n, 3).
    """
    low, high = positions.min(axis=0), positions.max(axis=0)
    size = max(float(np.linalg.norm(high - low)), _MIN_VIEW_M)
    aim = (low + high) / 2 + [0.0, 0.0, 0.15 * size]  # the tool is above
    return aim + size * np.array([0.3, -1.25, 0.9]), aim


def arrow(moment: Moment) -> Floats:
    """Return begin and end of the force's arrow [m], shape (1, 2, 3)."""
    return np.stack([moment.tip, moment.tip + METRES_PER_NEWTON * moment.force])[None]


def blade(tool: ToolSettings) -> tuple[Floats, Indices]:
    """Return the blade, in the tool frame: its edge from root to tip, with the spine behind it.

    Returns:
        corners [m], shape (n, 3), and triangles, shape (m, 3).
    """
    root, tip = np.array(tool.blade_root), np.array(tool.blade_tip)
    along, back, side = _axes(tool)
    shoulder = tip - along * _SPINE
    behind = np.stack([back * _SPINE + side * by for by in (-_THICKNESS / 2, _THICKNESS / 2)])
    return _loft(np.stack([root, *root + behind]), np.stack([tip, *shoulder + behind]))


def handle(tool: ToolSettings) -> tuple[Floats, Indices]:
    """Return the handle, in the tool frame, behind the blade's root: a cylinder.

    Returns:
        As `blade`.
    """
    along, back, side = _axes(tool)
    angles = np.linspace(0.0, 2 * np.pi, _SIDES, endpoint=False)[:, None]
    end = tool.blade_root + _RADIUS * (np.cos(angles) * back + np.sin(angles) * side)
    return _loft(end - along * _HANDLE, end)


def _axes(tool: ToolSettings) -> Floats:
    """Return unit vectors along the edge to the tip, to the spine, and across, shape (3, 3)."""
    along = np.subtract(tool.blade_tip, tool.blade_root)
    along /= np.linalg.norm(along)
    facing = tool.facing()
    # A blade that cuts all round is drawn facing +x where it can.
    back = -facing if facing.any() else -np.eye(3)[int(np.argmin(np.abs(along)))]
    back -= along * (back @ along)
    back /= np.linalg.norm(back)
    return np.stack([along, back, np.cross(along, back)])


def _loft(first: Floats, second: Floats) -> tuple[Floats, Indices]:
    """Return the solid between two convex polygons, both clockwise on the path to the second."""
    n = len(first)
    at, then = np.arange(n), np.roll(np.arange(n), -1)
    sides = [np.stack([at, then, then + n], axis=1), np.stack([at, then + n, at + n], axis=1)]
    fan = np.stack([np.zeros(n - 2, int), at[1:-1], at[2:]], axis=1)
    return np.concatenate([first, second]), np.concatenate([*sides, fan[:, ::-1], fan + n])
