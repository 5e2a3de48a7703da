"""Contact and loads on a half space: flat punch, sphere, patch and point, against their formulas.

The half space is a cylinder, radius and depth D, its outside held: that leaves the settlement short
by c a / D, with a the size of the contact. So each figure is taken at D and 2 D, where the error
halves, and twice the second less the first is free of it to first order.
"""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from bench.common.meshes import kuhn_block, pressed
from cutting_trainer.tissue_sim.elasticity.compliance import solve_static
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel, ModelName
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh

Floats = np.ndarray
MODULUS, CONTACT, DEPTH = 5000.0, 0.01, 1e-4
FAR = 6
"""D by a."""
every_case = pytest.mark.parametrize(
    ('name', 'nu', 'elements', 'error'),
    [('linear', 0.3, 8, 0.10), ('linear_smoothed', 0.47, 4, 0.03),
     ('corotational_smoothed', 0.45, 4, 0.03)],
)  # fmt: skip


def planes(inner: int, size: float) -> Floats:
    """Even out to the edge of the contact, then wider and wider, to `size` [m]."""
    steps = [CONTACT / inner] * inner
    while sum(steps) < size:
        steps.append(1.4 * steps[-1])
    at = np.concatenate([[0.0], np.cumsum(steps)])
    at[inner:] = CONTACT + (at[inner:] - CONTACT) * (size - CONTACT) / (at[-1] - CONTACT)
    return at


class HalfSpace:
    """A quarter of a cylinder between two planes of symmetry, its surface at z = 0.

    Args:
        name: elastic model.
        nu: Poisson's ratio.
        inner: elements over the radius of the contact.
        size: radius and depth, by the radius of the contact.
    """

    def __init__(self, name: ModelName, nu: float, inner: int, size: float) -> None:
        radii = planes(inner, size * CONTACT)
        cells = len(radii) - 1
        block = kuhn_block((cells,) * 3, (cells,) * 3)
        x, y, z = np.rint(block.rest).astype(int).T
        # Squares about the axis become circles.
        angle = np.pi / 4 * np.minimum(x, y) / np.maximum(np.maximum(x, y), 1)
        angle = np.where(y > x, np.pi / 2 - angle, angle)
        self.radius = radii[np.maximum(x, y)]
        rest = np.stack(
            [self.radius * np.cos(angle), self.radius * np.sin(angle), -radii[cells - z]], axis=1
        )
        rest[x == 0, 0] = 0.0
        material = Material(MODULUS, nu, 1000.0)
        self.model = ElasticModel(TetMesh(rest, block.tetrahedra), material, name)
        self.rest = self.model.mesh.rest
        self.top = z == cells
        self.far = (self.radius == radii[-1]) | (z == 0)
        self.free = np.stack([x > 0, y > 0, np.ones(len(x), bool)], axis=1)
        self.free[self.far] = False

    def solve(self, held: Floats, u: Floats, load: Floats) -> Floats:
        """Displacement [m] with some nodes held at u's z, the far ones at u, under a load [N]."""
        free = self.free.copy()
        free[held, 2] = False
        return u + solve_static(self.model, free.ravel(), load - self.model.product(u), 1e-7)

    def press(self, shape: Floats, held: Floats) -> tuple[Floats, Floats]:
        """Displacement and pressing force by node, on a quarter, of a rigid body without friction.

        Args:
            shape: how far the surface must go down where the body touches it [m], shape (n,).
            held: where it touches, shape (n,).
        """
        u = np.zeros_like(self.rest)
        u[held, 2] = -shape[held]
        u = self.solve(held, u, np.zeros_like(u))
        return u, -self.model.product(u)[:, 2]

    def patch(self) -> Floats:
        """Nodal forces of 1 Pa on the disc of the contact [N]."""
        triangles = self.model.mesh.triangles
        on = self.top[triangles].all(axis=1)
        on &= self.radius[triangles].max(axis=1) < 1.001 * CONTACT
        return pressed(self.model.mesh, on, lambda points: np.ones(len(points)))


@cache
def half_space(name: ModelName, nu: float, inner: int, size: float) -> HalfSpace:
    return HalfSpace(name, nu, inner, size)


