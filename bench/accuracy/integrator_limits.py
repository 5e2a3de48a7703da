"""The command `bench stability`: each integrator's largest stable step, in theory and in fact."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from scipy.sparse.linalg import LinearOperator, eigsh

from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.tissue_sim.assembly import make_task
from cutting_trainer.tissue_sim.contact.coupling import NO_SPRINGS
from cutting_trainer.tissue_sim.elasticity.models import MODELS, ElasticModel, ModelName
from cutting_trainer.tissue_sim.motion.integrators import INTEGRATORS, Integrator, IntegratorName
from cutting_trainer.tissue_sim.motion.stability import FrequencyBound, step_bound
from cutting_trainer.tissue_sim.planner.candidate import Task

Floats = NDArray[np.float64]

_STEPS, _BLOCK = 2400, 20
_GROWTH = 1e3
_DECAY_LIMIT, _RISES = 1e-4, 1 + 1e-6
_RELATIVE_AMPLITUDE = 1e-9
"""Amplitude of the disturbance, as a part of the tissue's length: rotations stay small."""


@dataclass(frozen=True)
class Limit:
    """The largest stable step of an integrator [s]; infinite: none.

    Attributes:
        used: step of the simulation, before its factor `safety`.
        theory: from the converged highest frequency.
        measured: where a disturbance begins to grow.
    """

    model: ModelName
    integrator: IntegratorName
    used: float
    theory: float
    measured: float


def run_stability(scene: str, *, as_json: bool = False) -> None:
    """Print the limits on a scene's mesh.

    Args:
        scene: name or path.
        as_json: print them as JSON.

    Raises:
        SessionError, SceneError, MeshError: the scene cannot be used.
    """
    task = make_task(load_scene(scene).tissue)
    console = Console(highlight=False, stderr=as_json)
    found: list[Limit] = []
    with console.status('') as line:
        for model in MODELS:
            line.update(model)
            found += limits(task, model)
    if as_json:
        print(json.dumps(as_data(scene, task, found), indent=2, allow_nan=False))
        return
    console.print(_table(scene, task, found))
    console.print(
        'used: from the bound of the frequency that the simulation has; theory: from the highest '
        f'frequency itself; measured: a disturbance grows within {_STEPS} steps. The implicit '
        'integrator has no limit; its step is a matter of accuracy. substeps: of a frame, by the '
        f'step that is used and a safety of {task.stepping.safety:g}.'
    )


