"""No kernel is met first in a session: compiling it would stop the tissue for seconds."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from numba.core.caching import IndexDataCacheFile

pytestmark = pytest.mark.long

COMPILED = """
import sys

def kernels():
    found = {}
    for name, module in list(sys.modules.items()):
        if name.startswith('cutting_trainer.'):
            for key, value in vars(module).items():
                if hasattr(value, 'signatures') and value.__module__ == name:
                    found[f'{name}.{key}'] = value
    return found

def loaded():
    return {name: len(kernel.signatures) for name, kernel in kernels().items()}

def report(before):
    found = {name: n for name, n in loaded().items() if n != before.get(name, 0)}
    print('kernels:', len(before), 'loaded later:', found)
"""
IN_SESSION = """
import numpy as np
from cutting_trainer.cutting.warm_up import warm_up as warm_up_cutting
from cutting_trainer.haptic_bridge.emulated_arm.hand import EmulatedHand, compile_script
from cutting_trainer.haptic_bridge.warm_up import warm_up as warm_up_force_path
from cutting_trainer.session.in_process import simulate
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.session.compile_kernels import warm_up_arm

scene = load_scene(sys.argv[1])
session = simulate(sys.argv[1])
warm_up_arm()
warm_up_cutting(scene.cutting)
warm_up_force_path(scene.tool, scene.device, scene.haptics, scene.profile)
before, seconds = loaded(), 6.0
script = compile_script(scene.arm.script, scene.device.tissue_from_device, seconds)
hand = EmulatedHand(scene.arm.hand, script)
for tick in range(int(1000 * seconds)):
    hand.move_to(1e-3 * tick, 1e-3 * tick)
    session.tick(hand.position, tuple(hand.orientation))
assert session.tissue.simulation.elements_cut > 0
report(before)
missing = {name: k.stats.cache_misses for name, k in kernels().items() if k.stats.cache_misses}
print('not set up:', missing)
"""
MUCH_CUT = """
import numpy as np
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.cutting.warm_up import warm_up as warm_up_cutting
from bench.speed.strokes import Session
from bench.speed.tissue import box, liver_material
from cutting_trainer.tissue_sim.motion.active_region import ActiveSettings
from cutting_trainer.tissue_sim.contact.blade import Resistance
from cutting_trainer.tissue_sim.contact.tool import indenter_contact
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping
from cutting_trainer.tissue_sim.elasticity.models import MODELS
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TopologyDelta
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation
from cutting_trainer.tissue_sim.warm_up import warm_up

warm_up()
warm_up_cutting(CuttingSettings())
before = loaded()
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
        simulation.frame(indenter_contact(mesh, place, np.array([0.0, 0.0, -1.0]), depth))
    assert simulation.dynamics.active_nodes == 100
    simulation.apply_cut(TopologyDelta(removed_tetrahedra=np.arange(5)))
    simulation.frame(None)
report(before)
"""

SELDOM = """
from pathlib import Path
import numpy as np
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.session.scene_overrides import write_changed
from cutting_trainer.tissue_sim.assembly import make_simulation
from cutting_trainer.tissue_sim.contact.tool import indenter_contact
from cutting_trainer.tissue_sim.motion.parallel_euler import ParallelEuler

ParallelEuler.min_nodes = 0
changes = {
    'tissue.active_region': '{mode: budget, nodes: 20}',
    'tissue.material.prony': '[[0.3, 0.1]]',
    'tissue.budget.cores': sys.argv[2],
}
scene = load_scene(str(write_changed(load_scene('block'), Path(sys.argv[1]), changes)))
simulation, _ = make_simulation(scene.tissue)
before, mesh = loaded(), simulation.mesh
for depth in (1e-3, 2e-3):
    place = mesh.rest.max(axis=0) * [0.5, 0.5, 1.0]
    simulation.frame(indenter_contact(mesh, place, np.array([0.0, 0.0, -1.0]), depth))
report(before)
"""

SAVE = """
import sys
from numba.core.caching import IndexDataCacheFile
from cutting_trainer.session.compile_kernels import share_cache

share_cache()
folder, name = sys.argv[1:]
for number in range(100):
    IndexDataCacheFile(folder, 'kernel', 'stamp').save((name, number), 'compiled')
"""


def said(program: str, *arguments: str) -> list[str]:
    done = subprocess.run(
        [sys.executable, '-c', COMPILED + program, *arguments],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.parametrize('scene', [pytest.param('liver', marks=pytest.mark.thorough), 'block'])
def test_setup_has_compiled_and_nodes_have_loaded_all_that_a_session_calls(scene: str) -> None:
    later, missing = said(IN_SESSION, scene)
    kernels, found = later.split(' loaded later: ')
    assert int(kernels.removeprefix('kernels: ')) > 80
    assert found == '{}'
    assert missing == 'not set up: {}'


def test_warm_up_leaves_no_kernel_to_be_compiled_in_a_session() -> None:
    (later,) = said(MUCH_CUT)
    assert later.endswith(' loaded later: {}'), later


@pytest.mark.parametrize('cores', ['1', '2'])
def test_a_scene_with_far_field_viscosity_or_threads_has_loaded_their_kernels(
    tmp_path: Path, cores: str
) -> None:
    (later,) = said(SELDOM, str(tmp_path), cores)
    assert later.endswith(' loaded later: {}'), later


def test_two_processes_that_compile_one_kernel_at_once_lose_no_signature(tmp_path: Path) -> None:
    environment = os.environ | {'NUMBA_CACHE_DIR': str(tmp_path)}
    compilers = [
        subprocess.Popen([sys.executable, '-c', SAVE, str(tmp_path), name], env=environment)
        for name in 'ab'
    ]
    assert [compiler.wait() for compiler in compilers] == [0, 0]
    saved = IndexDataCacheFile(str(tmp_path), 'kernel', 'stamp')
    keys = [(name, number) for name in 'ab' for number in range(100)]
    assert [key for key in keys if saved.load(key) != 'compiled'] == []
