"""CDR codecs for the fixed-layout messages of the 1 kHz loops.

`rclpy` builds a Python object for every field of every message; a loop that runs a thousand times
a second reads and writes the bytes instead, by one `struct` call a message.

Limitations: little-endian plain CDR (what every RMW of Jazzy sends on the machines that ROS
supports), and messages that consist of a `std_msgs/Header` followed by numbers.
"""

import math
import struct
from collections.abc import Sequence
from functools import lru_cache
from typing import ClassVar, NamedTuple

from tissue_sim.refusals import MessageError

_ENCAPSULATION = b'\x00\x01\x00\x00'
_HEADER = struct.Struct('<4siII')
_SIZES = {'B': 1, 'i': 4, 'I': 4, 'Q': 8, 'd': 8}
_NANOSECONDS = 1_000_000_000
_LONGEST_PADDING_AT_END = 3
LONGEST_FRAME = 255
"""Bytes of a frame_id."""
_REMEMBERED = 64
"""Frames of which the bytes are not read again."""
UNIT = 0.01
"""By which the length of a unit quaternion may differ from 1."""
_LAST_STATE = 2
LARGEST = 1e6
"""Of any number that is a quantity: a position in millimetres, a stiffness in N/m."""


class WireError(MessageError):
    """Bytes that are not the message they were taken for, or values that do not fit into it."""


class Sample(NamedTuple):
    """One decoded message.

    Attributes:
        stamp_ns: `header.stamp` [ns]; 0 marks invalid data (CRTK).
        frame_id: `header.frame_id`.
        values: all numbers after the header in the order of the message, arrays flattened.
    """

    stamp_ns: int
    frame_id: str
    values: tuple[float, ...]


class StampedCodec:
    """Reads and writes one message type; the subclasses name its fields.

    Attributes:
        layout: (field, struct code, count) of everything after the header.
        fields: where each field stands in `Sample.values`.

    Args:
        frame_id: of the messages to encode.
    """

    layout: ClassVar[tuple[tuple[str, str, int], ...]] = ()
    fields: ClassVar[dict[str, slice]] = {}

    def __init_subclass__(cls) -> None:
        first = 0
        cls.fields = {}
        for name, _, count in cls.layout:
            cls.fields[name] = slice(first, first + count)
            first += count

    def __init__(self, frame_id: str = '') -> None:
        self.name = type(self).__name__.removesuffix('Codec')
        self._frame = frame_id.encode() + b'\0'
        self._packer = _body(self.layout, len(self._frame))
        self._bodies: dict[int, struct.Struct] = {}
        self._frames: dict[bytes, str] = {}

    def encode(self, stamp_ns: int, values: Sequence[float]) -> bytes:
        """The message as CDR bytes, for `Publisher.publish`.

        Args:
            stamp_ns: `header.stamp` [ns].
            values: as in `Sample.values`.
        """
        seconds, nanoseconds = divmod(stamp_ns, _NANOSECONDS)
        try:
            head = _HEADER.pack(_ENCAPSULATION, seconds, nanoseconds, len(self._frame))
            return head + self._packer.pack(self._frame, *values)
        except struct.error as error:
            raise WireError(
                'values that do not fit',
                f'{self.name} takes {list(self.fields)} as flat numbers, got {values}: {error}',
            ) from None

    def decode(self, data: bytes) -> Sample:
        """The stamp, frame and numbers of a message in CDR bytes."""
        size = len(data)
        if size < _HEADER.size:
            text = f'{self.name} cut short: {size} bytes are less than its header'
            raise WireError('wrong length', text)
        encapsulation, seconds, nanoseconds, length = _HEADER.unpack_from(data)
        if encapsulation[:2] != _ENCAPSULATION[:2]:
            raise WireError(
                'wrong encoding',
                f'{self.name} is not little-endian plain CDR: it starts with '
                f'{encapsulation.hex()}, not with {_ENCAPSULATION.hex()}',
            )
        body = self._bodies.get(length)
        if body is None:
            if not 0 < length <= size - _HEADER.size:
                text = f'{self.name} gives its frame_id {length} bytes of {size} in all'
                raise WireError('wrong length', text)
            if length > LONGEST_FRAME + 1:
                text = f'{self.name} has a frame_id of {length - 1} bytes: {LONGEST_FRAME} at most'
                raise WireError('frame_id too long', text)
            body = self._bodies[length] = _body(self.layout, length)
        if not 0 <= size - _HEADER.size - body.size <= _LONGEST_PADDING_AT_END:
            raise WireError(
                'wrong length',
                f'{self.name} with a frame_id of {length - 1} bytes has '
                f'{_HEADER.size + body.size} bytes, got {size}',
            )
        frame, *values = body.unpack_from(data, _HEADER.size)
        name = self._frames.get(frame)
        if name is None:
            if len(self._frames) >= _REMEMBERED:
                self._frames.clear()
            name = self._frames[frame] = self._frame_name(frame)
        return Sample(seconds * _NANOSECONDS + nanoseconds, name, tuple(values))

    def believed(self, data: bytes) -> Sample:
        """As `decode`, for whoever has no better judgement of what the numbers may be.

        Raises:
            MessageError: it cannot be decoded, a quantity is not finite or beyond `LARGEST`, an
                orientation is no unit quaternion, or a contact state does not exist.
        """
        sample = self.decode(data)
        values = sample.values
        for name, code, _ in self.layout:
            at = self.fields[name]
            if code == 'd' and not all(abs(value) <= LARGEST for value in values[at]):
                text = f'{name} of {self.name} is {values[at]}'
                raise MessageError('not finite or too far', text)
            if name == 'orientation' and abs(math.hypot(*values[at]) - 1) > UNIT:
                text = f'its length is {math.hypot(*values[at]):.3g}, it must be 1'
                raise MessageError('orientation that is no unit quaternion', text)
            if name == 'state' and values[at][0] > _LAST_STATE:
                raise MessageError('no such state', f'state {values[at][0]} of {self.name}')
        return sample

    def _frame_name(self, frame: bytes) -> str:
        if frame[-1:] != b'\0':
            text = f'{self.name} has a frame_id that does not end with a zero byte: {frame!r}'
            raise WireError('frame_id that is no text', text)
        try:
            return frame[:-1].decode()
        except UnicodeDecodeError:
            text = f'{self.name} has a frame_id that is not UTF-8: {frame!r}'
            raise WireError('frame_id that is no text', text) from None


