"""Recorded sessions as episodes of a data set.

A frame is a tick of the force loop, so that forces keep their rate; each stream has its newest
value at each tick. Where there are pictures, a frame is a picture.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.bags.errors import BagError
from cutting_trainer.bags.playback_messages import first_time
from cutting_trainer.bags.reader import Bag, open_bag
from cutting_trainer.bags.topic_names import CONTACT, FORCE, POSE, SERVO_CF, of_session
from cutting_trainer.node_common.cdr_codec import (
    ContactCodec,
    ForceSampleCodec,
    PoseStampedCodec,
    StampedCodec,
    WrenchStampedCodec,
)
from cutting_trainer.session.errors import SessionError
from cutting_trainer.studies.bag_collection import StudyBag
from cutting_trainer.studies.session_metadata import SessionMetadata

Floats = NDArray[np.float64]

STATE, FORCES, ACTION = 'observation.state', 'observation.force', 'action'
_RATE_TOLERANCE = 0.02
STREAMS: dict[str, tuple[str, type[StampedCodec], tuple[str, ...], tuple[str, ...]]] = {
    STATE: (POSE, PoseStampedCodec, ('position', 'orientation'),
            ('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw')),
    FORCES: (SERVO_CF, WrenchStampedCodec, ('force',), ('x', 'y', 'z')),
    'observation.contact': (CONTACT, ContactCodec, ('state', 'device', 'proxy'),
                            ('state', 'tip_x', 'tip_y', 'tip_z',
                             'proxy_x', 'proxy_y', 'proxy_z')),
    'observation.tissue': (FORCE, ForceSampleCodec,
                           ('force', 'resistance', 'kinetic_energy', 'elastic_energy', 'topology'),
                           ('force_x', 'force_y', 'force_z', 'resistance', 'kinetic_energy',
                            'elastic_energy', 'cuts')),
}  # fmt: skip
"""Features: topic, codec, its fields, and names of the values; all in SI units."""


@dataclass(frozen=True)
class Episode:
    """A bag as an episode.

    Attributes:
        name: of the bag.
        values: of each feature, each shape (n, k); with pictures, the force has shape (n, w, 3).
        times: of the frames [s since the first message of the bag], shape (n,).
        rate: of the force loop [Hz].
        about: metadata.
    """

    name: str
    values: dict[str, Floats]
    times: Floats
    rate: int
    about: dict[str, Any]

    @property
    def task(self) -> str:
        """Name of the scene."""
        return str(self.about['scene'])

    @property
    def length(self) -> int:
        """Number of frames."""
        return len(self.times)

    def by_picture(self, fps: int) -> 'Episode':
        """Return the episode with a frame for each picture.

        A picture comes at the end of its ticks: all of their forces go with it, w by 3 numbers. The
        ticks at the end that fill no picture are left out.

        Args:
            fps: pictures a second.

        Raises:
            SessionError: a picture has no whole number of ticks, or there is none.
        """
        width, rest = divmod(self.rate, fps)
        count = self.length // width if width else 0
        if rest or not count:
            raise SessionError(
                f'{self.name}: {self.length} ticks at {self.rate} Hz make no pictures at {fps} Hz, '
                f'which need a rate that is a multiple of it: export without --video'
            )
        last = np.arange(1, count + 1) * width - 1
        values = {name: of[last] for name, of in self.values.items()}
        values[FORCES] = self.values[FORCES][: count * width].reshape(count, width, -1)
        following = np.minimum(last + width, self.length - 1)
        values[ACTION] = self.values[STATE][following]
        return replace(self, values=values, times=self.times[last])


def read_episode(bag: StudyBag, metadata: SessionMetadata) -> Episode:
    """Return a bag as an episode with a frame for each tick.

    Raises:
        BagError: it lacks a stream, or has no whole rate.
    """
    opened = open_bag(bag.path)
    streams = {}
    for feature, (topic, codec, names, _) in STREAMS.items():
        streams[feature] = _stream(opened, topic, codec(), names, bag.name)
    stamps, (_, poses, delay) = streams[FORCES][0], streams[STATE]
    period = float(np.median(np.diff(stamps))) * 1e-9
    rate = max(round(1.0 / period), 1)
    if abs(rate * period - 1.0) > _RATE_TOLERANCE:
        raise BagError(f'{bag.name} has forces every {period:.4g} s: that is no whole rate')
    begin = max(int(of[0]) for of, *_ in streams.values())
    end = int(stamps[-1])
    if end <= begin:
        raise BagError(f'{bag.name} has no time in which it has all of {", ".join(STREAMS)}')
    ticks = begin + np.arange(int((end - begin) * 1e-9 * rate) + 1) * round(1e9 / rate)
    values = {
        feature: data[np.searchsorted(of, ticks, side='right') - 1]
        for feature, (of, data, _) in streams.items()
    }
    # The action is where the hand goes next.
    following = np.searchsorted(streams[STATE][0], ticks, side='right')
    values[ACTION] = poses[np.minimum(following, len(poses) - 1)]
    times = np.array((ticks + delay - first_time(opened)) * 1e-9, np.float64)
    return Episode(bag.name, values, times, rate, metadata.of(bag, opened))


def _stream(
    bag: Bag, topic: str, codec: StampedCodec, names: Sequence[str], of: str
) -> tuple[NDArray[np.int64], Floats, int]:
    """Return stamps [ns], shape (n,), values of fields, shape (n, k), and delay of recording [ns].

    The delay is the median from stamp to recording.
    """
    found = of_session(topic, bag.topics())
    samples, delays = [], []
    for recorded in bag.messages([found]):
        sample = codec.decode(recorded.data)
        if sample.stamp_ns:
            samples.append(sample)
            delays.append(recorded.log_time - sample.stamp_ns)
    if len(samples) < 2:
        raise BagError(f'{of} has no stream {topic}: it cannot be an episode')
    samples.sort(key=lambda sample: sample.stamp_ns)
    picked = [[v for name in names for v in s.values[codec.fields[name]]] for s in samples]
    stamps = np.array([s.stamp_ns for s in samples], np.int64)
    return stamps, np.array(picked, float), int(np.median(delays))
