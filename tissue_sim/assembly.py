"""From the scene's section `tissue` to the simulation of it."""

from tissue_sim.active_region import ActiveSettings
from tissue_sim.blade import Resistance
from tissue_sim.dynamics import TimeStepping
from tissue_sim.material import Material
from tissue_sim.mesh import TetMesh
from tissue_sim.mesh_io import load_tissue
from tissue_sim.settings import TissueSettings
from tissue_sim.simulation import TissueSimulation


def make_simulation(settings: TissueSettings) -> TissueSimulation:
    """The simulation that a scene describes.

    Args:
        settings: its section `tissue`.

    Raises:
        MeshError: the mesh cannot be used.
    """
    nodes, tetrahedra, fixed = load_tissue(settings)
    m, d = settings.material, settings.damping
    return TissueSimulation(
        TetMesh(nodes, tetrahedra, fixed),
        Material(m.youngs_modulus, m.poissons_ratio, m.density, d.alpha, d.beta),
        Resistance(settings.cut_threshold, m.toughness, m.blade_friction),
        model=settings.model,
        stepping=TimeStepping(
            settings.integrator,
            rate=settings.integration.rate,
            safety=settings.integration.safety,
            min_substeps=settings.integration.min_substeps,
            max_substeps=settings.integration.max_substeps,
            frequency_growth=settings.integration.frequency_growth,
        ),
        active=ActiveSettings(**settings.active_region.model_dump()),
        stretch=settings.stretch,
    )
