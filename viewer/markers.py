"""The tissue, the tool and the force as `visualization_msgs/MarkerArray`, for RViz and Foxglove.

A message of 20,000 triangles would need 60,000 Python objects: its bytes are written from arrays.
"""

import struct
from typing import Literal

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

from cutting_trainer.tissue_sim.mesh.replica import MeshReplica
from cutting_trainer.viewer.appearance import arrow
from cutting_trainer.viewer.tool_state import Floats, Moment

Colouring = Literal['displacement', 'von_mises']
ARROW, SPHERE, LINE_LIST, TRIANGLE_LIST = 0, 2, 5, 11
ADD, DELETE = 0, 2
"""Constants of `visualization_msgs/Marker`."""
_SHADES = np.asarray(mpl.colormaps['viridis'](np.linspace(0, 1, 256)), np.float32)
_PLAIN = (1.0, 1.0, 1.0, 1.0)
CUT_COLOUR = (120 / 255, 8 / 255, 22 / 255, 1.0)
_BLADE, _PROXY, _FORCE = (0.45, 0.5, 0.58, 1.0), (0.16, 0.59, 0.35, 0.6), (0.12, 0.35, 0.86, 1.0)
_BLADE_WIDTH, _SHAFT, _HEAD = 0.0012, 0.0016, 0.0044


class _Writer:
    """Writer of little-endian plain CDR."""

    def __init__(self) -> None:
        self._pieces = [b'\x00\x01\x00\x00']
        self._at = 0

    def _put(self, data: bytes, alignment: int) -> None:
        padding = -self._at % alignment
        self._pieces.append(b'\0' * padding + data)
        self._at += padding + len(data)

    def numbers(self, code: str, *values: float) -> None:
        """Write numbers of one size."""
        self._put(struct.pack(f'<{len(values)}{code}', *values), struct.calcsize(code))

    def text(self, value: str) -> None:
        """Write a string."""
        data = value.encode() + b'\0'
        self.numbers('I', len(data))
        self._put(data, 1)

    def rows(self, values: NDArray[np.generic]) -> None:
        """Write a sequence of structures of equal numbers, shape (n, k)."""
        self.numbers('I', len(values))
        if len(values):
            self._put(np.ascontiguousarray(values).tobytes(), values.itemsize)

    def data(self) -> bytes:
        """Return all bytes."""
        return b''.join(self._pieces)


