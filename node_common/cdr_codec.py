"""CDR codecs for the messages of fixed layout in the 1 kHz loops.

`rclpy` builds a Python object for every field of every message; a loop that runs a thousand times
a second reads and writes the bytes instead, by one `struct` call a message.

Limitations: little-endian plain CDR (as every RMW of Jazzy sends it on the machines that ROS
supports), and messages that consist of a `std_msgs/Header` followed by numbers.
"""

import math
import struct
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, ClassVar, NamedTuple

from cutting_trainer.node_common.rejections import MessageError, require_tool

_ENCAPSULATION = b'\x00\x01\x00\x00'
_HEADER = struct.Struct('<4siII')
_FRAME = 4
"""Place of the frame_id among the unpacked values of a message; its numbers follow."""
_SIZES = {'B': 1, 'i': 4, 'I': 4, 'Q': 8, 'd': 8}
_KINDS = {'B': 'u1', 'i': '<i4', 'I': '<u4', 'Q': '<u8', 'd': '<f8'}
_NANOSECONDS = 1_000_000_000
_MAX_TRAILING_PADDING = 3
MAX_FRAME_ID_LENGTH = 255
"""[bytes] of a frame_id."""
_FRAME_CACHE_SIZE = 64
"""Decoded frame_ids that are kept."""
NORM_TOLERANCE = 0.01
"""Largest difference between the norm of a unit quaternion and 1."""
_LAST = {'state': 2, 'mode': 3}
"""Largest number of a field that chooses."""
MAX_QUANTITY = 1e6
"""Bound on every physical quantity: a position in millimetres, a stiffness in N/m."""


class WireError(MessageError):
    """Bytes that are not a message of the expected type, or values that do not fit into it."""


