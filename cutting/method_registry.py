"""Cutting methods by their names in a scene file."""

from cutting_trainer.cutting.batch import Scheme
from cutting_trainer.cutting.combined import CombinedMethod
from cutting_trainer.cutting.delete import DeleteMethod
from cutting_trainer.cutting.method_interface import CutMethod
from cutting_trainer.cutting.scene_schema import CuttingSettings


def make_method(settings: CuttingSettings) -> CutMethod:
    """Return the method of some settings."""
    floor = settings.altitude_floor
    match settings.method:
        case 'combined':
            return CombinedMethod(Scheme(tau=settings.tau or 0.33, floor=floor, leads_on=True))
        case 'combined_midpoint':
            tau = settings.tau or 0.25
            return CombinedMethod(Scheme(tau=tau, floor=floor, true_points=False, slides=False))
        case 'subdivide':
            # Mor: every crossing divides its edge in place, even close to a node.
            return CombinedMethod(Scheme(tau=0.0, floor=0.0, slides=False, least_share=1e-3))
        case 'separate':
            return CombinedMethod(
                Scheme(tau=0.5, floor=0.0, true_points=False, slides=False, subdivides=False)
            )
        case 'delete':
            return DeleteMethod()
