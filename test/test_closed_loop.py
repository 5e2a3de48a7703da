"""Proxy and tissue in a closed loop without ROS: frames and ticks of a session in one process."""

from pathlib import Path

import numpy as np
import pytest

from cutting_trainer.haptic_bridge.proxy.proxy import Proxy
from cutting_trainer.haptic_bridge.proxy.surface import Surface
from cutting_trainer.haptic_bridge.proxy.undented_surface import UndentedSurface
from cutting_trainer.tissue_sim.contact.blade import Resistance
from cutting_trainer.tissue_sim.contact.tool import ContactState, Frame, ToolContact
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.mesh.files import load_mesh
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation

pytestmark = pytest.mark.long

LIVER = Path(__file__).parents[1] / 'config' / 'meshes' / 'liver.msh'
RADIUS, STIFFNESS, TICKS = 0.004, 200.0, 33


class ClosedLoop:
    """A liver under a tool on a given path."""

    def __init__(self, threshold: float = 100.0) -> None:
        nodes, tets = load_mesh(LIVER, 1.0)
        self.simulation = TissueSimulation(
            TetMesh(nodes, tets, nodes[:, 2] < 1e-6),
            Material(5400.0, 0.45, 1060.0, 10.0, 5e-4),
            Resistance(threshold, 80.0, 10.0),
        )
        self.proxy = Proxy(RADIUS)
        self.surface: Surface | None = None
        self.ground = UndentedSurface()

    def frame(self, path: np.ndarray) -> tuple[Frame, ToolContact]:
        """One frame of ticks along a path [m], shape (TICKS, 3), then one frame of the tissue."""
        simulation = self.simulation
        self.surface = Surface(
            simulation.positions,
            simulation.mesh.triangles,
            revision=simulation.step,
            topology=simulation.mesh.topology,
            previous=self.surface,
        )
        self.ground.follow(simulation.step * TICKS * 1_000_000, self.surface)
        for device in path:
            touch = self.proxy.step(self.ground.surface, 1.0, device)
            if touch.touching:
                self.ground.freeze()
        device = path[-1]
        nodes, slots = np.unique(touch.nodes, return_inverse=True)
        contact = ToolContact(
            state=ContactState.TOUCHING if touch.touching else ContactState.NONE,
            topology=simulation.mesh.topology,
            nodes=nodes,
            weights=np.bincount(slots, touch.weights, len(nodes)),
            device=device.copy(),
            offset=touch.position - touch.contact,
            normal=touch.normal.copy(),
            stiffness=STIFFNESS,
            radius=RADIUS,
            blade_root=device + np.array([0, 0, 0.02]),
            blade_tip=device - [0, 0, RADIUS],
        )
        return simulation.frame(contact), contact

    def top(self, x: float, y: float) -> float:
        """Height of the surface at rest over a point [m]."""
        corners = self.simulation.mesh.rest[self.simulation.mesh.triangles]
        middles = corners.mean(axis=1)
        near = np.hypot(middles[:, 0] - x, middles[:, 1] - y) < 0.006
        return float(middles[near, 2].max())


@pytest.mark.parametrize(('x', 'y'), [(0.03, 0.008), (-0.02, 0.018), (-0.035, -0.01)])
@pytest.mark.parametrize('depth', [0.004, 0.008, 0.012])
def test_a_tool_held_in_the_tissue_does_not_swing_and_the_proxy_s_force_is_the_stiffer_one(
    x: float, y: float, depth: float
) -> None:
    loop = ClosedLoop()
    top = loop.top(x, y) + RADIUS
    times = np.arange(60 * TICKS) / 1000
    heights = top - depth * (0.5 - 0.5 * np.cos(np.pi * np.minimum(times, 1.0)))
    path = np.column_stack([np.full_like(heights, x), np.full_like(heights, y), heights])
    forces, energies = [], []
    for k in range(60):
        frame, contact = loop.frame(path[k * TICKS : (k + 1) * TICKS])
        forces.append(frame.force)
        energies.append(frame.kinetic_energy)
    still = np.array(forces[-10:])
    size = np.linalg.norm(still[-1])
    assert size > 0.05
    # On a slope the frictionless tool may still creep; it must not swing.
    assert np.abs(np.diff(still, axis=0)).max() < 0.01 * size
    assert energies[-1] < 1e-4 * frame.elastic_energy
    # The thesis's two forces: what loads the tissue, and what the hand feels. Under a sphere the
    # stiffness grows with depth, so that its product with the depth is above the force: by a half
    # for Hertz's law alone, by less with what is linear in series.
    series = np.linalg.norm(frame.stiffness)
    external = series * (loop.proxy.touch.position - contact.device)
    assert size <= np.linalg.norm(external) <= 1.5 * size
    np.testing.assert_allclose(still[-1] / size, external / np.linalg.norm(external), atol=0.03)


def test_energy_decays_after_release_and_the_tissue_comes_to_rest_exactly() -> None:
    loop = ClosedLoop()
    top = loop.top(0.0, 0.0) + RADIUS
    down = np.linspace(top, top - 0.006, 10 * TICKS)
    path = np.column_stack([np.zeros_like(down), np.zeros_like(down), down])
    for k in range(10):
        loop.frame(path[k * TICKS : (k + 1) * TICKS])
    away = np.tile([0.0, 0.0, top + 0.02], (TICKS, 1))
    loop.frame(away)
    energies = []
    for _ in range(200):
        frame, _ = loop.frame(away)
        assert not frame.force.any()
        energies.append(frame.kinetic_energy + frame.elastic_energy)
    totals = np.array(energies)
    assert (np.diff(totals) <= 1e-12 * totals[0]).all()
    assert totals[30] < 1e-3 * totals[0]
    assert not loop.simulation.velocity.any()


def test_the_same_path_gives_the_same_bits() -> None:
    hashes = []
    for _ in range(2):
        loop = ClosedLoop()
        top = loop.top(0.0, 0.0) + RADIUS
        down = np.linspace(top, top - 0.005, 8 * TICKS)
        path = np.column_stack([np.zeros_like(down), np.zeros_like(down), down])
        for k in range(8):
            frame, _ = loop.frame(path[k * TICKS : (k + 1) * TICKS])
        hashes.append((loop.simulation.displacement.tobytes(), frame.force.tobytes()))
    assert hashes[0] == hashes[1]
