"""What the section `cutting` of a scene file may say."""

from typing import Literal

from pydantic import Field

from tissue_sim.scene_file import SceneModel


class CuttingSettings(SceneModel):
    """The section `cutting`."""

    method: Literal['combined', 'combined_midpoint', 'subdivide', 'separate', 'delete'] = Field(
        default='combined',
        description='combined: cases A to H, on the swept surface; combined_midpoint: the same at '
        'midpoints; subdivide: at the true crossings only; separate: along existing faces; '
        'delete: tetrahedra that the blade meets are taken out',
    )
    tau: float | None = Field(
        default=None,
        gt=0.0,
        lt=0.5,
        description='a crossing nearer to a node than this share of its edge goes to the node; by '
        'default 0.33 for combined, 0.25 for combined_midpoint; other methods have no use for it',
    )
    altitude_floor: float = Field(
        default=0.02,
        ge=0.0,
        lt=0.2,
        description='no new element is flatter than this share of the median altitude at the start',
    )
