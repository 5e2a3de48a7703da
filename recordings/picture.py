"""Picture of a recorded session: the tissue at one moment, the path of the tool, the force."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from numpy.typing import NDArray

from cutting_trainer.bags.playback_messages import first_time, require_moment
from cutting_trainer.bags.reader import open_bag
from cutting_trainer.bags.recorded_tissue import first_current_keyframe, follow
from cutting_trainer.bags.topic_names import CONTACT, MESH, SERVO_CF, UPDATES, of_session
from cutting_trainer.haptic_bridge.force_kernels import INSIDE, NONE, TOUCHING
from cutting_trainer.node_common.cdr_codec import ContactCodec, WrenchStampedCodec
from cutting_trainer.session.errors import SessionError
from cutting_trainer.tissue_sim.contact.tool import ToolMode
from cutting_trainer.tissue_sim.mesh.replica import MeshReplica

Floats = NDArray[np.float64]

FORMATS = ('.png', '.svg', '.pdf')

_TISSUE, _CUT = np.array([0.86, 0.50, 0.42]), np.array([0.62, 0.04, 0.08])
_PATH, _BLADE, _FORCE = '#8a8a8a', '#1f4e8c', '#1f4e8c'
STYLE: Any = {
    'grid.color': '#e4e4e4',
    'grid.linewidth': 0.5,
    'svg.hashsalt': 'equal bags, equal files',
}
_LIGHT = np.array([-0.35, -0.45, 0.82])
_ELEVATION, _AZIMUTH = 38.0, -68.0  # [deg]
_MILLIMETRES = 1e3


@dataclass
class Story:
    """Data of the picture. Times are times of recording, [s] since the first message.

    Attributes:
        replica: tissue at the moment.
        moment: time of the tissue [s].
        tool: rows of `tool/contact`: time, tip [m], blade root and tip [m], contact state,
            shape (n, 11).
        forces: time and norm [N] of `arm/servo_cf`, shape (m, 2).
    """

    replica: MeshReplica = field(default_factory=MeshReplica)
    moment: float = 0.0
    tool: Floats = field(default_factory=lambda: np.zeros((0, 11)))
    forces: Floats = field(default_factory=lambda: np.zeros((0, 2)))


def make_picture(bag: Path, file: Path, at: float | None) -> None:
    """Draw a session into a file.

    Args:
        bag: folder of the bag.
        file: file to write; its extension sets the format.
        at: time of the tissue [s]; None: the end.

    Raises:
        BagError: it is not a bag, or shorter.
        SessionError: there is no tissue in it, or the file cannot be written.
    """
    if file.suffix not in FORMATS:
        raise SessionError(f'{file} is no picture: give it an extension of {", ".join(FORMATS)}')
    if file.parent != bag and not file.parent.is_dir():
        raise SessionError(f'{file.parent} does not exist: make it first, the picture goes into it')
    story = read_story(bag, at)
    with mpl.rc_context(STYLE):
        draw(story).savefig(file, dpi=130)


def read_story(bag: Path, at: float | None) -> Story:
    """Read a bag once; the mesh follows its keyframes and deltas up to the moment.

    Args:
        bag: its folder.
        at: moment [s]; None: the end.
    """
    story = Story()
    state, mode = (ContactCodec.fields[name].start for name in ('state', 'mode'))
    force = WrenchStampedCodec.fields['force']
    contacts, wrenches = ContactCodec(), WrenchStampedCodec()
    places = [ContactCodec.fields[name] for name in ('device', 'blade_root', 'blade_tip')]
    tool, forces = [], []
    start, time = 0, 0.0
    opened = open_bag(bag)
    if at is not None:
        require_moment(opened, at)
    servo_cf = of_session(SERVO_CF, opened.topics())
    first = first_current_keyframe(opened)
    known_from = 0 if first is None else first.log_time
    until = math.inf if at is None else max(first_time(opened) + at * 1e9, known_from)
    for message in opened.messages():
        start = start or message.log_time
        time = (message.log_time - start) * 1e-9
        if message.topic == CONTACT:
            stamp, _, values = contacts.decode(message.data)
            if stamp:  # 0: there was no device yet
                held = values[state]
                if held == INSIDE and ToolMode(values[mode]).is_grasper:
                    held = TOUCHING  # jaws hold the tissue: it is not cut
                tool.append([time, *(x for place in places for x in values[place]), held])
        elif message.topic == servo_cf:
            norm = np.linalg.norm(wrenches.decode(message.data).values[force])
            forces.append([time, float(norm)])
        elif message.topic in (MESH, UPDATES) and known_from <= message.log_time <= until:
            follow(story.replica, message.topic, opened.read(message))
    story.moment = time if at is None else min(at, time)
    if story.replica.revision < 0:
        raise SessionError(f'{bag} has no message of {MESH}: there is no tissue to draw')
    story.tool = np.array(tool, float).reshape(-1, 11)
    story.forces = np.array(forces, float).reshape(-1, 2)
    return story


def draw(story: Story) -> Figure:
    """Draw the figure: tissue and tool above, force below."""
    figure = Figure(figsize=(8.0, 7.2), layout='constrained')
    above, below = figure.subplot_mosaic(
        [['tissue'], ['force']],
        height_ratios=[3.2, 1],
        per_subplot_kw={'tissue': {'projection': '3d', 'computed_zorder': False}},
    ).values()
    draw_tissue(above, story)
    _draw_force(below, story)
    return figure


def draw_tissue(axes: Any, story: Story) -> None:
    """Draw the tissue, and the tool if it is known, in axes of three dimensions."""
    replica = story.replica
    corners = replica.positions()[replica.triangles] * _MILLIMETRES
    _draw_surface(axes, corners, replica.triangle_kind == 1)
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    past = story.tool[story.tool[:, 0] <= story.moment]
    if len(past):
        tips = past[::10, 1:4] * _MILLIMETRES
        axes.plot(*tips.T, color=_PATH, lw=0.9, zorder=3, label='path of the tip')
        inside = np.where(past[::10, 10:] == INSIDE, tips, np.nan)
        axes.plot(*inside.T, color=_BLADE, lw=0.9, ls=':', zorder=4, label='in the tissue')
        blade = past[-1, 4:10].reshape(1, 2, 3) * _MILLIMETRES
        edge = Line3DCollection(blade, colors=_BLADE, lw=2.5, zorder=4, label='blade')
        axes.add_collection3d(edge)
        low, high = np.minimum(low, tips.min(axis=0)), np.maximum(high, tips.max(axis=0))
        axes.legend(loc='upper left', frameon=False, fontsize=8)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low, zoom=1.25)
    axes.view_init(elev=_ELEVATION, azim=_AZIMUTH)
    axes.set(xlabel='x [mm]', ylabel='y [mm]', zlabel='z [mm]')
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_pane_color('white')
    axes.tick_params(labelsize=8)
    axes.set_title(f'{len(replica.tetrahedra)} tetrahedra, after {story.moment:.1f} s', fontsize=10)


def _draw_surface(axes: Any, corners: Floats, cut: NDArray[np.bool_]) -> None:
    """Draw the triangles: the outside half transparent, in front of the cut faces.

    Args:
        axes: axes to draw in.
        corners: corners of the triangles [mm], shape (k, 3, 3).
        cut: mask of the cut faces, shape (k,).
    """
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    up, round_ = np.deg2rad(_ELEVATION), np.deg2rad(_AZIMUTH)
    to_eye = [np.cos(up) * np.cos(round_), np.cos(up) * np.sin(round_), np.sin(up)]
    brightness = 0.7 + 0.45 * np.clip(normals @ _LIGHT, -1, 1)
    base = np.where(cut[:, None], _CUT, _TISSUE)
    colours = np.column_stack([np.clip(base * brightness[:, None], 0, 1), np.where(cut, 1, 0.5)])
    for order, chosen in enumerate((cut, ~cut & (normals @ to_eye > 0))):
        faces = Poly3DCollection(
            corners[chosen],
            facecolors=colours[chosen],
            edgecolors='#00000020',
            lw=0.3,
            zorder=order,
        )
        axes.add_collection3d(faces)


def _draw_force(axes: Any, story: Story) -> None:
    top = 1.25 * max(float(story.forces[:, 1].max(initial=0.0)), 0.1)
    for state, colour, name in ((INSIDE, '#e8b4b0', 'cut'), (None, '#dddddd', 'contact')):
        held = spans(story.tool, state)
        boxes = [[(a, 0), (b, 0), (b, top), (a, top)] for a, b in held]
        axes.add_collection(PolyCollection(boxes, facecolors=colour, label=name))
    axes.plot(*story.forces.T, color=_FORCE, lw=0.8, label='force on the hand')
    axes.axvline(story.moment, color='black', lw=0.8, ls=':', label='moment above')
    axes.set(xlabel='time [s]', ylabel='force [N]', ylim=(0, top))
    axes.set_xlim(0, max(story.forces[-1:, 0].max(initial=0), story.moment))
    axes.legend(loc='upper left', frameon=False, fontsize=8, ncols=4)


def spans(tool: Floats, state: int | None) -> Floats:
    """Return begin and end [s] of each interval in a contact state, shape (k, 2).

    Args:
        tool: as in `Story`.
        state: contact state; None: any contact but `INSIDE`.
    """
    held = tool[:, 10]
    chosen = held == state if state is not None else (held != NONE) & (held != INSIDE)
    edges = np.flatnonzero(np.diff(chosen.astype(int), prepend=0, append=0))
    times = np.append(tool[:, 0], tool[-1:, 0])
    return times[edges].reshape(-1, 2)
