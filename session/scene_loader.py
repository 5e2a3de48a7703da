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
from cutting_trainer.node_common.scene_reader import SceneModel, nearest, read_section
from cutting_trainer.node_common.share_folder import share_folder
from cutting_trainer.session.errors import SessionError
from cutting_trainer.tissue_sim.scene_schema import TissueSettings

SCENES = share_folder() / 'config' / 'scenes'


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
class Scene:
    """Content of a scene file.

    Attributes:
        name: name of the file, without its extension.
        path: the file.
        profile: limits of the device that the scene names.
        exercise: the task; without a title the scene is none.
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


def load_scene(scene: str) -> Scene:
    """Read and check a scene.

    Args:
        scene: name of a file in config/scenes, without its extension, or path of a scene file.

    Raises:
        SessionError: there is no such scene.
        SceneError, SettingsError: a value of the file is not valid.
    """
    path = find_scene(scene)
    tool = read_section(path, 'tool', ToolSettings)
    device = read_section(path, 'device', DeviceSettings)
    haptics = read_section(path, 'haptics', HapticsSettings)
    try:
        profile = device.load_profile()
        check_together(tool, device, haptics, profile)
    except SettingsError as error:
        raise SettingsError(f'{path}: {error}') from None
    return Scene(
        name=path.stem,
        path=path,
        tissue=read_section(path, 'tissue', TissueSettings),
        tool=tool,
        device=device,
        profile=profile,
        haptics=haptics,
        cutting=read_section(path, 'cutting', CuttingSettings),
        arm=read_section(path, 'arm', ArmSettings),
        session=read_section(path, 'session', SessionSettings),
        exercise=read_section(path, 'exercise', ExerciseSettings),
    )


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
