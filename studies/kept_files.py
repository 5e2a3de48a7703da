"""Files that a study keeps of each session: the force over time, the tissue at the end."""

import hashlib
import os
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from cutting_trainer.recordings.export_command import write_solid
from cutting_trainer.recordings.what_if import Run
from cutting_trainer.studies.designs import Key
from cutting_trainer.studies.outputs import FileName
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation

FOLDER = 'kept'
_ENDINGS: dict[FileName, str] = {'force': 'force.parquet', 'tissue': 'tissue.vtu'}


def contents_of(
    run: Run, simulation: TissueSimulation, wanted: Iterable[FileName]
) -> dict[FileName, bytes]:
    """Return the content of the files of a session.

    Args:
        run: the session.
        simulation: tissue at the end.
        wanted: which of them.
    """
    found = dict[FileName, bytes]()
    with tempfile.TemporaryDirectory() as folder:
        for name in wanted:
            file = Path(folder) / _ENDINGS[name]
            if name == 'force':
                columns = dict(zip(('force_x', 'force_y', 'force_z'), run.vectors.T, strict=True))
                times = {'time': run.times}
                pq.write_table(pa.table(times | columns | {'contact': run.contact}), file)
            else:
                mesh = simulation.mesh
                write_solid(file, mesh.rest, simulation.displacement, mesh.tetrahedra, mesh.fixed)
            found[name] = file.read_bytes()
    return found


def keep(folder: Path, key: Key, contents: Mapping[FileName, bytes]) -> dict[str, str]:
    """Write the files of a row, each in one step, and return their hashes by name.

    Args:
        folder: of the results.
        key: of the row.
        contents: of the files.
    """
    for name, content in contents.items():
        file = _place(folder, key, name)
        file.parent.mkdir(exist_ok=True)
        new = file.with_suffix('.new')
        with new.open('wb') as out:
            out.write(content)
            out.flush()
            os.fsync(out.fileno())
        new.replace(file)
    return {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()}


def are_kept(folder: Path, key: Key, wanted: Iterable[FileName], hashes: Mapping[str, str]) -> bool:
    """Return whether the files of a row are there, as they were written."""
    for name in wanted:
        file = _place(folder, key, name)
        if not file.is_file() or hashlib.sha256(file.read_bytes()).hexdigest() != hashes.get(name):
            return False
    return True


def _place(folder: Path, key: Key, name: FileName) -> Path:
    bag, setting = key
    return folder / FOLDER / f'{bag}_{setting or "recorded"}_{_ENDINGS[name]}'
