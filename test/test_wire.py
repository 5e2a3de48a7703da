"""Claims about the codecs: they write and read what rclpy does, and refuse everything else."""

import contextlib

import numpy as np
import pytest
from cutting_trainer_msgs.msg import Contact, ForceSample
from geometry_msgs.msg import PoseStamped, TwistStamped, WrenchStamped
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message

from cutting_trainer.node_common.cdr_codec import (
    ContactCodec,
    ForceSampleCodec,
    PoseStampedCodec,
    StampedCodec,
    TwistStampedCodec,
    WireError,
    WrenchStampedCodec,
)

pytestmark = pytest.mark.long

CODECS = {
    PoseStampedCodec: PoseStamped,
    TwistStampedCodec: TwistStamped,
    WrenchStampedCodec: WrenchStamped,
    ContactCodec: Contact,
    ForceSampleCodec: ForceSample,
}
NUMBERS = {
    'B': st.integers(0, 2**8 - 1),
    'I': st.integers(0, 2**32 - 1),
    'i': st.integers(-(2**31), 2**31 - 1),
    'Q': st.integers(0, 2**64 - 1),
    'd': st.floats(allow_nan=False),
}
FRAMES = st.text(st.characters(codec='utf-8', exclude_characters='\0'), max_size=40).filter(
    lambda name: len(name.encode()) <= 40
)
STAMPS = st.integers(-(2**31) * 10**9, (2**31 - 1) * 10**9 + 10**9 - 1)


def values_of(codec):
    return st.tuples(*[NUMBERS[c] for _, c, count in codec.layout for _ in range(count)])


def flat(message):
    """All numbers of a message after its header, in order."""
    if hasattr(message, 'get_fields_and_field_types'):
        names = [n for n in message.get_fields_and_field_types() if n != 'header']
        return [x for name in names for x in flat(getattr(message, name))]
    return list(message) if isinstance(message, np.ndarray) else [message]


@pytest.mark.parametrize('codec', CODECS, ids=lambda c: c.__name__)
@given(st.data())
def test_rclpy_reads_what_is_written_and_the_other_way_round(codec, data):
    stamp, frame, values = data.draw(STAMPS), data.draw(FRAMES), data.draw(values_of(codec))
    ours = codec(frame).encode(stamp, values)
    message = deserialize_message(ours, CODECS[codec])
    header = message.header
    assert header.stamp.sec * 10**9 + header.stamp.nanosec == stamp
    assert header.frame_id == frame
    assert tuple(flat(message)) == values
    assert codec().decode(serialize_message(message)) == (stamp, frame, values)


@pytest.mark.parametrize('codec', CODECS, ids=lambda c: c.__name__)
@given(st.data())
def test_a_record_that_a_kernel_fills_has_the_bytes_of_the_message(codec, data):
    stamp, frame, values = data.draw(STAMPS), data.draw(FRAMES), data.draw(values_of(codec))
    ours = codec(frame)
    bytes_of = bytearray(ours.encode(0, [0] * len(values)))
    record = np.frombuffer(bytes_of, np.dtype(ours.record_fields()))
    record['seconds'], record['nanoseconds'] = divmod(stamp, 10**9)
    for name, where in codec.fields.items():
        record[name] = values[where][0] if len(values[where]) == 1 else values[where]
    assert bytes(bytes_of) == ours.encode(stamp, values)


@pytest.mark.parametrize('codec', CODECS, ids=lambda c: c.__name__)
@pytest.mark.parametrize('length', range(41))
def test_bytes_are_those_of_rclpy_for_every_length_of_the_frame_id(codec, length):
    """All but the padding, which rclpy leaves as it finds it: where no byte of ours can matter."""
    count = len(flat(CODECS[codec]()))
    ours = codec('f' * length).encode(1, [7] * count)
    theirs = serialize_message(deserialize_message(ours, CODECS[codec]))
    assert len(ours) == len(theirs)
    differing = [i for i in range(len(ours)) if ours[i] != theirs[i]]
    for i in differing:
        changed = bytearray(ours)
        changed[i] ^= 0xFF
        assert codec().decode(bytes(changed)) == codec().decode(ours)


