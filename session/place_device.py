"""Guided set-up: where a device is, by touches of known points, written to a scene."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from io import StringIO
from typing import Any

import numpy as np
from rich.console import Console
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq

from cutting_trainer.haptic_bridge.devices.convention import METRES, DeviceConvention
from cutting_trainer.haptic_bridge.devices.placement import (
    HOLD_S,
    LIFT_M,
    Placement,
    PlacementError,
    check_lift,
    place,
)
from cutting_trainer.haptic_bridge.devices.probe_pose import QUARTER_TURN_DEG, check_rotation
from cutting_trainer.haptic_bridge.devices.probe_stream import ProbeCheck
from cutting_trainer.haptic_bridge.scene_schema import (
    DeviceProfile,
    DeviceSettings,
    SettingsError,
    Transform,
    check_together,
)
from cutting_trainer.node_common.cdr_codec import StampedMessage
from cutting_trainer.node_common.share_folder import SCENES
from cutting_trainer.session.errors import SessionError
from cutting_trainer.session.scene_loader import Scene, load_scene
from cutting_trainer.tissue_sim.assembly import load_tissue

MOVE_TIMEOUT_S = 30.0
"""Time for each move [s]."""
SHIPPED = (
    *('block', 'circle', 'excision', 'flap', 'liver', 'liver_suspended', 'lumps', 'pad'),
    *('palpation', 'two_tools', 'vessel'),
)
"""Scenes that come with the trainer; others in their folder are copies."""
CORNERS = ('front left', 'front right', 'back right', 'back left')
_DIGITS = 6
_NAME = 'placement'
_OF_TIME = ('rate', 'jitter', 'age')
"""Checks that say nothing about where a tip at rest is."""


@dataclass
class Guide:
    """Asks for the touches, and writes what they say.

    Attributes:
        scene: whose section `device` is to be written.
        points: in its tissue's frame [m], shape (n, 3).
        names: of the points.
        found: placement of the device; None before it is known.
    """

    scene: Scene
    points: np.ndarray
    names: list[str]
    found: Placement | None = field(default=None)

    @classmethod
    def of(cls, scene: str, points: Sequence[str] = ()) -> 'Guide':
        """Return the guide for a scene file.

        Args:
            scene: path of the file.
            points: as `x,y,z` [m] in its tissue's frame; (): corners of the tissue's underside.

        Raises:
            SessionError: the scene is one of those that come with the trainer, or a point is none.
            SceneError, SettingsError, MeshError: the scene or its mesh cannot be used.
        """
        said = load_scene(scene)
        if said.path.parent == SCENES and said.path.stem in SHIPPED:
            raise SessionError(
                f'{said.path} comes with the trainer: copy it, and place the device in the copy'
            )
        if points:
            given = np.array([_point(text) for text in points])
            try:
                place(given, given)
            except PlacementError as error:
                raise SessionError(f'--point: {error}') from None
            return cls(said, given, [f'point {n}' for n in range(1, len(given) + 1)])
        nodes = load_tissue(said.tissue)[0]
        low, high = nodes.min(axis=0), nodes.max(axis=0)
        x, y = [low[0], high[0], high[0], low[0]], [low[1], low[1], high[1], high[1]]
        corners = np.column_stack([x, y, np.full(4, low[2])])
        return cls(said, corners, [f'the {corner} corner' for corner in CORNERS])

    @property
    def metres(self) -> float:
        """Return one unit of the positions of the scene's device [m]."""
        return METRES[self.scene.device.length_unit]

    @property
    def goals(self) -> list[dict[str, Any]]:
        """Return poses, as in a script, of a hand that does what is asked."""
        above = (self.points[-1] + [0.0, 0.0, LIFT_M]).tolist()
        goals: list[dict[str, Any]] = [{'position': point} for point in self.points.tolist()]
        return [*goals, {'position': above}, _turned(above)]

    @property
    def profile(self) -> DeviceProfile:
        """Return the profile of the scene's device."""
        return self.scene.profile

    def lead(self, node: Any, notes: Console) -> list[ProbeCheck]:
        """Ask for touches, lift and turn, and find the placement.

        Args:
            node: `DeviceProbe`.
            notes: console for what is asked.
        """
        self._introduce(notes)
        convention = DeviceConvention(self.scene.device)

        def ours(position: np.ndarray, turn: Sequence[float] = (0.0, 0.0, 0.0, 1.0)) -> np.ndarray:
            pose = StampedMessage(0, '', (*map(float, position), *map(float, turn)))
            return np.array(convention.pose(pose).values)

        def touch(name: str) -> np.ndarray:
            return ours(node.await_touch(self.metres, MOVE_TIMEOUT_S, name))[:3]

        touched: list[np.ndarray] = []
        try:
            for name, point in zip(self.names, self.points, strict=True):
                place_of = ', '.join(f'{1e3 * value:.1f}' for value in point)
                _ask(notes, f'Touch {name} ({place_of} mm in the tissue), and hold it there.')
                touched.append(touch(name))
            found = place(np.array(touched), self.points, self.names)
            _ask(notes, f'Lift the tip straight up by about {1e3 * LIFT_M:g} mm, and hold it.')
            check_lift(found, touch('the place above') - touched[-1])
            _ask(
                notes,
                f'Turn the tool by {QUARTER_TURN_DEG:g} degrees about the vertical, '
                'counterclockwise seen from above, and hold it.',
            )
            before, after = node.await_rotation(MOVE_TIMEOUT_S)
            turns = [None if q is None else ours(np.zeros(3), q)[3:] for q in (before, after)]
            assert turns[0] is not None
            turned = check_rotation(turns[0], turns[1], found.rotation[2], node.pose_topic)
        except PlacementError as error:
            return [ProbeCheck(_NAME, 'wrong', f'{len(touched)} points touched', str(error))]
        if turned.verdict == 'ok':
            self.found = found
        return [turned]

    def _introduce(self, notes: Console) -> None:
        if self.names[0] == 'point 1':
            return
        size = 1e3 * np.ptp(self.points, axis=0)
        _ask(
            notes,
            f'Lay a sheet where the tissue is to be: {size[0]:.0f} mm from left to right, '
            f'{size[1]:.0f} mm from front to back. On one half as large, the tool moves twice as '
            f'far as the hand. Hold the tip still for {HOLD_S:g} s on each point.',
        )

    def write(self, checks: Sequence[ProbeCheck]) -> ProbeCheck:
        """Write the placement to the scene, if nothing is wrong; return the result."""
        wrong = hindrances(checks)
        if self.found is None or wrong:
            why = f'because of {", ".join(wrong)}' if wrong else 'because the turn was not seen'
            return ProbeCheck('scene', 'wrong', 'not written', f'nothing was written {why}')
        try:
            write_placement(self.scene, self.found)
        except SettingsError as error:
            return ProbeCheck('scene', 'wrong', 'not written', str(error))
        rpy = ', '.join(f'{angle:.1f}' for angle in self.found.rpy_deg)
        worst = 1e3 * self.found.residuals.max()
        measured = f'turned by {rpy} deg, scale {self.found.scale:.3f}, within {worst:.1f} mm'
        return ProbeCheck('scene', 'ok', f'{measured}; written to {self.scene.path}')


