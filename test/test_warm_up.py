"""No kernel is met first in a session: compiling it would stop the tissue for seconds."""

import subprocess
import sys

LATER = """
import sys
import numpy as np
from cutting.settings import CuttingSettings
from cutting.warm_up import warm_up as warm_up_cutting
from session.measure.bench_strokes import Session
from session.measure.bench_tissue import box, liver_material
from tissue_sim.active_region import ActiveSettings
from tissue_sim.blade import Resistance
from tissue_sim.contact import press_triangle
from tissue_sim.dynamics import TimeStepping
from tissue_sim.elasticity import MODELS
from tissue_sim.simulation import TissueSimulation
from tissue_sim.warm_up import warm_up

def compiled():
    kernels = {}
    for name, module in list(sys.modules.items()):
        if name.split('.')[0] in ('tissue_sim', 'cutting', 'haptic_bridge'):
            for key, value in vars(module).items():
                if hasattr(value, 'signatures') and value.__module__ == name:
                    kernels[f'{name}.{key}'] = len(value.signatures)
    return kernels

warm_up()
warm_up_cutting(CuttingSettings())
before = compiled()
session = Session(12_000)  # more nodes than a patch has
for _ in range(4):
    session.stroke()
rows = session.simulation.dynamics.model.tensor_mass
n = session.simulation.mesh.node_count
rows.tensors.room[:n] = 0
rows.update(np.arange(n))  # packed
assert rows._filled[0] == rows.tensors.used[:n].sum()
for model in MODELS:
    mesh = box(12_000)
    simulation = TissueSimulation(
        mesh, liver_material(), Resistance(10.0, 1.0, 1.0), model=model,
        stepping=TimeStepping('symplectic_euler'), active=ActiveSettings('budget', 100),
    )
    for depth in (1e-3, 2e-3):
        place = mesh.rest.max(axis=0) * [0.5, 0.5, 1.0]
        simulation.frame(press_triangle(mesh, place, np.array([0.0, 0.0, -1.0]), depth))
    assert simulation.dynamics.active_nodes == 100
after = compiled()
print({name: count for name, count in after.items() if count != before.get(name, 0)})
"""


def test_warm_up_leaves_no_kernel_to_be_compiled_in_a_session() -> None:
    done = subprocess.run(
        [sys.executable, '-c', LATER], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == '{}\n'
