"""Dry friction sticks, slips and stays where it is; it takes energy, and the tissue gets it too."""

import numpy as np
import pytest
from flat_tissue import flat_surface

from cutting_trainer.haptic_bridge.force_kernels import NONE, TOUCHING
from cutting_trainer.haptic_bridge.force_path import ForcePath
from cutting_trainer.haptic_bridge.proxy.friction import drag, make_stick, split_stiffness
from cutting_trainer.haptic_bridge.proxy.proxy import Proxy
from cutting_trainer.haptic_bridge.proxy.surface import Surface
from cutting_trainer.haptic_bridge.scene_schema import (
    DeviceProfile,
    DeviceSettings,
    HapticsSettings,
    ToolSettings,
)
from cutting_trainer.node_common.cdr_codec import ContactCodec, StampedMessage
from cutting_trainer.node_common.operating_state import CrtkState
from cutting_trainer.tissue_sim.contact.friction import Friction

MS = 1_000_000
RADIUS, RIGID, ALONG = 0.004, 200.0, 120.0
MU = 0.3
SOME = Friction(MU)
UP = np.array([0.0, 0.0, 1.0])
PROFILE = DeviceProfile(max_force=3.0, max_slew=500.0, max_stiffness=1000.0)
QUIET = HapticsSettings(soft_start=0.0, max_damping=0.0)