@pytest.mark.parametrize('codec', CODECS, ids=lambda c: c.__name__)
def test_fields_are_named_as_in_the_message(codec):
    values = tuple(range(len(flat(CODECS[codec]()))))
    message = deserialize_message(codec().encode(0, values), CODECS[codec])
    if codec in (PoseStampedCodec, TwistStampedCodec, WrenchStampedCodec):
        message = next(
            v for v in (getattr(message, n, None) for n in ('pose', 'twist', 'wrench')) if v
        )
    for name, where in codec.fields.items():
        if name.startswith('contact_stamp'):
            part = 'nanosec' if name.endswith('nanoseconds') else 'sec'
            assert values[where] == (getattr(message.contact_stamp, part),)
        else:
            assert list(values[where]) == flat(getattr(message, name))


@pytest.mark.parametrize(
    ('codec', 'older'),
    [
        (ContactCodec, 'tool'),
        (ContactCodec, 'mode'),
        (ContactCodec, 'blade_facing'),
        (ForceSampleCodec, 'tool'),
        (ForceSampleCodec, 'torque'),
    ],
)
def test_what_messages_of_older_bags_lack_is_zero(codec, older):
    names = [name for name, _, _ in codec.layout]
    count = codec.fields[older].start
    values = tuple(range(1, count + 1))

    class Older(StampedCodec):
        layout = codec.layout[: names.index(older)]

    data, lacking = Older('tissue').encode(5, values), codec.fields[names[-1]].stop - count
    assert codec().decode(data) == (5, 'tissue', (*values, *(0,) * lacking))
    assert codec().decode(codec('tissue').encode(5, values)) == codec().decode(data)
    for wrong in (values[:-3], (*values, *(0,) * (lacking + 1))):
        with pytest.raises(WireError, match='flat numbers'):
            codec('tissue').encode(5, wrong)
    with pytest.raises(WireError, match='wrong length'):
        codec().decode(data[:-4])


def test_nan_and_infinity_pass_for_a_gate_behind_the_codec_to_judge():
    data = WrenchStampedCodec('a').encode(0, (np.nan, np.inf, -np.inf, 0, 0, 0))
    np.testing.assert_equal(
        WrenchStampedCodec().decode(data).values, (np.nan, np.inf, -np.inf, 0, 0, 0)
    )


@given(st.binary(max_size=120), st.booleans())
def test_random_bytes_are_a_message_or_a_wire_error_but_no_other_error(data, encapsulated):
    with contextlib.suppress(WireError):
        PoseStampedCodec().decode(b'\x00\x01\x00\x00' * encapsulated + data)


@pytest.mark.parametrize(
    ('spoil', 'sentence'),
    [
        (lambda d: d[:10], 'cut short'),
        (lambda d: d[:-1], 'has 76 bytes, got 75'),
        (lambda d: d + bytes(4), 'has 76 bytes, got 80'),
        (lambda d: b'\x00\x00' + d[2:], 'not little-endian'),
        (lambda d: d[:12] + b'\xff\xff\xff\xff' + d[16:], 'gives its frame_id 4294967295 bytes'),
        (lambda d: d[:12] + bytes(4) + d[16:], 'gives its frame_id 0 bytes'),
        (lambda d: d[:17] + b'x' + d[18:], 'does not end with a zero byte'),
        (lambda d: d[:16] + b'\xff' + d[17:], 'not UTF-8'),
    ],
)
def test_malformed_bytes_are_refused_with_a_sentence(spoil, sentence):
    data = PoseStampedCodec('a').encode(5, range(7))
    with pytest.raises(WireError, match=sentence):
        PoseStampedCodec().decode(spoil(data))


@pytest.mark.parametrize('values', [range(6), range(8), ['x'] * 7])
def test_values_that_do_not_fit_are_refused_with_the_names_of_the_fields(values):
    with pytest.raises(WireError, match='position'):
        PoseStampedCodec().encode(0, list(values))


def test_padding_at_the_end_as_some_middleware_adds_is_accepted():
    data = WrenchStampedCodec('a').encode(5, range(6))
    assert WrenchStampedCodec().decode(data + bytes(3)) == WrenchStampedCodec().decode(data)
