"""Teleoperated soft-tissue cutting trainer, from Python and without ROS: see docs/python.md.

A name is imported when it is first used, so that importing the package costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cutting_trainer.session.in_process import LinkSettings, simulate
    from cutting_trainer.tissue_sim.contact.blade import Resistance
    from cutting_trainer.tissue_sim.contact.tool import indenter_contact
    from cutting_trainer.tissue_sim.elasticity.material import Material
    from cutting_trainer.tissue_sim.mesh.files import load_mesh
    from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
    from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation

__all__ = [
    'LinkSettings',
    'Material',
    'Resistance',
    'TetMesh',
    'TissueSimulation',
    'indenter_contact',
    'load_mesh',
    'simulate',
]

_MODULES = {
    'LinkSettings': 'session.in_process',
    'Material': 'tissue_sim.elasticity.material',
    'Resistance': 'tissue_sim.contact.blade',
    'TetMesh': 'tissue_sim.mesh.tetra_mesh',
    'TissueSimulation': 'tissue_sim.simulation.simulation',
    'load_mesh': 'tissue_sim.mesh.files',
    'indenter_contact': 'tissue_sim.contact.tool',
    'simulate': 'session.in_process',
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    return getattr(import_module(f'{__name__}.{_MODULES[name]}'), name)
