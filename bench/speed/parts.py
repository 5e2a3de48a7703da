"""Parts that `bench speed` can measure, by name: what a command line may ask for."""

from enum import StrEnum


class Part(StrEnum):
    """Parts of the trainer whose speed is measured."""

    FORCE = 'force'
    STEP = 'step'
    FRAME = 'frame'
    CUT = 'cut'
    PROXY = 'proxy'
    CODEC = 'codec'
    SESSION = 'session'
    START = 'start'
