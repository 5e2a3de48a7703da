"""Section `tissue.budget` of a scene: the requirements on the tissue."""

from pydantic import Field

from cutting_trainer.node_common.scene_reader import SceneModel


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
        le=1,
        description='share of a core that the simulation may use [-], above 0 to 1; it runs on one',
    )
