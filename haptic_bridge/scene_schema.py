"""Scene sections `tool`, `device` and `haptics`, and the profile of a device."""

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, Field, ValidationError, model_validator
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from cutting_trainer.haptic_bridge.proxy.coupling_spring import DEFAULT_STIFFNESS_N_M, Stiffness
from cutting_trainer.node_common.error_place import nearest
from cutting_trainer.node_common.orientation import from_rpy
from cutting_trainer.node_common.scene_reader import SceneModel, bounded_yaml, syntax_error
from cutting_trainer.node_common.share_folder import share_folder
from cutting_trainer.node_common.yaml_bounds import YamlBoundError
from cutting_trainer.tissue_sim.contact.tool import MIN_RADIUS_M

Vector = tuple[float, float, float]
Coordinate = Annotated[float, Field(ge=-10, le=10)]
"""[m]"""
Place = tuple[Coordinate, Coordinate, Coordinate]
Angle = Annotated[float, Field(ge=-360, le=360)]
"""[deg]"""
Angles = tuple[Angle, Angle, Angle]
NodeName = Annotated[str, Field(pattern=r'^/[A-Za-z_][A-Za-z0-9_/]*$')]
Edge = Annotated[float, Field(gt=0, le=5)]
_MIN_SINE = 0.01
"""Of the angle between a blade and the direction that its edge faces."""


class SettingsError(ValueError):
    """A setting that is not possible; the message says which, where, and the remedy."""


class ToolSettings(SceneModel):
    """Scene section `tool`. The origin of the tool frame is the device's tip."""

    radius: float = Field(
        0.004, ge=MIN_RADIUS_M, le=0.05, description='[m] of the sphere that touches'
    )
    coupling_stiffness: Stiffness = DEFAULT_STIFFNESS_N_M
    blade_root: Place = Field(
        (0.0, 0.0, 0.02), description='[m] end of the cutting edge at the handle, tool frame'
    )
    blade_tip: Place = Field(
        (0.0, 0.0, -0.004), description='[m] end of the cutting edge at the tip, tool frame'
    )
    blade_facing: Vector = Field(
        (0.0, 0.0, 0.0),
        description='direction across the blade in which its edge cuts, tool frame; spine and '
        'flat carry the tissue along, uncut. [0, 0, 0]: it cuts all round',
    )
    mode: Literal['scalpel', 'palpator', 'open_grasper', 'closed_grasper'] = Field(
        'scalpel',
        description='mode at first: a palpator never goes in, a closed grasper holds the tissue '
        'that it has closed on. The parameter `tool_mode` of haptic_bridge, or '
        '`device.mode_button`, changes it',
    )

    @model_validator(mode='after')
    def _blade_has_length(self) -> 'ToolSettings':
        if np.linalg.norm(np.subtract(self.blade_root, self.blade_tip)) < 1e-4:
            raise ValueError('blade_root and blade_tip coincide: a blade is at least 0.1 mm long')
        if any(self.blade_facing) and np.linalg.norm(self.facing()) == 0.0:
            raise ValueError(
                f'blade_facing {list(self.blade_facing)} is along the blade: give a direction '
                'across it, for example [1, 0, 0]'
            )
        return self

    def facing(self) -> np.ndarray:
        """Return the unit vector across the blade from spine to edge, or zero, shape (3,)."""
        along = np.subtract(self.blade_tip, self.blade_root)
        along /= np.linalg.norm(along)
        across = self.blade_facing - along * (along @ self.blade_facing)
        size = float(np.linalg.norm(across))
        if size <= _MIN_SINE * np.linalg.norm(self.blade_facing):
            return np.zeros(3)
        return np.asarray(across / size)


