"""The methods of cutting by the names that a scene file uses."""

from cutting.batch import Scheme
from cutting.combined import CombinedMethod
from cutting.delete import DeleteMethod
from cutting.method import CutMethod
from cutting.settings import CuttingSettings


def make_method(settings: CuttingSettings) -> CutMethod:
    """The method that the settings ask for."""
    floor = settings.altitude_floor
    match settings.method:
        case 'combined':
            return CombinedMethod(Scheme(tau=settings.tau or 0.33, floor=floor))
        case 'combined_midpoint':
            tau = settings.tau or 0.25
            return CombinedMethod(Scheme(tau=tau, floor=floor, true_points=False, slides=False))
        case 'subdivide':
            # Mor: every crossing divides its edge where it is, however near to a node.
            return CombinedMethod(Scheme(tau=0.0, floor=0.0, slides=False, least_share=1e-3))
        case 'separate':
            return CombinedMethod(
                Scheme(tau=0.5, floor=0.0, true_points=False, slides=False, subdivides=False)
            )
        case 'delete':
            return DeleteMethod()
