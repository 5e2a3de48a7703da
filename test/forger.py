"""A tissue that somebody forges answers for: what the hand may feel of it, tick by tick."""

from dataclasses import dataclass

import numpy as np
from rig import PROFILE, QUIET, RADIUS, K, Rig, lowered

from cutting_trainer.haptic_bridge.force_kernels import INSIDE, MAX_SLEW_PERIOD_S, NONE, TOUCHING
from cutting_trainer.node_common.cdr_codec import StampedMessage
from cutting_trainer.node_common.rejections import RejectionStatistics

SLEW = PROFILE.max_slew * MAX_SLEW_PERIOD_S
"""[N] that the slew limit allows in 5 ms: by so much a force may exceed what the bridge knows."""
WHERE = ('free', 'touching', 'cutting')
HEIGHTS = {'free': 0.03, 'touching': RADIUS - 5e-3, 'cutting': RADIUS - 6e-3}
"""[m] of the tip. The blade ends 4 mm below: in free air it is 26 mm above the tissue."""


@dataclass
class Worst:
    """What was felt of forged answers.

    Attributes:
        excess: largest force above the bound [N].
        free: largest force in free air [N].
        ticks: that were looked at.
        forged: answers that were sent.
    """

    excess: float = -np.inf
    free: float = 0.0
    ticks: int = 0
    forged: int = 0


def forged_sample(rng: np.random.Generator, rig: Rig) -> StampedMessage:
    """An answer that pushes as hard as it can, in one of many ways."""
    sequence = int(rig.last_contact.contact[0]) - int(rng.integers(0, 40))
    push = rng.normal(size=3) * rng.choice([1.0, 50.0, 900.0])
    if rng.random() < 0.6:
        push = np.array([0.0, 0.0, rng.choice([5.0, 50.0, 999.0])])
    stiff = rng.choice([0.0, 80.0, 1e3, 1e6])
    stiffness = np.diag([0.0, 0.0, stiff]) if rng.random() < 0.5 else np.eye(3) * stiff
    step = rig.step + int(rng.choice([1, 2, 100, 10**6]))
    topology = rig.topology + int(rng.integers(0, 2))
    place = rig.path._tip + rng.normal(size=3) * rng.choice([0.0, 1e-3, 1.0])
    state = int(rng.choice([NONE, TOUCHING, INSIDE], p=[0.1, 0.4, 0.5]))
    revision = rig.step + int(rng.integers(0, 3))
    head = (step, revision, topology, max(sequence, 0), *divmod(rig.now, 10**9), state)
    most = rng.choice([0.0, 1.0, 1000.0])
    turning = (*(0.1 * push), most, 0.5, 0.3)
    values = (*head, *place, *push, *stiffness.ravel(), most, 0.0, 0.0, 0, *turning)
    return StampedMessage(
        rig.now, 'tissue', tuple(float(v) if i > 6 else v for i, v in enumerate(values))
    )


def attack(seed: int, where: str, count: int) -> Worst:
    """Sends so many forged answers at a random pace, from 0.2 to 1000 Hz, and looks at each tick.

    At paces below 30 Hz only the time around each forged answer is played.
    """
    rng, worst = np.random.default_rng(seed), Worst()
    rig = Rig(haptics=QUIET)
    rig.path.rejections = RejectionStatistics()
    rig.run(lowered(5e-3, 200) if where != 'free' else np.full(200, HEIGHTS['free']))
    rig.inside = where == 'cutting'
    rig.run(np.full(150, HEIGHTS[where]))
    pace = 10 ** rng.uniform(np.log10(0.2), 3.0)
    between = max(1, min(round(1000 / pace), 150))  # [ms]
    height, forging = HEIGHTS[where], 0
    for tick in range(count * between):
        if tick % between == 0:
            forging = 1
        height = HEIGHTS[where] + 5e-4 * np.sin(tick / 100)
        _tick(rig, height, forged_sample(rng, rig) if forging else None)
        worst.forged += forging
        forging = 0
        force = float(np.linalg.norm(rig.forces[-1]))
        distance = max(RADIUS - height, 0.0)
        worst.excess = max(worst.excess, force - K * distance - SLEW)
        worst.ticks += 1
        if where == 'free':
            worst.free = max(worst.free, force)
    return worst


def _tick(rig: Rig, height: float, forged: StampedMessage | None) -> None:
    """One tick of a rig, with a forged answer in place of the tissue's where there is one."""
    honest = rig.spoil
    if forged is not None:
        sim, rig.sim = rig.sim, True
        rig.spoil = lambda _: forged
        left, rig.ms = rig.ms, -1  # the next tick is one of a frame
        rig.tick((0.0, 0.0, height))
        rig.ms, rig.sim = left + 1, sim
    else:
        rig.tick((0.0, 0.0, height))
    rig.spoil = honest
