"""Governor of the frame rate: what the tissue concedes while frames come late.

The shares of nodes are `SHARES` in `motion/far_field.py`.
"""

from collections import deque

_WINDOW = 30
"""Frames in which missed deadlines are counted."""
_TOLERATED = 2
"""Missed deadlines among these at which nothing is conceded: a stall of the machine is no load."""
_CALM = 150
"""Frames in time after which a concession may be taken back."""
_GROWTH = 1.5
"""Largest ratio of the costs of a frame with one concession less and with it."""


class Governor:
    """Decides how many concessions a tissue makes to keep its frame rate.

    A concession touches neither what is near a tool, nor a message, nor the force in the hand's
    loop: fewer nodes of a far field move on their own (`FarField.concede`). Meshes are no
    concession: the hand's loop touches the surface that they carry. A tissue whose nodes all move
    has nothing to concede, and its frames are missed.

    Args:
        period: of a frame [s].
        possible: greatest number of concessions.

    Attributes:
        concession: for the next frame.
    """

    def __init__(self, period: float, possible: int) -> None:
        self.concession = 0
        self._period = period
        self._possible = possible
        self._missed: deque[bool] = deque(maxlen=_WINDOW)
        self._spent: deque[float] = deque(maxlen=_CALM)

    def follow(self, spent: float, late: float) -> None:
        """Decide by the newest frame.

        Args:
            spent: time that it took [s].
            late: time from its deadline to its beginning [s].
        """
        missed = late >= self._period
        self._missed.append(missed)
        self._spent.append(spent)
        if sum(self._missed) > _TOLERATED and self.concession < self._possible:
            self._change(1)
        elif missed:
            self._spent.clear()
        elif self.concession and self._has_room():
            self._change(-1)

    def _has_room(self) -> bool:
        """Return whether frames have been short enough for long enough.

        As many may be too long as missed deadlines are tolerated.
        """
        if len(self._spent) < _CALM:
            return False
        long = sorted(self._spent)[-1 - _TOLERATED * _CALM // _WINDOW]
        return long * _GROWTH < self._period

    def _change(self, by: int) -> None:
        """Change the concession; what was seen with the one before says nothing about it."""
        self.concession += by
        self._missed.clear()
        self._spent.clear()
