"""What cannot be used is refused at the edge with a reason, and the statistics stay bounded."""

import math
import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from meshes import irregular_box

from cutting_trainer.node_common.cdr_codec import (
    MAX_FRAME_ID_LENGTH,
    ContactCodec,
    ForceSampleCodec,
    PoseStampedCodec,
    StampedCodec,
    WrenchStampedCodec,
)
from cutting_trainer.node_common.errors import MeshError
from cutting_trainer.node_common.operating_state import OperatingStateMachine
from cutting_trainer.node_common.rejections import (
    MAX_DETAIL_LENGTH,
    MAX_REASON_LENGTH,
    MAX_REASONS,
    OTHER_REASONS,
    MessageError,
    RejectionStatistics,
    require_frame,
)
from cutting_trainer.tissue_sim.contact.incoming import tool_contact
from cutting_trainer.tissue_sim.mesh.replica import MeshReplica, state_hash
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh

pytestmark = pytest.mark.long

NODES = 20
TISSUE = SimpleNamespace(node_count=NODES, topology=0)
BAD = (math.nan, math.inf, -math.inf, 1e300, -1e300)


def contact(**changed: Any) -> SimpleNamespace:
    """A contact as the bridge sends it, with some fields of another value."""
    header = SimpleNamespace(frame_id='tissue', stamp=SimpleNamespace(sec=1, nanosec=2))
    fields: dict[str, Any] = {
        'header': header,
        'sequence': 5,
        'state': 1,
        'topology': 0,
        'nodes': np.array([1, 2, 3] + [0] * 6, np.uint32),
        'weights': np.array([0.5, 0.25, 0.25] + [0.0] * 6),
        'normal': np.array([0.0, 0.0, 1.0]),
        'coupling_stiffness': 200.0,
        'proxy_radius': 0.004,
        'tool': 0,
        'mode': 0,
        'blade_facing': np.zeros(3),
    }
    for name in ('device', 'proxy', 'point', 'blade_root', 'blade_tip', 'external_force'):
        fields[name] = np.zeros(3)
    return SimpleNamespace(**fields | changed)


def mesh(**changed: Any) -> SimpleNamespace:
    """A mesh as `tissue_sim` sends it, with some fields of another value."""
    tissue = TetMesh(*irregular_box((1, 1, 1), 0.01, 3))
    still = np.zeros_like(tissue.rest)
    fields: dict[str, Any] = {
        'rest': tissue.rest.ravel().copy(),
        'displacement': still.ravel(),
        'fixed': tissue.fixed.copy(),
        'tetrahedra': tissue.tetrahedra.ravel().copy(),
        'triangles': tissue.triangles.ravel().copy(),
        'triangle_kind': tissue.triangle_kind.copy(),
        'revision': 3,
        'topology': 0,
        'step': 0,
        'state_hash': state_hash(tissue.rest, still, tissue.tetrahedra),
    }
    return SimpleNamespace(**fields | changed)


def spoilt(values: np.ndarray, value: float) -> np.ndarray:
    out = values.copy()
    out[-1] = value
    return out


@pytest.mark.parametrize('bad', BAD)
@pytest.mark.parametrize(
    'name', ['weights', 'device', 'proxy', 'point', 'normal', 'blade_root', 'blade_tip']
)
def test_a_contact_with_a_number_that_cannot_be_is_refused_by_name(name: str, bad: float) -> None:
    tool_contact(contact(), TISSUE)
    with pytest.raises(MessageError, match=name) as refused:
        tool_contact(contact(**{name: spoilt(getattr(contact(), name), bad)}), TISSUE)
    assert refused.value.reason == 'not finite or too far'


def test_a_contact_of_before_a_cut_that_took_nodes_away_is_none_of_its_nodes() -> None:
    """What it touched may be gone, and is nobody's fault; a blade in the tissue is held by it."""
    late = tool_contact(contact(nodes=np.full(9, NODES, np.uint32), topology=7), TISSUE)
    assert len(late.nodes) == len(late.weights) == 0
    assert late.topology == 7
    np.testing.assert_array_equal(late.blade_tip, contact().blade_tip)
    assert len(tool_contact(contact(), TISSUE).nodes) > 0


