"""Read exported arrays with h5py alone, and print figures of each session as JSON: no trainer.

    python -I hdf5_reader.py FILE

For each session, by the hash of its bag: the largest force [N], the number of its samples, the area
of all cuts [m^2], and for each state of the tissue its time [s], volume [m^3] and opened area at
rest, of one side [m^2].
"""

import json
import sys
from typing import Any

import h5py
import numpy as np


def figures(session: h5py.Group) -> dict[str, Any]:
    """Return the figures of a session."""
    force = session['streams/arm_servo_cf/force'][:]
    return {
        'largest_force': np.linalg.norm(force, axis=1).max(),
        'force_samples': len(force),
        'cut_area': session['cuts/area'][:].sum(),
        'states': [state(session['tissue'], i) for i in range(len(session['tissue/block']))],
    }


def state(tissue: h5py.Group, number: int) -> tuple[float, float, float]:
    """Return time, volume and opened area of a state."""
    mesh, block = tissue['connectivity'], int(tissue['block'][number])

    def of(name: str, offset: str) -> Any:
        return mesh[name][slice(*mesh[offset][block : block + 2])]

    rest = of('rest', 'node_offset')
    moved = tissue['displacement'][slice(*tissue['displacement_offset'][number : number + 2])]
    corners = (rest + moved)[of('tetrahedra', 'tetrahedron_offset')]
    volume = np.linalg.det(corners[:, 1:] - corners[:, :1]).sum() / 6
    cut = of('triangle_kind', 'triangle_offset') == 1
    faces = rest[of('triangles', 'triangle_offset')[cut]]
    sides = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    return float(tissue['time'][number]), volume, np.linalg.norm(sides, axis=1).sum() / 4


if __name__ == '__main__':
    with h5py.File(sys.argv[1]) as file:
        found = {of.attrs['bag_hash']: figures(of) for of in file['sessions'].values()}
    if any(name.startswith('cutting_trainer') for name in sys.modules):
        sys.exit('the reader has imported the trainer: it is no foreign one')
    print(json.dumps(found))
