"""Coupling spring between device and proxy: its stiffness in a scene, and its force."""

from typing import Annotated

import numpy as np
from pydantic import Field

from cutting_trainer.node_common.kernels import inner, kernel

DEFAULT_STIFFNESS_N_M = 200.0
Stiffness = Annotated[
    float, Field(ge=1, le=10_000, description='[N/m] of the spring between device and proxy')
]
"""Key `tool.coupling_stiffness` of a scene."""


@kernel(nogil=True)
def surface_stiffness(stiffness: np.ndarray, largest: float) -> float:
    """Return k of a frictionless contact K = k n n^T - n g^T, g along the surface [N/m].

    `largest` if it is unknown. The normal may rotate along the path; k stays the same.
    """
    k = stiffness[0, 0] + stiffness[1, 1] + stiffness[2, 2]
    return k if 0.0 < k < largest else largest


@inner
def spring_force(
    tissue: np.ndarray, coupling: float, tip: np.ndarray, proxy: np.ndarray, out: np.ndarray
) -> None:
    """Compute the force on the tissue: of the spring, in series with the tissue where it is known.

    Args:
        tissue: stiffness of contact and spring in series [N/m], shape (3, 3); zero: unknown.
        coupling: stiffness of the spring [N/m].
        tip: of the device [m], shape (3,).
        proxy: on the undented surface [m], shape (3,).
        out: [N], shape (3,).
    """
    for k in range(3):
        out[k] = surface_stiffness(tissue, coupling)
        out[k] *= tip[k] - proxy[k]
