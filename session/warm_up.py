"""Compiles the kernels into their cache, so that the first session starts as fast as the next.

Run as `python -m session.warm_up`; a second run takes seconds.
"""

import time
from collections.abc import Callable

from cutting.settings import CuttingSettings
from cutting.warm_up import warm_up as warm_up_cutting
from haptic_bridge.arm import EmulatedArm
from haptic_bridge.arm_settings import ArmSettings
from haptic_bridge.hand import Hand, compile_script
from haptic_bridge.settings import DeviceSettings, HapticsSettings, ToolSettings, Transform
from haptic_bridge.warm_up import warm_up as warm_up_force_path
from tissue_sim.warm_up import warm_up as warm_up_tissue


def main() -> None:
    """Warms up group by group, one line each."""
    for name, warm_up in GROUPS.items():
        began = time.monotonic()
        print(f'compiling {name} ...', end='', flush=True)
        warm_up()
        print(f' {time.monotonic() - began:.1f} s', flush=True)


def warm_up_haptics() -> None:
    """Ticks the force loop a few times."""
    device = DeviceSettings()
    warm_up_force_path(ToolSettings(), device, HapticsSettings(), device.load_profile())


def warm_up_arm() -> None:
    """Moves the emulated arm for some periods."""
    pose = {'position': [0.0, 0.0, 0.0]}
    phase = {'kind': 'rest'}
    script = {'start': pose, 'phases': [phase]}
    settings = ArmSettings.model_validate({'script': script})
    arm = EmulatedArm(settings, Hand(settings.hand, compile_script(settings.script, Transform())))
    for number in range(3):
        arm.advance(number * 1_000_000, enabled=number > 0)


GROUPS: dict[str, Callable[[], None]] = {
    'the tissue': warm_up_tissue,
    'the force loop': warm_up_haptics,
    'the emulated arm': warm_up_arm,
    'cutting': lambda: warm_up_cutting(CuttingSettings()),
}


if __name__ == '__main__':
    main()
