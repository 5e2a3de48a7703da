"""Recorded sessions as a data set of LeRobot, format v3.0: tables, no videos.

Format: github.com/huggingface/lerobot, `src/lerobot/datasets/utils.py` of version 0.4. An episode
is a bag, a frame is a tick of its force loop, so that forces keep their rate. Each stream has its
newest value at each tick.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from cutting_trainer.bags.errors import BagError
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

VERSION = 'v3.0'
INFO_FILE, EPISODES_FILE = 'meta/info.json', 'meta/trainer_episodes.json'
_CHUNK = 1000
"""Files of a folder."""
_DATA = 'data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet'
_QUANTILES = {'q01': 0.01, 'q10': 0.1, 'q50': 0.5, 'q90': 0.9, 'q99': 0.99}
_RATE_TOLERANCE = 0.02
_STREAMS: dict[str, tuple[str, type[StampedCodec], tuple[str, ...], tuple[str, ...]]] = {
    'observation.state': (POSE, PoseStampedCodec, ('position', 'orientation'),
                          ('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw')),
    'observation.force': (SERVO_CF, WrenchStampedCodec, ('force',), ('x', 'y', 'z')),
    'observation.contact': (CONTACT, ContactCodec, ('state', 'device', 'proxy'),
                            ('state', 'tip_x', 'tip_y', 'tip_z',
                             'proxy_x', 'proxy_y', 'proxy_z')),
    'observation.tissue': (FORCE, ForceSampleCodec,
                           ('force', 'resistance', 'kinetic_energy', 'elastic_energy', 'topology'),
                           ('force_x', 'force_y', 'force_z', 'resistance', 'kinetic_energy',
                            'elastic_energy', 'cuts')),
}  # fmt: skip
"""Features: topic, codec, its fields, and names of the values; all in SI units."""
_SCALARS = {'timestamp': 'float32', 'frame_index': 'int64', 'episode_index': 'int64',
            'index': 'int64', 'task_index': 'int64'}  # fmt: skip


@dataclass(frozen=True)
class Episode:
    """A bag as an episode.

    Attributes:
        values: of each feature, each shape (n, k).
        about: metadata.
    """

    values: dict[str, Floats]
    about: dict[str, Any]

    @property
    def task(self) -> str:
        """Name of the scene."""
        return str(self.about['scene'])

    @property
    def length(self) -> int:
        """Number of frames."""
        return len(self.values['action'])


def write_dataset(
    bags: Sequence[StudyBag],
    output: Path,
    data_licence: str,
    progress: Callable[[str], None] = lambda name: None,
) -> list[Path]:
    """Write a data set, and read it back.

    Args:
        bags: of one rate of the force loop.
        output: new folder.
        data_licence: SPDX identifier of the recordings' licence; '': not said.
        progress: called with the name of each bag.

    Returns:
        Written files of metadata.

    Raises:
        BagError: a bag lacks a stream.
        SessionError: the folder exists, rates differ, or a file read back differs from its bag.
    """
    if output.exists():
        raise SessionError(f'{output} exists already: name a new folder for the data set')
    tasks: dict[str, int] = {}
    metadata = SessionMetadata()
    rows, about, first, rates = [], list[dict[str, Any]](), 0, dict[int, str]()
    totals: dict[str, list[Floats]] = {}
    for number, bag in enumerate(bags):
        progress(bag.name)
        episode, rate = _episode(bag, metadata)
        rates.setdefault(rate, bag.name)
        if len(rates) > 1:
            said = ' and '.join(f'{name} has {hz} Hz' for hz, name in rates.items())
            raise SessionError(f'{said}: a data set has one rate; export them apart')
        task = tasks.setdefault(episode.task, len(tasks))
        table = _table(episode, rate, number, first, task)
        chunk, file = divmod(number, _CHUNK)
        path = output / _DATA.format(chunk_index=chunk, file_index=file)
        _write(table, path)
        _check(path, episode, bag)
        columns = {**episode.values} | {
            name: np.asarray(table.column(name), float)[:, None] for name in _SCALARS
        }
        for name, values in columns.items():
            totals.setdefault(name, []).append(values)
        rows.append(
            {
                'episode_index': number,
                'tasks': [episode.task],
                'length': episode.length,
                'data/chunk_index': chunk,
                'data/file_index': file,
                'dataset_from_index': first,
                'dataset_to_index': first + episode.length,
                'meta/episodes/chunk_index': 0,
                'meta/episodes/file_index': 0,
                **{
                    f'stats/{name}/{kind}': value
                    for name, values in columns.items()
                    for kind, value in _statistics(values).items()
                },
            }
        )
        about.append({'episode_index': number, **episode.about})
        first += episode.length
    _write(pa.Table.from_pylist(rows), output / 'meta/episodes/chunk-000/file-000.parquet')
    _write_tasks(list(tasks), output / 'meta/tasks.parquet')
    statistics = {name: _statistics(np.vstack(values)) for name, values in totals.items()}
    info = {
        'codebase_version': VERSION,
        'robot_type': 'cutting_trainer',
        'total_episodes': len(bags),
        'total_frames': first,
        'total_tasks': len(tasks),
        'chunks_size': _CHUNK,
        'data_files_size_in_mb': 100,
        'video_files_size_in_mb': 200,
        'fps': next(iter(rates)),
        'splits': {'train': f'0:{len(bags)}'},
        'data_path': _DATA,
        'video_path': None,
        'features': _features(),
        'license': data_licence,
    }
    written = {INFO_FILE: info, 'meta/stats.json': statistics, EPISODES_FILE: about}
    for name, content in written.items():
        (output / name).write_text(json.dumps(content, indent=2), encoding='utf-8')
    return [output / name for name in written]


def _episode(bag: StudyBag, metadata: SessionMetadata) -> tuple[Episode, int]:
    """Return an episode, and the rate of its ticks [Hz]."""
    opened = open_bag(bag.path)
    streams = {}
    for feature, (topic, codec, names, _) in _STREAMS.items():
        streams[feature] = _stream(opened, topic, codec(), names, bag.name)
    stamps, poses = streams['observation.state']
    period = float(np.median(np.diff(stamps))) * 1e-9
    rate = max(round(1.0 / period), 1)
    if abs(rate * period - 1.0) > _RATE_TOLERANCE:
        raise BagError(f'{bag.name} has poses every {period:.4g} s: that is no whole rate')
    begin = max(int(of[0]) for of, _ in streams.values())
    end = int(stamps[-1])
    if end <= begin:
        raise BagError(f'{bag.name} has no time in which it has all of {", ".join(_STREAMS)}')
    ticks = begin + np.arange(int((end - begin) * 1e-9 * rate) + 1) * round(1e9 / rate)
    values = {
        feature: data[np.searchsorted(of, ticks, side='right') - 1]
        for feature, (of, data) in streams.items()
    }
    # The action is where the hand goes next.
    values['action'] = np.vstack([values['observation.state'][1:], poses[-1:]])
    return Episode(values, metadata.of(bag, opened)), rate


def _stream(
    bag: Bag, topic: str, codec: StampedCodec, names: Sequence[str], of: str
) -> tuple[NDArray[np.int64], Floats]:
    """Return stamps [ns], shape (n,), and the values of some fields, shape (n, k)."""
    found = of_session(topic, bag.topics())
    samples = [codec.decode(recorded.data) for recorded in bag.messages([found])]
    samples = [sample for sample in samples if sample.stamp_ns]
    if len(samples) < 2:
        raise BagError(f'{of} has no stream {topic}: it cannot be an episode')
    samples.sort(key=lambda sample: sample.stamp_ns)
    picked = [[v for name in names for v in s.values[codec.fields[name]]] for s in samples]
    return np.array([s.stamp_ns for s in samples], np.int64), np.array(picked, float)


def _features() -> dict[str, dict[str, Any]]:
    names = {feature: of[3] for feature, of in _STREAMS.items()}
    names['action'] = names['observation.state']
    return {
        **{
            feature: {'dtype': 'float64', 'shape': [len(of)], 'names': list(of)}
            for feature, of in names.items()
        },
        **{name: {'dtype': kind, 'shape': [1], 'names': None} for name, kind in _SCALARS.items()},
    }


def _table(episode: Episode, rate: int, number: int, first: int, task: int) -> pa.Table:
    frames = np.arange(episode.length)
    arrays: dict[str, Any] = {
        name: pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])
        for name, values in episode.values.items()
    }
    same = np.ones_like(frames)
    arrays |= {
        'timestamp': pa.array(frames / rate, pa.float32()),
        'frame_index': pa.array(frames),
        'episode_index': pa.array(number * same),
        'index': pa.array(first + frames),
        'task_index': pa.array(task * same),
    }
    return pa.table(arrays)


def _statistics(values: Floats) -> dict[str, list[float]]:
    """Return statistics of each column, as LeRobot has them."""
    kinds = {kind: np.quantile(values, share, axis=0) for kind, share in _QUANTILES.items()}
    kinds |= {
        'min': values.min(axis=0),
        'max': values.max(axis=0),
        'mean': values.mean(axis=0),
        'std': values.std(axis=0),
    }
    return {**{kind: of.tolist() for kind, of in kinds.items()}, 'count': [len(values)]}


def _write(table: pa.Table, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path, compression='snappy')


def _write_tasks(tasks: Sequence[str], path: Path) -> None:
    """Write the tasks as pandas writes a frame whose index they are."""
    index = '__index_level_0__'
    columns = [
        {'name': 'task_index', 'field_name': 'task_index', 'pandas_type': 'int64',
         'numpy_type': 'int64', 'metadata': None},
        {'name': None, 'field_name': index, 'pandas_type': 'unicode', 'numpy_type': 'object',
         'metadata': None},
    ]  # fmt: skip
    pandas = {'index_columns': [index], 'column_indexes': [], 'columns': columns}
    table = pa.table({'task_index': list(range(len(tasks))), index: list(tasks)})
    _write(table.replace_schema_metadata({'pandas': json.dumps(pandas)}), path)


def _check(path: Path, episode: Episode, bag: StudyBag) -> None:
    table = pq.read_table(path)
    for name, values in episode.values.items():
        read = table.column(name).combine_chunks().flatten().to_numpy().reshape(values.shape)
        if not np.array_equal(read, values):
            raise SessionError(f'{path} has another {name} than {bag.name}: the disk is at fault')
