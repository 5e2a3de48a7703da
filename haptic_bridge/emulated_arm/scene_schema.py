"""Scene section `arm`: the emulated arm, the hand on it, and the script of the hand."""

from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from cutting_trainer.haptic_bridge.scene_schema import Angles, Place, SettingsError
from cutting_trainer.node_common.orientation import from_quaternion, from_rpy
from cutting_trainer.node_common.scene_reader import SceneModel

Quaternion = tuple[float, float, float, float]


class PoseSettings(SceneModel):
    """A pose of the tool in the tissue frame."""

    position: Place = Field(description='[m]')
    rpy_deg: Angles | None = Field(
        None, description='[deg] roll, pitch, yaw about the fixed axes x, y, z'
    )
    quaternion: Quaternion | None = Field(None, description='x, y, z, w instead of rpy_deg')

    @model_validator(mode='after')
    def _one_orientation(self) -> 'PoseSettings':
        if self.rpy_deg is not None and self.quaternion is not None:
            raise ValueError('rpy_deg and quaternion are both given: delete one of them')
        if self.quaternion is not None:
            norm = sum(q * q for q in self.quaternion) ** 0.5
            if abs(norm - 1) > 1e-3:
                raise ValueError(f'quaternion has length {norm:.4g}: it must be 1')
        return self

    def rotation(self) -> np.ndarray | None:
        """Return the rotation of the tool, shape (3, 3), or None where none is given."""
        if self.quaternion is not None:
            return from_quaternion(self.quaternion)
        return None if self.rpy_deg is None else from_rpy(self.rpy_deg)


class Waypoint(PoseSettings):
    """Next pose of the hand; without an orientation it keeps the present one."""

    share: float = Field(1.0, gt=0, le=1000, description='duration, in shares of the phase')


class Phase(SceneModel):
    """A part of the script: a path through waypoints, with a rest at each."""

    kind: Literal['approach', 'palpate', 'cut', 'retract', 'rest'] = Field(
        description='activity of the hand; the summary of a session goes by it'
    )
    name: str = Field('', description='for messages; empty: the kind')
    share: float = Field(1.0, gt=0, le=1000, description='duration, in shares of the script')
    button: bool = Field(False, description='whether the hand presses the button of the arm')
    repeat: int = Field(1, ge=1, le=1000, description='rounds through the waypoints')
    waypoints: tuple[Waypoint, ...] = Field((), description='none: the hand stays')

    @model_validator(mode='after')
    def _goes_somewhere(self) -> 'Phase':
        if not self.waypoints and self.kind != 'rest':
            raise ValueError(
                f'a phase of kind {self.kind} needs waypoints: add one, or make it a rest'
            )
        return self


class ScriptSettings(SceneModel):
    """The script of the hand for a session."""

    start: PoseSettings = Field(description='where tool and hand wait for the haptic bridge')
    seconds: float = Field(20.0, gt=0, le=86_400, description='[s] duration of all phases together')
    phases: tuple[Phase, ...] = Field(min_length=1)

    @property
    def cuts(self) -> bool:
        """Whether a phase of the script is meant to cut."""
        return any(phase.kind == 'cut' for phase in self.phases)


class HandSettings(SceneModel):
    """A hand as a spring and a damper between the scripted target and the tool."""

    stiffness: float = Field(
        400.0, ge=0, le=5000, description='[N/m]; a limp hand has 50, a stiff one 1000, none 0'
    )
    damping: float = Field(8.0, ge=0, le=200, description='[N s/m]')
    tremor: float = Field(
        0.0, ge=0, le=0.005, description='[m] root mean square, each axis, at 8 to 12 Hz'
    )


class ArmSettings(SceneModel):
    """Scene section `arm`: three translations with force; the orientation follows the hand."""

    frame_id: str = Field('arm_base', min_length=1, description='frame of the messages')
    rate: float = Field(1000.0, ge=100, le=4000, description='[Hz] of poses out and forces in')
    mass: float = Field(0.1, ge=0.02, le=2.0, description='[kg] as felt at the tip')
    viscous_friction: float = Field(0.3, ge=0, le=50, description='[N s/m]')
    coulomb_friction: float = Field(0.03, ge=0, le=5, description='[N]')
    encoder_resolution: float = Field(
        2e-5, ge=0, le=0.005, description='[m] of measured_cp, each axis; 0: exact'
    )
    velocity_cutoff: float = Field(
        80.0, gt=0, le=1000, description='[Hz] of the low-pass on the differentiated position'
    )
    force_resolution: float = Field(
        0.002, ge=0, le=0.5, description='[N] of the motors, each axis; 0: exact'
    )
    max_force: float = Field(4.0, gt=0, le=100, description='[N] norm at which the motors saturate')
    delay: float = Field(
        0.0, ge=0, le=0.2, description='[s] from servo_cf to the motors, in whole periods'
    )
    watchdog: float = Field(
        0.03, ge=0.005, le=0.3, description='[s] after the last servo_cf the motors are at zero'
    )
    hand: HandSettings = HandSettings()
    script: ScriptSettings | None = Field(
        None, description='of the emulated arm; none: only a real arm moves the tool'
    )

    def require_script(self) -> ScriptSettings:
        """Return the script.

        Raises:
            SettingsError: there is none.
        """
        if self.script is None:
            raise SettingsError(
                'the scene has no arm.script, which the emulated arm follows: add one, or connect '
                'a real arm'
            )
        return self.script

    @model_validator(mode='after')
    def _watchdog_spans_periods(self) -> 'ArmSettings':
        if self.watchdog * self.rate < 5:
            raise ValueError(
                f'watchdog: {self.watchdog:g} s is less than five periods at {self.rate:g} Hz; '
                f'take at least {5 / self.rate:g} s'
            )
        return self
