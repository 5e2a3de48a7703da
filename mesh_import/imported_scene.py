"""Scene of an imported organ: fixed nodes, and a tool that starts above it and cuts it."""

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.session.errors import SessionError

Points = NDArray[np.float64]

FIXED_SHARE = 0.15
"""Share of the nodes that are fixed, the lowest ones."""
MIN_FIXED_NODES = 6
MAX_TOOL_RADIUS_M = 0.004
DAMPING_PER_EDGE = 1e-4 / 0.0093
"""beta [s] per edge length [m], as in the scene `liver`: it shortens the step of a finer mesh."""
MIN_THICKNESS_M = 0.003
"""Smallest size of an organ along each axis."""
MAX_CUT_LENGTH_M = 0.04

_SCENE = """\
# {source}, imported: {nodes} nodes, {tetrahedra} tetrahedra, edges of about {edge:.2g} mm.
# Lengths in m. Tissue frame: z up, origin at the centre of the underside. All keys: docs/scenes.md.

tissue:
  mesh: {mesh}
  unit: m
  material:
    preset: liver_elastography
    # Lower than measured, so that the tissue opens before it has yielded by centimetres.
    toughness: 10
    blade_friction: 2
{regions}  damping: {{alpha: 15, beta: {beta:.2g}}}
  # Fixed nodes: the underside. Use boxes to fix other nodes.
  fixed:
    - below: {{axis: z, value: {held:.6g}}}
  cut_threshold: {threshold:.3g}
  budget: {{displacement: {press:.3g}, rotation: 30, contact_radius: {contact:.3g}, error: 0.35}}
  model: linear_smoothed
  integrator: symplectic_euler
  integration: {{rate: 30, safety: 0.8, frequency_growth: 2, max_substeps: 400}}

tool:
  radius: {radius:.4g}
  coupling_stiffness: 200
  # Tool frame: origin at the tip (centre of the sphere), z up the handle; the blade cuts along +x.
  blade_root: [0, 0, {root:.4g}]
  blade_tip: [0, 0, {tip:.4g}]
  blade_facing: [1, 0, 0]

device:
  profile: emulated
  tissue_from_device:
    translation: [{x:.6g}, {y:.6g}, {above:.6g}]
    rotation_rpy_deg: [0, 0, 0]
    scale: 1

haptics:
  extrapolation: local_stiffness

cutting:
  method: combined

arm:
  mass: 0.1
  viscous_friction: 0.3
  coulomb_friction: 0.03
  hand: {{stiffness: 400, damping: 8, tremor: 0}}
  script:
    # Positions are of the tip; it touches where it is one radius above the surface.
    start: {{position: {start}, rpy_deg: [0, 0, 0]}}
    seconds: 16
    phases:
      - kind: approach
        share: 2
        waypoints:
          - {{position: {near}}}
      - kind: palpate
        share: 4
        waypoints:
          - {{position: {pressed}, share: 2}}
          - {{position: {near}}}
      - kind: approach
        name: to the cut
        share: 1.5
        waypoints:
          - {{position: {over}}}
      - kind: cut
        share: 6
        waypoints:  # in, until the end of the blade is about {deep:.2g} mm deep, along, out
          - {{position: {pushed_in}, share: 2}}
          - {{position: {first}}}
          - {{position: {middle}, share: 1.5}}
          - {{position: {last}, share: 1.5}}
          - {{position: {out}}}
      - kind: retract
        share: 1.5
        waypoints:
          - {{position: {end}}}

session:
  seconds: 16
"""


def require_thick(source: Path, size: Points) -> None:
    """Reject an organ that is too thin to press and cut.

    Args:
        source: surface file.
        size: size of the organ along the axes [m], shape (3,).

    Raises:
        SessionError: it is too thin.
    """
    if size.min() < MIN_THICKNESS_M:
        raise SessionError(
            f'{source} is {1e3 * size.min():.2g} mm thick, less than {1e3 * MIN_THICKNESS_M:g} mm: '
            'too thin to press and cut; is the unit right (--unit)?'
        )


