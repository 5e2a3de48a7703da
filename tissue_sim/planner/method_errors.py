"""Errors of a method on a scene, from the trial loads on its mesh."""

import math
from dataclasses import replace

import numpy as np

from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import ModelName
from cutting_trainer.tissue_sim.motion.integrators import IntegratorName
from cutting_trainer.tissue_sim.planner.budget import Budget
from cutting_trainer.tissue_sim.planner.candidate import ErrorEstimate
from cutting_trainer.tissue_sim.planner.mesh_errors import Probing

MARGIN = 1.25
"""Safety factor on errors found at a few places: others may be worse."""
_HAND = 2 * math.pi
"""Frequency of a palpating hand [rad/s]."""


def model_errors(model: ModelName, probing: Probing, budget: Budget) -> ErrorEstimate:
    """Return the errors of a model, independent of the integrator.

    A linear model has a strain of cos(theta) - 1 in an undeformed element that rotates by theta.
    """
    at_rest = errors_at_rest(model, probing, budget)
    enough = (budget.error - at_rest.total) / MARGIN
    return replace(at_rest, strain=MARGIN * probing.strains.error(model, enough))


def errors_at_rest(model: ModelName, probing: Probing, budget: Budget) -> ErrorEstimate:
    """Return the errors known before any deep indentation; strain is 0."""
    elements = MARGIN * probing.elements[model not in ('linear', 'corotational')]
    turned = 1 - math.cos(math.radians(budget.rotation)) if model.startswith('linear') else 0.0
    return ErrorEstimate(elements, turned, 0.0, contact=MARGIN * probing.contact)


def time_error(
    integrator: IntegratorName, material: Material, frequency: float, step: float
) -> float:
    """Return the relative error of the slowest motion in response to a hand that moves at 1 Hz.

    It is the error of the discrete transfer function of u'' + c u' + omega^2 u = omega^2 f.

    Args:
        integrator: name.
        material: only its damping counts.
        frequency: of the slowest motion [rad/s].
        step: [s].
    """
    c = material.alpha + material.beta * frequency**2
    z = np.exp(1j * _HAND * step)
    ahead, behind = (z - 1) / step, (1 - 1 / z) / step
    rate, acceleration = {
        'euler': (ahead, ahead * ahead),
        'symplectic_euler': (behind, ahead * behind),
        'rk4': (1j * _HAND, -(_HAND**2)),
        'implicit': (behind, behind * behind),
    }[integrator]
    exact = frequency**2 - _HAND**2 + 1j * c * _HAND
    return float(abs(exact / (acceleration + c * rate + frequency**2) - 1))
