"""State of the cutting service, its stroke and its mesh, to continue from."""

from dataclasses import dataclass

from cutting_trainer.cutting import batch, combined, delete, lookup, stroke_state_check
from cutting_trainer.cutting.method_interface import CutMethod
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.simulation.serialisation import (
    ObjectState,
    capture,
    classes_of,
    rebuild,
)
from cutting_trainer.tissue_sim.simulation.state import MESH_CLASSES, smallest_mesh
from cutting_trainer.tissue_sim.simulation.state_checks import check_mesh, checked


@dataclass
class MethodState:
    """All that the next cut depends on, beside its sweep.

    Attributes:
        method: of cutting, within a stroke or not.
        mesh: to which the next change applies.
    """

    method: CutMethod
    mesh: TetMesh

    def state(self) -> ObjectState:
        """Return the serialised state."""
        return capture(self, _CLASSES)


_CLASSES = {
    **MESH_CLASSES,
    **classes_of((batch, combined, delete, lookup)),
    f'{__name__}.MethodState': MethodState,
}


def from_state(state: ObjectState, method: CutMethod) -> MethodState:
    """Return the method and mesh of a serialised state.

    Args:
        state: as returned by `MethodState.state`.
        method: of cutting in the session's scene.

    Raises:
        StateError: the state is not valid, or is of another version.
    """
    restored: MethodState = rebuild(state, _CLASSES, MethodState(method, smallest_mesh()))
    checked(_check, restored)
    return restored


def _check(memory: MethodState) -> None:
    check_mesh(memory.mesh)
    if isinstance(memory.method, combined.CombinedMethod):
        stroke_state_check.check_combined(memory.method, memory.mesh)
