"""The scene file as a whole, each section checked by the folder that it belongs to."""

from dataclasses import dataclass
from pathlib import Path

from pydantic import Field

from cutting.settings import CuttingSettings
from haptic_bridge.arm_settings import ArmSettings
from haptic_bridge.settings import (
    DeviceProfile,
    DeviceSettings,
    HapticsSettings,
    SettingsError,
    ToolSettings,
    check_together,
)
from session.errors import SessionError
from tissue_sim.scene_file import SceneModel, nearest, read_section
from tissue_sim.settings import TissueSettings
from tissue_sim.share import share_folder

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
    """Everything that a scene file says.

    Attributes:
        name: of the file, without its ending.
        path: the file.
        profile: limits of the device that the scene names.
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


def load_scene(scene: str) -> Scene:
    """Reads and checks a scene.

    Args:
        scene: name of a file in config/scenes, without its ending, or the path of a scene file.

    Raises:
        SessionError: there is no such scene.
        SceneError, SettingsError: the file says something that cannot be.
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
    )


def find_scene(scene: str, folder: Path = SCENES) -> Path:
    """The file that a scene's name or path means.

    Raises:
        SessionError: there is none; names what there is.
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
