"""Problems of the chart with a tool: a sphere presses and slides on a block of scattered nodes."""

from dataclasses import replace
from functools import cached_property

import numpy as np

from bench.accuracy.footprint import BLOCK, MATERIAL, Press, block, sliding_ratio
from bench.accuracy.problems import ALPHA, BETA, Errors, Rest
from bench.accuracy.sphere_contact import Layer, SphereOnLayer
from cutting_trainer.tissue_sim.elasticity.models import ModelName

_CELLS = {4: (11, 11, 4), 7: (16, 16, 7), 9: (20, 20, 9)}
"""Bricks of the block along each axis, by those over its height."""
_SEED = 1
_RADIUS, _DEPTH = 0.004, 0.003
_PLACE = (0.052, 0.049)
_AROUND = np.array([0.7, 0.8, 0.9, 1.0, 1.1])
"""Depths of a force-depth curve, in shares of the charted one."""


class _OnBlock:
    """A sphere of 4 mm, 3 mm deep; the law of the footprint is linear elasticity's."""

    resolutions = tuple(_CELLS)
    models: tuple[ModelName, ...] = ('linear', 'linear_smoothed')

    def press(self, model: ModelName, resolution: int) -> Press:
        damped = replace(MATERIAL, alpha=ALPHA, beta=BETA)
        return Press(block(_CELLS[resolution], _SEED), model=model, material=damped)


class FootprintPress(_OnBlock):
    """The sphere presses: its depth under a force, and its force at a depth."""

    name = 'footprint'
    title = 'A sphere of radius 4 mm presses 3 mm deep, scattered nodes, ν 0.45'
    reference_name = 'scikit-fem, quadratic triangles of a round layer'

    @cached_property
    def reference(self) -> float:
        """Force at the depth [N]."""
        width = float(np.sqrt(BLOCK[0] * BLOCK[1] / np.pi))
        layer = Layer(BLOCK[2], width, MATERIAL.youngs_modulus, MATERIAL.poissons_ratio)
        return SphereOnLayer(layer, _RADIUS, _RADIUS / 8, large=False).force(_DEPTH)

    def rest(self, model: ModelName, resolution: int) -> Rest:
        """Return the block, with so many bricks over its height, under the sphere."""
        press = self.press(model, resolution)
        depths = _DEPTH * _AROUND
        forces = press.forces(_PLACE, _RADIUS, depths.tolist())
        force = np.interp(_DEPTH, depths, forces)
        depth = np.exp(np.interp(np.log(self.reference), np.log(forces), np.log(depths)))
        errors = Errors(abs(depth / _DEPTH - 1), abs(force / self.reference - 1))
        return Rest(press.model, press.displacement(_PLACE, _RADIUS, _DEPTH), errors)


class Sliding(_OnBlock):
    """The sphere along 3 cm of a block that is the same everywhere: the force's ripple."""

    name = 'sliding'
    title = 'The same at 16 places along 3 cm: greatest over least force, less 1'
    reference_name = 'a force without ripple'

    def rest(self, model: ModelName, resolution: int) -> Rest:
        """Return the block, with so many bricks over its height, and greatest over least less 1."""
        press = self.press(model, resolution)
        ripple = sliding_ratio(press) - 1.0
        dent = press.displacement(_PLACE, _RADIUS, _DEPTH)
        return Rest(press.model, dent, Errors(ripple, ripple))