def punch(space: HalfSpace) -> float:
    """Force on a cylinder's flat end, pressed in by DEPTH [N]."""
    held = space.top & (space.radius < 1.001 * CONTACT)
    _, force = space.press(np.full(len(held), DEPTH), held)
    return 4 * float(force[held].sum())


def sphere(space: HalfSpace) -> float:
    """Force on a sphere pressed in until Hertz's contact has the radius CONTACT [N].

    Which nodes touch is found: none pulls, none is inside of the sphere.
    """
    shape = DEPTH - space.radius**2 * DEPTH / CONTACT**2 / 2
    held = space.top & (space.radius < 1.001 * CONTACT)
    for _ in range(20):
        u, force = space.press(shape, held)
        touching = (held & (force > 0)) | (space.top & ~held & (-u[:, 2] < shape))
        if (touching == held).all():
            return 4 * float(force[held].sum())
        held = touching
    raise AssertionError('no contact was found')


def settlement(space: HalfSpace) -> float:
    """Of the middle of a disc under 1 Pa, as if all of the disc's area were loaded [m]."""
    load = space.patch()
    u = space.solve(np.zeros(len(load), bool), np.zeros_like(load), load)
    middle = int(np.argmin(np.linalg.norm(space.rest, axis=1)))
    return float(u[middle, 2] * np.pi * CONTACT**2 / 4 / load[:, 2].sum())


def without_the_outside(value: Callable[[HalfSpace], float], *case: object) -> float:
    """What a settlement comes to as D grows; the error of D is first seen to be as it should."""
    near, middle, wide = (value(half_space(*case, FAR * k)) for k in (1, 2, 4))
    assert 1.7 < (middle - near) / (wide - middle) < 2.5
    assert 0.02 < (wide - middle) / wide < 0.08
    return 2 * wide - middle


@every_case
def test_a_flat_punch_needs_2_a_e_d(name: ModelName, nu: float, elements: int, error: float):
    exact = 2 * CONTACT * MODULUS / (1 - nu**2) * DEPTH
    found = without_the_outside(lambda space: exact / punch(space), name, nu, elements)
    assert found == pytest.approx(1, abs=error)


@every_case
def test_a_sphere_needs_the_force_of_hertz(name: ModelName, nu: float, elements: int, error: float):
    exact = 4 / 3 * MODULUS / (1 - nu**2) * np.sqrt(CONTACT**2 / DEPTH) * DEPTH**1.5
    found = without_the_outside(lambda space: exact / sphere(space), name, nu, elements)
    assert found == pytest.approx(1, abs=error)


@every_case
def test_a_loaded_disc_settles_as_boussinesq_says(
    name: ModelName, nu: float, elements: int, error: float
):
    exact = 2 * CONTACT / (MODULUS / (1 - nu**2))
    found = without_the_outside(lambda space: settlement(space) / exact, name, nu, elements)
    assert found == pytest.approx(1, abs=error)


@every_case
def test_far_from_a_small_load_the_tissue_moves_as_under_boussinesqs_point(
    name: ModelName, nu: float, elements: int, error: float
):
    """The outside is put where the formula has it, so that no size of the domain is left in it."""
    space = half_space(name, nu, elements, FAR)
    load = space.patch()
    force = -4 * load[:, 2].sum()
    x, y, z = space.rest.T
    distance = np.maximum(np.linalg.norm(space.rest, axis=1), 1e-12)
    scale = force / (4 * np.pi * MODULUS / (2 * (1 + nu)))
    outward = -z / distance**3 - (1 - 2 * nu) / (distance * (distance - z))
    exact = scale * np.stack(
        [x * outward, y * outward, -(z**2) / distance**3 - 2 * (1 - nu) / distance], axis=1
    )
    u = space.solve(np.zeros(len(x), bool), np.where(space.far[:, None], exact, 0.0), load)
    between = (distance > 2.5 * CONTACT) & (distance < 5 * CONTACT)
    assert between.sum() > 100
    wrong = np.linalg.norm(u - exact, axis=1) / np.linalg.norm(exact, axis=1)
    assert wrong[between].max() < 0.10
    assert wrong[between].mean() < error
