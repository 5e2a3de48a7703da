"""The problems at rest, one for each panel of the chart."""

from bench.accuracy.contact_problems import FootprintPress, Sliding
from bench.accuracy.problems import AfterCut, Cantilever, Indentation, LargeRotation, LargeStrain

Problem = (
    Indentation | Cantilever | LargeRotation | AfterCut | LargeStrain | FootprintPress | Sliding
)


def static_problems() -> tuple[Problem, ...]:
    """Return the problems of the panels, except free vibration and the active region."""
    return (
        Indentation(),
        FootprintPress(),
        Sliding(),
        Cantilever(0.3),
        Cantilever(0.47),
        Cantilever(0.49),
        LargeRotation(),
        AfterCut(),
        LargeStrain('punch 10 %'),
        LargeStrain('press 30 %'),
    )
