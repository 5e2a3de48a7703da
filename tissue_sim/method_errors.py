"""What a method gets wrong on a scene, from what probing its mesh came to."""

import math
from dataclasses import replace

import numpy as np

from tissue_sim.budget import Budget
from tissue_sim.candidate import Errors
from tissue_sim.elasticity import ModelName
from tissue_sim.integrators import IntegratorName
from tissue_sim.material import Material
from tissue_sim.probe import Probing

MARGIN = 1.25
"""What errors that were found at a few places are multiplied by: others may be worse."""
_HAND = 2 * math.pi
"""Frequency of a hand that palpates [rad/s]."""


def model_errors(model: ModelName, probing: Probing, budget: Budget) -> Errors:
    """What a model gets wrong whatever the integrator.

    An element that turns by theta without deformation feels a strain of cos(theta) - 1 in a linear
    model.
    """
    at_rest = errors_at_rest(model, probing, budget)
    strains = probing.strains
    rotating = model.startswith('corotational')
    return replace(at_rest, strain=MARGIN * (strains.rotating if rotating else strains.linear))


def errors_at_rest(model: ModelName, probing: Probing, budget: Budget) -> Errors:
    """The part of it that is known before anything has been pressed deep; strain is 0."""
    elements = MARGIN * probing.elements[model.endswith('_smoothed')]
    if model.startswith('corotational'):
        return Errors(elements, 0.0, 0.0)
    return Errors(elements, 1 - math.cos(math.radians(budget.rotation)), 0.0)


def time_error(
    integrator: IntegratorName, material: Material, frequency: float, step: float
) -> float:
    """Relative error of the answer of the slowest motion to a hand that moves at 1 Hz.

    That of the discrete transfer function of u'' + c u' + omega^2 u = omega^2 f.

    Args:
        integrator: which one.
        material: its damping counts.
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