class Transform(SceneModel):
    """Device frame to tissue frame: tissue = translation + rotation(scale * device)."""

    translation: Place = Field((0.0, 0.0, 0.0), description='[m] of the device origin')
    rotation_rpy_deg: Angles = Field(
        (0.0, 0.0, 0.0), description='[deg] roll, pitch, yaw about the fixed axes x, y, z'
    )
    scale: float = Field(1.0, ge=0.001, le=100, description='tissue motion over device motion')

    def rotation(self) -> np.ndarray:
        """Return the rotation from the device frame to the tissue frame, shape (3, 3)."""
        return from_rpy(self.rotation_rpy_deg)

    def to_tissue(self, positions: np.ndarray) -> np.ndarray:
        """Map device positions [m], shape (..., 3), to the tissue frame."""
        return np.asarray(positions) @ (self.scale * self.rotation().T) + self.translation

    def to_device(self, positions: np.ndarray) -> np.ndarray:
        """Map tissue positions [m], shape (..., 3), to the device frame."""
        return (np.asarray(positions) - self.translation) @ self.rotation() / self.scale


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
    force_topic: Literal['servo_cf', 'body/servo_cf', 'spatial/servo_cf'] = Field(
        'servo_cf', description='topic below `arm` on which the device takes the force'
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
    e_stop_button: int | None = Field(
        None, ge=0, le=31, description='index into buttons of arm/button that presses E-STOP'
    )
    mode_button: int | None = Field(
        None,
        ge=0,
        le=31,
        description='index into buttons of arm/button that makes a palpator of the scalpel, or '
        'closes the jaws of a grasper, or back',
    )
    reset_button: int | None = Field(
        None,
        ge=0,
        le=31,
        description='index into buttons of arm/button that makes the tissue whole again; an E-STOP '
        'stays',
    )
    clutch_button: int | None = Field(
        None,
        ge=0,
        le=31,
        description='index into buttons of arm/button that takes the hand off the tool while it is '
        'pressed; without it, buttons[0] of arm/clutch does',
    )
    jaw_closed: float | None = Field(
        None,
        ge=-1,
        le=3,
        description='angle of arm/jaw/measured_js [rad] at which the jaws of a grasper close, or '
        'scissors become a scalpel; 0.1 above it they open, or become a palpator. Without it the '
        'jaws are not followed',
    )
    accepted_publishers: tuple[NodeName, ...] = Field(
        (),
        max_length=32,
        description='nodes, as /name, that alone may publish poses, forces and meshes for the '
        'bridge; without any, the first of each topic may',
    )

    def load_profile(self) -> 'DeviceProfile':
        """Read the limits of the chosen device."""
        return DeviceProfile.load(share_folder() / 'config' / 'devices' / f'{self.profile}.yaml')


LimitName = Literal[
    'max_force', 'max_slew', 'max_stiffness', 'max_torque', 'max_torsional_stiffness', 'workspace'
]


class DeviceProfile(SceneModel):
    """Limits of a device."""

    device: str = Field('', description='name of the device, for messages')
    max_force: float = Field(gt=0, le=100, description='[N] largest norm ever commanded')
    max_slew: float = Field(gt=0, le=100_000, description='[N/s] largest rate of the force')
    max_stiffness: float = Field(
        gt=0, le=50_000, description='[N/m] largest stiffness that it renders stably'
    )
    max_torque: float = Field(
        0.0, ge=0, le=10, description='[N m] largest norm ever commanded; 0: it renders no torque'
    )
    max_torsional_stiffness: float = Field(
        0.0, ge=0, le=100, description='[N m/rad] largest stiffness that it renders stably'
    )
    workspace: tuple[Edge, Edge, Edge] | None = Field(
        None, description='[m] edges of the box in which the tip can be; without it, unknown'
    )
    sources: dict[LimitName, str] = Field({}, description='where each figure comes from')

    @classmethod
    def load(cls, path: Path) -> 'DeviceProfile':
        """Read a device file.

        Raises:
            SettingsError: the file is missing, or something in it is missing, unknown or out of
                range.
        """
        try:
            content = YAML(typ='safe', pure=True).load(bounded_yaml(path))
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
        except YamlBoundError as error:
            raise SettingsError(error.of(path)) from None
        except (ValueError, OSError) as error:  # no text, no date, a number without end
            reason = ' '.join(str(error).split())[:120]
            raise SettingsError(
                f'{path} cannot be read: {reason}: write it in plain YAML'
            ) from None


def _first_problem(error: ValidationError, model: type[BaseModel]) -> str:
    """Return the first fault of a file of one level, as a sentence."""
    problem = error.errors()[0]
    if not problem['loc']:
        return (
            f'the file is {problem["input"]!r:.60}, but a profile is a mapping with max_force first'
        )
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
    return f'{place} is {repr(problem["input"])[:60]}: {problem["msg"]} ({key}: {meaning})'


class HapticsSettings(SceneModel):
    """Scene section `haptics`."""

    extrapolation: Literal['constant', 'time', 'position', 'local_stiffness'] = Field(
        'local_stiffness', description='extrapolation of the 30 Hz force between two frames'
    )
    forces: Literal['two', 'one'] = Field(
        'two',
        description="two: the hand feels the tissue's reaction; one: the force of the spring",
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
    force_scale: float = Field(1.0, ge=0.001, le=100, description='hand force over tissue force')
    max_damping: float = Field(
        5.0, ge=0, le=100, description='[N s/m] largest of the passivity controller; 0 turns it off'
    )


def check_together(
    tool: ToolSettings, device: DeviceSettings, haptics: HapticsSettings, profile: DeviceProfile
) -> None:
    """Check that settings that are each right fit together.

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
    # Springs of twice the coupling's stiffness, spread over the blade, turned about its end.
    length = np.linalg.norm(np.subtract(tool.blade_root, tool.blade_tip))
    turned = 2 / 3 * tool.coupling_stiffness * length**2
    turned *= haptics.force_scale / device.tissue_from_device.scale
    if profile.max_torque > 0 and turned > profile.max_torsional_stiffness:
        raise SettingsError(
            f'tool.coupling_stiffness: a blade of {length:g} m is {turned:.3g} N m/rad stiff at '
            f'the hand, but the device bears {profile.max_torsional_stiffness:g} N m/rad '
            '(max_torsional_stiffness)'
        )
