"""The picture of a session shows the tissue of a bag at a moment, gaps in the bag or not."""

from pathlib import Path

import numpy as np
import pytest
from cutting_trainer_msgs.msg import Mesh, MeshDelta
from rclpy.serialization import serialize_message

from cutting_trainer.bags.message_text import schema_text
from cutting_trainer.bags.recorded_qos import OfferedQos
from cutting_trainer.bags.writer import BagWriter
from cutting_trainer.node_common.cdr_codec import ContactCodec, WrenchStampedCodec
from cutting_trainer.recordings import picture
from cutting_trainer.recordings.picture import make_picture, read_story
from cutting_trainer.session.errors import SessionError

pytestmark = pytest.mark.long

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
TYPES = {
    picture.MESH: 'cutting_trainer_msgs/msg/Mesh',
    picture.UPDATES: 'cutting_trainer_msgs/msg/MeshDelta',
    picture.CONTACT: 'cutting_trainer_msgs/msg/Contact',
    picture.SERVO_CF: 'geometry_msgs/msg/WrenchStamped',
}


def keyframe(revision: int) -> Mesh:
    return Mesh(
        revision=revision,
        rest=[0.0, 0, 0, 0.01, 0, 0, 0, 0.01, 0, 0, 0, 0.01],
        displacement=[0.0] * 12,
        fixed=[0] * 4,
        tetrahedra=[0, 1, 2, 3],
        triangles=[0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3],
        triangle_kind=[0, 0, 0, 1],
    )


def delta(base: int, lift: float) -> MeshDelta:
    return MeshDelta(
        base_revision=base,
        revision=base + 1,
        node_count=4,
        tetrahedron_count=1,
        triangle_count=4,
        displaced=[3],
        displacement=[0.0, 0.0, lift],
    )


def contact(state: int, stamp: int) -> bytes:
    size = sum(count for _, _, count in ContactCodec.layout)
    values = [0] * size
    values[ContactCodec.fields['state']] = [state]
    values[ContactCodec.fields['blade_tip']] = [0.0, 0.0, 0.02]
    return ContactCodec('tissue').encode(stamp, tuple(values))


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """Two seconds: a delta each half second, one of them lost, a keyframe after it; a contact."""
    folder = tmp_path / 'bag'
    writer = BagWriter(folder, custom_data={})
    for topic, kind in TYPES.items():
        writer.add_topic(topic, kind, schema_text(kind), '', [OfferedQos()])

    def write(topic: str, time: float, data: bytes) -> None:
        stamp = START + int(time * SECOND)
        writer.write(topic, stamp, stamp, data, 0)

    write(picture.MESH, 0.0, serialize_message(keyframe(0)))
    write(picture.UPDATES, 0.5, serialize_message(delta(0, 0.001)))
    write(picture.UPDATES, 1.0, serialize_message(delta(2, 0.003)))
    write(picture.MESH, 1.5, serialize_message(keyframe(3)))
    for number, state in enumerate((0, 1, 1, 2, 0)):
        stamp = START + number * SECOND // 2
        write(picture.CONTACT, number / 2, contact(state, stamp))
        wrench = WrenchStampedCodec('arm').encode(stamp, (0.0, 0.0, float(state), 0, 0, 0))
        write(picture.SERVO_CF, number / 2, wrench)
    writer.close()
    return folder


def test_tissue_is_that_of_the_moment(bag: Path) -> None:
    story = read_story(bag, 0.7)
    assert story.replica.revision == 1
    assert story.replica.displacement[3, 2] == 0.001
    assert story.moment == 0.7


def test_lost_delta_is_healed_by_the_next_keyframe(bag: Path) -> None:
    assert read_story(bag, 1.2).replica.revision == 1
    story = read_story(bag, None)
    assert story.replica.revision == 3
    assert story.moment == pytest.approx(2.0)


def test_force_and_contact_are_shown_to_the_end_whatever_the_moment(bag: Path) -> None:
    story = read_story(bag, 0.1)
    np.testing.assert_allclose(story.forces[:, 1], [0, 1, 1, 2, 0])
    np.testing.assert_allclose(picture.spans(story.tool, None), [[0.5, 1.5]])
    np.testing.assert_allclose(picture.spans(story.tool, 2), [[1.5, 2.0]])


@pytest.mark.parametrize('ending', picture.FORMATS)
def test_picture_is_written_in_the_format_of_its_name(bag: Path, ending: str) -> None:
    file = bag / f'picture{ending}'
    make_picture(bag, file, None)
    magic = {'.png': b'\x89PNG', '.svg': b'<?xml', '.pdf': b'%PDF'}
    assert file.read_bytes().startswith(magic[ending])


def test_bag_without_tissue_and_files_that_cannot_be_are_refused(bag: Path, tmp_path: Path) -> None:
    with pytest.raises(SessionError, match='no picture'):
        make_picture(bag, bag / 'picture.txt', None)
    with pytest.raises(SessionError, match='does not exist'):
        make_picture(bag, bag / 'no' / 'picture.png', None)
    writer = BagWriter(tmp_path / 'empty', custom_data={})
    writer.close()
    with pytest.raises(SessionError, match='no tissue to draw'):
        make_picture(tmp_path / 'empty', bag / 'picture.png', None)
