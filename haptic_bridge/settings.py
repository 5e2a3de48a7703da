"""What a scene says about the tool, the device and the haptics, and what a device can do."""

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, Field, ValidationError, model_validator
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from haptic_bridge.orientation import from_rpy
from tissue_sim.scene_file import SceneModel, nearest, syntax_error
from tissue_sim.share import share_folder

Vector = tuple[float, float, float]
Edge = Annotated[float, Field(gt=0, le=5)]


class SettingsError(ValueError):
    """A setting that cannot be; the message says which, where, and what would be right."""


class ToolSettings(SceneModel):
    """Scene section `tool`. The origin of the tool frame is the device's tip."""

    radius: float = Field(0.004, gt=0, le=0.05, description='[m] of the sphere that touches')
    coupling_stiffness: float = Field(
        200.0, ge=1, le=10_000, description='[N/m] of the spring between device and proxy'
    )
    blade_root: Vector = Field(
        (0.0, 0.0, 0.02), description='[m] end of the cutting edge at the handle, tool frame'
    )
    blade_tip: Vector = Field(
        (0.0, 0.0, -0.004), description='[m] end of the cutting edge at the tip, tool frame'
    )

    @model_validator(mode='after')
    def _blade_has_length(self) -> 'ToolSettings':
        if np.linalg.norm(np.subtract(self.blade_root, self.blade_tip)) < 1e-4:
            raise ValueError('blade_root and blade_tip coincide: a blade is at least 0.1 mm long')
        return self


class Transform(SceneModel):
    """Device frame to tissue frame: tissue = translation + rotation(scale * device)."""

    translation: Vector = Field((0.0, 0.0, 0.0), description='[m] of the device origin')
    rotation_rpy_deg: Vector = Field(
        (0.0, 0.0, 0.0), description='[deg] roll, pitch, yaw about the fixed axes x, y, z'
    )
    scale: float = Field(1.0, gt=0, le=100, description='tissue motion over device motion')

    def rotation(self) -> np.ndarray:
        """Rotation of vectors from the device frame to the tissue frame, shape (3, 3)."""
        return from_rpy(self.rotation_rpy_deg)

    def to_tissue(self, positions: np.ndarray) -> np.ndarray:
        """Maps device positions [m], shape (..., 3), to the tissue frame."""
        return np.asarray(positions) @ (self.scale * self.rotation().T) + self.translation

    def to_device(self, positions: np.ndarray) -> np.ndarray:
        """Maps tissue positions [m], shape (..., 3), to the device frame."""
        return (np.asarray(positions) - self.translation) @ self.rotation() / self.scale

    def force_to_device(self, forces: np.ndarray) -> np.ndarray:
        """Rotates tissue forces [N], shape (..., 3), into the device frame, unscaled."""
        return np.asarray(forces) @ self.rotation()


class DeviceSettings(SceneModel):
    """Scene section `device`."""

    profile: str = Field(
        'emulated', pattern=r'^[a-z0-9_]+$', description='file in config/devices, without .yaml'
    )
    tissue_from_device: Transform = Transform()
    force_frame: Literal['base', 'body'] = Field(
        'base',
        description='axes of servo_cf: of the device base (as drivers expect) or the tool body',
    )
    force_sign: Literal[1, -1] = Field(
        1, description='-1 where the device takes the force on itself, not the one on the hand'
    )
    length_unit: Literal['m', 'dm', 'cm', 'mm'] = Field(
        'm', description='unit of the positions that the device sends'
    )
    mirrored_axis: Literal['none', 'x', 'y', 'z'] = Field(
        'none', description='axis whose sign makes the frame of a left-handed device right-handed'
    )
    hold_button: bool = Field(
        False, description='force only while the button arm/button is pressed; else PAUSED'
    )

    def load_profile(self) -> 'DeviceProfile':
        """Reads the limits of the chosen device."""
        return DeviceProfile.load(share_folder() / 'config' / 'devices' / f'{self.profile}.yaml')


Limit = Literal['max_force', 'max_slew', 'max_stiffness', 'workspace']


