"""Calls every kernel of cutting once, so that none is compiled or loaded in a stroke."""

from itertools import pairwise

import numpy as np

from cutting.methods import make_method
from cutting.settings import CuttingSettings
from tissue_sim.blade import Sweep
from tissue_sim.warm_up import small_cube


def warm_up(settings: CuttingSettings) -> None:
    """Draws a blade through a cube by the method of some settings."""
    mesh = small_cube()
    method = make_method(settings)
    x = np.array([-0.001, 0.004, 0.007, 0.011])
    for before, after in pairwise(x):
        edge = [np.array([at, 0.0052, z]) for at in (before, after) for z in (0.012, 0.004)]
        result = method.advance(mesh, mesh.rest, Sweep(*edge))
        if not result.delta.empty:
            mesh.apply(result.delta)
    method.finish(mesh, mesh.rest)
