"""Claims about force loop and tissue in one process, in a time of its own."""

import numpy as np
import pytest
from meshes import irregular_box

from bench.haptics.pages import run_accuracy, run_stability
from bench.speed.script import run_script
from bench.speed.strokes import Session
from cutting_trainer.cutting.combined import CombinedMethod
from cutting_trainer.cutting.method_interface import SweepError
from cutting_trainer.haptic_bridge.force_path import ForcePath
from cutting_trainer.haptic_bridge.scene_schema import DeviceSettings, HapticsSettings, ToolSettings
from cutting_trainer.session.errors import SessionError
from cutting_trainer.session.in_process import InProcess, LinkSettings, Tissue
from cutting_trainer.tissue_sim.contact.blade import Resistance
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation

pytestmark = pytest.mark.long

RADIUS, TOP = 0.004, 0.012
RATE = 50.0
FRAME = 20
"""Ticks of a frame."""


def session(link: LinkSettings | None = None) -> InProcess:
    """A small soft block under a tool."""
    nodes, tetrahedra = irregular_box((4, 4, 3), 0.004, 1, jitter=0.1)
    simulation = TissueSimulation(
        TetMesh(nodes, tetrahedra, nodes[:, 2] < 1e-6),
        Material(3000.0, 0.45, 1060.0, 10.0, 5e-4),
        Resistance(100.0, 80.0, 10.0),
    )
    tool, device, haptics = ToolSettings(radius=RADIUS), DeviceSettings(), HapticsSettings()
    path = ForcePath(tool, device, haptics, device.load_profile())
    return InProcess(path, Tissue(simulation), RATE, link)


def pressed(link: LinkSettings | None = None, ticks: int = 700) -> tuple[InProcess, np.ndarray]:
    """Forces [N] by tick of a press 3 mm deep, shape (ticks, 3)."""
    loop = session(link)
    depth = np.interp(np.arange(ticks), [0, 200, ticks], [-2e-3, 3e-3, 3e-3])
    tips = np.column_stack([np.full((ticks, 2), 0.008), TOP + RADIUS - depth])
    return loop, np.array([loop.tick(tip).wrench[:3] for tip in tips])


def test_the_same_seed_gives_the_same_bits_and_another_one_does_not():
    runs = [pressed(LinkSettings(delay=0.02, loss=0.2, seed=s))[1] for s in (1, 1, 2)]
    assert runs[0].any()
    np.testing.assert_array_equal(runs[0], runs[1])
    assert (runs[0] != runs[2]).any()


def test_the_tissue_is_at_its_own_rate_and_answers_the_press():
    loop, forces = pressed()
    assert loop.ticks == 700
    assert loop.frame is not None
    assert loop.frame.step == 700 // FRAME
    np.testing.assert_allclose(forces[-1], loop.frame.force, rtol=0.05, atol=5e-3)
    assert forces[-1, 2] > 0.05


def test_an_answer_that_never_comes_is_a_silent_simulation():
    loop, forces = pressed(LinkSettings(loss=1.0))
    assert loop.frame is not None
    assert not forces.any()


@pytest.mark.parametrize('delay', [0.0, 0.05])
def test_an_answer_takes_computing_and_the_way_there_and_back(delay):
    loop = session(LinkSettings(delay=delay, compute=0.01))
    ages = []
    for _ in range(300):
        loop.tick(np.array([0.0, 0.0, 0.1]))
        ages.append(loop.path.simulation_age(10**9 + (loop.ticks - 1) * 10**6))
    first = int(np.flatnonzero(np.isfinite(ages))[0])
    assert first == pytest.approx(FRAME + 1000 * (0.01 + delay), abs=1)


def test_a_sweep_that_is_refused_stays_uncut_as_in_the_graph(monkeypatch):
    asked = []
    advance = CombinedMethod.advance

    def refused_at_first(self, mesh, positions, sweep):
        asked.append(sweep)
        if len(asked) == 1:
            raise SweepError('too long')
        return advance(self, mesh, positions, sweep)

    monkeypatch.setattr(CombinedMethod, 'advance', refused_at_first)
    strokes = Session(2000)
    before = len(strokes.simulation.mesh.tetrahedra)
    strokes.stroke()
    np.testing.assert_allclose(asked[1].tip_from, asked[0].tip_to, atol=5e-3)
    assert len(strokes.simulation.mesh.tetrahedra) > before


@pytest.mark.parametrize('command', [run_accuracy, run_stability])
def test_a_folder_that_cannot_take_the_tables_is_refused_before_anything_runs(command, tmp_path):
    with pytest.raises(SessionError, match='nowhere'):
        command(tmp_path / 'nowhere')


def test_the_script_of_the_demo_opens_its_planned_lines_without_trouble() -> None:
    """The tissue goes along by 12 to 18 mm before it is cut: the hand goes on after the lines."""
    frames, _ = run_script('liver', {})
    assert len(frames.opened) == 2
    assert min(frames.opened) >= 0.95
    assert not any(frames.trouble)


def test_rounding_does_not_decide_over_a_cut() -> None:
    """A hand that is off by less than an atom cuts the same, and feels the same."""
    frames, said = run_script('liver', {})
    off = {'device.tissue_from_device.translation': '[2.0e-14, 0, 0.06]'}
    other, other_said = run_script('liver', off)
    assert other_said == said
    np.testing.assert_allclose(other.force, frames.force, atol=1e-6)
