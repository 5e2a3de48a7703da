"""Recorded sessions as arrays in one HDF5 file, which any HDF5 library reads.

A stream has all of its messages at their own rate. The mesh changes by cuts, so that its arrays are
ragged: blocks one behind another, and an array of offsets. `docs/studies.md` has the layout.
"""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from cutting_trainer.bags.playback_messages import first_time
from cutting_trainer.bags.reader import Bag, open_bag
from cutting_trainer.bags.recorded_tissue import follow, tissue_messages
from cutting_trainer.bags.topic_names import CUTS, MESH, of_session
from cutting_trainer.node_common.cdr_codec import StampedCodec, StampedMessage
from cutting_trainer.node_common.stamps import nanoseconds
from cutting_trainer.recordings.export_command import STREAMS, TYPES, table_name
from cutting_trainer.session.errors import SessionError
from cutting_trainer.studies.bag_collection import StudyBag
from cutting_trainer.studies.growing_arrays import GrowingArray, RaggedArray, check_arrays
from cutting_trainer.studies.session_metadata import SessionMetadata
from cutting_trainer.tissue_sim.mesh.replica import MeshReplica, state_hash

FORMAT, VERSION, ENDING = 'cutting_trainer sessions', 1, '.h5'
UNITS = {
    **dict.fromkeys(('position', 'device', 'proxy', 'point', 'proxy_radius'), 'm'),
    **dict.fromkeys(('blade_root', 'blade_tip'), 'm'),
    **dict.fromkeys(('force', 'external_force', 'resistance'), 'N'),
    **dict.fromkeys(('torque', 'torque_resistance'), 'N m'),
    **dict.fromkeys(('coupling_stiffness', 'stiffness'), 'N/m'),
    **dict.fromkeys(('kinetic_energy', 'elastic_energy'), 'J'),
    'linear': 'm/s',
    'angular': 'rad/s',
    'contact_stamp_seconds': 's',
    'contact_stamp_nanoseconds': 'ns',
}
"""Unit by field of a stream; others have none."""
_BATCH = 1024
"""Messages in memory."""
_TIME = ('time', np.float64, (), 's', 'of recording, since the first message of the bag')
_STAMP = ('stamp_ns', np.int64, (), 'ns', 'header.stamp of the message, since the epoch')
_SWEEP = ('root_from', 'tip_from', 'root_to', 'tip_to')
_CALL = {'tool': np.uint8, 'command': np.uint8, 'revision': np.uint64}
_ANSWER = {'success': np.uint8, 'error_code': np.uint16, 'topology': np.uint64}
_REPORT: dict[str, tuple[Any, str]] = {
    'touched': (np.uint32, '1'), 'removed': (np.uint32, '1'), 'added': (np.uint32, '1'),
    'new_nodes': (np.uint32, '1'), 'area': (np.float64, 'm^2'),
    'removed_volume': (np.float64, 'm^3'), 'worst_altitude': (np.float64, 'm'),
    'duration': (np.float64, 's'),
}  # fmt: skip


def write_sessions(
    bags: Sequence[StudyBag],
    output: Path,
    data_licence: str,
    progress: Callable[[str], None] = lambda name: None,
) -> list[Path]:
    """Write sessions into one file, and read it back.

    Args:
        bags: to write.
        output: new file, .h5.
        data_licence: SPDX identifier of the recordings' licence; '': not said.
        progress: called with the name of each bag.

    Returns:
        The written file.

    Raises:
        BagError: a bag has no tissue.
        SessionError: the file exists, or differs from the bags when it is read back.
    """
    if output.suffix != ENDING:
        raise SessionError(f'{output}: a file of arrays ends in {ENDING}')
    if output.exists():
        raise SessionError(f'{output} exists already: name a new file')
    if not output.parent.is_dir():
        raise SessionError(f'{output.parent} does not exist: make it first')
    part = output.with_name(f'{output.name}.part')
    metadata, digests = SessionMetadata(), dict[str, str]()
    try:
        part.touch()  # its error names the file, that of HDF5 does not
        with h5py.File(part, 'w', rdcc_nbytes=0) as file:  # blocks are whole chunks
            file.attrs.update(format=FORMAT, version=VERSION, licence=data_licence)
            for number, bag in enumerate(bags):
                progress(bag.name)
                group = file.create_group(f'sessions/{number:04d}')
                digests |= {a.name: a.digest() for a in _write_session(group, bag, metadata)}
        check_arrays(part, digests)
        _check_tissues(part)
        part.replace(output)
    finally:
        part.unlink(missing_ok=True)
    return [output]


