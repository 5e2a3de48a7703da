"""Figures of the contact: the force of a sphere against quadratic elements, whatever the mesh."""

import math

from bench.accuracy.footprint import BLOCK, CELLS, MATERIAL, Press, block, sliding_ratio
from bench.accuracy.sphere_contact import Layer, SphereOnLayer, sneddon, thickness_factor
from bench.figures.figure import Figure

RADII = (0.004, 0.008)
"""[m]"""
DEPTHS = (0.001, 0.002, 0.003)
"""[m]"""
PLACE = (0.052, 0.049)
"""[m] x and y of the tool."""
_SLIDES = 16
_LAYER = Layer(
    BLOCK[2],
    math.sqrt(BLOCK[0] * BLOCK[1] / math.pi),
    MATERIAL.youngs_modulus,
    MATERIAL.poissons_ratio,
)


def measure() -> list[Figure]:
    """Return the figures of line 1."""
    presses = {edge: Press(block(cells)) for edge, cells in CELLS.items()}
    spread, small, large = [], [], []
    for radius in RADII:
        reference = SphereOnLayer(_LAYER, radius, radius / 5, large=True)
        exact = [reference.force(depth, 3) for depth in DEPTHS]
        forces = {edge: press.forces(PLACE, radius, DEPTHS[1:2]) for edge, press in presses.items()}
        known = [*(float(force[0]) for force in forces.values()), exact[1]]
        spread.append(max(known) / min(known) - 1)
        found = presses[6.2].forces(PLACE, radius, DEPTHS)
        published = sneddon(_LAYER, radius, DEPTHS[0])
        published *= thickness_factor(_LAYER, radius, DEPTHS[0])
        small.append(abs(float(found[0]) / published - 1))
        large += [abs(float(found[i]) / exact[i] - 1) for i in (1, 2)]
    edges = ', '.join(f'{edge:g}' for edge in CELLS)
    name = f'stiffness at 2 mm, edges of {edges} mm and quadratic: greatest over least, less 1'
    slide = sliding_ratio(presses[6.2], _SLIDES)
    return [
        Figure(1, name, max(spread), 0.10, 'at most', '', len(RADII) * (len(CELLS) + 1)),
        Figure(1, 'force sliding, greatest over least', slide, 1.10, 'at most', '', _SLIDES),
        Figure(1, "off Sneddon's sphere at 1 mm", max(small), 0.07, 'at most', '', len(small)),
        Figure(
            1, 'off quadratic contact at 2 and 3 mm', max(large), 0.07, 'at most', '', len(large)
        ),
    ]
