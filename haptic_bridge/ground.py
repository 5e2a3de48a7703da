"""The surface that the proxy moves on: the tissue's, without the dent that the tool itself makes.

A frame of the simulation tells where the dent was. At 30 Hz a proxy on the dented surface is held
back by the walls of a dent that should have moved along: sliding at 60 mm/s the force of the frames
was off by 40 % of its peak, however it was extrapolated. A frictionless tool meets no such walls.
So the surface stands still from the first touch on; the coupling spring and the tissue under it
share the depth below it by their stiffness.
"""

from haptic_bridge.surface import Surface

STILL = 1e-4
"""[m] of motion between two frames under which a tissue that was let go has recovered."""
_FRAME_RANGE = (0.01, 0.05)
"""[s] between the surfaces that a blend is spread over; frames outside are late, not slow."""
_LONGEST_RECOVERY = 0.5
"""[s] after which a tissue that still moves is followed as it is."""
_SECOND = 1e-9


class Ground:
    """Follows the tissue while the tool is free, and stands still while it presses.

    Limitations: what moves the tissue beside the tool is not seen as long as the tool presses; a
    change of connectivity then takes over the dented surface.

    Attributes:
        surface: for the proxy; None before the first.
        newest: of the tissue.
    """

    def __init__(self) -> None:
        self.surface: Surface | None = None
        self.newest: Surface | None = None
        self._newest_ns = 0
        self._frame = _FRAME_RANGE[1]
        self._dented = False
        self._free_ns: int | None = None
        self._free_revision = 0

    def follow(self, now_ns: int, surface: Surface) -> None:
        """Takes the newest surface of the tissue, in every tick."""
        if surface is not self.newest:
            shortest, longest = _FRAME_RANGE
            self._frame = min(max((now_ns - self._newest_ns) * _SECOND, shortest), longest)
            self.newest, self._newest_ns = surface, now_ns
        if self.surface is None or not self._dented or _is_another(surface, self.surface):
            self.surface = surface
        elif self._free_ns is not None and surface.revision >= self._free_revision:
            late = (now_ns - self._free_ns) * _SECOND > _LONGEST_RECOVERY
            if surface.motion < STILL or late:
                self.release()
                self.surface = surface

    def press(self) -> None:
        """The tool touches: from here on the surface has its dent."""
        self._dented = True
        self._free_ns = None

    def answered_free(self, now_ns: int, revision: int) -> None:
        """The simulation has let the tool go in a frame of a revision."""
        if self._free_ns is None:
            self._free_ns, self._free_revision = now_ns, revision

    def release(self) -> None:
        """There is no dent to wait for, as while the blade is in the tissue."""
        self._dented = False
        self._free_ns = None

    def blend(self, now_ns: int) -> float:
        """Where between its start and its end the surface is, 0 to 1."""
        if self.surface is not self.newest:
            return 1.0
        return min((now_ns - self._newest_ns) * _SECOND / self._frame, 1.0)


def _is_another(surface: Surface, known: Surface) -> bool:
    return surface.topology != known.topology or surface.revision < known.revision
