"""A scene's own script in one process: time and substeps of each frame, and what was cut.

`python -m bench.speed.script liver tissue.material.toughness=164` changes keys of the scene.
"""

import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rich.console import Console

from bench.speed.frame import FRAME_PERIOD_MS
from cutting_trainer.cutting.cut_invariants import cut_face_area
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.haptic_bridge.emulated_arm.arm import EmulatedArm
from cutting_trainer.haptic_bridge.emulated_arm.hand import EmulatedHand, compile_script
from cutting_trainer.recordings.incision_metrics import planned_paths
from cutting_trainer.session.in_process import InProcess, Tissue, make_force_path
from cutting_trainer.session.scene_loader import Scene, load_scene
from cutting_trainer.session.scene_overrides import parse_changes, write_changed
from cutting_trainer.tissue_sim.assembly import make_simulation
from cutting_trainer.tissue_sim.contact.tool import ContactState, CutOutcome, Frame, ToolContact
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, TopologyDelta
from cutting_trainer.tissue_sim.mesh.topology import CUT

Pose = tuple[np.ndarray, np.ndarray]
"""Position [m], shape (3,), and orientation as quaternion x y z w, shape (4,)."""
_MS = 1_000_000
_SAMPLES = 100
"""Points of a planned line."""
_NEAR_M = 1.5e-3
_TINY = 1e-30


@dataclass
class Frames:
    """Measured result of each frame.

    Attributes:
        phase: of the script.
        spent: processor time of the tissue [ms].
        substeps: number.
        force: on the hand [N], shape (3,).
        inside: whether the blade is in the tissue.
        lag: from the device's edge to the one in the tissue [m].
        slow: simulated time over frame time.
        trouble: warnings.
        active: points where the law counts, heavier nodes, their mass over the whole.
        opened: share of each planned line that the whole script opens.
    """

    phase: list[str] = field(default_factory=list)
    spent: list[float] = field(default_factory=list)
    substeps: list[int] = field(default_factory=list)
    force: list[np.ndarray] = field(default_factory=list)
    inside: list[bool] = field(default_factory=list)
    lag: list[float] = field(default_factory=list)
    slow: list[float] = field(default_factory=list)
    trouble: list[str] = field(default_factory=list)
    active: list[tuple[float, ...]] = field(default_factory=list)
    opened: list[float] = field(default_factory=list)


class _Timed(Tissue):
    """Tissue whose frames are timed without the answers of `cutting`."""

    frames: Frames
    phase = ''
    _answered = 0.0

    def frame(self, contact: ToolContact | None) -> Frame:
        self._answered = 0.0
        start = time.thread_time()
        frame = super().frame(contact)
        found = self.frames
        found.spent.append(1e3 * (time.thread_time() - start - self._answered))
        found.phase.append(self.phase)
        found.substeps.append(frame.substeps)
        found.force.append(frame.force)
        found.inside.append(frame.state == ContactState.INSIDE)
        blade = self.simulation.blade
        tip = None if blade is None or contact is None else blade._tip - contact.blade_tip
        found.lag.append(0.0 if tip is None else float(np.linalg.norm(tip)))
        found.slow.append(frame.slow_motion)
        found.trouble.append(frame.trouble)
        s = frame.strain
        found.active.append((s.domains, s.elements, s.heavier, s.added) if s else (0, 0, 0, 0.0))
        return frame

    def _answer(self) -> tuple[CutOutcome, TopologyDelta | None]:
        start = time.thread_time()
        answer = super()._answer()
        self._answered = time.thread_time() - start
        return answer


def run_script(name: str, changes: dict[str, str]) -> tuple[Frames, list[str]]:
    """Run the script of a scene, hand and arm included.

    Args:
        name: of the scene, or its file.
        changes: of the scene, by dotted key.

    Returns:
        The frames, and sentences on the cuts.
    """
    scene = load_scene(name)
    with tempfile.TemporaryDirectory() as folder:
        scene = load_scene(str(write_changed(scene, Path(folder), changes)))
    simulation, _ = make_simulation(scene.tissue)
    tissue = _Timed(simulation, make_method(scene.cutting))
    tissue.frames = Frames()
    session = InProcess(make_force_path(scene), tissue, scene.tissue.integration.rate)
    for tissue.phase, _ in script_ticks(scene, session):
        pass
    area = cut_face_area(simulation.mesh)
    said = [f'cut {simulation.elements_cut} elements, incision {1e4 * area:.2f} cm^2']
    frames = tissue.frames
    frames.opened = opened_lines(scene, simulation.mesh)
    for number, share in enumerate(frames.opened, 1):
        said.append(f'line {number}: {share:.0%} of its length is opened')
    return frames, said