def hindrances(checks: Sequence[ProbeCheck]) -> list[str]:
    """Return the names of the checks by which a placement would not be right."""
    return [c.name for c in checks if c.verdict == 'wrong' and c.name not in _OF_TIME]


def _turned(position: list[float]) -> dict[str, Any]:
    return {'position': position, 'rpy_deg': [0.0, 0.0, QUARTER_TURN_DEG]}


def _ask(notes: Console, text: str) -> None:
    notes.print(text, highlight=False, markup=False)


def _point(text: str) -> list[float]:
    try:
        values = [float(part) for part in text.split(',')]
    except ValueError:
        values = []
    if len(values) != 3 or not np.isfinite(values).all():
        raise SessionError(f'--point {text}: give x,y,z in metres, as in --point 0.02,-0.01,0')
    return values


def write_placement(scene: Scene, placement: Placement) -> None:
    """Write where a device is to the section `device` of a scene file; all else stays.

    Args:
        scene: its file is written.
        placement: of the device of its first tool.

    Raises:
        SettingsError: the coupling would be too stiff for the device.
    """
    frame = Transform(
        translation=_rounded(placement.translation),
        rotation_rpy_deg=_rounded(placement.rpy_deg),
        scale=round(placement.scale, _DIGITS),
    )
    device = DeviceSettings.model_validate(
        scene.device.model_dump() | {'tissue_from_device': frame.model_dump()}
    )
    check_together(scene.tool, device, scene.haptics, scene.profile)
    yaml = YAML()
    yaml.preserve_quotes, yaml.width = True, 4096
    yaml.indent(mapping=2, sequence=4, offset=2)
    content = yaml.load(scene.path.read_text(encoding='utf-8'))
    if not isinstance(content.get('device'), dict):
        content['device'] = CommentedMap()
    section = content['device']
    if not isinstance(section.get('tissue_from_device'), dict):
        section['tissue_from_device'] = CommentedMap()
    for key, value in frame.model_dump().items():
        section['tissue_from_device'][key] = _flow(value)
    out = StringIO()
    yaml.dump(content, out)
    part = scene.path.with_name(f'.{scene.path.name}.part')
    part.write_text(out.getvalue(), encoding='utf-8')
    shutil.copymode(scene.path, part)
    part.replace(scene.path)


def _rounded(values: Sequence[float] | np.ndarray) -> tuple[float, float, float]:
    x, y, z = (round(float(value), _DIGITS) + 0.0 for value in values)
    return x, y, z


def _flow(value: Any) -> Any:
    if not isinstance(value, tuple):
        return value
    row = CommentedSeq(value)
    row.fa.set_flow_style()
    return row