def scene_text(
    mesh: str,
    source: str,
    nodes: Points,
    tetrahedra: NDArray[np.int32],
    edge: float,
    labels: NDArray[np.int64],
) -> str:
    """Return a scene that palpates the highest point and cuts along x across it.

    Args:
        mesh: name of the mesh file in the folder of the scene.
        source: name of the surface file, for the heading.
        nodes: [m], z up, the underside at 0, shape (n, 3).
        tetrahedra: shape (m, 4).
        edge: target edge length [m].
        labels: of the tetrahedra, shape (m,).
    """
    size = np.ptp(nodes, axis=0)
    radius = min(MAX_TOOL_RADIUS_M, size.min() / 6)
    x, y, top = nodes[nodes[:, 2].argmax()]
    ends, heights = _line(nodes, tetrahedra, np.array([x, y]), min(MAX_CUT_LENGTH_M, size[0] / 2))

    def at(place: float, above: float) -> str:
        height = np.interp(place, ends, heights)
        return f'[{place:.5g}, {y:.5g}, {height + above:.5g}]'

    low, high, middle = ends[0], ends[-1], float(ends.mean())
    press = radius / 2
    free = max(heights) - min(heights) + 4 * radius
    return _SCENE.format(
        mesh=json.dumps(mesh, ensure_ascii=False),
        source=' '.join(source.split()),
        nodes=len(nodes),
        tetrahedra=len(tetrahedra),
        edge=1e3 * edge,
        regions=_regions(nodes, tetrahedra, labels),
        beta=DAMPING_PER_EDGE * edge,
        held=_held(nodes, edge),
        threshold=0.08 * radius / MAX_TOOL_RADIUS_M,
        press=press,
        contact=2 * radius,
        radius=radius,
        root=5 * radius,
        tip=-radius,
        x=x,
        y=y,
        above=top + 4 * radius,
        start=at(x, 8 * radius),
        near=at(x, 3 * radius),
        pressed=at(x, radius - press),
        over=at(low, free),
        pushed_in=at(low, -4 * radius),
        first=at(low, -2.5 * radius),
        middle=at(middle, -2.5 * radius),
        last=at(high, -2.5 * radius),
        out=at(high, 4 * radius),
        end=at(high, 8 * radius),
        deep=3.5e3 * radius,
    )


def _regions(nodes: Points, tetrahedra: NDArray[np.int32], labels: NDArray[np.int64]) -> str:
    """Return the regions of a scene, all but that of the highest place, which the tool touches."""
    touched = labels[(tetrahedra == nodes[:, 2].argmax()).any(axis=1)][0]
    others = [label for label in np.unique(labels) if label != touched]
    if not others:
        return ''
    lines = [f'  regions:  # give each its own values; the label {touched} has those above']
    return '\n'.join([*lines, *(f'    - {{label: {label}}}' for label in others), ''])


def _held(nodes: Points, edge: float) -> float:
    """Return the height up to which nodes are fixed [m], at most half of the organ's."""
    heights = np.sort(nodes[:, 2])
    enough = heights[min(max(MIN_FIXED_NODES, round(FIXED_SHARE * len(heights))), len(heights)) - 1]
    return float(min(max(enough, 0.1 * edge), heights[-1] / 2))


def _line(
    nodes: Points, tetrahedra: NDArray[np.int32], centre: Points, length: float
) -> tuple[Points, Points]:
    """Return x of points of the line above the organ, and the heights there [m], each (k,)."""
    places = np.linspace(-length / 2, length / 2, 13)
    heights = np.array(
        [height(nodes, tetrahedra, centre + np.array([offset, 0.0])) for offset in places], float
    )
    # the part around the centre that has tissue under it, and not much lower
    good = heights > heights[6] - length / 5
    first = 6 - int(np.argmin([*good[6::-1], False]) - 1)
    last = 6 + int(np.argmin([*good[6:], False]) - 1)
    return centre[0] + places[first : last + 1], heights[first : last + 1]


def height(nodes: Points, tetrahedra: NDArray[np.int32], place: Points) -> float:
    """Return the largest z of the solid at a place [m]; -inf where there is none.

    Args:
        nodes: [m], shape (n, 3).
        tetrahedra: shape (m, 4).
        place: x and y [m], shape (2,).
    """
    faces = tetrahedra[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3)
    a, b, c = (nodes[faces[:, i]] for i in range(3))
    u, v, w = b[:, :2] - a[:, :2], c[:, :2] - a[:, :2], place - a[:, :2]
    area = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    with np.errstate(divide='ignore', invalid='ignore'):
        s = (w[:, 0] * v[:, 1] - w[:, 1] * v[:, 0]) / area
        t = (u[:, 0] * w[:, 1] - u[:, 1] * w[:, 0]) / area
        inside = (s >= -1e-9) & (t >= -1e-9) & (s + t <= 1 + 1e-9)
        z = a[:, 2] + s * (b[:, 2] - a[:, 2]) + t * (c[:, 2] - a[:, 2])
    return float(z[inside].max(initial=-np.inf))
