"""Proxy of finite radius on a deforming surface (Ruspini, Kolarov and Khatib 1997).

The proxy is the centre of a sphere that goes where the device goes but stays outside of the tissue.
Instead of a sweep against rounded triangles, each triangle nearby gives a half-space that it does
not reach to within the radius; the proxy goes straight to the point of their intersection that is
closest to the device, and looks again from there. A straight way inside a convex set that no
triangle enters cannot tunnel, whatever the step.
"""

import math

import numpy as np

from haptic_bridge.proxy_kernels import STATE, carry, follow_device
from haptic_bridge.surface import Surface


class Touch:
    """What a tool finds on the surface; the arrays are read-only views of the newest result.

    Attributes:
        position: centre of the sphere [m], shape (3,).
        contact: mean of the touched points, by load [m], shape (3,).
        normal: unit vector from the device to the centre: where the surface pushes, shape (3,).
        nodes: of up to three touched triangles, most loaded first, shape (9,); any
            number where the weight is 0.
        weights: share of each in the load: barycentric in a triangle, times the share of the
            triangle; not negative, sum 1 in all; 0 where unused, shape (9,).

    Where nothing is touched, contact to weights are those of the nearest point; all weights are 0
    if there is none.
        valid: False where the last input was not finite; nothing has changed then.
    """

    position: np.ndarray
    contact: np.ndarray
    normal: np.ndarray
    nodes: np.ndarray
    weights: np.ndarray

    def __init__(self, state: np.ndarray) -> None:
        self._state = state
        for name in ('position', 'contact', 'normal', 'nodes', 'weights'):
            view = state[name][0]
            view.flags.writeable = False
            setattr(self, name, view)
        self.valid = True

    @property
    def touching(self) -> bool:
        """Whether the surface holds the proxy back."""
        return bool(self._state['touching'][0])

    @property
    def depth(self) -> float:
        """Distance of device and proxy [m]."""
        return float(self._state['depth'][0])


class Proxy:
    """A sphere between device and tissue.

    Limitations: in a gap narrower than the sphere, both lips are violated alike. A surface of which
    revisions were missed may have passed over the proxy; it then comes out at the nearest point.

    Args:
        radius: of the sphere [m].

    Attributes:
        touch: newest result.

    Raises:
        ValueError: the radius is not a positive length.
    """

    def __init__(self, radius: float) -> None:
        if not (math.isfinite(radius) and radius > 0):
            raise ValueError(f'proxy: the radius is {radius} m, it must be positive')
        self.radius = radius
        self._state = np.zeros(1, STATE)
        self._device = np.zeros(3)
        self._surface: Surface | None = None
        self._blend = 0.0
        self.touch = Touch(self._state)

    def reset(self) -> None:
        """Lets go of the surface, as while a cut is on: the next step starts at the device.

        If the device is inside the tissue then, the proxy comes out at the nearest point of the
        surface, however deep: the caller must ramp the force.
        """
        self._surface = None
        self._state['placed'] = False
        self._state['touching'] = False

    def step(self, surface: Surface, blend: float, device: np.ndarray) -> Touch:
        """Moves the proxy towards the device.

        Args:
            surface: the newest.
            blend: where between its start and its end the surface is, 0 to 1.
            device: tool tip [m], shape (3,).

        Returns:
            `touch`.
        """
        self._device[:] = device
        self.touch.valid = all(map(math.isfinite, (blend, *self._device.tolist())))
        if not self.touch.valid:
            return self.touch
        blend = min(max(float(blend), 0.0), 1.0)
        known, start = self._surface, blend
        followed = surface is known
        if followed:
            start = self._blend
        elif known is not None and surface.continues(known):
            self._carry(known, self._blend, 1.0)
            followed, start = True, 0.0
        if not followed:
            self._state['nodes'] = -1
            self._state['clearance'] = 0.0
        if start != blend or not followed:
            self._carry(surface, start, blend)
        self._surface, self._blend = surface, blend
        follow_device(surface.geometry, blend, self._device, self.radius, self._state)
        return self.touch

    def _carry(self, surface: Surface, start: float, end: float) -> None:
        motion = surface.motion * abs(end - start)
        carry(surface.geometry, start, end, motion, self.radius, self._state)