def _table(scene: str, task: Task, found: list[Limit]) -> Table:
    d = task.material
    table = Table('model', 'integrator', box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
    for column in ('used', 'theory', 'measured', 'substeps'):
        table.add_column(column, justify='right')
    table.title = f'Largest stable step of {escape(scene)}, in ms'
    table.caption = (
        f'{len(task.mesh.tetrahedra)} tetrahedra, alpha {d.alpha:g} 1/s, beta {d.beta:g} s'
    )
    before = ''
    for limit in found:
        count = substeps(task, limit)
        table.add_row(
            '' if limit.model == before else limit.model,
            limit.integrator,
            *(_milliseconds(s) for s in (limit.used, limit.theory, limit.measured)),
            'never stable' if count is None else f'{count}',
        )
        before = limit.model
    return table


def as_data(scene: str, task: Task, found: list[Limit]) -> dict[str, Any]:
    """Return the limits for JSON, in SI units.

    Returns:
        scene, tetrahedra, alpha, beta, safety, frame; by model and integrator the limits, null
        where there is none, 0 where no step is stable, and the substeps of a frame, null there.
    """
    d = task.material
    return {
        'scene': scene,
        'tetrahedra': len(task.mesh.tetrahedra),
        'alpha': d.alpha,
        'beta': d.beta,
        'safety': task.stepping.safety,
        'frame': 1 / task.stepping.rate,
        'limits': [
            {
                'model': limit.model,
                'integrator': limit.integrator,
                'used': _finite(limit.used),
                'theory': _finite(limit.theory),
                'measured': _finite(limit.measured),
                'substeps': substeps(task, limit),
            }
            for limit in found
        ],
    }


def substeps(task: Task, limit: Limit) -> int | None:
    """Number of substeps of a frame; None where no step is stable."""
    step = task.stepping.safety * limit.used
    least = task.stepping.min_substeps
    return max(int(np.ceil(1 / task.stepping.rate / step)), least) if step else None


def limits(task: Task, model: ModelName) -> Iterator[Limit]:
    """Return the limits of a model, by integrator."""
    elastic = ElasticModel(task.mesh, task.material, model)
    omega, mode = highest_mode(elastic)
    for integrator in INTEGRATORS:
        yield measured_limit(task, elastic, integrator, omega, mode)


def highest_mode(model: ElasticModel) -> tuple[float, Floats]:
    """Return highest natural frequency [rad/s], converged, and its mode [m], shape (3 n,)."""
    root = np.sqrt(_inverse_mass(model))

    def scaled(x: Floats) -> Floats:
        return np.asarray(root * model.product((root * x.ravel()).reshape(-1, 3)).ravel())

    operator = LinearOperator((len(root), len(root)), matvec=scaled, dtype=float)
    start = np.random.default_rng(0).standard_normal(len(root))
    top, vector = eigsh(operator, k=1, which='LA', v0=start, tol=1e-7)
    return float(np.sqrt(top[0])), root * vector[:, 0]


def measured_limit(
    task: Task, model: ElasticModel, integrator: IntegratorName, omega: float, mode: Floats
) -> Limit:
    """Bisect the step at which a disturbance of the highest mode begins to grow, to a
    thousandth.

    Args:
        task: the scene.
        model: its elasticity.
        integrator: which one.
        omega, mode: from `highest_mode`.
    """
    alpha, beta = task.material.alpha, task.material.beta
    bound = FrequencyBound(model, _inverse_mass(model)).omega
    used = step_bound(integrator, bound, alpha, beta)
    theory = step_bound(integrator, omega, alpha, beta)
    if theory == 0.0:
        return Limit(model.name, integrator, used, 0.0, 0.0)
    if not np.isfinite(theory):
        calm = not grows(task, model, integrator, 1.0, omega, mode)
        return Limit(model.name, integrator, used, theory, np.inf if calm else 0.0)
    stable, unstable = 0.5 * theory, 2.0 * theory
    while unstable > 1.001 * stable:
        step = (stable + unstable) / 2
        if grows(task, model, integrator, step, omega, mode):
            unstable = step
        else:
            stable = step
    return Limit(model.name, integrator, used, theory, stable)


def grows(
    task: Task,
    model: ElasticModel,
    integrator: IntegratorName,
    step: float,
    omega: float,
    mode: Floats,
) -> bool:
    """Return whether a small disturbance of the highest mode grows.

    Args:
        task: the scene; its damping counts.
        model: its elasticity.
        integrator: which one.
        step: [s].
        omega, mode: of the disturbance [rad/s], [m], shape (3 n,).
    """
    if model.rotating:  # the rotations of a run that went wrong would be where this one begins
        model = ElasticModel(model.mesh, model.material, model.name)
    length = float(np.linalg.norm(np.ptp(model.mesh.rest, axis=0)))
    inverse = _inverse_mass(model)
    u = _RELATIVE_AMPLITUDE * length * mode / np.abs(mode).max()
    v = np.zeros_like(u)
    spring = NO_SPRINGS
    method = Integrator(integrator, task.material.alpha, task.material.beta)
    sizes = [float(np.linalg.norm(u))]
    for _ in range(_STEPS // _BLOCK):
        method.step(model.operands(), inverse, model.diagonal, spring, u, v, step, _BLOCK)
        sizes.append(float(np.hypot(np.linalg.norm(u), np.linalg.norm(v) / omega)))
        if not sizes[-1] <= _GROWTH * sizes[0]:
            return True
        if sizes[-1] < _DECAY_LIMIT * sizes[0]:
            return False
    half = len(sizes) // 2
    return max(sizes[half:]) > _RISES * max(sizes[:half])


def _inverse_mass(model: ElasticModel) -> Floats:
    return np.repeat(np.where(model.mesh.fixed == 1, 0.0, 1.0 / model.mass), 3)


def _finite(seconds: float) -> float | None:
    return seconds if np.isfinite(seconds) else None


def _milliseconds(seconds: float) -> str:
    return f'{1e3 * seconds:.4g}' if np.isfinite(seconds) else 'none'
