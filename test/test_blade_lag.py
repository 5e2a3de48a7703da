"""The edge in the tissue stays with the device's, and lets go of tissue that it has left."""

from dataclasses import replace

import numpy as np
import pytest
from meshes import irregular_box
from test_blade import TOUGHNESS, contact_at

from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.session.in_process import Tissue
from cutting_trainer.tissue_sim.contact.blade import Resistance
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation

TOP, EDGE, COUPLING, STIFF = 0.02, 0.03, 400.0, 30000.0


def tissue(rate: float, youngs_modulus: float = 5000.0) -> Tissue:
    nodes, tets = irregular_box((12, 6, 4), 0.005, 3, jitter=0.1)
    simulation = TissueSimulation(
        TetMesh(nodes, tets, nodes[:, 2] < 1e-9),
        Material(youngs_modulus, 0.4, 1000.0, 5.0, 2e-4),
        Resistance(0.05, TOUGHNESS, 0.0),
        stepping=TimeStepping(rate=rate, max_substeps=1000),
    )
    return Tissue(simulation, make_method(CuttingSettings()))


def eased(a: np.ndarray, b: np.ndarray, seconds: float, rate: float) -> np.ndarray:
    t = np.arange(1, round(seconds * rate) + 1)[:, None] / round(seconds * rate)
    return a + t**3 * (10 - 15 * t + 6 * t * t) * (b - a)


@pytest.mark.parametrize('seed', range(6))
def test_a_short_slice_lags_by_its_springs_alone_and_lets_go_when_it_is_withdrawn(seed) -> None:
    rng, rate = np.random.default_rng(seed), 30.0
    start = np.array([rng.uniform(0.015, 0.045), rng.uniform(0.01, 0.02), TOP + 0.002])
    deep = start - [0, 0, 0.002 + rng.uniform(0.006, 0.012)]
    angle = rng.uniform(-np.pi, np.pi)
    there = deep + rng.uniform(0.004, 0.010) * np.array([np.cos(angle), np.sin(angle), 0])
    up = np.array([*there[:2], TOP + 0.030])
    ways = [eased(*way, rate) for way in ((start, deep, 0.6), (deep, there, 0.2), (there, up, 0.3))]
    cutter = tissue(rate)
    simulation, lags = cutter.simulation, []
    for tip in np.concatenate(ways):
        frame = cutter.frame(contact_at(simulation, tip))
        if simulation.blade is not None:
            lags.append(simulation.blade.lag)
            # Each spring yields at the toughness of its piece, up to a tenth longer at rest; all of
            # them are twice the coupling.
            assert lags[-1] <= 1.1 * TOUGHNESS * EDGE / (2 * COUPLING)
        if tip[2] > TOP + 0.005:
            assert not frame.force.any()
    assert max(lags) > 5e-4
    assert simulation.blade is None


def turn(rate: float, seconds: float = 1.0) -> tuple[float, float]:
    """Turn a blade by 57 degrees about its tip, 10 mm deep; return work and price of it [J]."""
    cutter = tissue(rate, STIFF)
    simulation, deep = cutter.simulation, np.array([0.02, 0.0138, 0.0102])
    down = eased(np.array([0.02, 0.0138, TOP + 5e-4]), deep, 0.5, rate)
    angles = eased(np.zeros(1), np.ones(1), seconds, rate)[:, 0]
    work, lost, last = 0.0, 0.0, None
    for tip, angle in [*((tip, 0.0) for tip in down), *((deep, angle) for angle in angles)]:
        root = tip + EDGE * np.array([np.sin(angle), 0.0, np.cos(angle)])
        contact = contact_at(simulation, tip)
        object.__setattr__(contact, 'blade_root', root)
        frame = cutter.frame(contact)
        blade = simulation.blade
        if blade is None:
            continue
        if last is not None:
            work += 0.5 * (blade.force + last[0]) @ (tip - last[2])
            work -= 0.5 * (frame.turning.torque + last[1])[1] * (angle - last[3])
        last = blade.force, frame.turning.torque, tip, angle
        v, c = simulation.velocity, simulation.material
        lost += c.beta * float(np.sum(v * simulation.model.force(v))) / rate
        lost += c.alpha * float(simulation.model.mass @ np.square(v).sum(axis=1)) / rate
    stretch = blade.stretch
    stored = COUPLING * float(np.square(stretch).sum()) / 48  # half of 400 / 24 by spring
    return work - lost - stored - frame.elastic_energy - frame.kinetic_energy, blade.paid


@pytest.mark.long
def test_turning_the_blade_in_tissue_costs_toughness_times_the_swept_area() -> None:
    work, paid = turn(250.0)
    assert paid > 1e-3
    assert work == pytest.approx(paid, rel=0.08)


def test_a_blade_in_fine_soft_tissue_is_felt_by_toughness_and_friction_without_chatter() -> None:
    toughness, friction, depth = 2.7, 2.3, 0.0055
    nodes, tets = irregular_box((15, 9, 6), 0.0017, 3, jitter=0.1)
    bottom = nodes[:, 2] < 1e-9
    nodes[:, 2] += TOP - nodes[:, 2].max()
    simulation = TissueSimulation(
        TetMesh(nodes, tets, bottom),
        Material(3600.0, 0.45, 1000.0, 15.0, 2e-4),
        Resistance(0.01, toughness, friction),
        model='stiffening',
        stepping=TimeStepping(rate=20.0, max_substeps=1000),
    )
    cutter = Tissue(simulation, make_method(CuttingSettings()))
    above = np.array([0.004, 0.0075, TOP + 0.001])
    deep = above - [0.0, 0.0, 0.001 + depth]
    stops = [above, deep - [0.0, 0.0, 0.003], deep, deep + np.array([0.015, 0.0, 0.0])]
    forces = []
    for tip in np.concatenate([np.linspace(*stops[i : i + 2], 20) for i in range(3)]):
        frame = cutter.frame(replace(contact_at(simulation, tip), stiffness=200.0))
        if tip[0] > 0.01:
            forces.append(-frame.force[0])
    wanted = depth * (toughness + friction)
    assert np.mean(forces) == pytest.approx(wanted, rel=0.1)
    assert np.std(forces) < 0.1 * wanted