def script_ticks(scene: Scene, session: InProcess) -> Iterator[tuple[str, Pose]]:
    """Run the script of a scene; before each tick yield its phase, and the pose of the device.

    Args:
        scene: with a script.
        session: before its first tick.
    """
    script = compile_script(scene.arm.require_script(), scene.device.tissue_from_device)
    arm = EmulatedArm(scene.arm, EmulatedHand(scene.arm.hand, script))
    arm.script_running = True
    for tick in range(1, round(1000 * script.seconds) + 1):
        pose = np.array(arm.position), np.array(arm.orientation)
        yield script.phase_at(tick / 1000)[0], pose
        wrench = session.tick(*pose).wrench
        arm.command(tick * _MS, wrench[:3], tick * _MS)
        arm.advance(tick * _MS, enabled=True)


def opened_lines(scene: Scene, mesh: TetMesh) -> list[float]:
    """Return which share of each planned line of a script is opened."""
    corners = mesh.rest[mesh.triangles[mesh.triangle_kind == CUT]]
    return [_opened(corners, path) for path in planned_paths(scene.arm.require_script())]


def _opened(corners: np.ndarray, path: np.ndarray) -> float:
    """Return the share of a planned line within 1.5 mm of cut faces, seen along z.

    Faces of a cut are upright: seen along z they are their edges.

    Args:
        corners: of the faces [m], shape (k, 3, 3).
        path: corners of the line [m], shape (j, 3).
    """
    reached = np.cumsum([0.0, *np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1)])
    at = np.linspace(0.0, reached[-1], _SAMPLES)
    points = np.column_stack([np.interp(at, reached, path[:, axis]) for axis in (0, 1)])
    starts = corners[:, :, :2].reshape(-1, 2)
    edges = np.roll(corners, -1, axis=1)[:, :, :2].reshape(-1, 2) - starts
    from_start = points[:, None] - starts
    shares = (from_start * edges).sum(axis=2) / np.maximum((edges**2).sum(axis=1), _TINY)
    away = from_start - np.clip(shares, 0.0, 1.0)[..., None] * edges
    distances = np.linalg.norm(away, axis=2).min(axis=1, initial=np.inf)
    return float((distances < _NEAR_M).mean())


def main() -> None:
    """Print time, substeps, forces and lag by phase."""
    frames, said = run_script(sys.argv[1], parse_changes(sys.argv[2:]))
    console = Console(width=150)
    spent, steps = np.array(frames.spent), np.array(frames.substeps)
    force, lag = np.linalg.norm(frames.force, axis=1), np.array(frames.lag)
    phases, active = np.array(frames.phase), np.array(frames.active)
    for phase in ['', *dict.fromkeys(frames.phase)]:
        at = phases == phase if phase else np.ones(len(spent), bool)
        s = active[at].max(axis=0)
        console.print(
            f'{phase or "all":45s} frame {np.median(spent[at]):5.1f} p99 '
            f'{np.percentile(spent[at], 99):5.1f} ms, substeps {np.median(steps[at]):.0f} to '
            f'{steps[at].max()}, force {force[at].max():.2f} N, lag {1e3 * lag[at].max():.1f} mm, '
            f'slow {min(np.array(frames.slow)[at]):.2f}, active {s[0]:.0f} {s[1]:.0f}, heavier '
            f'{s[2]:.0f} {s[3]:.1%}',
            soft_wrap=True,
        )
    console.print(f'within {FRAME_PERIOD_MS:.1f} ms: {np.mean(spent <= FRAME_PERIOD_MS):.1%}')
    for sentence in [*said, *sorted({t for t in frames.trouble if t})]:
        console.print(sentence, soft_wrap=True)


if __name__ == '__main__':
    main()
