"""The press of a sphere on blocks of any resolution, by static solutions of the trainer's model."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bench.common.meshes import PLANE_TOLERANCE_M, kuhn_block
from cutting_trainer.tissue_sim.contact.coupling import Coupling
from cutting_trainer.tissue_sim.contact.tool import ContactState, ToolContact
from cutting_trainer.tissue_sim.contact.tool_spring import ContactName, ToolSprings
from cutting_trainer.tissue_sim.elasticity.compliance import solve_static
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel, ModelName
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh

Floats = NDArray[np.float64]

BLOCK = (0.1, 0.1, 0.04)
"""[m]"""
MATERIAL = Material(5400.0, 0.45, 1060.0)
CELLS = {9.1: (11, 11, 4), 6.2: (16, 16, 7), 3.6: (28, 28, 11), 2.3: (43, 43, 17)}
"""Bricks along each axis of the block, by edge [mm]."""
_SHAKEN = 0.2
"""Largest displacement of an inner node from its regular place, in edges."""
_STIFF = 1e5
"""[N/m] of a coupling spring that takes no part."""
_UP = np.array([0.0, 0.0, 1.0])


def block(cells: tuple[int, int, int], seed: int = 0) -> TetMesh:
    """Return the block, fixed at its underside, its inner nodes moved at random."""
    mesh = kuhn_block(cells, BLOCK)
    size = np.array(BLOCK)
    move = np.random.default_rng(seed).uniform(-_SHAKEN, _SHAKEN, mesh.rest.shape) * size / cells
    move[(abs(mesh.rest) < PLANE_TOLERANCE_M) | (abs(mesh.rest - size) < PLANE_TOLERANCE_M)] = 0.0
    return TetMesh(mesh.rest + move, mesh.tetrahedra, mesh.rest[:, 2] < PLANE_TOLERANCE_M)


def touched(mesh: TetMesh, place: Sequence[float] | Floats) -> tuple[NDArray[np.int64], Floats]:
    """Return nodes and weights of the point of a block's top above a place, [m], shape (2,)."""
    corners = mesh.rest[mesh.triangles]
    top = np.flatnonzero((corners[:, :, 2] > BLOCK[2] - PLANE_TOLERANCE_M).all(axis=1))
    triangles = mesh.triangles[top].astype(np.int64)
    corners = np.moveaxis(mesh.rest[triangles][:, :, :2], 1, 2)
    system = np.concatenate([corners, np.ones((len(corners), 1, 3))], axis=1)
    weights = np.linalg.solve(system, np.array([*place, 1.0])[None, :, None])[:, :, 0]
    chosen = int(weights.min(axis=1).argmax())
    positive = np.maximum(weights[chosen], 0.0)
    return triangles[chosen], positive / positive.sum()


