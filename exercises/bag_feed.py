"""Attempts from bags: every measure comes from the bag alone."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from cutting_trainer.bags.playback_messages import first_time
from cutting_trainer.bags.reader import Bag
from cutting_trainer.bags.recorded_tissue import first_current_keyframe, follow
from cutting_trainer.bags.topic_names import CONTACT, MESH, SERVO_CF, UPDATES, of_session
from cutting_trainer.exercises.metrics import Attempt
from cutting_trainer.exercises.scene_schema import ExerciseSettings
from cutting_trainer.node_common.cdr_codec import ContactCodec, WrenchStampedCodec
from cutting_trainer.tissue_sim.mesh.replica import MeshReplica

MOTION_FIELDS = [
    ContactCodec.fields[name] for name in ('device', 'blade_root', 'blade_tip', 'state')
]
"""Places in a contact of what `Attempt.add_motion` takes after the time."""


def read_attempt(
    bag: Bag, exercise: ExerciseSettings, answers: tuple[np.ndarray, np.ndarray] | None = None
) -> Attempt:
    """Return the attempt that a bag records.

    Times are those of the device poses for the motion, and of the messages' stamps for the force:
    they do not depend on when the recorder had its turn.

    Args:
        bag: of a session.
        exercise: of its scene.
        answers: stamps [ns] of the poses that count, and the norm of the force in answer to each
            [N], both shape (n,); None: all poses, and all forces at their own times.

    Raises:
        BagError: a part of the bag is damaged.
    """
    attempt = Attempt(exercise)
    servo_cf = of_session(SERVO_CF, bag.topics())
    contacts, wrenches = ContactCodec(), WrenchStampedCodec()
    force = WrenchStampedCodec.fields['force']
    motion: list[tuple[float, ...]] = []
    forces: list[tuple[float, float]] = []
    first, last = (1, math.inf) if answers is None else (answers[0][0], answers[0][-1])
    replica, topology = MeshReplica(), -1
    origin = first_time(bag)
    keyframe = first_current_keyframe(bag)
    known_from = 0 if keyframe is None else keyframe.log_time
    for message in bag.messages([CONTACT, servo_cf, MESH, UPDATES]):
        if message.topic == CONTACT:
            stamp, _, values = contacts.decode(message.data)
            if first <= stamp <= last:  # 0: there was no device yet
                motion.append(((stamp - origin) * 1e-9, *motion_of(values)))
        elif message.topic == servo_cf:
            stamp, _, values = wrenches.decode(message.data)
            forces.append(((stamp - origin) * 1e-9, math.hypot(*values[force])))
        elif message.log_time >= known_from:
            follow(replica, message.topic, bag.read(message))
            if replica.topology != topology:
                topology = replica.topology
                attempt.see_tissue((message.log_time - origin) * 1e-9, replica)
    if answers is not None:
        forces = list(zip((answers[0] - origin) * 1e-9, answers[1], strict=True))
    add_samples(attempt, motion, forces)
    return attempt


def motion_of(contact: Sequence[Any]) -> list[float]:
    """Return what `Attempt.add_motion` takes after the time from the values of a contact."""
    return [x for place in MOTION_FIELDS for x in contact[place]]


def add_samples(
    attempt: Attempt,
    motion: Sequence[tuple[float, ...]],
    forces: Sequence[tuple[float, float]],
) -> None:
    """Add samples in any order to an attempt, each time once.

    Args:
        attempt: that sees them.
        motion: rows of `Attempt.add_motion`.
        forces: rows of `Attempt.add_forces`.
    """
    attempt.add_motion(_in_order(np.array(motion, float).reshape(-1, 11)))
    attempt.add_forces(_in_order(np.array(forces, float).reshape(-1, 2)))


def _in_order(samples: np.ndarray) -> np.ndarray:
    """Return samples in ascending order of time, each time once."""
    samples = samples[np.argsort(samples[:, 0], kind='stable')]
    return samples[np.diff(samples[:, 0], prepend=-np.inf) > 0]
