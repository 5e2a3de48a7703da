"""Recorded sessions as a data set of LeRobot, format v3.0.

Format: github.com/huggingface/lerobot, `src/lerobot/datasets/utils.py` of version 0.4. An episode
is a bag.
"""

import json
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from cutting_trainer.session.errors import SessionError
from cutting_trainer.studies import dataset_video as video
from cutting_trainer.studies.bag_collection import StudyBag
from cutting_trainer.studies.dataset_episode import (
    ACTION,
    FORCES,
    STATE,
    STREAMS,
    Episode,
    read_episode,
)
from cutting_trainer.studies.session_metadata import SessionMetadata

Floats = NDArray[np.float64]

VERSION = 'v3.0'
INFO_FILE, EPISODES_FILE = 'meta/info.json', 'meta/trainer_episodes.json'
_CHUNK = 1000
"""Files of a folder."""
_DATA = 'data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet'
_QUANTILES = {'q01': 0.01, 'q10': 0.1, 'q50': 0.5, 'q90': 0.9, 'q99': 0.99}
_SCALARS = {'timestamp': 'float32', 'frame_index': 'int64', 'episode_index': 'int64',
            'index': 'int64', 'task_index': 'int64'}  # fmt: skip


def write_dataset(
    bags: Sequence[StudyBag],
    output: Path,
    data_licence: str,
    progress: Callable[[str], None] = lambda name: None,
    *,
    pictures: bool = False,
) -> list[Path]:
    """Write a data set, and read it back.

    Args:
        bags: of one rate of the force loop.
        output: new folder.
        data_licence: SPDX identifier of the recordings' licence; '': not said.
        progress: called with the name of each bag.
        pictures: a frame is a picture of a video, not a tick of the force loop.

    Returns:
        Written files of metadata.

    Raises:
        BagError: a bag lacks a stream.
        SessionError: the folder exists, rates differ, a bag cannot be drawn, or a file read back
            differs from its bag.
    """
    if output.exists():
        raise SessionError(f'{output} exists already: name a new folder for the data set')
    metadata = SessionMetadata()
    output.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f'{output.name}.', dir=output.parent) as temporary:
        dataset = _Dataset(Path(temporary, output.name), pictures=pictures)
        for bag in bags:
            progress(bag.name)
            dataset.add(bag, read_episode(bag, metadata))
        names = dataset.finish(data_licence)
        Path(temporary, output.name).rename(output)
    return [output / name for name in names]


