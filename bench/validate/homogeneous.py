"""Published curves of the law: a cube in a homogeneous, isochoric deformation."""

import time
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from bench.common.meshes import kuhn_block
from bench.validate.case import Result
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import MODELS, ElasticModel, ModelName

Floats = NDArray[np.float64]

STIFFENING = 6.0
"""b with which a blade cuts liver; not fitted to these curves."""
FAT_SHEAR, FAT_EXPONENT = 748.5, -1.18
"""Shear modulus of fat under compression, 748.5 C^-1.18 Pa, C the square of the stretch."""
FAT_STRETCHES = (0.9, 0.8)
LIVER_E, LIVER_STRAIN, LIVER_STRESS = 5400.0, 0.38, 0.27e6
"""Young's modulus [Pa], ultimate true strain and ultimate stress [Pa] of liver."""
_CELLS, _SIDE, _STEP = (2, 2, 2), 0.01, 1e-3


class Cube:
    """A cube of tetrahedra that is deformed as a whole.

    Args:
        model: elastic model.
        youngs_modulus: [Pa].
    """

    def __init__(self, model: ModelName, youngs_modulus: float) -> None:
        mesh = kuhn_block(_CELLS, (_SIDE,) * 3)
        material = Material(youngs_modulus, 0.45, 1060.0, stiffening=STIFFENING)
        self._model = ElasticModel(mesh, material, model)
        self._rest = mesh.rest
        self.tetrahedra = len(mesh.tetrahedra)

    def power(self, gradient: Floats, rate: Floats) -> float:
        """Return the first Piola-Kirchhoff stress times a rate of the gradient [Pa]."""
        force = self._model.force(self._rest @ (gradient - np.eye(3)).T)
        return float((force * (self._rest @ rate.T)).sum()) / _SIDE**3

    def tension(self, stretch: float) -> float:
        """Return the true stress of an incompressible bar [Pa]."""
        gradient = np.diag([stretch, stretch**-0.5, stretch**-0.5])
        rate = np.diag([1.0, -0.5 * stretch**-1.5, -0.5 * stretch**-1.5])
        return stretch * self.power(gradient, rate)

    def shear(self, stretch: float) -> float:
        """Return the modulus of small shear waves under uniaxial stretch, mean of the axes [Pa]."""
        gradient = np.diag([stretch, stretch**-0.5, stretch**-0.5])
        found = []
        for m, n in permutations(range(3), 2):
            slide = np.zeros((3, 3))
            slide[m, n] = 1.0
            rate = slide @ gradient
            ends = [self.power(gradient + s * rate, rate) for s in (-_STEP, _STEP)]
            found.append((ends[1] - ends[0]) / (2 * _STEP))
        return float(np.mean(found))


def run_fat(quick: bool) -> list[Result]:
    """Return the rise of the shear modulus of fat under compression."""
    results = []
    for model in MODELS:
        for stretch in FAT_STRETCHES:
            start = time.thread_time()
            cube = Cube(model, 3 * FAT_SHEAR)
            found = cube.shear(stretch) / cube.shear(1.0)
            cpu = time.thread_time() - start
            exact = stretch ** (2 * FAT_EXPONENT)
            name = f'shear modulus over the first, compressed by {100 * (1 - stretch):.0f} %'
            error = found / exact - 1
            results.append(Result(name, model, cube.tetrahedra, '', exact, found, error, cpu))
    return results


def run_liver(quick: bool) -> list[Result]:
    """Return the stress of liver at its ultimate strain."""
    results = []
    for model in MODELS:
        start = time.thread_time()
        cube = Cube(model, LIVER_E)
        found = cube.tension(float(np.exp(LIVER_STRAIN))) / 1e3
        cpu = time.thread_time() - start
        exact = LIVER_STRESS / 1e3
        name = f'true stress at a true strain of {LIVER_STRAIN:g}'
        error = found / exact - 1
        results.append(Result(name, model, cube.tetrahedra, 'kPa', exact, found, error, cpu))
    return results
