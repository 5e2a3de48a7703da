"""A simulation gives the same bits whatever its process has computed before."""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.long

PRESS = """
import numpy as np
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.tissue_sim.assembly import make_simulation
from cutting_trainer.tissue_sim.contact.tool import indenter_contact

simulation, _ = make_simulation(load_scene('flap').tissue)
place, down = np.array([0.012, 0.0, 0.010]), np.array([0.0, 0.0, -1.0])
for depth in 0.006 * np.sin(np.linspace(0.0, np.pi, 150)) ** 2:
    simulation.frame(indenter_contact(simulation.mesh, place, down, depth))
print(simulation.displacement.tobytes().hex())
"""


def pressed(before: str) -> str:
    done = subprocess.run(
        [sys.executable, '-c', before + PRESS],
        cwd=Path(__file__).parents[1],
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout


def test_a_turning_tissue_moves_the_same_bit_for_bit_in_a_process_that_has_loaded_kernels() -> None:
    # The planner's process has run all models by all integrators, that of a re-simulation one.
    others = 'from cutting_trainer.tissue_sim.warm_up import warm_up\nwarm_up()\n'
    assert pressed('') == pressed(others)
