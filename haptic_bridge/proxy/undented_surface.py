"""The undented surface on which the proxy moves: the tissue's, without the tool's indentation.

Each frame of the simulation shows the indentation at an earlier place of the tool. At 30 Hz, a
proxy on the indented surface is held back by walls that should have moved along: sliding at
60 mm/s, the force of the frames was off by 40 % of its peak, with every extrapolation. A
frictionless tool meets no such walls. Therefore the surface stands still from the first touch on;
the coupling spring and the tissue under it share the depth below it by their stiffness.
"""

from cutting_trainer.haptic_bridge.proxy.surface import Surface

RECOVERED_MOTION_M = 1e-4
"""[m] Motion between two frames below which a released tissue counts as recovered."""
_BLEND_RANGE_S = (0.01, 0.05)
"""[s] between the surfaces that a blend spans; frames outside are late, not slow."""
_RECOVERY_TIMEOUT_S = 0.5
"""[s] after which a tissue that still moves is followed as it is."""
_SECOND = 1e-9


class UndentedSurface:
    """Follows the tissue while the tool is free, and stands still while it touches.

    Limitations: motion of the tissue beside the tool is ignored as long as the tool touches; a
    change of connectivity then takes over the indented surface.

    Attributes:
        surface: for the proxy; None before the first.
        newest: of the tissue.
    """

    def __init__(self) -> None:
        self.surface: Surface | None = None
        self.newest: Surface | None = None
        self._newest_ns = 0
        self._frame = _BLEND_RANGE_S[1]
        self._dented = False
        self._free_ns: int | None = None
        self._free_revision = 0

    def follow(self, now_ns: int, surface: Surface) -> None:
        """Store the newest surface of the tissue, in every tick."""
        if surface is not self.newest:
            shortest, longest = _BLEND_RANGE_S
            self._frame = min(max((now_ns - self._newest_ns) * _SECOND, shortest), longest)
            self.newest, self._newest_ns = surface, now_ns
        if self.surface is None or not self._dented or _is_another(surface, self.surface):
            self.surface = surface
        elif self._free_ns is not None and surface.revision >= self._free_revision:
            late = (now_ns - self._free_ns) * _SECOND > _RECOVERY_TIMEOUT_S
            if surface.motion < RECOVERED_MOTION_M or late:
                self.release()
                self.surface = surface

    def freeze(self) -> None:
        """Freeze the surface: the tool touches, and later surfaces are indented."""
        self._dented = True
        self._free_ns = None

    def note_free(self, now_ns: int, revision: int) -> None:
        """Record that the simulation reports a free tool in a frame of a revision."""
        if self._free_ns is None:
            self._free_ns, self._free_revision = now_ns, revision

    def release(self) -> None:
        """Follow the tissue at once, without recovery, as while the blade is in the tissue."""
        self._dented = False
        self._free_ns = None

    def blend(self, now_ns: int) -> float:
        """Return the position of the surface between its start and its end, 0 to 1."""
        if self.surface is not self.newest:
            return 1.0
        return min((now_ns - self._newest_ns) * _SECOND / self._frame, 1.0)


def _is_another(surface: Surface, known: Surface) -> bool:
    return surface.topology != known.topology or surface.revision < known.revision