@pytest.mark.parametrize(
    ('changed', 'reason'),
    [
        ({'state': 3}, 'no such state'),
        ({'tool': 1}, 'no such tool'),
        ({'mode': 4}, 'no such mode of the tool'),
        ({'blade_facing': np.array([0.6, 0.0, 0.6])}, 'no unit vector'),
        ({'nodes': np.full(9, 2**32 - 1, np.uint32)}, 'index out of range'),
        ({'weights': np.full(9, 0.5)}, 'invalid weights'),
        ({'normal': np.array([0.0, 0.0, 1.1])}, 'invalid normal'),
        ({'coupling_stiffness': math.nan}, 'stiffness out of range'),
        ({'coupling_stiffness': -1.0}, 'stiffness out of range'),
        ({'coupling_stiffness': 0.0}, 'stiffness out of range'),
        ({'coupling_stiffness': 5e-324, 'state': 0}, 'stiffness out of range'),
        ({'coupling_stiffness': 2e5}, 'stiffness out of range'),
        ({'proxy_radius': math.inf}, 'radius out of range'),
        ({'proxy_radius': 9e-6}, 'radius out of range'),
        ({'external_force': np.array([math.nan, 0.0, 0.0])}, 'force out of range'),
        (
            {'header': SimpleNamespace(frame_id='arm', stamp=contact().header.stamp)},
            'wrong frame',
        ),
        *(
            (
                {
                    'header': SimpleNamespace(
                        frame_id='tissue', stamp=SimpleNamespace(sec=0, nanosec=nanoseconds)
                    )
                },
                'no such time',
            )
            for nanoseconds in (10**9, 2**32 - 1)
        ),
    ],
)
def test_each_other_field_of_a_contact_is_refused_with_its_reason(changed, reason: str) -> None:
    with pytest.raises(MessageError) as refused:
        tool_contact(contact(**changed), TISSUE)
    assert refused.value.reason == reason


@pytest.mark.parametrize(
    ('changed', 'reason'),
    [
        *(({'rest': spoilt(mesh().rest, bad)}, 'not finite or too far') for bad in BAD),
        *(({'displacement': spoilt(mesh().rest, bad)}, 'not finite or too far') for bad in BAD),
        ({'tetrahedra': spoilt(mesh().tetrahedra, 99)}, 'index out of range'),
        ({'triangles': spoilt(mesh().triangles, 99)}, 'index out of range'),
        ({'tetrahedra': mesh().tetrahedra[:-1]}, 'arrays that do not fit'),
        ({'fixed': mesh().fixed[:-1]}, 'arrays that do not fit'),
        ({'rest': np.zeros(0)}, 'index out of range'),
        ({'rest': mesh().rest + 1e-6}, 'wrong hash'),
        ({'tetrahedra': np.roll(mesh().tetrahedra, 4)}, 'wrong hash'),
    ],
)
def test_a_mesh_that_cannot_be_is_refused_and_the_one_before_stays(changed, reason: str) -> None:
    replica = MeshReplica()
    replica.load(mesh())
    before = replica.hash()
    with pytest.raises(MessageError) as refused:
        replica.load(mesh(revision=9, **changed))
    assert refused.value.reason == reason
    assert (replica.revision, replica.hash()) == (3, before)


@pytest.mark.parametrize('bad', BAD)
@pytest.mark.parametrize('field', ['displacement', 'rest'])
def test_a_delta_with_a_number_that_cannot_be_changes_nothing(field: str, bad: float) -> None:
    replica = MeshReplica()
    replica.load(mesh())
    before, empty = replica.hash(), np.zeros(0)
    delta = SimpleNamespace(
        base_revision=3,
        revision=4,
        topology=0,
        step=1,
        node_count=len(replica.rest),
        tetrahedron_count=len(replica.tetrahedra),
        triangle_count=len(replica.triangles),
        **dict.fromkeys(('tetrahedra_changed', 'tetrahedra', 'triangles_changed'), empty),
        **dict.fromkeys(('triangles', 'triangle_kind'), empty),
        **{'displaced': np.array([1]), 'displacement': np.zeros(3)},
        **{'rest_changed': np.array([1]), 'rest': np.zeros(3), 'fixed': np.zeros(1)},
    )
    setattr(delta, field, np.array([0.0, bad, 0.0]))
    with pytest.raises(MessageError, match=field):
        replica.apply(delta)
    assert (replica.revision, replica.hash()) == (3, before)


