"""Friction on soft tissue: what the hand feels is what drags the tissue along."""

import numpy as np
import pytest

from bench.accuracy.footprint import BLOCK, block
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.haptic_bridge.force_path import ForcePath
from cutting_trainer.haptic_bridge.scene_schema import (
    DeviceProfile,
    DeviceSettings,
    HapticsSettings,
    ToolSettings,
)
from cutting_trainer.session.in_process import InProcess, Tissue, tool_contact
from cutting_trainer.tissue_sim.contact.blade import Resistance
from cutting_trainer.tissue_sim.contact.footprint import SETTLEMENT, Footprint
from cutting_trainer.tissue_sim.contact.friction import NO_FRICTION, Friction
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation
from cutting_trainer.tissue_sim.simulation.state import from_state, state_of

RADIUS, COUPLING, DEPTH = 0.004, 200.0, 0.004
PLACE = np.array([0.04, 0.049, BLOCK[2] + RADIUS - DEPTH])
PROFILE = DeviceProfile(max_force=3.0, max_slew=500.0, max_stiffness=1000.0)


def pressed(friction, integrator='symplectic_euler') -> InProcess:
    """A session on a block of liver, the tool held at a place in it."""
    simulation = TissueSimulation(
        block((11, 11, 4)),
        Material(5400.0, 0.45, 1060.0, 15.0, 2e-4),
        Resistance(100.0, 200.0, 20.0),
        model='linear_smoothed',
        stepping=TimeStepping(integrator),
        friction=friction,
    )
    haptics = HapticsSettings(soft_start=0.0)
    tool = ToolSettings(radius=RADIUS, coupling_stiffness=COUPLING)
    path = ForcePath(tool, DeviceSettings(), haptics, PROFILE, friction=friction)
    session = InProcess(path, Tissue(simulation, make_method(CuttingSettings())), 30.0)
    for height in np.linspace(DEPTH + 2e-3, 0.0, 300):
        session.tick(PLACE + np.array([0.0, 0.0, height]))
    session.wait(0.5, PLACE)
    return session


def footprint(session: InProcess) -> Footprint:
    """The nodes that share the load now."""
    touch = session.path._proxy.touch
    nodes, weights = touch.nodes[:3], touch.weights[:3] / touch.weights[:3].sum()
    footprints = session.tissue.simulation.tools[0]._springs._footprints
    hertz = np.sqrt(RADIUS * 2e-3)
    return footprints.around(nodes, weights, footprints.radius(nodes, weights, hertz))


@pytest.mark.parametrize('integrator', ['symplectic_euler', 'implicit'])
def test_a_sliding_hand_feels_what_drags_the_tissue(integrator):
    session, friction, speed = pressed(Friction(0.4), integrator), 0.4, 0.03
    hand, tissue = [], []
    for x in np.arange(0.0, 0.02, speed * 1e-3):
        hand.append(session.tick(PLACE + np.array([x, 0.0, 0.0])).wrench[:3])
        tissue.append(session.frame.force)
    hand, tissue = np.array(hand)[len(hand) // 2 :], np.array(tissue)[len(tissue) // 2 :]
    np.testing.assert_allclose(-hand[:, 0], friction * hand[:, 2], rtol=1e-3)
    np.testing.assert_allclose(-tissue[:, 0], friction * tissue[:, 2], rtol=0.05)
    np.testing.assert_allclose(tissue[:, 0].mean(), hand[:, 0].mean(), rtol=0.02)
    assert np.abs(tissue[:, 1]).max() < 0.02 * np.abs(tissue[:, 0]).mean()


def test_a_sticking_tool_drags_the_tissue_along_and_lets_it_go():
    session, way = pressed(Friction(2.0)), 1.5e-3
    simulation = session.tissue.simulation
    before = simulation.displacement.copy()
    for x in np.linspace(0.0, way, 300):
        session.tick(PLACE + np.array([x, 0.0, 0.0]))
    session.wait(1.0, PLACE + np.array([way, 0.0, 0.0]))
    hand = np.array(session.tick(PLACE + np.array([way, 0.0, 0.0])).wrench[:3])
    tissue = session.frame.force
    assert -hand[0] < 2.0 * hand[2]
    assert tissue[0] == pytest.approx(hand[0], rel=0.02)
    # Of the way, the tissue goes what the coupling spring does not take up.
    spring = -tissue[0] / COUPLING
    found = footprint(session)
    moved = found.weights @ (simulation.displacement - before)[found.nodes, 0]
    assert moved == pytest.approx(way - spring, rel=0.05)
    for height in np.linspace(0.0, 0.03, 300):
        session.tick(PLACE + np.array([way, 0.0, height]))
    session.wait(3.0, PLACE + np.array([way, 0.0, 0.03]))
    assert np.abs(simulation.displacement).max() < 1e-5


def test_the_stiffness_along_a_half_space_is_that_of_cerruti():
    """An even load around a point goes along the surface by (2 - nu) / (2 - 2 nu) of what it would
    sink under the same force, whatever the pressure's shape.
    """
    session, nu = pressed(Friction(0.4)), 0.45
    along = 1 / session.frame.stiffness[1, 1] - 1 / COUPLING
    sinks = SETTLEMENT * (1 - nu**2) / (5400.0 * footprint(session).radius)
    assert along == pytest.approx(sinks * (2 - nu) / (2 - 2 * nu), rel=0.10)


@pytest.mark.parametrize('friction', [NO_FRICTION, Friction(0.4)])
def test_a_recorded_state_goes_on_bit_for_bit(friction):
    session = pressed(friction)
    simulation = session.tissue.simulation
    for x in np.linspace(0.0, 2e-3, 100):
        contact = tool_contact(session.tick(PLACE + np.array([x, 0.0, 0.0])).contact)
    twin = from_state(state_of(simulation))
    assert type(twin.tools[0]._springs) is type(simulation.tools[0]._springs)
    for _ in range(5):
        forces = simulation.frame(contact).force, twin.frame(contact).force
        assert forces[0].tobytes() == forces[1].tobytes()
    assert simulation.displacement.tobytes() == twin.displacement.tobytes()
