"""The recorded hand of a session: its poses, when each frame saw them, and the force on it."""

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cutting_trainer.bags.reader import Bag
from cutting_trainer.bags.recorded_frames import FrameRecord, read_run
from cutting_trainer.bags.resimulation_start import find_beginning
from cutting_trainer.bags.topic_names import CONTACT, FORCE, POSE, SERVO_CF, of_session
from cutting_trainer.haptic_bridge.force_kernels import NONE
from cutting_trainer.node_common.cdr_codec import (
    ContactCodec,
    ForceSampleCodec,
    PoseStampedCodec,
    StampedMessage,
    WrenchStampedCodec,
)
from cutting_trainer.node_common.rejections import MessageError
from cutting_trainer.session.errors import SessionError

_FRAME_NS, _TICK_NS = 33_333_333, 1_000_000


@dataclass(frozen=True)
class RecordedForce:
    """Force on the hand in answer to each pose.

    Attributes:
        times: stamps of the poses [ns], shape (n,).
        forces: norm of the force on the hand [N], shape (n,).
        contact: contact flag, shape (n,).
        vectors: force on the hand in the frame of the device [N], shape (n, 3).
    """

    times: np.ndarray
    forces: np.ndarray
    contact: np.ndarray
    vectors: np.ndarray


def computable_poses(bag: Bag) -> tuple[list[FrameRecord], list[StampedMessage]]:
    """Return the computable frames of a session, and the poses of the device during them.

    Raises:
        BagError: no frame can be computed; the message has the reason.
        SessionError: the bag has no poses.
    """
    beginning = find_beginning(bag)
    every, _ = read_run(bag, beginning.segment.run)
    records, after = beginning.frames(every), 0
    if beginning.tissue is not None:
        before = [record for record in every if record.step < beginning.step]
        # A tissue that is not computed has answered the poses of the frame before.
        first = time_of_contact(records[0])
        after = time_of_contact(before[-1]) if before else first - _FRAME_NS
    until = max((time_of_contact(record) for record in records), default=0)
    if any(record.others for record in records):
        raise SessionError(
            f'{bag.path} has several tools: their hands cannot be moved anew in a changed scene; '
            'resimulate it without --with'
        )
    poses, answered = _poses(bag, beginning.segment.since)
    poses = [pose for pose in poses if after < pose.stamp_ns <= until]
    if not poses:
        raise SessionError(f'{bag.path} has no message of {POSE}: there is no hand to follow')
    ends = [*map(time_of_contact, records[1:]), until]  # an answer comes before the next frame
    answers = [min(answered.get(r.time, 0), end) for r, end in zip(records, ends, strict=True)]
    return [replace(r, answered=at) for r, at in zip(records, answers, strict=True)], poses


def times_of_frame(record: FrameRecord) -> tuple[int, int]:
    """Return the stamps [ns] of the last poses before a frame, and before its answer."""
    begin = time_of_contact(record)
    return begin, max(begin, record.answered)


def time_of_contact(record: FrameRecord) -> int:
    """Return the stamp [ns] of the last pose before a frame."""
    return record.pose.stamp_ns if record.pose is not None else record.time - _FRAME_NS


def recorded_force(bag: Bag, poses: Sequence[StampedMessage]) -> RecordedForce:
    """Return the recorded force on the hand in answer to its poses.

    Raises:
        SessionError: the bag has no forces of the hand, or no contacts.
    """
    state, force = ContactCodec.fields['state'], WrenchStampedCodec.fields['force']
    times = np.array([pose.stamp_ns for pose in poses])
    touched = _at(bag, CONTACT, ContactCodec(), times)[:, state].ravel() != NONE
    vectors = _at(bag, SERVO_CF, WrenchStampedCodec(), times)[:, force]
    return RecordedForce(times, np.linalg.norm(vectors, axis=1), touched, vectors)


def _poses(bag: Bag, since: int) -> tuple[list[StampedMessage], dict[int, int]]:
    """Return the poses of the device since a log time [ns], and which was before each force sample.

    Returns:
        The poses; and for the stamp of a force sample, that of the last pose before it [ns].
    """
    pose, force = PoseStampedCodec(), ForceSampleCodec()
    topic, poses = of_session(POSE, bag.topics()), []
    answered: dict[int, int] = {}
    for recorded in bag.messages([topic, FORCE]):
        if recorded.log_time < since:
            continue
        with contextlib.suppress(MessageError):  # no node has used such a message
            if recorded.topic == topic:
                poses.append(pose.decode(recorded.data))
            elif poses:
                answered[force.decode(recorded.data).stamp_ns] = poses[-1].stamp_ns
    return poses, answered


def _at(bag: Bag, topic: str, codec: Any, times: np.ndarray) -> np.ndarray:
    """Return the values of a 1 kHz stream in answer to poses at times [ns], shape (n, values)."""
    topic = of_session(topic, bag.topics())
    samples = [codec.decode(recorded.data) for recorded in bag.messages([topic])]
    if not samples:
        raise SessionError(f'{bag.path} has no message of {topic}: --with compares with it')
    stamps = np.array([sample.stamp_ns for sample in samples])
    newest = np.searchsorted(stamps, np.append(times[1:], times[-1] + _TICK_NS)) - 1
    return np.array([sample.values for sample in samples])[np.maximum(newest, 0)]
