"""Cases for which a claim is tried, of all combinations of some values.

Of models and integrators, `./trainer test` tries each model by the implicit integrator, which takes
its stiffness, and by one explicit integrator, which takes its force. `--all` tries every pair.
"""

from collections.abc import Iterable
from itertools import product
from typing import Any

import pytest

from cutting_trainer.tissue_sim.elasticity.models import MODELS
from cutting_trainer.tissue_sim.motion.integrators import IntegratorName

EXPLICIT: tuple[IntegratorName, ...] = ('euler', 'rk4', 'symplectic_euler')
"""In the order by which the stiffening model is tried with the integrator of the shipped scenes."""


def thinned(*axes: Iterable[Any]) -> list[Any]:
    """Return a product of which every third case, with each pair of values, is not `thorough`.

    Args:
        axes: values; one of the axes at least has three.
    """
    numbered = product(*(list(enumerate(axis)) for axis in axes))
    return [
        pytest.param(
            *(value for _, value in case),
            marks=pytest.mark.thorough if sum(at for at, _ in case) % 3 else (),
        )
        for case in numbered
    ]


every_explicit_pair = pytest.mark.parametrize(('name', 'integrator'), thinned(MODELS, EXPLICIT))
every_pair = pytest.mark.parametrize(
    ('name', 'integrator'),
    [*thinned(MODELS, EXPLICIT), *((name, 'implicit') for name in MODELS)],
)
