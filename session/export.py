"""`trainer export`: a bag's streams as CSV, its tissue at a moment as a mesh file."""

from pathlib import Path
from typing import Any

import meshio
import numpy as np

from bags.player import first_time
from bags.reader import Bag, open_bag
from bags.tissue import tissue_at
from bags.topics import CONTACT, FORCE, OF_DEVICE, SERVO_CF, of_session
from haptic_bridge.wire import (
    ContactCodec,
    ForceSampleCodec,
    PoseStampedCodec,
    StampedCodec,
    TwistStampedCodec,
    WrenchStampedCodec,
)
from session.errors import SessionError
from tissue_sim.replica import MeshReplica

SOLIDS = ('.vtk', '.vtu')
SURFACES = ('.ply', '.stl')
_STREAMS: dict[str, type[StampedCodec]] = {
    OF_DEVICE[0]: PoseStampedCodec,
    OF_DEVICE[1]: TwistStampedCodec,
    OF_DEVICE[2]: WrenchStampedCodec,
    SERVO_CF: WrenchStampedCodec,
    CONTACT: ContactCodec,
    FORCE: ForceSampleCodec,
}
_AXES = {3: 'xyz', 4: 'xyzw'}


def export(folder: Path, output: Path, at: float | None) -> list[Path]:
    """Writes a mesh file where `output` has the ending of one, else a folder of CSV files.

    Args:
        folder: of the bag.
        output: file, or new folder.
        at: moment of the mesh [s]; None: the end.

    Returns:
        What was written.

    Raises:
        BagError: it is not a bag, or there is no tissue in it.
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
            f'{output}: a mesh ends in {endings}; a name without an ending is a folder for CSV'
        )
    if at is not None:
        raise SessionError('--at is the moment of a mesh: streams are written as a whole')
    output.mkdir(exist_ok=True)
    return write_streams(bag, output)


def write_mesh(tissue: MeshReplica, file: Path) -> None:
    """Writes the deformed tissue [m].

    A solid (.vtk, .vtu) has its tetrahedra, with displacement [m] and fixed by node; a surface
    (.ply, .stl) the triangles of the outside and of cuts.
    """
    if file.suffix in SOLIDS:
        cells = [('tetra', np.asarray(tissue.tetrahedra, np.int64))]
        data = {'displacement': tissue.displacement, 'fixed': tissue.fixed.astype(np.int32)}
        meshio.Mesh(tissue.positions(), cells, point_data=data).write(file)
        return
    used, triangles = np.unique(tissue.triangles, return_inverse=True)
    cells = [('triangle', triangles.reshape(-1, 3).astype(np.int32))]
    meshio.Mesh(tissue.positions()[used], cells).write(file)


def write_streams(bag: Bag, folder: Path) -> list[Path]:
    """One file a stream: time of recording [s], stamp [ns], then the fields in SI units."""
    files = []
    origin = first_time(bag)
    for topic, kind in _STREAMS.items():
        name = of_session(topic, bag.topics())
        if name not in bag.topics():
            continue
        codec = kind()
        file = folder / f'{topic[1:].replace("/", "_")}.csv'
        with file.open('w', encoding='utf-8', newline='\n') as out:
            out.write(','.join(['time', 'stamp_ns', *columns(kind)]) + '\n')
            for recorded in bag.messages([name]):
                sample = codec.decode(recorded.data)
                time = (recorded.log_time - origin) * 1e-9
                row: list[Any] = [f'{time:.9f}', sample.stamp_ns, *sample.values]
                out.write(','.join(map(str, row)) + '\n')
        files.append(file)
    return files


def columns(kind: type[StampedCodec]) -> list[str]:
    """Names of a message's numbers: `force_x`, or `weights_0` where there are no axes."""
    names = []
    for name, _, count in kind.layout:
        axes = _AXES.get(count, [str(i) for i in range(count)])
        names += [name] if count == 1 else [f'{name}_{axis}' for axis in axes]
    return names
