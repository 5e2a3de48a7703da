"""A whole scene file; the package of each section checks it."""

from dataclasses import dataclass
from pathlib import Path

from pydantic import Field

from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.exercises.scene_schema import ExerciseSettings
from cutting_trainer.haptic_bridge.emulated_arm.scene_schema import ArmSettings
from cutting_trainer.haptic_bridge.scene_schema import (
    DeviceProfile,
    DeviceSettings,
    HapticsSettings,
    SettingsError,
    ToolSettings,
    check_together,
)
from cutting_trainer.node_common.error_place import nearest
from cutting_trainer.node_common.scene_reader import SceneModel, read_section, tool_names
from cutting_trainer.node_common.share_folder import SCENES
from cutting_trainer.session.errors import SessionError
from cutting_trainer.tissue_sim.scene_schema import TissueSettings

_MIN_FRAMES = 1.2
"""Frames of the tissue within `haptics.stale_after`."""


class SessionSettings(SceneModel):
    """The section `session`."""

    seconds: float | None = Field(
        None,
        ge=1,
        le=86400,
        description="duration [s], 1 to 86400, that the arm's script is stretched to; "
        'without it the script has its own',
    )


@dataclass(frozen=True)
class SceneTool:
    """One tool of a scene, with its device.

    Attributes:
        label: namespace of its bridge and arm; '': the first tool, which has none.
        profile: limits of the device that the scene names.
    """

    label: str
    tool: ToolSettings
    device: DeviceSettings
    profile: DeviceProfile
    haptics: HapticsSettings
    arm: ArmSettings


@dataclass(frozen=True)
class Scene:
    """Content of a scene file.

    Attributes:
        name: name of the file, without its extension.
        path: the file.
        profile: limits of the device that the scene names.
        exercise: the task; without a title the scene is none.
        others: the further tools, in their order.
    """

    name: str
    path: Path
    tissue: TissueSettings
    tool: ToolSettings
    device: DeviceSettings
    profile: DeviceProfile
    haptics: HapticsSettings
    cutting: CuttingSettings
    arm: ArmSettings
    session: SessionSettings
    exercise: ExerciseSettings
    others: tuple[SceneTool, ...] = ()

    @property
    def tools(self) -> tuple[SceneTool, ...]:
        """All tools, the first one first."""
        first = SceneTool('', self.tool, self.device, self.profile, self.haptics, self.arm)
        return (first, *self.others)


def load_scene(scene: str) -> Scene:
    """Read and check a scene.

    Args:
        scene: name of a file in config/scenes, without its extension, or path of a scene file.

    Raises:
        SessionError: there is no such scene.
        SceneError, SettingsError: a value of the file is not valid.
    """
    path = find_scene(scene)
    first = _load_tool(path, '')
    return Scene(
        name=path.stem,
        path=path,
        tissue=read_section(path, 'tissue', TissueSettings),
        tool=first.tool,
        device=first.device,
        profile=first.profile,
        haptics=first.haptics,
        cutting=read_section(path, 'cutting', CuttingSettings),
        arm=first.arm,
        session=read_section(path, 'session', SessionSettings),
        exercise=read_section(path, 'exercise', ExerciseSettings),
        others=tuple(_load_tool(path, name) for name in tool_names(path)),
    )


def require_frames(scene: Scene) -> None:
    """Reject a scene whose force would fade between two frames.

    Raises:
        SettingsError: the tissue has too few frames a second for `haptics.stale_after`.
    """
    rate = scene.tissue.integration.rate
    for tool in scene.tools:
        stale = tool.haptics.stale_after
        if stale * rate < _MIN_FRAMES:
            where = f'tools.{tool.label}.haptics' if tool.label else 'haptics'
            raise SettingsError(
                f'{scene.path}: {where}.stale_after: a force of {rate:g} frames a second would '
                f'fade after {stale:g} s, between two frames; set tissue.integration.rate to '
                f'{_MIN_FRAMES / stale:.3g} at least'
            )


def _load_tool(path: Path, label: str) -> SceneTool:
    tool = read_section(path, 'tool', ToolSettings, label)
    device = read_section(path, 'device', DeviceSettings, label)
    haptics = read_section(path, 'haptics', HapticsSettings, label)
    try:
        profile = device.load_profile()
        check_together(tool, device, haptics, profile)
    except SettingsError as error:
        where = f'{path}: tools.{label}' if label else f'{path}'
        raise SettingsError(f'{where}: {error}') from None
    arm = read_section(path, 'arm', ArmSettings, label)
    return SceneTool(label, tool, device, profile, haptics, arm)


def find_scene(scene: str, folder: Path = SCENES) -> Path:
    """Return the file of a scene, given its name or path.

    Raises:
        SessionError: there is none; the message lists the known scenes.
    """
    if scene.endswith(('.yaml', '.yml')) or '/' in scene:
        return Path(scene).resolve()
    known = sorted(path.stem for path in folder.glob('*.yaml'))
    if scene in known:
        return folder / f'{scene}.yaml'
    near = nearest(scene, known)
    hint = f'did you mean {near}? ' if near else ''
    raise SessionError(
        f'scene {scene!r} is not known: {hint}there are {", ".join(known) or "none"}; '
        'or give the path of a .yaml file'
    )