class Markers:
    """Writes marker messages of tissue and tool.

    Args:
        frame: of the positions.
        colouring: quantity that colours the tissue.
        largest: value of the last colour: displacement [m] or stress [Pa]; 0: 10 mm, or a tenth of
            Young's modulus.
        youngs_modulus: by region [Pa], for stress, shape (1 + r,); a number: of all.
        poissons_ratio: the same.
    """

    def __init__(
        self,
        frame: str,
        colouring: Colouring,
        largest: float,
        youngs_modulus: float | Floats,
        poissons_ratio: float,
    ) -> None:
        usual = {'displacement': 0.01, 'von_mises': 0.1 * float(np.max(youngs_modulus))}
        self._frame, self._colouring = frame, colouring
        self._largest = largest or usual[colouring]
        self._elasticity = youngs_modulus, poissons_ratio

    def array(
        self, replica: MeshReplica, moment: Moment | None, radius: float, stamp_ns: int
    ) -> bytes:
        """Return the message of a moment, in CDR.

        Args:
            replica: of the tissue.
            moment: of the tool; None: not known yet.
            radius: of the proxy [m].
            stamp_ns: [ns].
        """
        out = _Writer()
        out.numbers('I', 2 if moment is None else 5)
        stamp = divmod(stamp_ns, 1_000_000_000)
        kinds, positions = replica.triangle_kind, replica.positions()
        outer, opened = (replica.triangles[kinds == kind].ravel() for kind in (0, 1))
        colours = shades(self._values(replica) / self._largest)
        one = (1.0, 1.0, 1.0)
        self._marker(
            out, stamp, 'tissue', TRIANGLE_LIST, one, _PLAIN, positions[outer], colours[outer]
        )
        self._marker(out, stamp, 'cut', TRIANGLE_LIST, one, CUT_COLOUR, positions[opened])
        if moment is not None:
            self._tool(out, stamp, moment, radius)
        return out.data()

    def _values(self, replica: MeshReplica) -> Floats:
        if self._colouring == 'displacement':
            return np.linalg.norm(replica.displacement, axis=1)
        return von_mises(replica, *self._elasticity)

    def _tool(self, out: _Writer, stamp: tuple[int, int], moment: Moment, radius: float) -> None:
        thin, ball = (_BLADE_WIDTH, 0.0, 0.0), (2 * radius,) * 3
        self._marker(out, stamp, 'tool', LINE_LIST, thin, _BLADE, moment.blade)
        self._marker(out, stamp, 'proxy', SPHERE, ball, _PROXY, place=moment.proxy)
        points = arrow(moment)[0] if moment.force.any() else np.zeros((0, 3))
        shape = (_SHAFT, _HEAD, 0.0)
        self._marker(out, stamp, 'force', ARROW, shape, _FORCE, points)

    def _marker(
        self,
        out: _Writer,
        stamp: tuple[int, int],
        name: str,
        kind: int,
        scale: tuple[float, ...],
        colour: tuple[float, ...],
        points: Floats | None = None,
        colours: NDArray[np.float32] | None = None,
        place: Floats | None = None,
    ) -> None:
        """Write one marker; without a place or a point it is removed from the screen."""
        points = np.zeros((0, 3)) if points is None else points
        shown = place is not None or len(points) > 0
        self._header(out, stamp)
        out.text(name)
        out.numbers('i', 0, kind, ADD if shown else DELETE)
        position = (0.0, 0.0, 0.0) if place is None else place
        out.numbers('d', *position, 0.0, 0.0, 0.0, 1.0, *scale)
        out.numbers('f', *colour)
        out.numbers('i', 0, 0)  # lifetime: until it is replaced
        out.numbers('B', 0)
        out.rows(np.asarray(points, '<f8'))
        out.rows(np.zeros((0, 4), '<f4') if colours is None else np.asarray(colours, '<f4'))
        out.text('')  # texture
        self._header(out, (0, 0), '')
        out.text('')
        out.numbers('I', 0)
        out.numbers('I', 0)
        out.text('')  # text, mesh
        out.text('')
        out.text('')
        out.numbers('I', 0)
        out.numbers('B', 0)

    def _header(self, out: _Writer, stamp: tuple[int, int], frame: str | None = None) -> None:
        out.numbers('i', stamp[0])
        out.numbers('I', stamp[1])
        out.text(self._frame if frame is None else frame)


def shades(shares: Floats) -> NDArray[np.float32]:
    """Return colours red, green, blue, opacity by share from 0 to 1, shape (n, 4)."""
    return _SHADES[(np.clip(shares, 0, 1) * (len(_SHADES) - 1)).astype(int)]


def von_mises(
    replica: MeshReplica, youngs_modulus: float | Floats, poissons_ratio: float
) -> Floats:
    """Return the von Mises stress by node, averaged over its elements by volume [Pa], shape (n,).

    It uses Green's strain and Hooke's law (St. Venant-Kirchhoff), so that a rotation has no stress.

    Args:
        replica: of the tissue.
        youngs_modulus: by region [Pa], shape (1 + r,); a number: of all.
        poissons_ratio: of the material.
    """
    tetrahedra, rest = replica.tetrahedra, replica.rest
    edges = np.moveaxis(rest[tetrahedra[:, 1:]] - rest[tetrahedra[:, :1]], 1, 2)
    moved = replica.positions()
    turned = np.moveaxis(moved[tetrahedra[:, 1:]] - moved[tetrahedra[:, :1]], 1, 2)
    gradient = turned @ np.linalg.inv(edges)
    strain = (np.swapaxes(gradient, 1, 2) @ gradient - np.eye(3)) / 2
    moduli = np.atleast_1d(youngs_modulus)
    # A region that the scene does not know: a stranger's mesh must not end the viewer.
    regions = np.minimum(replica.regions, len(moduli) - 1) if len(replica.regions) else 0
    mu = moduli[regions] / (2 * (1 + poissons_ratio))
    deviator = strain - np.trace(strain, axis1=1, axis2=2)[:, None, None] * np.eye(3) / 3
    stress = 2 * mu * np.sqrt(1.5 * (deviator**2).sum(axis=(1, 2)))
    volumes = np.abs(np.linalg.det(edges)) / 6
    nodes, n = tetrahedra.ravel(), len(rest)
    total = np.bincount(nodes, np.repeat(stress * volumes, 4), n)
    return total / np.maximum(np.bincount(nodes, np.repeat(volumes, 4), n), 1e-30)
