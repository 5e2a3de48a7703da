"""Cost of the compiled part of a tick on a surface of 20,000 triangles.

The tool slides over hills, on a surface that stands still as the ground does in contact, or on one
that moves in every tick; the proxy's step and the force law with the safety chain are timed apart,
each call by itself, in the thread's own processor time. The same ticks run several times and the
fastest of each counts, so that other processes do not; differences between ticks remain.
"""

import time

import numpy as np

from bench.common.clock import Figure, figure
from cutting_trainer.haptic_bridge import extrapolation, force_kernels
from cutting_trainer.haptic_bridge.proxy.proxy import Proxy
from cutting_trainer.haptic_bridge.proxy.surface import Surface
from cutting_trainer.haptic_bridge.scene_schema import DeviceSettings, HapticsSettings, ToolSettings
from cutting_trainer.node_common.kernels import kernel

_command = kernel(force_kernels.command, nogil=True)
POINTS = 101
_TICKS_A_FRAME = 33


def hills(phase: float) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes [m] and triangles of a square of 0.1 m with waves of 4 mm, 2 (POINTS - 1)^2 of
    them.
    """
    line = np.linspace(-0.05, 0.05, POINTS)
    x, y = (a.ravel() for a in np.meshgrid(line, line, indexing='ij'))
    z = 0.002 * np.sin(200 * x + phase) * np.cos(170 * y)
    i = np.arange(POINTS**2).reshape(POINTS, POINTS)
    a, b, c, d = (n.ravel() for n in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return np.column_stack([x, y, z]), triangles.astype(np.int32)


def measure(ticks: int, moving: bool) -> np.ndarray:
    """Return the time of the proxy's step and of the force law [us], shape (ticks, 2)."""
    tool, device, haptics = ToolSettings(), DeviceSettings(), HapticsSettings()
    setup = force_kernels.make_setup(tool, device, haptics, device.load_profile())
    state, history = np.zeros(1, force_kernels.STATE), np.zeros(1, extrapolation.HISTORY)
    force, where = np.array([0.0, 0.0, 0.3]), np.zeros(3)
    stiffness, depth = np.diag([0.0, 0.0, 80.0]), np.array([0.0, 0.0, 4e-3])
    extrapolation.push(history, 1, where, force, stiffness, depth, topology=0, state=1)
    proxy, surface = Proxy(tool.radius), None
    spent = np.empty((ticks, 2))
    pose = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    for i in range(ticks):
        if i == 0 or (moving and i % _TICKS_A_FRAME == 0):
            nodes, triangles = hills(0.02 * i / _TICKS_A_FRAME)
            surface = Surface(nodes, triangles, revision=i, topology=0, previous=surface)
        assert surface is not None
        pose[:3] = 0.03 * np.sin(1.3e-3 * i), 0.03 * np.sin(1.7e-3 * i), 0.0
        blend = (i % _TICKS_A_FRAME + 1) / _TICKS_A_FRAME if moving else 1.0
        start = time.thread_time()
        touch = proxy.step(surface, blend, pose[:3])
        middle = time.thread_time()
        force_kernels.to_tissue(setup, state, pose)
        state['proxy'], state['normal'] = touch.position, touch.normal
        _command(setup, state, history, force_kernels.TOUCHING, True, i, 1.0, 1e-3)
        spent[i] = middle - start, time.thread_time() - middle
    return 1e6 * spent


def proxy(repeats: int = 7, ticks: int = 3000) -> list[Figure]:
    """Return the proxy's step and the force law with its chain, on a surface at rest and a moving
    one.
    """
    measure(50, moving=False)
    figures = []
    for moving in (False, True):
        spent = np.min([measure(ticks, moving) for _ in range(repeats)], axis=0)
        where = 'moving surface' if moving else 'surface at rest'
        for name, column in zip(('proxy', 'force law and chain'), spent.T, strict=True):
            figures.append(figure(f'{name}, {where}', 'us', column))
    return figures