class DeviceProfile(SceneModel):
    """What a device bears."""

    device: str = Field('', description='name of the device, for messages')
    max_force: float = Field(gt=0, le=100, description='[N] largest norm ever commanded')
    max_slew: float = Field(gt=0, le=100_000, description='[N/s] largest rate of the force')
    max_stiffness: float = Field(
        gt=0, le=50_000, description='[N/m] largest that it renders stably'
    )
    workspace: tuple[Edge, Edge, Edge] | None = Field(
        None, description='[m] edges of the box in which the tip can be; without it, unknown'
    )
    sources: dict[Limit, str] = Field({}, description='where each figure comes from')

    @classmethod
    def load(cls, path: Path) -> 'DeviceProfile':
        """Reads a device file.

        Raises:
            SettingsError: the file is missing, or something in it is missing, unknown or out of
                range.
        """
        try:
            content = YAML(typ='safe', pure=True).load(path.read_text(encoding='utf-8'))
            return cls.model_validate(content)
        except FileNotFoundError:
            known = sorted(p.stem for p in path.parent.glob('*.yaml'))
            near = nearest(path.stem, known)
            hint = f'did you mean {near}?' if near else f'known are {", ".join(known) or "none"}'
            raise SettingsError(f'device.profile: {path} does not exist: {hint}') from None
        except ValidationError as error:
            raise SettingsError(f'{path}: {_first_problem(error, cls)}') from None
        except YAMLError as error:
            raise SettingsError(syntax_error(path, error)) from None


def _first_problem(error: ValidationError, model: type[BaseModel]) -> str:
    """The first thing that is wrong with a file of one level, as a sentence."""
    problem = error.errors()[0]
    if not problem['loc']:
        return f'the file is {problem["input"]!r}, but a profile is a mapping with max_force first'
    key, fields = str(problem['loc'][0]), model.model_fields
    if problem['type'] == 'extra_forbidden':
        near = nearest(key, fields)
        return f'{key} is unknown: ' + (
            f'did you mean {near}?' if near else f'known are {", ".join(fields)}'
        )
    meaning = fields[key].description
    if problem['type'] == 'missing' and len(problem['loc']) == 1:
        return f'{key} is missing: {meaning}'
    place = '.'.join(map(str, problem['loc']))
    return f'{place} is {problem["input"]!r}: {problem["msg"]} ({key}: {meaning})'


class HapticsSettings(SceneModel):
    """Scene section `haptics`."""

    extrapolation: Literal['constant', 'time', 'position', 'local_stiffness'] = Field(
        'local_stiffness', description='what becomes of the 30 Hz force between two frames'
    )
    contact: Literal['proxy', 'penalty', 'god_object'] = Field(
        'proxy', description='how the tool is held out; the others are there to compare'
    )
    forces: Literal['two', 'one'] = Field(
        'two',
        description="two: the hand feels the tissue's reaction; one: what the proxy does to it",
    )
    rate: float = Field(1000.0, ge=100, le=5000, description='[Hz] of the force loop')
    stale_after: float = Field(
        0.1, ge=0.04, le=1.0, description='[s] without a frame of the simulation before the fade'
    )
    fade: float = Field(
        0.05, ge=0.005, le=0.5, description='[s] from full force to zero when stale'
    )
    device_timeout: float = Field(
        0.02, ge=0.002, le=0.5, description='[s] without a device pose before the FAULT'
    )
    soft_start: float = Field(
        0.5, ge=0.0, le=10.0, description='[s] in which the force ceiling grows to max_force'
    )
    force_scale: float = Field(1.0, gt=0, le=100, description='hand force over tissue force')
    max_damping: float = Field(
        5.0, ge=0, le=100, description='[N s/m] largest of the passivity controller; 0 turns it off'
    )


def check_together(
    tool: ToolSettings, device: DeviceSettings, haptics: HapticsSettings, profile: DeviceProfile
) -> None:
    """Refuses settings that are right one by one but not together.

    Raises:
        SettingsError: the fade needs more slew than the device has, or the coupling is too stiff.
    """
    if profile.max_slew * haptics.fade < profile.max_force:
        raise SettingsError(
            f'haptics.fade: {profile.max_force:g} N cannot go to zero in {haptics.fade:g} s at the '
            f'{profile.max_slew:g} N/s (max_slew) of the device; take at least '
            f'{profile.max_force / profile.max_slew:g} s'
        )
    felt = tool.coupling_stiffness * device.tissue_from_device.scale * haptics.force_scale
    if felt > profile.max_stiffness:
        raise SettingsError(
            f'tool.coupling_stiffness: {tool.coupling_stiffness:g} N/m is {felt:g} N/m at the '
            f'hand, but the device bears {profile.max_stiffness:g} N/m (max_stiffness)'
        )
