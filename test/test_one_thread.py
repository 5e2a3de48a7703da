"""The tissue is simulated by one thread, unless its budget has several cores: the other core is
the force loop's.

BLAS computes long sums in several threads, which then wait for the next in a loop: one that is used
once a frame takes a whole core, and is no faster by it.
"""

import os
import time

import numpy as np
import pytest
from meshes import box

from cutting_trainer.tissue_sim.contact.blade import Resistance
from cutting_trainer.tissue_sim.contact.tool import indenter_contact
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.active_region import ActiveSettings
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation

pytestmark = pytest.mark.alone


@pytest.mark.skipif(os.cpu_count() == 1, reason='BLAS has one thread on one core')
@pytest.mark.parametrize('nodes', [0, 4000], ids=['all nodes', 'a region'])
def test_frames_of_a_large_tissue_take_no_second_core(nodes: int) -> None:
    rest, tetrahedra = box((24, 24, 18), 0.002)
    mesh = TetMesh(rest, tetrahedra, rest[:, 2] < 1e-9)
    assert mesh.node_count > 10_000  # from there on a dot product of BLAS has threads
    simulation = TissueSimulation(
        mesh,
        Material(5000.0, 0.45, 1060.0, 10.0, 2e-5),
        Resistance(10.0, 50.0, 5.0),
        model='linear',
        stepping=TimeStepping('symplectic_euler', max_substeps=1000),
        active=ActiveSettings('budget', nodes) if nodes else ActiveSettings(),
    )
    middle, down = rest.max(axis=0) * [0.5, 0.5, 1.0], np.array([0.0, 0.0, -1.0])
    for step in range(20):
        if step == 10:
            own, all_threads = time.thread_time(), time.process_time()
        along = np.array([1e-3 * step, 0.0, 0.0])
        assert not simulation.frame(indenter_contact(mesh, middle + along, down, 2e-3)).trouble
    own, all_threads = time.thread_time() - own, time.process_time() - all_threads
    assert own > 0.05
    assert all_threads < 1.2 * own
