"""A force path between a device and a flat tissue simulated at 30 Hz, tick by tick."""

import numpy as np
from flat_tissue import flat_surface

from cutting_trainer.haptic_bridge.force_kernels import INSIDE, NONE, TOUCHING
from cutting_trainer.haptic_bridge.force_path import ForcePath
from cutting_trainer.haptic_bridge.scene_schema import (
    DeviceProfile,
    DeviceSettings,
    HapticsSettings,
    ToolSettings,
)
from cutting_trainer.node_common.cdr_codec import ContactCodec, ForceSampleCodec, StampedMessage
from cutting_trainer.node_common.operating_state import CrtkState
from cutting_trainer.tissue_sim.contact.blade_constants import UNKNOWN_BLADE

MS = 1_000_000
FRAME = 33
K = 80.0
RADIUS = 0.004
PROFILE = DeviceProfile(max_force=3.0, max_slew=500.0, max_stiffness=1000.0)
QUIET = HapticsSettings(soft_start=0.0, max_damping=0.0)
UNIT = (0.0, 0.0, 0.0, 1.0)


class Rig:
    """A force path between a device at some height and a tissue that is a spring along z."""

    def __init__(
        self, *, haptics=QUIET, device=None, tool=None, profile=PROFILE, constants=UNKNOWN_BLADE
    ):
        self.tool = tool or ToolSettings(radius=RADIUS, coupling_stiffness=200.0)
        device = device or DeviceSettings()
        self.path = ForcePath(self.tool, device, haptics, profile, constants=constants)
        self.now, self.ms, self.step = 10**12, 0, 0
        self.state = CrtkState.ENABLED
        self.surface = flat_surface(revision=0)
        self.sim = self.mesh = self.poses = True
        self.topology, self.inside, self.near = 1, False, False
        self.forces, self.ticks = [], []
        self.last_contact = None
        self.spoil = lambda sample: sample
        self.waited = 0

    def run(self, heights):
        """One tick a millisecond with the tool tip at each of the heights [m]."""
        for z in np.atleast_1d(heights):
            self.tick((0.0, 0.0, float(z)))
        return np.array(self.forces[-len(np.atleast_1d(heights)) :])

    def tick(self, position, orientation=UNIT, stamp=None):
        self.now += MS
        self.ms += 1
        pose = (
            StampedMessage(stamp or self.now, '', (*position, *orientation)) if self.poses else None
        )
        sample = self._sample() if self.sim and self.ms % FRAME == 0 else None
        out = self.path.tick(
            self.now,
            state=self.state,
            pose=pose,
            sample=sample,
            sample_ns=self.now - self.waited * MS,
            surface=self.surface,
        )
        if out.fault:
            self.state = CrtkState.FAULT
        self.last_contact = out
        self.ticks.append(out)
        self.forces.append(out.wrench[:3])
        return out

    def contact(self, field):
        return self.ticks[-1].contact[ContactCodec.fields[field]]

    def _sample(self):
        """The tissue's answer to the contact of the tick before."""
        self.step += 1
        if self.mesh:
            self.surface = flat_surface(self.step, self.topology, self.surface)
        if self.last_contact is None:
            return None
        values = self.last_contact.contact
        device = values[ContactCodec.fields['device']]
        depth = max(RADIUS - device[2], 0.0) if values[1] != NONE else 0.0
        state = TOUCHING if depth > 0 else NONE
        stamp = divmod(self.last_contact.contact_stamp_ns, 10**9)
        state = INSIDE if self.inside else state
        head = (self.step, self.step, self.topology, values[0], *stamp, state)
        stiffness = (*(0.0,) * 8, K if state != NONE or self.near else 0.0)
        sample = StampedMessage(
            self.now,
            'tissue',
            (*head, *device, 0.0, 0.0, K * depth, *stiffness, 0.3, 0.0, 0.0, 0, *(0.0,) * 6),
        )
        return self.spoil(sample)


def spoiled(sample, **fields):
    values = list(sample.values)
    for name, value in fields.items():
        values[ForceSampleCodec.fields[name]] = value
    return sample._replace(values=tuple(values))


def lowered(depth, ms):
    """Down from 1 mm above the touch to a depth of the tip [m] in so many milliseconds."""
    return np.linspace(RADIUS + 1e-3, RADIUS - depth, ms)


def pressed(depth=5e-3, ms=300, **settings):
    """A rig that holds the tool at a depth [m] for a while, lowered in so many milliseconds."""
    rig = Rig(**settings)
    rig.run(lowered(depth, ms))
    rig.run(np.full(100, RADIUS - depth))
    return rig
