"""`trainer export`: write streams of a bag as CSV or Parquet, or its tissue as a mesh file."""

from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import parquet as pq

from cutting_trainer.bags.playback_messages import first_time
from cutting_trainer.bags.reader import Bag, open_bag
from cutting_trainer.bags.recorded_tissue import tissue_at
from cutting_trainer.bags.topic_names import CONTACT, FORCE, OF_DEVICE, SERVO_CF, of_session
from cutting_trainer.node_common.cdr_codec import (
    ContactCodec,
    ForceSampleCodec,
    PoseStampedCodec,
    StampedCodec,
    TwistStampedCodec,
    WrenchStampedCodec,
)
from cutting_trainer.session.errors import SessionError
from cutting_trainer.tissue_sim.mesh.replica import MeshReplica

SOLIDS = ('.vtk', '.vtu')
SURFACES = ('.ply', '.stl')
STREAMS: dict[str, type[StampedCodec]] = {
    OF_DEVICE[0]: PoseStampedCodec,
    OF_DEVICE[1]: TwistStampedCodec,
    OF_DEVICE[2]: WrenchStampedCodec,
    SERVO_CF: WrenchStampedCodec,
    CONTACT: ContactCodec,
    FORCE: ForceSampleCodec,
}
TYPES = {'d': np.float64, 'i': np.int32, 'I': np.uint32, 'Q': np.uint64, 'B': np.uint8}
_AXES = {3: 'xyz', 4: 'xyzw'}


def export(folder: Path, output: Path, at: float | None, *, parquet: bool = False) -> list[Path]:
    """Write a mesh file if `output` has the extension of one, else a folder of tables.

    Args:
        folder: folder of the bag.
        output: file, or new folder.
        at: time of the mesh [s]; None: the end.
        parquet: write the tables as Parquet, not as CSV.

    Returns:
        Written files.

    Raises:
        BagError: it is not a bag or shorter, or there is no tissue in it.
        SessionError: the output cannot be written.
    """
    bag = open_bag(folder)
    if not output.parent.is_dir():
        raise SessionError(f'{output.parent} does not exist: make it first')
    if output.suffix in SOLIDS + SURFACES:
        write_mesh(tissue_at(bag, at), output)
        return [output]
    if output.suffix:
        endings = ', '.join(SOLIDS + SURFACES)
        raise SessionError(
            f'{output}: a mesh file ends in {endings}; a folder of tables has no extension'
        )
    if at is not None:
        raise SessionError('--at is the time of a mesh: streams are written as a whole')
    if output.is_file():
        raise SessionError(f'{output} is a file: name a folder for the tables')
    if not any(of_session(topic, bag.topics()) in bag.topics() for topic in STREAMS):
        raise SessionError(f'{folder} has none of the streams {", ".join(STREAMS)}')
    output.mkdir(exist_ok=True)
    return write_streams(bag, output, parquet=parquet)


def write_mesh(tissue: MeshReplica, file: Path) -> None:
    """Write the deformed tissue [m].

    A solid (.vtk, .vtu) has its tetrahedra, with displacement [m] and fixed flag by node. A
    surface (.ply, .stl) has the triangles of the outside and of cuts.
    """
    if file.suffix in SOLIDS:
        write_solid(file, tissue.rest, tissue.displacement, tissue.tetrahedra, tissue.fixed)
        return
    used, triangles = np.unique(tissue.triangles, return_inverse=True)
    cells = [('triangle', triangles.reshape(-1, 3).astype(np.int32))]
    meshio.Mesh(tissue.positions()[used], cells).write(file)


def write_solid(
    file: Path,
    rest: NDArray[np.float64],
    displacement: NDArray[np.float64],
    tetrahedra: NDArray[np.integer],
    fixed: NDArray[np.integer],
) -> None:
    """Write a deformed solid with its displacement and fixed flag by node.

    Args:
        file: with one of the extensions `SOLIDS`.
        rest: [m], shape (n, 3).
        displacement: [m], shape (n, 3).
        tetrahedra: shape (m, 4).
        fixed: not 0 where the node does not move, shape (n,).
    """
    cells = [('tetra', np.asarray(tetrahedra, np.int64))]
    data = {'displacement': displacement, 'fixed': fixed.astype(np.int32)}
    meshio.Mesh(rest + displacement, cells, point_data=data).write(file)


def write_streams(bag: Bag, folder: Path, *, parquet: bool) -> list[Path]:
    """Write one file a stream: time of recording [s], stamp [ns], then the fields in SI units."""
    files = []
    origin = first_time(bag)
    for topic, kind in STREAMS.items():
        name = of_session(topic, bag.topics())
        if name not in bag.topics():
            continue
        ending = 'parquet' if parquet else 'csv'
        files.append(folder / f'{table_name(topic)}.{ending}')
        write = _write_parquet if parquet else _write_csv
        write(files[-1], kind, _rows(bag, name, kind(), origin))
    return files


def table_name(topic: str) -> str:
    """Return the name of a stream's table."""
    return topic[1:].replace('/', '_')


def _rows(bag: Bag, topic: str, codec: StampedCodec, origin: int) -> Iterator[Sequence[Any]]:
    for recorded in bag.messages([topic]):
        sample = codec.decode(recorded.data)
        yield (recorded.log_time - origin) * 1e-9, sample.stamp_ns, *sample.values


def _write_csv(file: Path, kind: type[StampedCodec], rows: Iterator[Sequence[Any]]) -> None:
    with file.open('w', encoding='utf-8', newline='\n') as out:
        out.write(','.join(columns(kind)) + '\n')
        for time, *values in rows:
            out.write(','.join(map(str, [f'{time:.9f}', *values])) + '\n')


def _write_parquet(file: Path, kind: type[StampedCodec], rows: Iterator[Sequence[Any]]) -> None:
    names = columns(kind)
    codes = chain.from_iterable([TYPES[code]] * count for _, code, count in kind.layout)
    types = [np.float64, np.int64, *codes]
    read = list(zip(*rows, strict=True)) or [()] * len(names)
    arrays = [np.array(column, type_) for column, type_ in zip(read, types, strict=True)]
    pq.write_table(pa.table(dict(zip(names, arrays, strict=True))), file)


def columns(kind: type[StampedCodec]) -> list[str]:
    """Return the names of the columns: `force_x`, or `weights_0` for fields without axes."""
    names = ['time', 'stamp_ns']
    for name, _, count in kind.layout:
        axes = _AXES.get(count, [str(i) for i in range(count)])
        names += [name] if count == 1 else [f'{name}_{axis}' for axis in axes]
    return names
