"""Accuracy of the force between two frames.

The same tool path goes through the force path over a tissue at 30 Hz, by each law of extrapolation,
and through a simulation that runs the tissue itself at 1 kHz, without any extrapolation.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.haptic_bridge.force_path import ForcePath
from cutting_trainer.haptic_bridge.proxy.proxy import Proxy
from cutting_trainer.haptic_bridge.proxy.surface import Surface
from cutting_trainer.haptic_bridge.proxy.undented_surface import UndentedSurface
from cutting_trainer.haptic_bridge.scene_schema import HapticsSettings
from cutting_trainer.session.errors import SessionError
from cutting_trainer.session.in_process import TICK_S, InProcess, LinkSettings, Tissue
from cutting_trainer.session.scene_loader import Scene, load_scene
from cutting_trainer.tissue_sim.assembly import make_simulation
from cutting_trainer.tissue_sim.contact.blade_constants import UNKNOWN_BLADE
from cutting_trainer.tissue_sim.contact.tool import ContactState, ToolContact
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation

Floats = NDArray[np.float64]

LAWS = ('constant', 'time', 'position', 'local_stiffness')
PLACES = ((-0.020, 0.018), (0.0, 0.0))
"""Where the liver is palpated: x and y [m]."""
FRAME_RATE_HZ = 30.0
_ENCODER = 2e-5
APPROACH_TIME_S = 0.5
"""Duration of the approach [s], which does not count."""


@dataclass(frozen=True)
class Motion:
    """Path of the tool over the liver.

    Attributes:
        name: of it.
        path: heights over the touch and way along x by time [s]: `path(t)` gives two arrays [m].
        seconds: after the way down.
        cuts: the blade may go in.
        bar: largest p95 that the default may have, in per cent of the peak; 0: none is set.
    """

    name: str
    path: Callable[[Floats], tuple[Floats, Floats]]
    seconds: float
    cuts: bool = False
    bar: float = 0.0


@dataclass(frozen=True)
class Row:
    """One law on one motion; errors in per cent of the peak force of the 1 kHz simulation."""

    motion: str
    law: str
    peak_newton: float
    median: float
    p95: float
    worst: float
    largest_jump: float
    jump_of_1_khz: float


def wave(hertz: float, least: float, most: float) -> Callable[[Floats], tuple[Floats, Floats]]:
    """Return up and down between two depths [m], see `Motion.path`."""

    def path(t: Floats) -> tuple[Floats, Floats]:
        return -(least + (most - least) * (0.5 - 0.5 * np.cos(2 * np.pi * hertz * t))), 0 * t

    return path


def _slide(hertz: float, depth: float, reach: float) -> Callable[[Floats], tuple[Floats, Floats]]:
    def path(t: Floats) -> tuple[Floats, Floats]:
        return 0 * t - depth, reach * np.sin(2 * np.pi * hertz * t)

    return path


def _cut(t: Floats) -> tuple[Floats, Floats]:
    down = np.interp(t, [0.0, 1.0, 3.0, 3.6], [0.0, -0.016, -0.016, 0.010])
    return down, np.interp(t, [1.0, 2.8], [0.0, 0.025])


MOTIONS = (
    Motion('palpation 0.5 Hz', wave(0.5, 0.001, 0.006), 2.0, bar=7.0),
    Motion('palpation 1 Hz', wave(1.0, 0.001, 0.006), 2.0, bar=7.0),
    Motion('palpation 2 Hz', wave(2.0, 0.001, 0.006), 1.0, bar=10.0),
    Motion('sliding 1 Hz', _slide(1.0, 0.005, 0.005), 2.0, bar=7.0),
    Motion('sliding 2 Hz', _slide(2.0, 0.005, 0.005), 1.0, bar=10.0),
    Motion('tapping 1 Hz', wave(1.0, -0.003, 0.005), 2.0),
    Motion('tapping 2 Hz', wave(2.0, -0.003, 0.005), 1.0),
    Motion('cutting', _cut, 3.8, cuts=True, bar=8.0),
)


class Bench:
    """Scene, tissue and tool paths of all runs.

    Args:
        scene: of which tissue and tool are taken.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene

    def tissue(self, rate: float, cuts: bool) -> Tissue:
        """Return the scene's tissue at a rate [Hz]; a blade gets in only if it may."""
        settings = self.scene.tissue
        changes = {
            'integration': settings.integration.model_copy(update={'rate': rate}),
            'cut_threshold': settings.cut_threshold if cuts else 1e3,
        }
        simulation, _ = make_simulation(settings.model_copy(update=changes))
        return Tissue(simulation, make_method(self.scene.cutting) if cuts else None)

    def path(self, motion: Motion, place: tuple[float, float]) -> Floats:
        """Return tips by tick [m], shape (k, 3).

        Down to where the motion begins, and through it.
        """
        t = np.arange(round((APPROACH_TIME_S + motion.seconds) / TICK_S)) * TICK_S
        part = np.clip(t / APPROACH_TIME_S, 0, 1)
        part = part**3 * (10 - 15 * part + 6 * part * part)
        height, along = motion.path(np.maximum(t - APPROACH_TIME_S, 0.0))
        height = (1 - part) * 0.002 + part * height
        top = self.touch_height(place)
        x, y = place
        return np.column_stack([x + along, np.full_like(t, y), top + height])

    def touch_height(self, place: tuple[float, float]) -> float:
        """Return height at which a tip that comes down first touches [m]."""
        simulation = self.tissue(FRAME_RATE_HZ, cuts=False).simulation
        surface = _surface(simulation, None)
        proxy = Proxy(self.scene.tool.radius)
        top = float(simulation.positions[:, 2].max()) + 0.01
        for height in np.arange(top, 0.0, -1e-4):
            if proxy.step(surface, 1.0, np.array([*place, height])).touching:
                return float(height)
        raise SessionError(f'there is no tissue at x {place[0]} m, y {place[1]} m')

    def reference(self, path: Floats, cuts: bool) -> Floats:
        """Return forces on the tool with the tissue at 1 kHz [N], shape (k, 3)."""
        tissue, tool = self.tissue(1 / TICK_S, cuts), self.scene.tool
        simulation, proxy, ground = tissue.simulation, Proxy(tool.radius), UndentedSurface()
        surface: Surface | None = None
        state = ContactState.NONE
        forces = np.zeros_like(path)
        for i, tip in enumerate(path):
            now = i * 1_000_000
            surface = _surface(simulation, surface)
            ground.follow(now, surface)
            assert ground.surface is not None
            if state == ContactState.INSIDE:
                proxy.reset()
                ground.release()
            touch = proxy.step(ground.surface, 1.0, tip)
            touched = state if state == ContactState.INSIDE else ContactState(int(touch.touching))
            if touched == ContactState.TOUCHING:
                ground.freeze()
            elif touched == ContactState.NONE:
                ground.note_free(now, simulation.step)
            nodes, slots = np.unique(np.maximum(touch.nodes, 0), return_inverse=True)
            frame = tissue.frame(
                ToolContact(
                    state=touched,
                    topology=simulation.mesh.topology,
                    nodes=nodes,
                    weights=np.bincount(slots, touch.weights, len(nodes)),
                    device=tip.copy(),
                    offset=touch.position - touch.contact,
                    normal=touch.normal.copy(),
                    stiffness=tool.coupling_stiffness,
                    radius=tool.radius,
                    blade_root=tip + tool.blade_root,
                    blade_tip=tip + tool.blade_tip,
                    blade_facing=tool.facing(),
                )
            )
            forces[i], state = frame.force, frame.state
        return forces

    def rendered(
        self, path: Floats, cuts: bool, link: LinkSettings | None = None, **haptics: object
    ) -> Floats:
        """Return forces that the force path commands over a tissue at 30 Hz [N], shape (k, 3)."""
        scene = self.scene
        settings = scene.haptics.model_copy(update={'soft_start': 0.0, **haptics})
        known = scene.tissue.blade_constants if cuts else UNKNOWN_BLADE
        force_path = ForcePath(scene.tool, scene.device, settings, scene.profile, constants=known)
        session = InProcess(force_path, self.tissue(FRAME_RATE_HZ, cuts), FRAME_RATE_HZ, link)
        frame = scene.device.tissue_from_device
        forces = np.zeros_like(path)
        for i, tip in enumerate(path):
            pose = np.round(frame.to_device(tip) / _ENCODER) * _ENCODER
            forces[i] = frame.rotation() @ session.tick(pose).wrench[:3]
        return forces


