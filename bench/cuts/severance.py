"""Severance of the swept surface: `python -m bench.cuts.severance`.

A bridge is a path through tetrahedra that share a face, from one side of the swept surface to the
other, within a tube around it and away from its free border.
"""

import argparse
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, maximum_flow
from scipy.spatial import cKDTree

from bench.cuts.curves import (
    SHAPES,
    Cut,
    Organ,
    circle,
    curved,
    four_arcs,
    four_lines,
    liver,
    scattered,
    slab,
)
from bench.cuts.strokes import results_along
from cutting_trainer.cutting.combined import FOLDED
from cutting_trainer.cutting.cut_invariants import ViolationError, check_mesh, cut_faces
from cutting_trainer.cutting.method_interface import FAILURES
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh

Floats = NDArray[np.float64]

_TUBE = 1.5
"""Half the width of the tube around the swept surface, in edges."""
_CLEAR = 0.5
"""Height above the surface from which a tetrahedron lies on one side, in edges."""
_MARGIN = 1.5
"""Width of the strip along a free border, or near another sheet, that is not judged, in edges."""
_SPACING = 0.12


@dataclass(frozen=True)
class Severed:
    """Measured result of a cut.

    Attributes:
        bridges: places of the bridges [m], shape (k, 3).
        faces: least number of faces that would have to be parted.
        said: warnings about tissue that holds together.
        folds: times that the blade was said to cross its own cut.
        free: the plug has come free; True without a plug.
        distances: of the nodes of the cut faces from the swept surface [h], shape (n,).
        error: sentence on a broken invariant, or ''.
    """

    bridges: Floats
    faces: int
    said: tuple[str, ...]
    folds: int
    free: bool
    distances: Floats
    error: str = ''


def cut_mesh(
    organ: Organ, cut: Cut, method: str = 'combined', *, check: bool = False
) -> tuple[TetMesh, tuple[str, ...], str]:
    """Cut a copy of a mesh.

    Args:
        organ: mesh.
        cut: strokes.
        method: name of the method.
        check: check the mesh after each batch, and not at the end only.

    Returns:
        The mesh, all warnings, and a sentence on a broken invariant or ''.
    """
    mesh = TetMesh(organ.nodes.copy(), organ.tetrahedra.copy())
    volume = float(mesh.volumes().sum())
    cutter = make_method(CuttingSettings.model_validate({'method': method}))
    warnings: list[str] = []
    try:
        for path in cut.paths:
            old = cut_faces(mesh)
            for result in results_along(cutter, mesh, path):
                warnings += result.report.warnings
                volume -= result.report.removed_volume
                if not result.delta.empty:
                    mesh.apply(result.delta)
                    if check:
                        check_mesh(mesh, volume, old)
                if FOLDED in result.report.warnings:
                    old = cut_faces(mesh)
            check_mesh(mesh, volume, old)
    except (ViolationError, *FAILURES) as error:
        return mesh, tuple(warnings), f'{type(error).__name__}: {error}'
    return mesh, tuple(warnings), ''


@dataclass(frozen=True)
class _Surface:
    """Points of a swept surface.

    Attributes:
        points: [m], shape (p, 3).
        normals: unit, shape (p, 3).
        judged: away from the free border and from other sheets, shape (p,).
    """

    points: Floats
    normals: Floats
    judged: NDArray[np.bool_]


def _surface(path: Floats, h: float, *, closed: bool) -> _Surface:
    """Sample the surface that a blade has swept along a path, shape (k, 2, 3)."""
    length = float(np.linalg.norm(path[0, 0] - path[0, 1]))
    across = np.linspace(0, 1, int(np.ceil(length / (_SPACING * h))) + 1)
    points = path[:, :1] + across[:, None] * (path[:, 1:] - path[:, :1])
    along = np.gradient(points, axis=0)
    normals = np.cross(along, (path[:, 1] - path[:, 0])[:, None])
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    middle = points[:, len(across) // 2]
    way = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(middle, axis=0), axis=1))])
    judged = np.ones(points.shape[:2], bool)
    judged &= ((1 - across) * length > _MARGIN * h)[None]
    if not closed:
        judged &= ((way > _MARGIN * h) & (way[-1] - way > _MARGIN * h))[:, None]
        # Another sheet nearby: the sides are not clear there.
        near = np.linalg.norm(middle[:, None] - middle[None], axis=2) < 2 * _MARGIN * h
        far = np.abs(way[:, None] - way[None]) > 1.5 * np.pi * _MARGIN * h
        judged &= ~(near & far).any(axis=1)[:, None]
    return _Surface(points.reshape(-1, 3), normals.reshape(-1, 3), judged.ravel())


