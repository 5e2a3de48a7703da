"""Section `tissue.budget` of a scene: the requirements on the tissue."""

from pydantic import Field, field_validator

from cutting_trainer.node_common.scene_reader import SceneModel
from cutting_trainer.tissue_sim.motion.parallel_euler import MAX_THREADS


class Budget(SceneModel):
    """Required range and accuracy of the method, and its allowed cost; `trainer plan` uses it."""

    displacement: float = Field(
        default=0.005,
        gt=0,
        le=0.5,
        description='largest displacement of the surface [m], above 0 to 0.5',
    )
    rotation: float = Field(
        default=10.0,
        ge=0,
        le=180,
        description='largest rotation of a part of the tissue [degrees], 0 to 180',
    )
    cuts: bool = Field(default=True, description='whether the tissue is cut')
    contact_radius: float = Field(
        default=0.008,
        gt=0,
        le=0.5,
        description='radius of the area that a tool loads [m], above 0 to 0.5',
    )
    error: float = Field(
        default=0.2,
        gt=0,
        le=1,
        description='largest relative error of displacement under a load [-], above 0 to 1',
    )
    cores: float = Field(
        default=0.5,
        gt=0,
        le=MAX_THREADS,
        description='share of a core that the simulation may use, up to 1, or a number of threads '
        "that compute a tissue of which 5,000 nodes or more move, by Euler's methods [-], "
        f'above 0 to {MAX_THREADS}',
    )

    @field_validator('cores')
    @classmethod
    def _check_whole(cls, cores: float) -> float:
        if cores > 1 and cores != int(cores):
            raise ValueError(
                f'{cores:g} is neither a share of a core, up to 1, nor a whole number of cores: '
                'write 1 or 2'
            )
        return cores

    @property
    def threads(self) -> int:
        """Threads that compute a frame."""
        return max(1, int(self.cores))
