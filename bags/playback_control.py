"""Control of a replay: pause, steps, speed, and at the end of the bag a stop or a loop."""

STEP_S = 1 / 30
"""[s] of the session per step: a frame of the simulation."""


class Playhead:
    """Position of a replay in the session.

    Args:
        start: [s] from the beginning of the session.
        end: [s]; with `loop` it continues from `start` there.
        rate: seconds of the session in one second.
        loop: begin again at the end.

    Attributes:
        paused: it stands still.
        rounds: number of repetitions.
        rate: seconds of the session in one second; may be changed.
    """

    def __init__(self, start: float, end: float, *, rate: float = 1.0, loop: bool = False) -> None:
        self.paused = True
        self.rounds = 0
        self._start, self._end = start, end
        self.rate, self._loop = rate, loop
        self._position = start
        self._since: float | None = None

    @property
    def position(self) -> float:
        """Return the position at the last move [s]."""
        return self._position

    @property
    def over(self) -> bool:
        """Return whether the end has been reached for good."""
        return not self._loop and self._position >= self._end

    def move(self, now: float) -> float:
        """Advance to a time of the caller's clock [s]; return the position [s]."""
        if not self.paused and self._since is not None:
            self._position += (now - self._since) * self.rate
        self._since = now
        if self._position >= self._end:
            self.rounds += self._loop
            self._position = self._start if self._loop else self._end
        return self._position

    def go(self) -> None:
        """Resume."""
        self.paused = False

    def toggle(self) -> None:
        """Pause or resume."""
        self.paused = not self.paused

    def seek(self, position: float) -> None:
        """Go to a position [s]."""
        self._position = min(max(position, self._start), self._end)

    def step(self) -> None:
        """Pause, one frame further on."""
        self.paused = True
        self._position += STEP_S
