"""Compile the kernels into their cache: the first session starts as fast as later ones.

Run as `python -m cutting_trainer.session.compile_kernels` for the demo's kernels, and with the
argument `further` for those of other methods; a second run takes seconds.
"""

import gc
import os
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from multiprocessing import get_context

import numpy as np

from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.cutting.warm_up import warm_up as warm_up_cutting
from cutting_trainer.haptic_bridge.emulated_arm.arm import EmulatedArm
from cutting_trainer.haptic_bridge.emulated_arm.hand import EmulatedHand, compile_script
from cutting_trainer.haptic_bridge.emulated_arm.scene_schema import ArmSettings
from cutting_trainer.haptic_bridge.scene_schema import (
    DeviceSettings,
    HapticsSettings,
    ToolSettings,
    Transform,
)
from cutting_trainer.haptic_bridge.warm_up import warm_up as warm_up_force_path
from cutting_trainer.tissue_sim.mesh.depth import depths_behind_entry
from cutting_trainer.tissue_sim.warm_up import small_cube, warm_up_method
from cutting_trainer.tissue_sim.warm_up import warm_up as warm_up_tissue


def main() -> None:
    """Warm up group by group, on every processor, one line each; then look that nothing lacks."""
    names = FURTHER if sys.argv[1:] == ['further'] else DEMO
    with ProcessPoolExecutor(len(os.sched_getaffinity(0)), get_context('spawn')) as pool:
        for job in as_completed([pool.submit(timed, name) for name in names]):
            print(job.result(), flush=True)
    # Two processes that compiled the same kernel at once may have lost one of its signatures.
    for name in names:
        timed(name)


def timed(name: str) -> str:
    """Warm up a group and return its name with the time that it took."""
    gc.disable()  # a collection looks through all that the compiler still holds
    began, cpu = time.monotonic(), time.process_time()
    (DEMO | FURTHER)[name]()
    return f'{name}: {time.monotonic() - began:.1f} s, CPU {time.process_time() - cpu:.1f} s'


def warm_up_haptics() -> None:
    """Tick the force loop a few times."""
    device = DeviceSettings()
    warm_up_force_path(ToolSettings(), device, HapticsSettings(), device.load_profile())


def warm_up_arm() -> None:
    """Move the emulated arm for some periods."""
    pose = {'position': [0.0, 0.0, 0.0]}
    phase = {'kind': 'rest'}
    script = {'start': pose, 'phases': [phase]}
    settings = ArmSettings.model_validate({'script': script})
    arm = EmulatedArm(
        settings,
        EmulatedHand(settings.hand, compile_script(settings.require_script(), Transform())),
    )
    for number in range(3):
        arm.advance(number * 1_000_000, enabled=number > 0)
    arm.guide(arm.position, arm.orientation)
    arm.advance(3_000_000, enabled=True)


def warm_up_gauge() -> None:
    """Compute the depth of a blade, as pages and reports do."""
    cube = small_cube()
    depths_behind_entry(np.zeros((1, 2, 3)), cube.rest, cube.triangles)


# The longest first: each processor takes the next one.
DEMO: dict[str, Callable[[], None]] = {
    'tissue': partial(warm_up_method, 'symplectic_euler'),
    'cutting': partial(warm_up_cutting, CuttingSettings()),
    'force loop': warm_up_haptics,
    'emulated arm': warm_up_arm,
}
FURTHER: dict[str, Callable[[], None]] = {
    'tissue by all integrators': warm_up_tissue,
    'cutting by deletion': partial(warm_up_cutting, CuttingSettings(method='delete')),
    'depth of a blade': warm_up_gauge,
}


if __name__ == '__main__':
    main()