class Ground:
    """The force loop over a flat ground that answers at 30 Hz: rigid, or softer along itself."""

    def __init__(self, friction=SOME, along=RIGID, haptics=QUIET):
        tool = ToolSettings(radius=RADIUS, coupling_stiffness=RIGID)
        self.path = ForcePath(tool, DeviceSettings(), haptics, PROFILE, friction=friction)
        self.along = along
        self.now, self.ms = 10**12, 0
        self.surface = flat_surface(revision=0)
        self.values = None

    def tick(self, tip):
        self.now += MS
        self.ms += 1
        sample = None
        if self.ms % 33 == 0 and self.values is not None:
            self.surface = flat_surface(self.ms // 33, 1, self.surface)
            sample = self._answer()
        pose = StampedMessage(self.now, '', (*map(float, tip), 0.0, 0.0, 0.0, 1.0))
        out = self.path.tick(
            self.now, state=CrtkState.ENABLED, pose=pose, sample=sample, surface=self.surface
        )
        assert not out.fault
        self.values = out.contact
        return np.array(out.wrench[:3])

    def field(self, name):
        return np.array(self.values[ContactCodec.fields[name]])

    def _answer(self):
        device = self.field('device')
        depth = max(RADIUS - device[2], 0.0) if self.values[1] != NONE else 0.0
        stiffness = np.diag([self.along, self.along, RIGID])
        head = (self.ms // 33, self.ms // 33, 1, self.values[0], *divmod(self.now, 10**9))
        state = TOUCHING if depth > 0 else NONE
        body = (*device, 0.0, 0.0, RIGID * depth, *stiffness.ravel(), 0.0, 0.0, 0.0, 0, *(0.0,) * 6)
        return StampedMessage(self.now, 'tissue', (*head, state, *body))

    def pressed(self, depth, ms=400):
        """Down to a depth [m] at the origin, and a rest there."""
        for z in (*np.linspace(RADIUS + 2e-3, RADIUS - depth, ms), *[RADIUS - depth] * 200):
            force = self.tick((0.0, 0.0, z))
        return force


@pytest.mark.parametrize('along', [RIGID, ALONG])
def test_it_sticks_to_the_cone_and_slips_on_it_exactly(along):
    ground, depth = Ground(along=along), 2e-3
    pushed = ground.pressed(depth)[2]
    assert pushed == pytest.approx(RIGID * depth, rel=1e-6)
    way = np.arange(0.0, 4e-3, 2e-6)
    forces = np.array([ground.tick((x, 0.0, RADIUS - depth)) for x in way])
    slips = MU * pushed / along
    sticks = way < 0.995 * slips
    np.testing.assert_allclose(forces[sticks, 0], -along * way[sticks], atol=1e-9)
    assert way[np.argmax(-forces[:, 0] >= 0.9999 * MU * pushed)] == pytest.approx(slips, rel=0.01)
    np.testing.assert_allclose(forces[way > 1.01 * slips, 0], -MU * pushed, rtol=1e-6)
    np.testing.assert_allclose(forces[:, 2], pushed, rtol=1e-6)
    # The tissue gets the same force, and the proxy that the coupling spring leads to.
    np.testing.assert_allclose(ground.field('external_force'), -forces[-1], rtol=1e-6, atol=1e-9)
    stretch = ground.field('device') - ground.field('proxy')
    np.testing.assert_allclose(RIGID * stretch, -forces[-1], rtol=1e-6, atol=1e-9)


def test_static_friction_holds_longer_and_lets_go_to_the_sliding_one():
    ground = Ground(Friction(MU, 1.5))
    pushed = ground.pressed(2e-3)[2]
    pulls = np.array([-ground.tick((x, 0.0, 2e-3))[0] for x in np.arange(0.0, 3e-3, 2e-6)])
    assert pulls.max() == pytest.approx(1.5 * MU * pushed, rel=0.01)
    assert pulls[-1] == pytest.approx(MU * pushed, rel=1e-6)


def test_a_trembling_hand_below_the_cone_does_not_creep():
    ground, random = Ground(), np.random.default_rng(3)
    ground.pressed(2e-3)
    for x in np.linspace(0.0, 3e-4, 100):
        ground.tick((x, 0.0, 2e-3))
    anchor = ground.path._s['stick'][0]['anchor'].copy()
    for move in random.normal(0.0, 3e-5, (10_000, 3)):
        ground.tick((3e-4 + move[0], move[1], 2e-3 + move[2]))
    assert np.abs(ground.path._s['stick'][0]['anchor'] - anchor)[:2].max() == 0.0
    assert ground.tick((3e-4, 0.0, 2e-3))[0] == pytest.approx(-RIGID * 3e-4, rel=1e-6)


def test_to_and_fro_takes_the_area_of_the_hysteresis():
    ground, reach = Ground(), 3e-3
    pushed = ground.pressed(2e-3)[2]
    way = reach * np.sin(np.linspace(0.0, 4 * np.pi, 8001))
    forces = np.array([ground.tick((x, 0.0, 2e-3))[0] for x in way])
    last = slice(4000, None)
    work = -np.sum((forces[last][1:] + forces[last][:-1]) / 2 * np.diff(way[last]))
    stick = MU * pushed / RIGID
    assert work == pytest.approx(4 * MU * pushed * (reach - stick), rel=0.02)


def closed_path(random, ticks=400):
    """A smooth closed path from above the ground into it and along it [m], shape (ticks, 3)."""
    t = np.linspace(0.0, 2 * np.pi, ticks)
    path = np.zeros((ticks, 3))
    for n in range(1, 4):
        a, b = random.normal(0.0, 2e-3 / n, (2, 3))
        path += a * (np.cos(n * t)[:, None] - 1) + b * np.sin(n * t)[:, None]
    return path + np.array([0.0, 0.0, RADIUS + 1e-3])


@pytest.mark.long
@pytest.mark.parametrize('ratio', [1.0, 1.5])
def test_no_closed_path_takes_energy_out(ratio):
    """The spring as it is computed, on 200 random paths that begin and end above the ground."""
    random, surface = np.random.default_rng(7), flat_surface()
    for _ in range(200):
        stick = make_stick(Friction(random.uniform(0.1, 1.5), ratio))
        proxy = Proxy(RADIUS, stick)
        path, forces = closed_path(random), []
        for tip in path:
            touch, force = proxy.step(surface, 1.0, tip), np.zeros(3)
            if touch.touching:
                pushed = RIGID * float(np.linalg.norm(proxy.place - tip))
                drag(stick, tip, touch.normal, pushed, ALONG)
                force = pushed * touch.normal + stick[0]['force']
            forces.append(force)
        pairs = (np.array(forces)[1:] + np.array(forces)[:-1]) / 2
        put_in = -np.sum(pairs * np.diff(path, axis=0))
        # The normal force begins within a tick: the trapezium is off by that much.
        kinks = RIGID * np.square(np.linalg.norm(np.diff(path, axis=0), axis=1).max())
        assert put_in >= -kinks


def test_without_friction_the_loop_is_the_same_bit_for_bit():
    loops = [Ground(friction) for friction in (Friction(), Friction(0.0, 2.0))]
    path = closed_path(np.random.default_rng(1), 600)
    forces = [np.array([loop.tick(tip) for tip in path]) for loop in loops]
    assert forces[0].any()
    assert forces[0].tobytes() == forces[1].tobytes()
    assert not loops[0].path._s['stick'][0]['anchor'].any()


def test_a_sticking_tool_goes_along_with_the_surface():
    stick = make_stick(Friction(1.0))
    proxy = Proxy(RADIUS, stick)
    still = flat_surface()
    tip = np.array([0.0, 0.0, RADIUS - 1e-3])
    proxy.step(still, 1.0, tip + 2e-3 * UP)
    drag(stick, tip, proxy.step(still, 1.0, tip).normal, 0.2, RIGID)
    moved = Surface(
        still.geometry.end + np.array([5e-4, 0.0, 0.0]),
        still._given,
        revision=2,
        topology=1,
        previous=still,
    )
    for blend in (0.25, 0.5, 1.0):
        touch = proxy.step(moved, blend, tip)
        drag(stick, tip, touch.normal, 0.2, RIGID)
        np.testing.assert_allclose(stick[0]['force'], [RIGID * blend * 5e-4, 0, 0], atol=1e-9)
        np.testing.assert_allclose(proxy.place, [0.0, 0.0, RADIUS], atol=1e-9)


def test_the_stiffness_of_a_sample_is_split_whatever_its_gradient():
    random = np.random.default_rng(5)
    n = random.normal(size=3)
    n /= np.linalg.norm(n)
    side = np.cross(n, [1.0, 0.0, 0.0])
    pressing = 90.0 * np.outer(n, n) - np.outer(n, 7.0 * side)
    given = pressing + 60.0 * (np.eye(3) - np.outer(n, n))
    found, along = split_stiffness(given, n)
    assert along == pytest.approx(60.0)
    np.testing.assert_allclose(found, pressing, atol=1e-12)
