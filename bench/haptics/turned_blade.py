"""Work of a hand that turns the blade in firm tissue, by the wrenches that its device gets.

The tissue is so firm for its toughness that nearly all of the work is that of the cut: toughness
times the sector that the edge sweeps below the surface.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from bench.cuts.strokes import good_block
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.haptic_bridge.force_path import ForcePath
from cutting_trainer.haptic_bridge.scene_schema import (
    DeviceProfile,
    DeviceSettings,
    HapticsSettings,
    ToolSettings,
)
from cutting_trainer.session.in_process import InProcess, Tissue
from cutting_trainer.tissue_sim.contact.blade import Resistance
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation

TOUGHNESS, DEPTH, ANGLE = 1.5, 0.010, 1.0
"""[J/m^2], [m] of the tip below the surface, [rad]"""
PRICE = TOUGHNESS * DEPTH**2 / 2 * np.tan(ANGLE)
"""[J] of the sector."""
RENDERS = DeviceProfile(
    max_force=3.0,
    max_slew=500.0,
    max_stiffness=1000.0,
    max_torque=0.1,
    max_torsional_stiffness=1.0,
)
TOOL = ToolSettings(
    radius=0.001, coupling_stiffness=400.0, blade_root=(0, 0, 0.028), blade_tip=(0, 0, -0.002)
)
_CELLS, _CELL, _PHASE_MS = (12, 6, 4), 0.005, 750


def turned(device: DeviceSettings, force_scale: float) -> tuple[float, float]:
    """Push a blade into the tissue, and turn it about its tip.

    Args:
        device: frames of the device; with `scale`, its ways are longer in the tissue.
        force_scale: hand force over tissue force.

    Returns:
        Work of the hand in the turn, by the commanded wrenches, and price of the cut [J].
    """
    nodes, tetrahedra = good_block(_CELLS, _CELL, seed=3)
    simulation = TissueSimulation(
        TetMesh(nodes, tetrahedra, nodes[:, 2] < 1e-9),
        Material(30000.0, 0.4, 1000.0, 5.0, 2e-4),
        Resistance(0.01, TOUGHNESS, 0.0),
        stepping=TimeStepping(rate=30.0, max_substeps=1000),
    )
    haptics = HapticsSettings(soft_start=0.0, max_damping=0.0, force_scale=force_scale)
    tissue = Tissue(simulation, make_method(CuttingSettings()))
    session = InProcess(ForcePath(TOOL, device, haptics, RENDERS), tissue, 30.0)
    frame, work, top = device.tissue_from_device, 0.0, float(nodes[:, 2].max())
    base = Rotation.from_matrix(frame.rotation().T)
    before: tuple[np.ndarray, np.ndarray, Rotation] | None = None
    for tick in range(3 * _PHASE_MS):
        down, part = _eased(tick / _PHASE_MS), _eased((tick / _PHASE_MS - 1) / 2)
        in_tissue = Rotation.from_rotvec([0, part * ANGLE, 0])
        tip = np.array([0.02, 0.0138, top + 0.002 - down * (0.002 + DEPTH)])
        place = frame.to_device(tip - in_tissue.apply(TOOL.blade_tip))
        held = base * in_tissue
        wrench = np.array(session.tick(place, held.as_quat()).wrench).reshape(2, 3)
        if device.force_frame == 'body':
            wrench = held.apply(wrench)
        if before is not None and part > 0.0:
            force, torque = (wrench + before[0]) / 2
            work -= float(force @ (place - before[1]))
            work -= float(torque @ (held * before[2].inv()).as_rotvec())
        before = wrench, place, held
    blade = simulation.blade
    return work, 0.0 if blade is None else blade.paid


def _eased(t: float) -> float:
    t = min(max(t, 0.0), 1.0)
    return t**3 * (10 - 15 * t + 6 * t * t)
