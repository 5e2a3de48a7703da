"""Attempts from bags: every measure comes from the bag alone."""

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


def read_attempt(bag: Bag, exercise: ExerciseSettings) -> Attempt:
    """Return the attempt that a bag records.

    Times are those of the device poses for the motion, and of the messages' stamps for the force:
    they do not depend on when the recorder had its turn.

    Args:
        bag: of a session.
        exercise: of its scene.

    Raises:
        BagError: a part of the bag is damaged.
    """
    attempt = Attempt(exercise)
    servo_cf = of_session(SERVO_CF, bag.topics())
    contacts, wrenches = ContactCodec(), WrenchStampedCodec()
    force = WrenchStampedCodec.fields['force']
    motion: list[list[float]] = []
    forces: list[tuple[float, ...]] = []
    replica, topology = MeshReplica(), -1
    origin = first_time(bag)
    keyframe = first_current_keyframe(bag)
    known_from = 0 if keyframe is None else keyframe.log_time
    for message in bag.messages([CONTACT, servo_cf, MESH, UPDATES]):
        if message.topic == CONTACT:
            stamp, _, values = contacts.decode(message.data)
            if stamp:  # 0: there was no device yet
                row = (x for place in MOTION_FIELDS for x in values[place])
                motion.append([(stamp - origin) * 1e-9, *row])
        elif message.topic == servo_cf:
            stamp, _, values = wrenches.decode(message.data)
            forces.append(((stamp - origin) * 1e-9, *values[force]))
        elif message.log_time >= known_from:
            follow(replica, message.topic, bag.read(message))
            if replica.topology != topology:
                topology = replica.topology
                attempt.see_tissue((message.log_time - origin) * 1e-9, replica)
    attempt.add_motion(_in_order(np.array(motion, float).reshape(-1, 11)))
    table = _in_order(np.array(forces, float).reshape(-1, 4))
    norm = np.linalg.norm(table[:, 1:], axis=1)
    attempt.add_forces(np.column_stack([table[:, 0], norm]))
    return attempt


def _in_order(samples: np.ndarray) -> np.ndarray:
    """Return samples in ascending order of time, each time once."""
    samples = samples[np.argsort(samples[:, 0], kind='stable')]
    return samples[np.diff(samples[:, 0], prepend=-np.inf) > 0]
