"""A published experiment, and what the trainer gives for it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

How = Literal['table', 'page', 'abstract', 'formula', 'computed']


@dataclass(frozen=True)
class Source:
    """Origin of a published figure.

    Attributes:
        name: authors and year.
        place: DOI or address, with table or page where it has one.
        how: what was read of it; `computed`: by quadratic elements, here.
    """

    name: str
    place: str
    how: How


@dataclass(frozen=True)
class Result:
    """One figure of the trainer beside the published one.

    Attributes:
        quantity: name of the figure, with its conditions.
        model: elastic model.
        tetrahedra: of the mesh.
        unit: of both values; '' for ratios.
        published: value of the source.
        value: value of the trainer; None: it has none, see `note`.
        error: relative error; None: no value.
        cpu: CPU time of the trainer's part [s], one thread.
        note: reason for a missing value, else ''.
    """

    quantity: str
    model: str
    tetrahedra: int
    unit: str
    published: float
    value: float | None
    error: float | None
    cpu: float
    note: str = ''

    def inside(self, tolerance: float) -> bool:
        """Return whether the error keeps a tolerance."""
        return self.error is not None and abs(self.error) <= tolerance


@dataclass(frozen=True)
class Case:
    """A published experiment that runs here.

    Attributes:
        name: word by which it is chosen.
        title: what is compared.
        sources: of the published figures.
        tolerance: largest relative error.
        tolerance_reason: origin of the tolerance.
        run: returns the results; its argument asks for the coarsest mesh alone.
    """

    name: str
    title: str
    sources: tuple[Source, ...]
    tolerance: float
    tolerance_reason: str
    run: Callable[[bool], list[Result]]


@dataclass(frozen=True)
class NotReproduced:
    """A published experiment that cannot be run here.

    Attributes:
        title: what would be compared.
        source: of the published figure.
        reason: why not.
    """

    title: str
    source: Source
    reason: str
