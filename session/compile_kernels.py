"""Compile the kernels into their cache: the first session starts as fast as later ones.

Run as `python -m cutting_trainer.session.compile_kernels` for the demo's kernels, and with the
argument `further` for those of other methods; a second run takes seconds. Each group imports for
itself: imports take seconds, too, and run side by side then.
"""

import atexit
import fcntl
import gc
import os
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any


def main() -> None:
    """Warm up group by group, on every processor, one line each."""
    groups = FURTHER if sys.argv[1:] == ['further'] else DEMO
    workers = len(os.sched_getaffinity(0))
    with ProcessPoolExecutor(workers, get_context('spawn'), start_worker) as pool:
        for job in as_completed([pool.submit(timed, name) for name in groups]):
            print(job.result(), flush=True)


def start_worker() -> None:
    """Prepare a process that compiles; it ends at once, as all that it has made is in the cache.

    To take the compiler's memory apart would last four seconds.
    """
    from cutting_trainer.session.compiler_shortcuts import take_shortcuts

    take_shortcuts()
    share_cache()
    atexit.register(os._exit, 0)


def share_cache() -> None:
    """Let one process at a time add to an index of the cache.

    Numba reads the index, adds a signature and writes it. Another process between would lose one.
    """
    from numba.core.caching import IndexDataCacheFile

    save = IndexDataCacheFile.save

    def save_alone(file: IndexDataCacheFile, key: Any, data: Any) -> None:
        folder = Path(os.environ.get('NUMBA_CACHE_DIR') or tempfile.gettempdir())
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / 'lock').open('w') as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            save(file, key, data)

    IndexDataCacheFile.save = save_alone


def timed(name: str) -> str:
    """Warm up a group and return its name with the time that it took."""
    gc.disable()  # a collection looks through all that the compiler still holds
    began, cpu = time.monotonic(), time.process_time()
    (DEMO | FURTHER)[name]()
    return f'{name}: {time.monotonic() - began:.1f} s, CPU {time.process_time() - cpu:.1f} s'


def warm_up_tissue() -> None:
    """Move a tissue by the default integrator."""
    from cutting_trainer.tissue_sim.warm_up import warm_up_method

    warm_up_method('symplectic_euler')


def warm_up_cutting(**settings: Any) -> None:
    """Cut with settings of the scene's section `cutting`."""
    from cutting_trainer.cutting.scene_schema import CuttingSettings
    from cutting_trainer.cutting.warm_up import warm_up_method

    warm_up_method(CuttingSettings(**settings))


def warm_up_parting() -> None:
    """Part what strokes leave between them."""
    from cutting_trainer.cutting.warm_up import warm_up_parting

    warm_up_parting()


def warm_up_haptics() -> None:
    """Tick the force loop a few times."""
    from cutting_trainer.haptic_bridge.scene_schema import (
        DeviceSettings,
        HapticsSettings,
        ToolSettings,
    )
    from cutting_trainer.haptic_bridge.warm_up import warm_up

    device = DeviceSettings()
    warm_up(ToolSettings(), device, HapticsSettings(), device.load_profile())


def warm_up_arm() -> None:
    """Move the emulated arm for some periods."""
    from cutting_trainer.haptic_bridge.emulated_arm.arm import EmulatedArm
    from cutting_trainer.haptic_bridge.emulated_arm.hand import EmulatedHand, compile_script
    from cutting_trainer.haptic_bridge.emulated_arm.scene_schema import ArmSettings
    from cutting_trainer.haptic_bridge.scene_schema import Transform

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


def warm_up_all_integrators() -> None:
    """Move a tissue by every integrator."""
    from cutting_trainer.tissue_sim.warm_up import warm_up

    warm_up()


def warm_up_gauge() -> None:
    """Compute the depth of a blade, as pages and reports do."""
    import numpy as np

    from cutting_trainer.tissue_sim.mesh.depth import depths_behind_entry
    from cutting_trainer.tissue_sim.warm_up import small_cube

    cube = small_cube()
    depths_behind_entry(np.zeros((1, 2, 3)), cube.rest, cube.triangles)


# The longest first: each processor takes the next one.
DEMO: dict[str, Callable[[], None]] = {
    'tissue': warm_up_tissue,
    'cutting': warm_up_cutting,
    'force loop': warm_up_haptics,
    'parting': warm_up_parting,
    'emulated arm': warm_up_arm,
}
FURTHER: dict[str, Callable[[], None]] = {
    'tissue by all integrators': warm_up_all_integrators,
    'cutting by deletion': partial(warm_up_cutting, method='delete'),
    'depth of a blade': warm_up_gauge,
}


if __name__ == '__main__':
    main()
