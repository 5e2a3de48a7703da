"""What the page shows in three dimensions: the tissue, the tool, the proxy, the force."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from haptic_bridge.chain import INSIDE
from haptic_bridge.settings import ToolSettings
from tissue_sim.replica import MeshReplica
from viewer.moment import Floats, Moment
from viewer.surfaces import CUT, OUTER, DrawnTissue, Surface

Indices = NDArray[np.int64]

TISSUE, OPENED, OTHER_TISSUE = (205, 118, 100), (120, 8, 22), (120, 140, 190)
BLADE, HANDLE, PROXY, FORCE = (178, 186, 196), (52, 60, 72), (40, 150, 90), (30, 90, 220)
METRES_A_NEWTON = 0.02
"""Length of the arrow by force."""
FIELD_OF_VIEW = 0.9
"""[rad] of the camera, upright."""
_LEAST_VIEW = 0.12
"""[m] that are in view, however small the tissue: the tool has its own size."""
_LEAST_FORCE = 0.02
"""[N] below which no arrow is drawn."""
_SPINE, _THICKNESS = 0.005, 0.0008
"""[m] Width and thickness of the blade as drawn."""
_HANDLE, _RADIUS, _SIDES = 0.07, 0.0035, 24
"""[m] Length and radius of the handle as drawn; its sides."""
_NOTHING = np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.uint32)
_LIP, _LIFT = 0.0010, 0.0004
"""[m] Width of the line along the lips of a cut, and how far it is above them: by it alone is seen
what has closed again, in a tissue without tension."""


class TissueView:
    """The tissue in the scene of a page.

    Args:
        server: of the page.
        name: in its scene.
        colour: of the outside, 0 to 255.
        offset: where it stands [m], shape (3,).
    """

    def __init__(
        self,
        server: Any,
        name: str,
        colour: tuple[int, int, int] = TISSUE,
        offset: tuple[float, ...] = (0.0, 0.0, 0.0),
    ) -> None:
        self._server = server
        self._drawn = DrawnTissue()
        self._shown: tuple[object, int] = (None, -1)
        looks: dict[int, dict[str, Any]] = {
            OUTER: {'color': colour},
            CUT: {'color': OPENED, 'flat_shading': True},
        }
        self._meshes = {
            kind: server.scene.add_mesh_simple(
                f'{name}/{kind}',
                *_NOTHING,
                position=offset,
                visible=False,
                **look,
            )
            for kind, look in looks.items()
        }
        self._name, self._offset = name, offset
        self._lips: Any = None

    def show(self, replica: Surface) -> None:
        """Brings the page up to the replica: positions, and faces where they have changed."""
        now = (replica, replica.revision)
        if now == self._shown or replica.revision < 0:
            return
        self._shown = now
        others = self._drawn.follow(replica)
        with self._server.atomic():
            for kind, mesh in self._meshes.items():
                faces = self._drawn.parts[kind].faces
                if len(faces):
                    mesh.vertices = self._drawn.positions(replica, kind)
                if others:
                    mesh.visible = bool(len(faces))
                    mesh.faces = faces if len(faces) else _NOTHING[1]
            self._show_lips(replica, others=others)

    def _show_lips(self, replica: Surface, *, others: bool) -> None:
        if others and self._lips is not None:
            self._lips.remove()  # lines cannot become more or fewer
            self._lips = None
        if not len(self._drawn.lips.edges):
            return
        points = self._drawn.lips.points(replica.rest + replica.displacement, _LIFT)
        if self._lips is None:
            self._lips = self._server.scene.add_line_segments(
                f'{self._name}/lips', points, OPENED, thickness=_LIP, position=self._offset
            )
        else:
            self._lips.points = points


class Stage:
    """Tool, proxy and force in the scene of a page.

    Args:
        server: of the page.
        tool: as it is drawn.
    """

    def __init__(self, server: Any, tool: ToolSettings) -> None:
        self._server = server
        scene = server.scene
        scene.set_up_direction('+z')
        scene.add_grid(
            '/floor', width=0.3, height=0.3, cell_size=0.01, section_size=0.05, plane='xy'
        )
        self._tool = scene.add_frame('/tool', show_axes=False, visible=False)
        self._proxy = scene.add_icosphere('/proxy', radius=1.0, color=PROXY, opacity=0.6)
        self._proxy.visible = False
        self._arrow = scene.add_arrows(
            '/force',
            np.zeros((1, 2, 3), np.float32),
            FORCE,
            shaft_radius=0.0008,
            head_radius=0.0022,
            head_length=0.005,
            visible=False,
        )
        self.equip(tool)

    def equip(self, tool: ToolSettings) -> None:
        """Draws another tool."""
        scene = self._server.scene
        for name, mesh, colour in (
            ('blade', blade(tool), BLADE),
            ('handle', handle(tool), HANDLE),
        ):
            scene.add_mesh_simple(f'/tool/{name}', *mesh, color=colour, flat_shading=True)
        self._proxy.scale = tool.radius

    def look_at(self, tissue: MeshReplica, *, beside: bool = False) -> None:
        """Puts the cameras of pages to come where the tissue is in view, or two of it."""
        camera = self._server.initial_camera
        positions = tissue.positions()
        if beside:
            further = positions + np.array([1.25 * np.ptp(positions[:, 0]), 0.0, 0.0])
            positions = np.concatenate([positions, further])
        position, aim = framing(positions)
        distance = float(np.linalg.norm(position - aim))
        camera.fov, camera.near, camera.far = FIELD_OF_VIEW, 0.02 * distance, 50 * distance
        camera.look_at, camera.position = tuple(aim), tuple(position)

    def show(self, moment: Moment) -> None:
        """Moves tool, proxy and arrow."""
        norm = float(np.linalg.norm(moment.force))
        with self._server.atomic():
            self._tool.position, self._tool.wxyz = moment.tip, moment.turn
            self._tool.visible = True
            self._proxy.position = moment.proxy
            self._proxy.visible = moment.contact != INSIDE
            self._arrow.visible = norm >= _LEAST_FORCE
            if norm >= _LEAST_FORCE:
                self._arrow.points = arrow(moment)


def framing(positions: Floats) -> tuple[Floats, Floats]:
    """Where the camera stands, and at what it looks [m].

    Args:
        positions: of the tissue [m], shape (n, 3).
    """
    low, high = positions.min(axis=0), positions.max(axis=0)
    size = max(float(np.linalg.norm(high - low)), _LEAST_VIEW)
    aim = (low + high) / 2 + [0.0, 0.0, 0.15 * size]  # the tool is above
    return aim + size * np.array([0.3, -1.25, 0.9]), aim


def arrow(moment: Moment) -> Floats:
    """Begin and end of the arrow of the force [m], shape (1, 2, 3)."""
    return np.stack([moment.tip, moment.tip + METRES_A_NEWTON * moment.force])[None]


def blade(tool: ToolSettings) -> tuple[Floats, Indices]:
    """The blade, in the tool frame: its edge from root to tip, its spine behind it.

    Returns:
        corners [m], shape (n, 3), and triangles, shape (m, 3).
    """
    root, tip = np.array(tool.blade_root), np.array(tool.blade_tip)
    along, back, side = _axes(tool)
    shoulder = tip - along * _SPINE
    behind = np.stack([back * _SPINE + side * by for by in (-_THICKNESS / 2, _THICKNESS / 2)])
    return _loft(np.stack([root, *root + behind]), np.stack([tip, *shoulder + behind]))


def handle(tool: ToolSettings) -> tuple[Floats, Indices]:
    """The handle, in the tool frame, behind the blade's root: a cylinder.

    Returns:
        As `blade`.
    """
    along, back, side = _axes(tool)
    angles = np.linspace(0.0, 2 * np.pi, _SIDES, endpoint=False)[:, None]
    end = tool.blade_root + _RADIUS * (np.cos(angles) * back + np.sin(angles) * side)
    return _loft(end - along * _HANDLE, end)


def _axes(tool: ToolSettings) -> Floats:
    """Unit vectors along the edge to the tip, to the spine, and across, shape (3, 3)."""
    along = np.subtract(tool.blade_tip, tool.blade_root)
    along /= np.linalg.norm(along)
    back = -np.eye(3)[int(np.argmin(np.abs(along)))]  # it cuts along +x where it can
    back -= along * (back @ along)
    back /= np.linalg.norm(back)
    return np.stack([along, back, np.cross(along, back)])


def _loft(first: Floats, second: Floats) -> tuple[Floats, Indices]:
    """The solid between two convex polygons that turn to the right on the way to the second."""
    n = len(first)
    at, then = np.arange(n), np.roll(np.arange(n), -1)
    sides = [np.stack([at, then, then + n], axis=1), np.stack([at, then + n, at + n], axis=1)]
    fan = np.stack([np.zeros(n - 2, int), at[1:-1], at[2:]], axis=1)
    return np.concatenate([first, second]), np.concatenate([*sides, fan[:, ::-1], fan + n])
