"""The beam in each peer. A peer is imported when it is requested.

All get the trainer's nodes, tetrahedra, node masses, clamps and nodal forces. A neo-Hookean
material gets the constants whose small strains are those of the beam's E and nu.
"""

from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.accuracy.peer_beam import Beam
from bench.accuracy.problems import material

Floats = NDArray[np.float64]

IMPLICIT_STEP_S = 1 / 120
"""[s]: the trainer's own implicit step."""
_BLOCK_STEP, _BLOCK_ITERATIONS = 1 / 600, 10
"""Of Newton's block descent, as its example of a hanging soft body has them [s], [-]."""


def flexcomp(at: Beam, integrator: str, dt: float) -> str:
    """Return the beam in MuJoCo's XML: one body with three sliders for each node that is not
    clamped.
    """
    mesh, solid = at.mesh, at.problem.solid
    return f"""<mujoco>
<option timestep="{dt!r}" gravity="0 0 0" integrator="{integrator}" solver="CG">
<flag contact="disable"/></option>
<worldbody><flexcomp name="beam" type="direct" dim="3" dof="full" mass="{float(at.masses.sum())!r}"
 radius="1e-5" point="{_words(mesh.rest)}" element="{_words(mesh.tetrahedra)}">
<contact contype="0" conaffinity="0" selfcollide="none"/>
<elasticity young="{solid.youngs_modulus!r}" poisson="{solid.poissons_ratio!r}"/>
<pin id="{_words(np.flatnonzero(mesh.fixed))}"/></flexcomp></worldbody></mujoco>"""


def _words(numbers: NDArray[Any]) -> str:
    return ' '.join(map(repr, numbers.ravel().tolist()))


def neo_hookean(mu: float, lam: float) -> tuple[float, float]:
    """Return the constants of mu/2 (I - 3) - mu/2 log(I + 1) + lambda/2 (J - a)^2 [Pa].

    They follow from the constants of Lame [Pa].

    Smith, de Goes, Kim, Stable Neo-Hookean Flesh Simulation, 2018, section 3.4.
    """
    return 4 / 3 * mu, lam + 5 / 6 * mu


class MujocoFlex:
    """A flex with three degrees of freedom a node, without contacts.

    Args:
        at: the beam.
        integrator: `Euler` or `discrete`.
    """

    def __init__(self, at: Beam, integrator: str) -> None:
        self._mujoco = mujoco = import_module('mujoco')
        self.dt = at.explicit_step() if integrator == 'Euler' else IMPLICIT_STEP_S
        model = mujoco.MjModel.from_xml_string(flexcomp(at, integrator, self.dt))
        self._free = np.flatnonzero(at.mesh.fixed == 0)
        bodies = model.flex_vertbodyid[self._free]
        model.body_mass[bodies] = at.masses[self._free]
        self._model, self._data = model, mujoco.MjData(model)
        mujoco.mj_setConst(model, self._data)
        self._dofs = model.body_dofadr[bodies][:, None] + np.arange(3)
        self._data.qfrc_applied[self._dofs] = at.load[self._free]
        self._count = at.mesh.node_count

    def step(self, count: int) -> None:
        self._mujoco.mj_step(self._model, self._data, count)

    def slow(self, factor: float) -> None:
        self._data.qvel *= factor

    def displacement(self) -> Floats:
        u = np.zeros((self._count, 3))
        u[self._free] = self._data.qpos[self._dofs]  # sliders alone: one place for each velocity
        return u


class NewtonTetrahedra:
    """Particles and tetrahedra in single precision on Warp's processor device, without contacts.

    Args:
        at: the beam.
        block: block descent (implicit) in the place of symplectic Euler.
    """

    def __init__(self, at: Beam, block: bool) -> None:
        self._warp, newton = import_module('warp'), import_module('newton')
        warp, mesh = self._warp, at.mesh
        warp.config.quiet = True
        builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        constants = material(at.problem.solid)
        mu, lam = constants.lame_mu, constants.lame_lambda
        if not block:  # Smith, de Goes, Kim 2018; block descent turns the constants itself
            mu, lam = neo_hookean(mu, lam)
        builder.add_soft_mesh(
            pos=warp.vec3(0.0, 0.0, 0.0), rot=warp.quat_identity(), scale=1.0,
            vel=warp.vec3(0.0, 0.0, 0.0), vertices=[warp.vec3(*x) for x in mesh.rest.tolist()],
            indices=mesh.tetrahedra.ravel().tolist(), density=constants.density, k_mu=mu,
            k_lambda=lam, k_damp=0.0, add_surface_mesh_edges=False, particle_radius=1e-5,
        )  # fmt: skip
        active = int(newton.ParticleFlags.ACTIVE)
        for node in np.flatnonzero(mesh.fixed):
            builder.particle_mass[node] = 0.0
            builder.particle_flags[node] = int(builder.particle_flags[node]) & ~active
        if block:
            builder.color()
        model = builder.finalize(device='cpu')
        model.particle_grid = None
        if block:
            self.dt = _BLOCK_STEP
            self._solver = newton.solvers.SolverVBD(
                model, iterations=_BLOCK_ITERATIONS, particle_enable_tile_solve=False
            )
        else:
            self.dt = at.explicit_step()
            self._solver = newton.solvers.SolverSemiImplicit(model, enable_tri_contact=False)
        self._now, self._next, self._control = model.state(), model.state(), model.control()
        self._force = warp.array(at.load.astype(np.float32), dtype=warp.vec3, device='cpu')
        self._rest = self._now.particle_q.numpy().astype(np.float64)

    def step(self, count: int) -> None:
        for _ in range(count):
            self._warp.copy(self._now.particle_f, self._force)
            self._solver.step(self._now, self._next, self._control, None, self.dt)
            self._now, self._next = self._next, self._now

    def slow(self, factor: float) -> None:
        velocity = self._now.particle_qd.numpy()  # shares the memory
        velocity *= factor

    def displacement(self) -> Floats:
        return np.asarray(self._now.particle_q.numpy() - self._rest)