@lru_cache(maxsize=256)
def _body(layout: tuple[tuple[str, str, int], ...], frame_length: int) -> struct.Struct:
    """Everything after the length of frame_id; CDR aligns to the byte after the encapsulation."""
    codes = [f'<{frame_length}s']
    offset = _HEADER.size - len(_ENCAPSULATION) + frame_length
    for _, code, count in layout:
        size = _SIZES[code]
        padding = -offset % size
        codes.append(f'{padding}x{count}{code}')
        offset += padding + size * count
    return struct.Struct(''.join(codes))


class PoseStampedCodec(StampedCodec):
    """`geometry_msgs/PoseStamped`: position [m], orientation as quaternion x y z w."""

    layout = (('position', 'd', 3), ('orientation', 'd', 4))


class TwistStampedCodec(StampedCodec):
    """`geometry_msgs/TwistStamped`: linear [m/s], angular [rad/s]."""

    layout = (('linear', 'd', 3), ('angular', 'd', 3))


class WrenchStampedCodec(StampedCodec):
    """`geometry_msgs/WrenchStamped`: force [N], torque [N m]."""

    layout = (('force', 'd', 3), ('torque', 'd', 3))


class ContactCodec(StampedCodec):
    """`cutting_trainer_msgs/Contact`: see the message for units."""

    layout = (
        ('sequence', 'Q', 1),
        ('state', 'B', 1),
        ('revision', 'Q', 1),
        ('topology', 'Q', 1),
        ('nodes', 'I', 9),
        ('weights', 'd', 9),
        ('device', 'd', 3),
        ('proxy', 'd', 3),
        ('point', 'd', 3),
        ('normal', 'd', 3),
        ('external_force', 'd', 3),
        ('coupling_stiffness', 'd', 1),
        ('blade_root', 'd', 3),
        ('blade_tip', 'd', 3),
        ('proxy_radius', 'd', 1),
    )


class ForceSampleCodec(StampedCodec):
    """`cutting_trainer_msgs/ForceSample`: see the message for units."""

    layout = (
        ('step', 'Q', 1),
        ('revision', 'Q', 1),
        ('topology', 'Q', 1),
        ('contact_sequence', 'Q', 1),
        ('contact_stamp_seconds', 'i', 1),
        ('contact_stamp_nanoseconds', 'I', 1),
        ('state', 'B', 1),
        ('position', 'd', 3),
        ('force', 'd', 3),
        ('stiffness', 'd', 9),
        ('resistance', 'd', 1),
        ('kinetic_energy', 'd', 1),
        ('elastic_energy', 'd', 1),
    )