class Press:
    """A block under a sphere.

    Args:
        mesh: of `block`.
        contact: how the load is spread.
        model: name of the elastic model.
        material: of the block.

    Attributes:
        model: the elastic model.
    """

    def __init__(
        self,
        mesh: TetMesh,
        contact: ContactName = 'footprint',
        model: ModelName = 'linear_smoothed',
        material: Material = MATERIAL,
    ) -> None:
        self._mesh = mesh
        self.model = ElasticModel(mesh, material, model)
        self._springs = ToolSprings(mesh, material.plane_modulus, contact)
        self._free = np.repeat(mesh.fixed == 0, 3)

    def forces(
        self,
        place: Sequence[float],
        radius: float,
        depths: Sequence[float],
        stiffness: float = _STIFF,
    ) -> Floats:
        """Return the normal force at rest at some depths [N].

        Args:
            place: x and y of the tool [m].
            radius: of the sphere [m].
            depths: of its lowest point under the surface [m].
            stiffness: of the coupling spring [N/m].
        """
        found, soft, reach = [], 0.0, -1.0
        for depth in depths:
            spring = self._spring(place, radius, depth, stiffness)
            if spring.reach != reach:
                soft, reach = self._compliance(spring), spring.reach
            series = replace(spring, stiffness=1 / (1 / stiffness + soft))
            linear = spring.hertz == 0.0
            found.append(series.stiffness * depth if linear else series.pushed(depth))
        return np.array(found)

    def displacement(self, place: Sequence[float], radius: float, depth: float) -> Floats:
        """Return the displacement at rest at a depth [m], shape (n, 3); arguments of `forces`."""
        (force,) = self.forces(place, radius, [depth])
        return -force * self._lifted(self._spring(place, radius, depth, _STIFF))

    def _spring(
        self, place: Sequence[float], radius: float, depth: float, stiffness: float
    ) -> Coupling:
        nodes, weights = touched(self._mesh, place)
        tip = np.array([*place, BLOCK[2] - depth])
        contact = ToolContact(
            state=ContactState.TOUCHING,
            topology=0,
            nodes=nodes,
            weights=weights,
            device=tip + radius * _UP,
            offset=radius * _UP,
            normal=_UP,
            stiffness=stiffness,
            radius=radius,
            blade_root=tip,
            blade_tip=tip,
        )
        return self._springs.spring(contact, 0.0, depth)

    def _compliance(self, spring: Coupling) -> float:
        return float(spring.weights @ self._lifted(spring)[spring.nodes, 2])

    def _lifted(self, spring: Coupling) -> Floats:
        """Return the displacement by a spring that lifts with 1 N [m], shape (n, 3)."""
        load = np.zeros_like(self._mesh.rest)
        load[spring.nodes] = spring.weights[:, None] * _UP
        return solve_static(self.model, self._free, load, 1e-4)


def main() -> None:
    """Print the forces of spheres of 4 and 8 mm by resolution, and while one slides."""
    from bench.accuracy.sphere_contact import Layer, SphereOnLayer, sneddon, thickness_factor

    depths, centre = (0.001, 0.002, 0.003), (0.052, 0.049)
    layer = Layer(BLOCK[2], np.sqrt(BLOCK[0] * BLOCK[1] / np.pi), 5400.0, 0.45)
    for radius in (0.004, 0.008):
        print(f'sphere of {1e3 * radius:g} mm: force [mN] at 1, 2, 3 mm')
        for edge, cells in CELLS.items():
            mesh = block(cells)
            for contact in ('footprint', 'triangle'):
                forces = Press(mesh, contact).forces(centre, radius, depths)
                print(f'  {edge} mm, {len(mesh.tetrahedra)} tetrahedra, {contact}:', _mn(forces))
        tissue = SphereOnLayer(layer, radius, radius / 5, large=True)
        print('  quadratic, neo-Hookean:', _mn([tissue.force(depth) for depth in depths]))
        tissue = SphereOnLayer(layer, radius, radius / 8, large=False)
        print('  quadratic, linear:', _mn([tissue.force(depth) for depth in depths]))
        factors = [thickness_factor(layer, radius, depth) for depth in depths]
        exact = [sneddon(layer, radius, d) * f for d, f in zip(depths, factors, strict=True)]
        print('  Sneddon, by thickness:', _mn(exact))
    for contact in ('footprint', 'triangle'):
        ratios = [sliding_ratio(Press(block(CELLS[edge]), contact)) for edge in (6.2, 3.6)]
        print(f'sliding, greatest over least, 6.2 and 3.6 mm, {contact}:', np.round(ratios, 3))


def sliding_ratio(press: Press, count: int = 16) -> float:
    """Return greatest over least force of a sphere of 4 mm that slides 30 mm, 3 mm deep."""
    forces = [
        press.forces((0.035 + 0.03 * s, 0.048 + 0.0061 * s), 0.004, [0.003], 200.0)[0]
        for s in np.linspace(0, 1, count)
    ]
    return float(max(forces) / min(forces))


def _mn(forces: Sequence[float]) -> str:
    return ' '.join(f'{1e3 * force:.2f}' for force in forces)


if __name__ == '__main__':
    main()