def bridges_of(mesh: TetMesh, cut: Cut, h: float) -> tuple[Floats, int]:
    """Return the places of bridges across the swept surfaces [m], and the faces of a least cut."""
    places: list[Floats] = []
    faces = 0
    centres = mesh.rest[mesh.tetrahedra].mean(axis=1)
    for path in cut.paths:
        surface = _surface(path, h, closed=cut.closed and len(cut.paths) == 1)
        distance, nearest = cKDTree(surface.points).query(centres, distance_upper_bound=_TUBE * h)
        tube = np.flatnonzero(np.isfinite(distance))
        tube = tube[surface.judged[nearest[tube]]]
        at = nearest[tube]
        away = centres[tube] - surface.points[at]
        height = np.einsum('ij,ij->i', away, surface.normals[at])
        aside = np.sqrt(np.maximum((away**2).sum(axis=1) - height**2, 0))
        keep = aside < 2 * _SPACING * h
        tube, height = tube[keep], height[keep]
        if len(tube):
            found, count = _bridges(mesh, centres, tube, height, h)
            places += found
            faces += count
    return np.array(places).reshape(-1, 3), faces


def _bridges(
    mesh: TetMesh, centres: Floats, tube: NDArray[np.int64], height: Floats, h: float
) -> tuple[list[Floats], int]:
    row = np.full(len(mesh.tetrahedra), -1)
    row[tube] = np.arange(len(tube))
    tet, face = np.nonzero(mesh.neighbors[tube] >= 0)
    other = row[mesh.neighbors[tube[tet], face] // 4]
    one, two = tet[other >= 0], other[other >= 0]
    count = len(tube)
    graph = csr_array((np.ones(len(one), np.int32), (one, two)), (count, count))
    _, part = connected_components(graph, directed=False)
    plus, minus = height > _CLEAR * h, height < -_CLEAR * h
    joined = np.intersect1d(part[plus], part[minus])
    if not len(joined):
        return [], 0
    source, sink = count, count + 1
    ends = [(np.full(plus.sum(), source), np.flatnonzero(plus))]
    ends += [(np.flatnonzero(minus), np.full(minus.sum(), sink))]
    rows = np.concatenate([one, *(e[0] for e in ends)])
    columns = np.concatenate([two, *(e[1] for e in ends)])
    capacity = np.ones(len(rows), np.int32)
    capacity[len(one) :] = 1000
    network = csr_array((capacity, (rows, columns)), (count + 2, count + 2))
    flow = maximum_flow(network.tocsr(), source, sink)
    left = csr_array(network - flow.flow)
    left.data[left.data < 0] = 0
    left.eliminate_zeros()
    reached = _reachable(left, source)
    cross = reached[one] & ~reached[two]
    return list(centres[tube[one[cross]]]), int(flow.flow_value)


def _reachable(graph: csr_array, start: int) -> NDArray[np.bool_]:
    found = np.zeros(graph.shape[0], bool)
    found[start] = True
    queue = [start]
    while queue:
        at = queue.pop()
        for other in graph.indices[graph.indptr[at] : graph.indptr[at + 1]]:
            if not found[other]:
                found[other] = True
                queue.append(int(other))
    return found


def plug_is_free(mesh: TetMesh, cut: Cut, h: float) -> bool:
    """Return whether the inside of a closed cut hangs together with nothing outside; also if the
    tissue ends within an edge of the cut.
    """
    if cut.inside is None:
        return True
    tet, face = np.nonzero(mesh.neighbors >= 0)
    count = len(mesh.tetrahedra)
    graph = csr_array(
        (np.ones(len(tet), np.int8), (tet, mesh.neighbors[tet, face] // 4)), (count, count)
    )
    _, part = connected_components(graph, directed=False)
    centres = mesh.rest[mesh.tetrahedra].mean(axis=1)
    away = np.linalg.norm((centres - cut.inside)[:, :2], axis=1)
    inner, outer = away < 0.5 * cut.radius, away > cut.beyond + h
    return len(np.intersect1d(part[inner], part[outer])) == 0


def surface_distances(mesh: TetMesh, cut: Cut, h: float) -> Floats:
    """Return distances of the cut faces' nodes from the swept surface [h], away from its border."""
    corners = np.unique(cut_faces(mesh).reshape(-1, 3), axis=0)
    best = np.full(len(corners), np.inf)
    judged = np.zeros(len(corners), bool)
    for path in cut.paths:
        surface = _surface(path, h, closed=cut.closed)
        if not len(corners):
            break
        distance, nearest = cKDTree(surface.points).query(corners)
        away = corners - surface.points[nearest]
        height = np.abs(np.einsum('ij,ij->i', away, surface.normals[nearest]))
        closer = distance < best
        judged[closer] = surface.judged[nearest[closer]]
        best = np.where(closer, height, best)
    return best[judged] / h


def measure(organ: Organ, cut: Cut, method: str = 'combined', *, check: bool = False) -> Severed:
    """Cut a copy of a mesh and measure whether the swept surface is severed."""
    mesh, warnings, error = cut_mesh(organ, cut, method, check=check)
    places, faces = bridges_of(mesh, cut, organ.h)
    said = tuple(w for w in warnings if 'together' in w or 'connected' in w)
    return Severed(
        places,
        faces,
        said,
        warnings.count(FOLDED),
        plug_is_free(mesh, cut, organ.h),
        surface_distances(mesh, cut, organ.h),
        error,
    )


PLUGS: dict[str, Callable[[Organ, float, np.random.Generator], Cut]] = {
    'circle': circle,
    'four arcs': four_arcs,
    'four lines': four_lines,
}


def _row(name: str, runs: list[Severed]) -> None:
    apart = sum(run.free for run in runs)
    clean = sum(run.faces == 0 for run in runs)
    said = sum(bool(run.said) for run in runs)
    unsaid = sum(run.faces > 0 and not run.said for run in runs)
    off = np.concatenate([run.distances for run in runs])
    rms = np.sqrt((off**2).mean()) if len(off) else 0.0
    print(
        f'{name:32} free {apart:3}/{len(runs)} severed {clean:3}/{len(runs)} unsaid {unsaid} '
        f'said {said} folds {sum(run.folds for run in runs)} '
        f'errors {sum(bool(run.error) for run in runs)} '
        f'distance {rms:.3f} h rms, {off.max(initial=0):.2f} h most',
        flush=True,
    )
    for run in runs:
        if run.error:
            print('   ', run.error[:150])


def fuzz(organ: Organ, count: int, seed: int, kept: Path) -> dict[str, float]:
    """Cut copies of a mesh by random curves, each once, and count bridges and violations.

    Args:
        organ: mesh.
        count: strokes.
        seed: of the first stroke; each has the next one.
        kept: file of results, one line each; strokes in it are not cut again.
    """
    lines = kept.read_text().splitlines() if kept.exists() else []
    runs = {run['seed']: run for run in map(json.loads, lines)}
    for k in range(seed, seed + count):
        if k not in runs:
            runs[k] = _random_stroke(organ, k)
            with kept.open('a') as file:
                print(json.dumps(runs[k]), file=file)
    chosen = [runs[k] for k in range(seed, seed + count)]
    nodes = sum(run['nodes'] for run in chosen)
    return {
        'strokes': len(chosen),
        'unsaid': sum(run['faces'] > 0 and not run['said'] for run in chosen),
        'said': sum(run['said'] for run in chosen),
        'violations': sum(bool(run['error']) for run in chosen),
        'rms': float(np.sqrt(sum(run['squares'] for run in chosen) / max(nodes, 1))),
        'most': max(run['most'] for run in chosen),
        'beyond 0.15': sum(run['beyond'] for run in chosen) / max(nodes, 1),
    }


def random_curve(organ: Organ, seed: int) -> Cut:
    """Return a curve of a random shape and depth."""
    rng = np.random.default_rng(seed)
    shape = str(rng.choice(list(SHAPES)))
    return curved(organ, shape, rng, through=bool(rng.integers(2)))


def _random_stroke(organ: Organ, seed: int) -> dict[str, Any]:
    run = measure(organ, random_curve(organ, seed))
    if run.faces or run.error:
        print(f'seed {seed}: {run.faces} faces at {run.bridges[:1]}, {run.error[:150]}')
    off = run.distances
    return {
        'seed': seed,
        'faces': run.faces,
        'said': bool(run.said),
        'error': run.error,
        'nodes': len(off),
        'squares': float((off**2).sum()),
        'most': float(off.max(initial=0.0)),
        'beyond': int((off > 0.15).sum()),
    }


def main() -> None:
    """Print the share of cuts that sever the swept surface."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument('--runs', type=int, default=20)
    parser.add_argument('--method', default='combined')
    parser.add_argument('--organs', nargs='*', default=['slab', 'liver', 'scattered'])
    parser.add_argument('--curves', type=int, default=20, help='random curves of each shape')
    parser.add_argument('--shapes', nargs='*', default=['circle', 'four arcs', 'four lines'])
    parser.add_argument('--fuzz', type=int, default=0, help='random curves in the first mesh only')
    parser.add_argument('--seed', type=int, default=0, help='of the first stroke')
    parser.add_argument('--kept', type=Path, default=Path('severance.jsonl'), help='of the fuzz')
    options = parser.parse_args()
    makers = {'slab': slab, 'liver': liver, 'scattered': scattered}
    if options.fuzz:
        name = options.organs[0]
        organ = slab((9, 9, 4)) if name == 'slab' else makers[name]()
        print(fuzz(organ, options.fuzz, options.seed, options.kept))
        return
    for organ in (makers[name]() for name in options.organs):
        ratios = [2, 3, 4] if organ.name == 'liver' else [2, 3, 4, 6]
        for name in options.shapes:
            for ratio in ratios:
                cuts = [
                    PLUGS[name](organ, ratio, np.random.default_rng(options.seed + k))
                    for k in range(options.runs)
                ]
                runs = [measure(organ, cut, options.method) for cut in cuts]
                _row(f'{organ.name}, {name}, {ratio} h', runs)
        for shape in SHAPES if options.curves else ():
            for through in (True, False):
                rngs = [
                    np.random.default_rng(1000 + options.seed + k) for k in range(options.curves)
                ]
                cuts = [curved(organ, shape, rng, through=through) for rng in rngs]
                runs = [measure(organ, cut, options.method) for cut in cuts]
                _row(f'{organ.name}, {shape}, {"through" if through else "partial"}', runs)


if __name__ == '__main__':
    main()