@pytest.mark.parametrize('codec', [PoseStampedCodec, WrenchStampedCodec, ContactCodec])
@pytest.mark.parametrize('bad', BAD)
def test_a_sample_with_a_quantity_that_cannot_be_is_not_believed(
    codec: type[StampedCodec], bad: float
) -> None:
    for name, code, _ in codec.layout:
        values: list[Any] = [0] * codec.fields[codec.layout[-1][0]].stop
        if codec is PoseStampedCodec:
            values[-1] = 1.0
        codec().believed(codec().encode(5, values))
        if code == 'd':
            values[codec.fields[name].start] = bad
            with pytest.raises(MessageError, match=name):
                codec().believed(codec().encode(5, values))


def test_an_orientation_or_a_state_that_does_not_exist_is_not_believed() -> None:
    with pytest.raises(MessageError, match='unit quaternion'):
        PoseStampedCodec().believed(PoseStampedCodec().encode(5, [0.0] * 7))
    for codec in (ContactCodec, ForceSampleCodec):
        values = [0] * codec.fields[codec.layout[-1][0]].stop
        values[codec.fields['state'].start] = 3
        with pytest.raises(MessageError, match='no such state'):
            codec().believed(codec().encode(5, values))
        values = [0] * len(values)
        values[codec.fields['tool'].start] = 4
        with pytest.raises(MessageError, match=r'tool 4 of .*: a scene has 4 at most, from 0'):
            codec().believed(codec().encode(5, values))


def test_a_mode_of_the_tool_that_does_not_exist_is_not_believed() -> None:
    values = [0] * ContactCodec.fields['mode'].stop
    values[-1] = 4
    with pytest.raises(MessageError, match='no such mode'):
        ContactCodec().believed(ContactCodec().encode(5, values))


def test_a_surface_that_is_not_that_of_its_tetrahedra_makes_no_mesh() -> None:
    replica, sent = MeshReplica(), mesh()
    replica.load(mesh(triangles=sent.triangles[3:], triangle_kind=sent.triangle_kind[1:]))
    with pytest.raises(MeshError, match='surface triangles were sent'):
        replica.mesh()


def test_frames_without_end_are_refused_and_new_ones_take_no_memory() -> None:
    reader = PoseStampedCodec()
    values = (*[0.0] * 6, 1.0)
    for number in range(1000):
        assert reader.decode(PoseStampedCodec(f'{number}').encode(5, values)).frame_id
    assert len(reader._frames) < 100
    reader.decode(PoseStampedCodec('x' * MAX_FRAME_ID_LENGTH).encode(5, values))
    with pytest.raises(MessageError, match='at most') as refused:
        reader.decode(PoseStampedCodec('x' * (MAX_FRAME_ID_LENGTH + 1)).encode(5, values))
    assert refused.value.reason == 'frame_id too long'
    with pytest.raises(MessageError, match='wrong frame'):
        require_frame('tool/contact', 'x' * 100_000)


def test_rejections_are_counted_by_topic_and_reason() -> None:
    rejections = RejectionStatistics()
    for number in range(5):
        rejections.add('tool/contact', MessageError('no such state', f'state {number}'))
    rejections.add('cutting/cut', KeyError('x'))
    assert rejections.values() == {
        'refused tool/contact: no such state': 5,
        'refused cutting/cut: KeyError': 1,
    }
    assert rejections.total == 6


def test_counts_and_lines_are_bounded_whatever_comes() -> None:
    rejections = RejectionStatistics()
    for number in range(1000):
        text = f'{number} \n\x1b[31m{"x" * 100_000}'
        rejections.add(f'topic{number}', MessageError('too large', text))
    values = rejections.values()
    assert len(values) == MAX_REASONS + 1
    assert values[f'refused {OTHER_REASONS}'] == 1000 - MAX_REASONS
    said = rejections.news()
    assert re.fullmatch(r'[ -~]+', said)
    assert len(said) < MAX_REASON_LENGTH + 400
    assert rejections.news() == ''


def test_what_is_said_of_a_message_is_short_however_long_its_strings_are() -> None:
    with pytest.raises(MessageError, match='10000000 characters') as found:
        require_frame('tissue/mesh', 10_000_000 * 'x')
    assert len(str(found.value)) < MAX_DETAIL_LENGTH + 100
    assert len(str(MessageError('no such message', 10_000_000 * 'x'))) < MAX_DETAIL_LENGTH + 100
    machine = OperatingStateMachine()
    assert len(machine.command(1_000_000 * 'x')) < MAX_DETAIL_LENGTH
