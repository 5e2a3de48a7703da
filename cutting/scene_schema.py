"""Section `cutting` of a scene file."""

from typing import Literal

from pydantic import Field

from cutting_trainer.node_common.scene_reader import SceneModel


class CuttingSettings(SceneModel):
    """Section `cutting` of a scene."""

    method: Literal['combined', 'combined_midpoint', 'subdivide', 'separate', 'delete'] = Field(
        default='combined',
        description='combined: cases A to H, on the swept surface; combined_midpoint: the same at '
        'midpoints; subdivide: at the true crossings only; separate: along existing faces; '
        'delete: touched tetrahedra are removed',
    )
    tau: float | None = Field(
        default=None,
        gt=0.0,
        lt=0.5,
        description='a crossing nearer to a node than this share of its edge goes to the node; by '
        'default 0.33 for combined, 0.25 for combined_midpoint; others ignore it',
    )
    altitude_floor: float = Field(
        default=0.02,
        ge=0.0,
        lt=0.2,
        description='no new element is flatter than this share of the median altitude at the start',
    )