def _write_session(
    group: h5py.Group, bag: StudyBag, metadata: SessionMetadata
) -> list[GrowingArray]:
    opened = open_bag(bag.path)
    about = metadata.of(bag, opened)
    lost = group.create_group('lost_messages')
    lost.attrs['about'] = 'number of lost messages by topic; a topic that lost none is not named'
    lost.attrs.update(about.pop('lost_messages'))
    group.attrs.update(about)
    origin = first_time(opened)
    return [
        *_write_streams(group.create_group('streams'), opened, origin),
        *_write_tissue(group.create_group('tissue'), opened, origin),
        *_write_cuts(group.create_group('cuts'), opened, origin),
    ]


class _Stream:
    """Arrays of one stream, one for each field."""

    def __init__(self, group: h5py.Group, kind: type[StampedCodec]) -> None:
        self._group, self._codec = group, kind()
        self._fields = list(kind.fields.values())
        self._time, self._stamp = GrowingArray(group, *_TIME), GrowingArray(group, *_STAMP)
        self._values = [
            GrowingArray(
                group, name, TYPES[code], (count,) if count > 1 else (), UNITS.get(name, '1')
            )
            for name, code, count in kind.layout
        ]
        self._waiting: list[tuple[float, StampedMessage]] = []
        self.arrays = [self._time, self._stamp, *self._values]

    def add(self, time: float, data: bytes) -> None:
        """Add a message."""
        self._waiting.append((time, self._codec.decode(data)))
        if len(self._waiting) == _BATCH:
            self.flush()

    def flush(self) -> None:
        """Move the messages that wait into the arrays."""
        if not self._waiting:
            return
        times, samples = zip(*self._waiting, strict=True)
        self._group.attrs.setdefault('frame_id', samples[0].frame_id)
        self._time.append(times)
        self._stamp.append([sample.stamp_ns for sample in samples])
        for array, of in zip(self._values, self._fields, strict=True):
            array.append([sample.values[of] for sample in samples])
        self._waiting.clear()


def _write_streams(group: h5py.Group, bag: Bag, origin: int) -> Iterator[GrowingArray]:
    topics, streams = bag.topics(), dict[str, _Stream]()
    for topic, kind in STREAMS.items():
        if (found := of_session(topic, topics)) in topics:
            own = group.create_group(table_name(topic))
            own.attrs['topic'] = found
            streams[found] = _Stream(own, kind)
    for recorded in bag.messages(streams):
        streams[recorded.topic].add((recorded.log_time - origin) * 1e-9, recorded.data)
    for stream in streams.values():
        stream.flush()
        yield from _flushed(stream.arrays)


def _write_tissue(group: h5py.Group, bag: Bag, origin: int) -> Iterator[GrowingArray]:
    frames = {
        of[0]: GrowingArray(group, *of)
        for of in (
            _TIME, _STAMP,
            ('step', np.uint64, (), '1', 'simulation frame'),
            ('revision', np.uint64, (), '1', 'counts published changes'),
            ('topology', np.uint64, (), '1', 'counts changes of connectivity'),
            ('block', np.int64, (), '1', 'block in the arrays of group connectivity'),
        )
    }  # fmt: skip
    moved = GrowingArray(
        group, 'displacement', np.float64, (3,), 'm', 'current minus rest position of each node'
    )
    shape = RaggedArray(group, 'displacement_offset', moved)
    own = group.create_group('connectivity')
    nodes = (
        GrowingArray(own, 'rest', np.float64, (3,), 'm', 'rest position of each node'),
        GrowingArray(own, 'fixed', np.uint8, about='1 where the node does not move'),
    )
    solids = (
        GrowingArray(own, 'tetrahedra', np.uint32, (4,), about='nodes, positively oriented'),
        GrowingArray(own, 'region', np.uint8, about="row of the scene's materials"),
    )
    faces = (
        GrowingArray(own, 'triangles', np.uint32, (3,), about='nodes, seen from outside'),
        GrowingArray(own, 'triangle_kind', np.uint8, about='0: original surface, 1: cut face'),
    )
    ragged = (
        RaggedArray(own, 'node_offset', *nodes),
        RaggedArray(own, 'tetrahedron_offset', *solids),
        RaggedArray(own, 'triangle_offset', *faces),
    )
    replica, block = MeshReplica(), -1
    for recorded in tissue_messages(bag):
        message, before = bag.read(recorded), _counts(replica)
        revision = replica.revision
        follow(replica, recorded.topic, message)
        if replica.revision == revision:
            continue  # another keyframe of the same state, or a delta that fits none
        if recorded.topic == MESH or _reconnects(message) or _counts(replica) != before:
            block += 1
            region = replica.regions
            regions = region if len(region) else np.zeros(len(replica.tetrahedra), np.uint8)
            ragged[0].append(replica.rest, replica.fixed)
            ragged[1].append(replica.tetrahedra, regions)
            ragged[2].append(replica.triangles, replica.triangle_kind)
        row = {
            'time': (recorded.log_time - origin) * 1e-9,
            'stamp_ns': nanoseconds(message.header.stamp),
            'step': replica.step, 'revision': replica.revision, 'topology': replica.topology,
            'block': block,
        }  # fmt: skip
        for name, value in row.items():
            frames[name].append([value])
        shape.append(replica.displacement)
    offsets = (of.offset for of in (shape, *ragged))
    yield from _flushed([*frames.values(), moved, *nodes, *solids, *faces, *offsets])


