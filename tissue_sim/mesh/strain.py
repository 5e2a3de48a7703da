"""Strain of a frame, where the stiffening law counts."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Strain:
    """Strain of the points where the law counts, and what it takes.

    Attributes:
        domains, elements: number of smoothing domains and of elements where the law counts.
        ratio: least and largest volume ratio J of these domains.
        stretch: their least and largest principal stretch.
        heavier: number of nodes integrated with more mass.
        added: this mass, relative to the tissue's.
        beyond: where the tissue is strained beyond the law's range, as a sentence; '': nowhere.
    """

    domains: int
    elements: int
    ratio: tuple[float, float]
    stretch: tuple[float, float]
    heavier: int
    added: float
    beyond: str
