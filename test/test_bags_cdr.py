"""Messages are read from bags by the definitions in them, without ROS, as ROS would read them."""

import random
from typing import Any

import numpy as np
import pytest
from cutting_trainer_msgs.msg import Contact, CutReport, ForceSample, FrameInputs, Mesh, MeshDelta
from cutting_trainer_msgs.srv import Cut, GetMesh
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.serialization import serialize_message
from service_msgs.msg import ServiceEventInfo

from cutting_trainer.bags.cdr import Decoder
from cutting_trainer.bags.errors import BagError
from cutting_trainer.bags.message_text import schema_text

SOURCE = random.Random(3)


def mesh_delta() -> MeshDelta:
    return MeshDelta(
        revision=2**63 + 1,
        displaced=[3, 1],
        displacement=[SOURCE.random() for _ in range(6)],
        fixed=[1],
        triangle_kind=[0, 1, 1],
        state_hash=2**64 - 1,
    )


def cut_event() -> Any:
    report = CutReport(method='combined', cases=[1, 2], area=2e-5, warnings=['thin', '', 'µ'])
    response = Cut.Response(success=True, node_weights=[0.25] * 4, report=report)
    info = ServiceEventInfo(event_type=2, sequence_number=-5)
    return Cut.Event(info=info, response=[response])


MESSAGES = {
    'cutting_trainer_msgs/msg/Contact': Contact(nodes=range(9), weights=[0.1] * 9, state=2),
    'cutting_trainer_msgs/msg/ForceSample': ForceSample(step=7, stiffness=np.arange(9.0)),
    'cutting_trainer_msgs/msg/FrameInputs': FrameInputs(step=7, has_contact=True, answer=3),
    'cutting_trainer_msgs/msg/Mesh': Mesh(scene='liver', rest=[0.5] * 3, fixed=[1]),
    'cutting_trainer_msgs/msg/MeshDelta': mesh_delta(),
    'cutting_trainer_msgs/srv/Cut_Event': cut_event(),
    'cutting_trainer_msgs/srv/GetMesh_Event': GetMesh.Event(request=[GetMesh.Request()]),
    'diagnostic_msgs/msg/DiagnosticArray': DiagnosticArray(
        status=[
            DiagnosticStatus(level=b'\x02', name='a', values=[KeyValue(key='k', value='v')]),
            DiagnosticStatus(level=b'\x00', name='b'),
        ]
    ),
}


def same(ours: Any, theirs: Any) -> bool:
    if hasattr(theirs, 'get_fields_and_field_types'):
        names = theirs.get_fields_and_field_types()
        return set(vars(ours)) == set(names) and all(
            same(getattr(ours, name), getattr(theirs, name)) for name in names
        )
    if isinstance(theirs, bytes):
        return bool(ours == theirs[0])
    if isinstance(theirs, str | int | float | np.number):
        return bool(ours == theirs)
    return len(ours) == len(theirs) and all(map(same, ours, theirs))


@pytest.mark.parametrize('name', MESSAGES)
def test_every_field_is_as_ros_wrote_it(name: str) -> None:
    message = MESSAGES[name]
    decoder = Decoder({name: schema_text(name)})
    assert same(decoder.decode(name, serialize_message(message)), message)


def test_arrays_of_numbers_come_as_arrays() -> None:
    name = 'cutting_trainer_msgs/msg/MeshDelta'
    read = Decoder({name: schema_text(name)}).decode(name, serialize_message(mesh_delta()))
    assert read.displacement.dtype == np.float64
    assert read.displaced.dtype == np.uint32
    assert read.rest.shape == (0,)


def test_bytes_cut_short_and_unknown_types_are_named() -> None:
    name = 'cutting_trainer_msgs/msg/MeshDelta'
    decoder = Decoder({name: schema_text(name)})
    data = serialize_message(mesh_delta())
    for end in (6, 30, len(data) - 9):
        with pytest.raises(BagError, match='damaged'):
            decoder.decode(name, data[:end])
    with pytest.raises(BagError, match='not little-endian'):
        decoder.decode(name, b'\x00\x00' + data[2:])
    with pytest.raises(BagError, match='does not define the type std_msgs/msg/Empty'):
        decoder.decode('std_msgs/msg/Empty', data)