class StampedMessage(NamedTuple):
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
    """Encodes and decodes one message type; subclasses name its fields.

    Attributes:
        layout: (field, struct code, count) of each field after the header.
        older: numbers of fields that messages of older bags have; what they lack is read as 0, and
            may be left out of the values to encode.
        fields: position of each field in `StampedMessage.values`.

    Args:
        frame_id: of the messages to encode.
    """

    layout: ClassVar[tuple[tuple[str, str, int], ...]] = ()
    older: ClassVar[tuple[int, ...]] = ()
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
        self._packer = _message(self.layout, len(self._frame))
        self._values = sum(count for _, _, count in self.layout)
        self._counts = {
            sum(count for _, _, count in self.layout[:fields]): fields
            for fields in sorted((len(self.layout), *self.older))
        }
        self._messages: dict[int, dict[int, struct.Struct]] = {}
        self._usual, self._usual_length = self._packer, -1
        self._frames: dict[bytes, str] = {}

    def encode(self, stamp_ns: int, values: Sequence[float]) -> bytes:
        """Return the message as CDR bytes for `Publisher.publish`.

        Args:
            stamp_ns: `header.stamp` [ns].
            values: as in `StampedMessage.values`.
        """
        seconds, nanoseconds = divmod(stamp_ns, _NANOSECONDS)
        frame, left_out = self._frame, self._values - len(values)
        if left_out and len(values) in self._counts:
            values = (*values, *(0,) * left_out)
        try:
            return self._packer.pack(
                _ENCAPSULATION, seconds, nanoseconds, len(frame), frame, *values
            )
        except struct.error as error:
            raise WireError(
                'values that do not fit',
                f'{self.name} takes {list(self.fields)} as flat numbers, got {values}: {error}',
            ) from None

    def record_fields(self) -> dict[str, Any]:
        """Return a message of this frame as `np.dtype` takes it: the layout and its stamp."""
        fields: list[tuple[str, Any, int]] = [('seconds', '<i4', 4), ('nanoseconds', '<u4', 8)]
        places = _places(self.layout, len(self._frame))
        for (name, code, count), place in zip(self.layout, places, strict=True):
            kind = _KINDS[code]
            fields.append((name, kind if count == 1 else (kind, (count,)), place))
        names, formats, offsets = (list(column) for column in zip(*fields, strict=True))
        size = self._packer.size
        return {'names': names, 'formats': formats, 'offsets': offsets, 'itemsize': size}

    def decode(self, data: bytes) -> StampedMessage:
        """Return stamp, frame and numbers of a message in CDR bytes."""
        usual = self._usual
        if len(data) == usual.size:  # nearly always the layout of the message before
            unpacked = usual.unpack(data)
            if unpacked[0] == _ENCAPSULATION and unpacked[3] == self._usual_length:
                return self._decoded(unpacked)
        return self._decode_other(data)

    def _decode_other(self, data: bytes) -> StampedMessage:
        size = len(data)
        if size < _HEADER.size:
            text = f'{self.name} cut short: {size} bytes are less than its header'
            raise WireError('wrong length', text)
        encapsulation, _, _, length = _HEADER.unpack_from(data)
        if encapsulation[:2] != _ENCAPSULATION[:2]:
            raise WireError(
                'wrong encoding',
                f'{self.name} is not little-endian plain CDR: it starts with '
                f'{encapsulation.hex()}, not with {_ENCAPSULATION.hex()}',
            )
        messages = self._messages.get(length)
        if messages is None:
            if not 0 < length <= size - _HEADER.size:
                text = f'{self.name} gives its frame_id {length} bytes of {size} in all'
                raise WireError('wrong length', text)
            if length > MAX_FRAME_ID_LENGTH + 1:
                size, most = length - 1, MAX_FRAME_ID_LENGTH
                text = f'{self.name} has a frame_id of {size} bytes: {most} at most'
                raise WireError('frame_id too long', text)
            messages = self._messages[length] = {
                count: _message(self.layout[:fields], length)
                for count, fields in self._counts.items()
            }
        whole = message = messages[self._values]
        if size < whole.size:
            fitting = [m for m in messages.values() if m.size <= size]
            message = fitting[-1] if fitting else whole
        if not 0 <= size - message.size <= _MAX_TRAILING_PADDING:
            raise WireError(
                'wrong length',
                f'{self.name} with a frame_id of {length - 1} bytes has {whole.size} bytes, '
                f'got {size}',
            )
        unpacked = message.unpack_from(data)
        if message is whole:
            self._usual, self._usual_length = whole, length
        else:
            unpacked += (0,) * (_FRAME + 1 + self._values - len(unpacked))
        return self._decoded(unpacked)

    def _decoded(self, unpacked: tuple[Any, ...]) -> StampedMessage:
        _, seconds, nanoseconds, _, frame = unpacked[: _FRAME + 1]
        name = self._frames.get(frame)
        if name is None:
            if len(self._frames) >= _FRAME_CACHE_SIZE:
                self._frames.clear()
            name = self._frames[frame] = self._frame_name(frame)
        stamp_ns = seconds * _NANOSECONDS + nanoseconds
        return StampedMessage(stamp_ns, name, unpacked[_FRAME + 1 :])

    def believed(self, data: bytes) -> StampedMessage:
        """Return the decoded message after a plausibility check of its numbers.

        Raises:
            MessageError: it cannot be decoded, a quantity is not finite or above `MAX_QUANTITY`, an
                orientation is no unit quaternion, or the contact state does not exist.
        """
        sample = self.decode(data)
        values = sample.values
        for name, code, _ in self.layout:
            at = self.fields[name]
            if code == 'd' and not all(abs(value) <= MAX_QUANTITY for value in values[at]):
                text = f'{name} of {self.name} is {values[at]}'
                raise MessageError('not finite or too far', text)
            if name == 'orientation' and abs(math.hypot(*values[at]) - 1) > NORM_TOLERANCE:
                text = f'its length is {math.hypot(*values[at]):.3g}, it must be 1'
                raise MessageError('orientation that is no unit quaternion', text)
            if name in _LAST and values[at][0] > _LAST[name]:
                raise MessageError(f'no such {name}', f'{name} {values[at][0]} of {self.name}')
            if name == 'tool':
                require_tool(self.name, values[at][0])
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


def _places(layout: tuple[tuple[str, str, int], ...], frame_length: int) -> list[int]:
    """Return where the fields of a message begin. CDR aligns from the end of the encapsulation."""
    places, end = [], _HEADER.size + frame_length
    for _, code, count in layout:
        place = end + -(end - len(_ENCAPSULATION)) % _SIZES[code]
        places.append(place)
        end = place + _SIZES[code] * count
    return places


@lru_cache(maxsize=256)
def _message(layout: tuple[tuple[str, str, int], ...], frame_length: int) -> struct.Struct:
    """Return the struct of a message."""
    codes = [f'{_HEADER.format}{frame_length}s']
    end = _HEADER.size + frame_length
    for (_, code, count), place in zip(layout, _places(layout, frame_length), strict=True):
        codes.append(f'{place - end}x{count}{code}')
        end = place + _SIZES[code] * count
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
        ('tool', 'B', 1),
        ('mode', 'B', 1),
        ('blade_facing', 'd', 3),
    )
    older = (15, 16, 17)


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
        ('tool', 'B', 1),
        ('torque', 'd', 3),
        ('torque_resistance', 'd', 1),
        ('immersed', 'd', 2),
    )
    older = (13, 14)
