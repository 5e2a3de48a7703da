"""Random strokes against the invariants of a cut: `trainer fuzz-cuts`, and the same in
the tests.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cutting_trainer.cutting.combined import FOLDED
from cutting_trainer.cutting.cut_invariants import (
    ViolationError,
    check_area,
    check_mesh,
    cut_face_area,
    cut_faces,
)
from cutting_trainer.cutting.geometry import smallest_altitudes
from cutting_trainer.cutting.method_interface import SweepError
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.tissue_sim.contact.blade import Sweep
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, TopologyDelta, interpolated

KINDS = ('plane', 'arc', 'twist', 'reversal', 'trembling', 'fast', 'exact', 'narrow')


@dataclass(frozen=True)
class Scene:
    """A mesh and some strokes through it, in order.

    Attributes:
        nodes: [m], shape (n, 3).
        tetrahedra: shape (m, 4).
        strokes: the blade's edge, root and tip, by step [m], each shape (k, 2, 3).
        motion: how far the tissue moves from step to step, as a share of its elements.
        seed: of that motion.
    """

    nodes: np.ndarray
    tetrahedra: np.ndarray
    strokes: tuple[np.ndarray, ...]
    motion: float
    seed: int

    def save(self, path: Path) -> None:
        """Write the scene to an npz file."""
        arrays: dict[str, Any] = {f'stroke_{k}': edges for k, edges in enumerate(self.strokes)}
        arrays |= {'nodes': self.nodes, 'tetrahedra': self.tetrahedra}
        np.savez(path, motion=self.motion, seed=self.seed, **arrays)

    @classmethod
    def load(cls, path: Path) -> 'Scene':
        """Read a scene that `save` has written."""
        with np.load(path) as data:
            strokes = tuple(data[f'stroke_{k}'] for k in range(len(data.files) - 4))
            return cls(
                data['nodes'],
                data['tetrahedra'],
                strokes,
                float(data['motion']),
                int(data['seed']),
            )


@dataclass(frozen=True)
class FuzzReport:
    """Result of random strokes.

    Attributes:
        strokes, batches: how many were cut, and how many changes of connectivity were checked.
        cases: elements by case, in the order of `method.CASES`, shape (10,).
        violations: one sentence each.
        saved: the scenes that led to them.
    """

    strokes: int
    batches: int
    cases: np.ndarray
    violations: tuple[str, ...]
    saved: tuple[Path, ...]


def run(
    strokes: int,
    seed: int,
    progress: Callable[[int], None] = lambda done: None,
    *,
    method: str = 'combined',
    folder: Path = Path(),
) -> FuzzReport:
    """Cut random meshes with random strokes and check the mesh after every batch.

    Args:
        strokes: how many.
        seed: of everything.
        progress: told the number of strokes that are done.
        method: name of the method.
        folder: where a scene that breaks an invariant is saved.
    """
    rng = np.random.default_rng(seed)
    done = batches = 0
    cases = np.zeros(10, np.int64)
    violations: list[str] = []
    saved: list[Path] = []
    while done < strokes:
        scene = random_scene(rng)
        scene_seed = f'{seed}-{done}'
        try:
            result = play(scene, method)
            batches += result[0]
            cases += result[1]
        except Exception as error:
            path = folder / f'cut-{method}-{scene_seed}.npz'
            scene.save(path)
            saved.append(path)
            violations.append(f'{type(error).__name__}: {error}')
        done += len(scene.strokes)
        progress(done)
    return FuzzReport(done, batches, cases, tuple(violations), tuple(saved))


def play(scene: Scene, method: str = 'combined') -> tuple[int, np.ndarray]:
    """Cut a scene and check the mesh after every batch.

    Returns:
        Number of batches, and elements by case, shape (10,).

    Raises:
        ViolationError: an invariant is broken.
    """
    mesh = TetMesh(scene.nodes, scene.tetrahedra)
    volume = float(mesh.volumes().sum())
    cutter = make_method(CuttingSettings.model_validate({'method': method}))
    tissue = _Tissue(mesh, scene)
    floor = _floor(mesh, method)
    batches = 0
    cases = np.zeros(10, np.int64)
    for edges in scene.strokes:
        old = cut_faces(mesh)
        for before, after in itertools.pairwise(edges):
            sweep = Sweep(before[0], before[1], after[0], after[1])
            try:
                result = cutter.advance(mesh, tissue.positions, sweep)
            except SweepError:
                continue
            cases += result.report.cases
            if not result.delta.empty:
                batches += 1
                volume -= result.report.removed_volume
                area = cut_face_area(mesh) + result.report.area
                tissue.apply(result.delta)
                check_mesh(mesh, volume, old)
                if method != 'delete':
                    check_area(mesh, area)
            if FOLDED in result.report.warnings:
                old = cut_faces(mesh)
            tissue.move()
        result = cutter.finish(mesh, tissue.positions)
        cases += result.report.cases
        if not result.delta.empty:
            batches += 1
            area = cut_face_area(mesh) + result.report.area
            tissue.apply(result.delta)
            check_mesh(mesh, volume, old)
            if method != 'delete':
                check_area(mesh, area)
    if len(mesh.tetrahedra) and (lowest := float(_altitudes(mesh).min())) < floor:
        raise ViolationError(f'an element has an altitude of {lowest:.3g} m, below {floor:.3g} m')
    return batches, cases


def _altitudes(mesh: TetMesh) -> np.ndarray:
    return smallest_altitudes(mesh.rest, mesh.tetrahedra)


def _floor(mesh: TetMesh, method: str) -> float:
    """Return the smallest allowed altitude of an element [m]."""
    if not method.startswith('combined'):
        return 0.0
    before = _altitudes(mesh)
    share = float(CuttingSettings().altitude_floor)
    return 0.999 * min(share * float(np.median(before)), float(before.min()))


class _Tissue:
    """Mesh whose nodes move a little in each step, and whose cut faces part."""

    def __init__(self, mesh: TetMesh, scene: Scene) -> None:
        self._mesh = mesh
        self._displacement = np.zeros((mesh.node_count, 3))
        self._rng = np.random.default_rng(scene.seed)
        size = np.cbrt(6 * mesh.volumes().mean())
        self._step = scene.motion * size

    @property
    def positions(self) -> np.ndarray:
        return self._mesh.rest + self._displacement

    def apply(self, delta: TopologyDelta) -> None:
        new = interpolated(self._displacement, delta.node_parents, delta.node_weights)
        moved = interpolated(self._displacement, delta.moved_parents, delta.moved_weights)
        self._displacement[delta.moved_nodes] = moved
        self._displacement = np.concatenate([self._displacement, new])
        touched = self._mesh.apply(delta)
        for target, source in touched.renumbered:
            self._displacement[target] = self._displacement[source]
        self._displacement = self._displacement[: self._mesh.node_count]

    def move(self) -> None:
        if self._step == 0.0:
            return
        rest = self._mesh.rest
        wave = self._rng.normal(size=(3, 3)) / (np.ptp(rest, axis=0).max() / 3)
        phase = self._rng.uniform(0, 6, 3)
        self._displacement += self._step * np.sin(rest @ wave + phase)
        cut = self._mesh.triangles[self._mesh.triangle_kind == 1]
        if len(cut):
            a, b, c = (rest[cut[:, i]] for i in range(3))
            inward = -np.cross(b - a, c - a)
            inward /= np.linalg.norm(inward, axis=1, keepdims=True)
            push = np.zeros_like(rest)
            for i in range(3):
                np.add.at(push, cut[:, i], inward)
            length = np.maximum(np.linalg.norm(push, axis=1, keepdims=True), 1e-9)
            self._displacement += self._step * push / length
        # Limited, so that no element is inverted.
        self._displacement *= min(
            1.0, 0.3 * self._size() / max(np.abs(self._displacement).max(), 1e-12)
        )

    def _size(self) -> float:
        return float(self._step and 0.5 * np.cbrt(self._mesh.volumes().mean()))


def random_scene(rng: np.random.Generator) -> Scene:
    """Return a small irregular mesh with shuffled numbers, and one to three strokes of any kind."""
    kinds = [str(rng.choice(KINDS)) for _ in range(rng.integers(1, 4))]
    cells = rng.integers(2, 5, 3)
    size = 0.002
    jitter = 0.0 if 'exact' in kinds else float(rng.uniform(0.05, 0.2))
    nodes, tets = shuffled_box(cells, size, jitter, rng)
    strokes = tuple(random_stroke(kind, nodes, size, rng) for kind in kinds)
    motion = float(rng.choice([0.0, 0.01, 0.03]))
    return Scene(nodes, tets, strokes, motion, int(rng.integers(1 << 30)))


def shuffled_box(
    cells: np.ndarray, size: float, jitter: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return a box of cubes of six tetrahedra, its inner nodes displaced, all numbers shuffled.

    Args:
        cells: cubes along each axis, shape (3,).
        size: edge of a cube [m].
        jitter: largest displacement along each axis, as a share of `size`.
        rng: source of it all.
    """
    shape = tuple(int(c) + 1 for c in cells)
    nodes = np.argwhere(np.ones(shape)) * size
    inner = ((nodes > 0.5 * size) & (nodes < (cells - 0.5) * size)).all(axis=1)
    nodes[inner] += rng.uniform(-jitter, jitter, (int(inner.sum()), 3)) * size
    number = np.arange(len(nodes)).reshape(shape)
    tets = []
    for order in ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)):
        at = np.argwhere(np.ones(tuple(int(c) for c in cells)))
        path = [number[tuple(at.T)]]
        for axis in order:
            at[:, axis] += 1
            path.append(number[tuple(at.T)])
        tets.append(np.stack(path, axis=1))
    shuffle = rng.permutation(len(nodes))
    tetrahedra = np.argsort(shuffle)[np.concatenate(tets)]
    tetrahedra = rng.permutation(tetrahedra)
    nodes = nodes[shuffle]
    a, b, c, d = (nodes[tetrahedra[:, i]] for i in range(4))
    negative = np.einsum('ij,ij->i', np.cross(b - a, c - a), d - a) < 0
    tetrahedra[negative, 2:] = tetrahedra[negative, :1:-1]
    return nodes, tetrahedra