def _counts(replica: MeshReplica) -> tuple[int, int, int]:
    return len(replica.rest), len(replica.tetrahedra), len(replica.triangles)


def _reconnects(delta: Any) -> bool:
    slots = (delta.rest_changed, delta.tetrahedra_changed, delta.triangles_changed)
    return any(len(of) for of in slots)


def _write_cuts(group: h5py.Group, bag: Bag, origin: int) -> Iterator[GrowingArray]:
    """Write a row for each answered call of the cutting service."""
    group.attrs['about'] = 'answered calls; command 0: sweep, 1: finish, 2: abort, 3: say the state'
    answered = ('stamp_ns', np.int64, (), 'ns', 'of the answer, since the epoch')
    arrays = {of[0]: GrowingArray(group, *of) for of in (_TIME, answered)}
    for name, number in (_CALL | _ANSWER).items():
        arrays[name] = GrowingArray(group, name, number)
    for name in _SWEEP:
        about = 'end of the cutting edge before or after the sweep'
        arrays[name] = GrowingArray(group, name, np.float64, (3,), 'm', about)
    for name, (dtype, unit) in _REPORT.items():
        arrays[name] = GrowingArray(group, name, dtype, (), unit)
    asked: dict[tuple[bytes, int], Any] = {}
    for recorded in bag.messages([CUTS]):
        event = bag.read(recorded)
        call = bytes(event.info.client_gid), event.info.sequence_number
        if event.request:
            asked[call] = event.request[0]
        if not event.response or call not in asked:
            continue
        request, answer = asked.pop(call), event.response[0]
        group.attrs.setdefault('method', answer.report.method)
        sources = (
            (request, (*_CALL, *_SWEEP)), (answer, _ANSWER), (answer.report, _REPORT),
        )  # fmt: skip
        arrays['time'].append([(recorded.log_time - origin) * 1e-9])
        arrays['stamp_ns'].append([nanoseconds(event.info.stamp)])
        for source, names in sources:
            for name in names:
                arrays[name].append([getattr(source, name, 0)])  # an old bag has no tool
    yield from _flushed(list(arrays.values()))


def _flushed(arrays: Sequence[GrowingArray]) -> Sequence[GrowingArray]:
    for array in arrays:
        array.flush()
    return arrays


def _check_tissues(file: Path) -> None:
    """Compare the last tissue of each session, built from the file alone, with its hash."""
    with h5py.File(file) as opened:
        for name, group in opened['sessions'].items():
            tissue, of = group['tissue'], group['tissue/connectivity']
            block = int(tissue['block'][-1])
            nodes, solids = (
                slice(*of[f'{kind}_offset'][block : block + 2]) for kind in ('node', 'tetrahedron')
            )
            moved = tissue['displacement'][slice(*tissue['displacement_offset'][-2:])]
            found = state_hash(of['rest'][nodes], moved, of['tetrahedra'][solids])
            if f'{found:016x}' != group.attrs['tissue_hash']:
                raise SessionError(f'{file} has another tissue at the end of session {name}')