class _Dataset:
    """A data set that is written."""

    def __init__(self, folder: Path, *, pictures: bool) -> None:
        self._folder, self._pictures = folder, pictures
        self._tasks: dict[str, int] = {}
        self._rows: list[dict[str, Any]] = []
        self._about: list[dict[str, Any]] = []
        self._rates: dict[int, str] = {}
        self._totals: dict[str, list[Floats]] = {}
        self._shades = video.NO_PIXELS
        self._frames = 0

    def add(self, bag: StudyBag, episode: Episode) -> None:
        """Write an episode."""
        rate, number = episode.rate, len(self._rows)
        self._rates.setdefault(rate, bag.name)
        if len(self._rates) > 1:
            said = ' and '.join(f'{name} has {hz} Hz' for hz, name in self._rates.items())
            raise SessionError(f'{said}: a data set has one rate; export them apart')
        if self._pictures:
            episode, rate = episode.by_picture(video.FPS), video.FPS
        task = self._tasks.setdefault(episode.task, len(self._tasks))
        table = _table(episode, rate, number, self._frames, task)
        chunk, file = divmod(number, _CHUNK)
        path = self._folder / _DATA.format(chunk_index=chunk, file_index=file)
        _write(table, path)
        _check(path, episode, bag)
        columns = {**episode.values} | {
            name: np.asarray(table.column(name), float)[:, None] for name in _SCALARS
        }
        statistics = {name: _statistics(values) for name, values in columns.items()}
        for name, values in columns.items():
            self._totals.setdefault(name, []).append(values)
        row = {
            'episode_index': number,
            'tasks': [episode.task],
            'length': episode.length,
            'data/chunk_index': chunk,
            'data/file_index': file,
            'dataset_from_index': self._frames,
            'dataset_to_index': self._frames + episode.length,
            'meta/episodes/chunk_index': 0,
            'meta/episodes/file_index': 0,
        }
        if self._pictures:
            place = self._video(chunk, file)
            shades = video.write_episode_video(bag.path, episode.times, place)
            self._shades = self._shades + shades
            statistics[video.CAMERA] = video.statistics(shades, _QUANTILES, episode.length)
            row |= video.place_of_episode(chunk, file, episode.length)
        row |= {
            f'stats/{name}/{kind}': value
            for name, of in statistics.items()
            for kind, value in of.items()
        }
        self._rows.append(row)
        self._about.append({'episode_index': number, **episode.about})
        self._frames += episode.length

    def finish(self, data_licence: str) -> list[str]:
        """Write the metadata; return the names of their files."""
        folder = self._folder
        _write(
            pa.Table.from_pylist(self._rows), folder / 'meta/episodes/chunk-000/file-000.parquet'
        )
        _write_tasks(list(self._tasks), folder / 'meta/tasks.parquet')
        columns = {name: np.concatenate(values) for name, values in self._totals.items()}
        statistics = {name: _statistics(values) for name, values in columns.items()}
        features = _features({name: values.shape[1:] for name, values in columns.items()})
        if self._pictures:
            statistics[video.CAMERA] = video.statistics(self._shades, _QUANTILES, self._frames)
            features[video.CAMERA] = video.feature(self._video(0, 0))
        info = {
            'codebase_version': VERSION,
            'robot_type': 'cutting_trainer',
            'total_episodes': len(self._rows),
            'total_frames': self._frames,
            'total_tasks': len(self._tasks),
            'chunks_size': _CHUNK,
            'data_files_size_in_mb': 100,
            'video_files_size_in_mb': 200,
            'fps': video.FPS if self._pictures else next(iter(self._rates)),
            'splits': {'train': f'0:{len(self._rows)}'},
            'data_path': _DATA,
            'video_path': video.PATH if self._pictures else None,
            'features': features,
            'license': data_licence,
        }
        written = {INFO_FILE: info, 'meta/stats.json': statistics, EPISODES_FILE: self._about}
        for name, content in written.items():
            (folder / name).write_text(json.dumps(content, indent=2), encoding='utf-8')
        return list(written)

    def _video(self, chunk: int, file: int) -> Path:
        place = {'video_key': video.CAMERA, 'chunk_index': chunk, 'file_index': file}
        return self._folder / video.PATH.format(**place)


def _features(shapes: Mapping[str, tuple[int, ...]]) -> dict[str, dict[str, Any]]:
    """Return the features of the tables, by their shapes."""
    names = {feature: list(of[3]) for feature, of in STREAMS.items()}
    names[ACTION] = names[STATE]
    if len(shapes[FORCES]) == 2:
        names[FORCES] = ['tick', 'axis']
    return {
        **{
            feature: {'dtype': 'float64', 'shape': list(shapes[feature]), 'names': of}
            for feature, of in names.items()
        },
        **{name: {'dtype': kind, 'shape': [1], 'names': None} for name, kind in _SCALARS.items()},
    }


def _table(episode: Episode, rate: int, number: int, first: int, task: int) -> pa.Table:
    frames = np.arange(episode.length)
    arrays: dict[str, Any] = {name: _nested(values) for name, values in episode.values.items()}
    same = np.ones_like(frames)
    arrays |= {
        'timestamp': pa.array(frames / rate, pa.float32()),
        'frame_index': pa.array(frames),
        'episode_index': pa.array(number * same),
        'index': pa.array(first + frames),
        'task_index': pa.array(task * same),
    }
    return pa.table(arrays)


def _nested(values: Floats) -> pa.Array:
    array = pa.array(values.ravel())
    for size in reversed(values.shape[1:]):
        array = pa.FixedSizeListArray.from_arrays(array, size)
    return array


def _statistics(values: Floats) -> dict[str, list[float]]:
    """Return statistics along the last axis, as LeRobot has them."""
    frames, values = len(values), values.reshape(-1, values.shape[-1])
    kinds = {kind: np.quantile(values, share, axis=0) for kind, share in _QUANTILES.items()}
    kinds |= {
        'min': values.min(axis=0),
        'max': values.max(axis=0),
        'mean': values.mean(axis=0),
        'std': values.std(axis=0),
    }
    return {**{kind: of.tolist() for kind, of in kinds.items()}, 'count': [frames]}


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
        read = table.column(name).combine_chunks()
        while pa.types.is_fixed_size_list(read.type):
            read = read.flatten()
        if not np.array_equal(read.to_numpy().reshape(values.shape), values):
            raise SessionError(f'{path} has another {name} than {bag.name}: the disk is at fault')