def random_stroke(
    kind: str, nodes: np.ndarray, size: float, rng: np.random.Generator
) -> np.ndarray:
    """Return the blade's edge, root and tip, step by step [m], shape (k, 2, 3)."""
    low, high = nodes.min(axis=0), nodes.max(axis=0)
    extent = float(np.linalg.norm(high - low))
    through = rng.uniform(low, high)
    frame = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    if kind == 'exact':
        through = nodes[rng.integers(len(nodes))]
        choices = [
            np.eye(3),
            np.array([[1, 1, 0], [0, 0, 1], [1, -1, 0]]) / np.sqrt([[2], [1], [2]]),
        ]
        frame = choices[rng.integers(2)][rng.permutation(3)]
    along, edge, normal = frame
    steps = 1 if kind == 'fast' else int(rng.integers(3, 14))
    begin, end = -extent, extent * rng.choice([1.0, rng.uniform(-0.4, 0.5)])
    way = np.linspace(begin, end, steps + 1)
    if kind == 'reversal':
        back = rng.uniform(begin, end)
        way = np.concatenate([way, np.linspace(end, back, steps + 1)[1:]])
        way = np.concatenate([way, np.linspace(back, end, steps + 1)[1:]])
    reach = float(rng.choice([extent, rng.uniform(0, 0.5) * extent, 0.0]))
    if kind == 'narrow':
        root, tip = through + 0.3 * size * edge, through - 0.3 * size * edge
    else:
        root, tip = through + extent * edge, through - reach * edge
    path = np.stack([root + way[:, None] * along, tip + way[:, None] * along], axis=1)
    if kind == 'arc':
        path += (rng.uniform(-1, 1) / extent * way**2)[:, None, None] * normal
    if kind == 'twist':
        turn = rng.uniform(-1, 1) * way / extent
        path[:, 1] += (np.tan(0.7 * turn) * 0.5 * extent)[:, None] * normal
    if kind in ('trembling', 'reversal'):
        path += rng.uniform(0, 0.1) * size * rng.normal(size=path.shape)
    return path
