"""Proxy of finite radius on a deforming surface (Ruspini, Kolarov and Khatib 1997).

The proxy is the centre of a sphere that follows the device but stays outside of the tissue.
Ruspini's sweep against rounded triangles is replaced: each triangle nearby gives a half-space at a
distance of the radius. The proxy moves straight to the point of their intersection that is
closest to the device, and searches again from there. A straight path inside a convex set that no
triangle enters cannot tunnel, whatever the step.
"""

import math

import numpy as np

from cutting_trainer.haptic_bridge.proxy.friction import make_stick
from cutting_trainer.haptic_bridge.proxy.kernels import STATE
from cutting_trainer.haptic_bridge.proxy.step import ANOTHER, NEXT, SAME, detach_alone, move_alone
from cutting_trainer.haptic_bridge.proxy.surface import NO_GEOMETRY, Geometry, Surface
from cutting_trainer.tissue_sim.contact.friction import NO_FRICTION

Way = tuple[Geometry, float, Geometry, float, int, float, float]
"""Surface, known surface, their relation and the blends, as `step.move` takes them."""
NO_WAY: Way = (NO_GEOMETRY, 0.0, NO_GEOMETRY, 0.0, ANOTHER, 0.0, 0.0)
"""Where the proxy does not move."""


class Touch:
    """Contact of a tool with the surface; the arrays are read-only views of the newest result.

    Attributes:
        position: centre of the sphere [m], shape (3,).
        contact: mean of the touched points, by load [m], shape (3,).
        normal: unit vector from the device to the centre: where the surface pushes, shape (3,).
        nodes: of up to three touched triangles, most loaded first, shape (9,); arbitrary
            number where the weight is 0.
        weights: share of each in the load: barycentric in a triangle, times the share of the
            triangle; not negative, sum 1 in all; 0 where unused, shape (9,).

    Where nothing is touched, contact to weights are those of the nearest point; all weights are 0
    if there is none.
        valid: False where the last input was not finite; nothing has changed then.
        state: for compiled functions, dtype STATE, shape (1,).
    """

    position: np.ndarray
    contact: np.ndarray
    normal: np.ndarray
    nodes: np.ndarray
    weights: np.ndarray

    def __init__(self, state: np.ndarray) -> None:
        self.state = state
        for name in ('position', 'contact', 'normal', 'nodes', 'weights'):
            view = state[name][0]
            view.flags.writeable = False
            setattr(self, name, view)
        self.valid = True

    @property
    def touching(self) -> bool:
        """Return whether the surface holds the proxy back."""
        return bool(self.state['touching'][0])

    @property
    def depth(self) -> float:
        """Return the distance of device and proxy [m]."""
        return float(self.state['depth'][0])


class Proxy:
    """The sphere that follows the device outside of the tissue.

    Limitations: in a gap narrower than the sphere, both cut faces are violated alike. A surface
    whose revisions were missed may have passed over the proxy; it then comes out at the nearest
    point.

    Args:
        radius: of the sphere [m].
        stick: its friction, record of `friction.STICK`, shape (1,); None: it has none.

    Attributes:
        touch: newest result.

    Raises:
        ValueError: the radius is not a positive length.
    """

    def __init__(self, radius: float, stick: np.ndarray | None = None) -> None:
        if not (math.isfinite(radius) and radius > 0):
            raise ValueError(f'proxy: the radius is {radius} m, it must be positive')
        self.radius = radius
        self._state = np.zeros(1, STATE)
        self._stick = make_stick(NO_FRICTION) if stick is None else stick
        self._device = np.zeros(3)
        self._surface: Surface | None = None
        self._blend = 0.0
        self.touch = Touch(self._state)

    @property
    def place(self) -> np.ndarray:
        """The centre of the sphere less its offset: from the tip, its depth leads there."""
        place: np.ndarray = self.touch.position - self._stick['offset'][0]
        return place

    def reset(self) -> None:
        """Detach from the surface, as during a cut: the next step starts at the device.

        If the device is inside the tissue then, the proxy comes out at the nearest point of the
        surface, however deep: the caller must ramp the force. The next touch sticks where it
        happens.
        """
        detach_alone(self._state, self._stick)

    def step(self, surface: Surface, blend: float, device: np.ndarray) -> Touch:
        """Move the proxy towards the device.

        Args:
            surface: the newest.
            blend: where between its start and its end the surface is, 0 to 1.
            device: tool tip [m], shape (3,).

        Returns:
            `touch`.
        """
        self._device[:] = device
        self.touch.valid = all(map(math.isfinite, (blend, *self._device.tolist())))
        if self.touch.valid:
            way = self.way_to(surface, min(max(float(blend), 0.0), 1.0))
            move_alone(*way, self._device, self.radius, self._state, self._stick)
        return self.touch

    def way_to(self, surface: Surface, blend: float) -> Way:
        """Return how the surface comes from that of the last step, which it is from now on.

        Args:
            surface, blend: as of `step`.

        Returns:
            First arguments of `step.move`, which must follow.
        """
        known, before = self._surface, self._blend
        self._surface, self._blend = surface, blend
        if surface is known:
            relation = SAME
        else:
            relation = NEXT if surface.continues(known) else ANOTHER
            known = known or surface
        return (
            surface.geometry,
            surface.motion,
            known.geometry,
            known.motion,
            relation,
            before,
            blend,
        )