def _surface(simulation: TissueSimulation, previous: Surface | None) -> Surface:
    return Surface(
        simulation.positions,
        simulation.mesh.triangles,
        revision=simulation.step,
        topology=simulation.mesh.topology,
        previous=previous,
    )


def compare(name: str) -> list[Row]:
    """Return a motion, by its name in `MOTIONS`, at all places by all laws."""
    motion = next(motion for motion in MOTIONS if motion.name == name)
    return measure(Bench(load_scene('liver')), motion)


def measure(
    bench: Bench,
    motion: Motion,
    *,
    places: tuple[tuple[float, float], ...] = PLACES,
    laws: tuple[str, ...] = LAWS,
) -> list[Row]:
    """Return a motion at some places by some laws."""
    paths = [bench.path(motion, place) for place in places]
    truths = [bench.reference(path, motion.cuts) for path in paths]
    return [
        _row(
            motion,
            law,
            truths,
            [bench.rendered(path, motion.cuts, extrapolation=law) for path in paths],
        )
        for law in laws
    ]


def _row(motion: Motion, law: str, truths: list[Floats], forces: list[Floats]) -> Row:
    skip = round(APPROACH_TIME_S / TICK_S)
    peaks = [float(np.linalg.norm(t, axis=1).max()) for t in truths]
    errors = np.concatenate(
        [
            np.linalg.norm(f - t, axis=1)[skip:] / peak
            for f, t, peak in zip(forces, truths, peaks, strict=True)
        ]
    )
    return Row(
        motion.name,
        law,
        max(peaks),
        100 * float(np.median(errors)),
        100 * float(np.percentile(errors, 95)),
        100 * float(errors.max()),
        100 * max(_jump(f, skip) / p for f, p in zip(forces, peaks, strict=True)),
        100 * max(_jump(t, skip) / p for t, p in zip(truths, peaks, strict=True)),
    )


def _jump(forces: Floats, skip: int) -> float:
    """Return largest difference of two forces in succession [N]."""
    return float(np.linalg.norm(np.diff(forces, axis=0), axis=1)[skip:].max())


def missed_bounds(rows: list[Row]) -> list[str]:
    """Return where the default misses its bar."""
    bars = {motion.name: motion.bar for motion in MOTIONS}
    default = HapticsSettings().extrapolation
    return [
        f'{row.motion}: p95 of {row.law} is {row.p95:.1f} %, the bar is {bars[row.motion]:g} %'
        for row in rows
        if row.law == default and 0 < bars[row.motion] < row.p95
    ]
