"""`trainer identify`: the material under which recorded hands would feel the recorded forces."""

import json
import os
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rich import box
from rich.console import Console
from rich.table import Table

from cutting_trainer.bags.errors import BagError
from cutting_trainer.recordings.recorded_scene import restore_scene
from cutting_trainer.session.errors import SessionError
from cutting_trainer.session.exit_status import Status
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.studies.bag_collection import StudyBag, find_bags
from cutting_trainer.studies.designs import Setting
from cutting_trainer.studies.evaluation import Job, read_recording
from cutting_trainer.studies.fit import Fit, Floats, Observation, Point
from cutting_trainer.studies.identification import (
    PARAMETERS,
    Estimate,
    Linearised,
    estimates_of,
    identifiability,
    prior_of,
)
from cutting_trainer.studies.identification_page import write_identification_page
from cutting_trainer.studies.identity import identity_of_worker
from cutting_trainer.studies.refined_mesh import write_refined
from cutting_trainer.studies.study_command import NO_DASK
from cutting_trainer.tissue_sim.scene_schema import MaterialSettings

MATERIAL_FILE, RESULT_FILE = 'material.yaml', 'identification.json'
PAGE_FILE = 'identification.html'
_KEY = 'tissue.material'
_MESH_KEY = 'tissue.mesh'


@dataclass(frozen=True)
class IdentifyOptions:
    """Options of the command.

    Attributes:
        bags: bags, folders with bags anywhere below, or globs.
        output: folder of the results.
        parameters: names of the constants; (): those that the scene has and hands may touch.
        noise: of the force for one sample of one component [N].
        changes: of the scene, by dotted key, in YAML.
        refine: compute on the mesh refined once, and once more on the recorded one.
        workers: number of own workers; 0: one for each processor.
        scheduler: address of a scheduler with workers; '': own workers.
        as_json: print the outcome as JSON.
    """

    bags: tuple[str, ...]
    output: Path
    parameters: tuple[str, ...] = ()
    noise: float = 0.003
    changes: Mapping[str, str] = field(default_factory=dict)
    refine: bool = False
    workers: int = 0
    scheduler: str = ''
    as_json: bool = False


@dataclass(frozen=True)
class Identification:
    """Outcome.

    Attributes:
        estimates: by constant.
        sentences: about constants that the bags do not determine, bags, and mesh.
        computed: number of re-simulations.
        cpu: processor time of these [s].
        problem: around the solution.
        observations: recorded forces.
        forces: computed at the solution [N], each shape (n, 3).
    """

    estimates: dict[str, Estimate]
    sentences: list[str]
    computed: int
    cpu: float
    problem: Linearised
    observations: list[Observation]
    forces: list[Floats]

    def plain(self) -> dict[str, object]:
        """Return the outcome for JSON."""
        return {
            'estimates': {
                name: {**_plain(estimate), 'unit': PARAMETERS[name]}
                for name, estimate in self.estimates.items()
            },
            'notes': self.sentences,
            'resimulations': self.computed,
            'processor_time': self.cpu,
        }


def run_identification(options: IdentifyOptions) -> Status:
    """Identify a material, write the results, and print them.

    Raises:
        BagError: a bag cannot be computed.
        SceneError: its scene is not valid with the changes.
        SessionError: there are no bags, no scheduler, or no Dask.
    """
    if find_spec('distributed') is None:
        raise SessionError(NO_DASK)
    for name in options.parameters:
        if name not in PARAMETERS:
            raise SessionError(f'--parameter {name}: there are {", ".join(PARAMETERS)}')
    bags = find_bags(options.bags, Path.cwd())
    options.output.mkdir(parents=True, exist_ok=True)
    with _workers(options) as client:
        found = identify(bags, options, client)
    preset = {name: _digits(e.value) for name, e in found.estimates.items()}
    (options.output / MATERIAL_FILE).write_text(
        yaml.safe_dump({'tissue': {'material': preset}}, sort_keys=False), encoding='utf-8'
    )
    text = json.dumps(found.plain(), indent=2)
    (options.output / RESULT_FILE).write_text(f'{text}\n', encoding='utf-8')
    names = [bag.name for bag in bags]
    page_ = options.output / PAGE_FILE
    write_identification_page(page_, names, found.estimates, found.sentences,
                              found.observations, found.forces)  # fmt: skip
    if options.as_json:
        print(text)
        return Status.OK
    console = Console(soft_wrap=True)
    console.print(_table(found.estimates), highlight=False)
    for line in found.sentences:
        console.print(line, highlight=False, markup=False)
    for file in (MATERIAL_FILE, RESULT_FILE, PAGE_FILE):
        console.print(f'wrote {options.output / file}', highlight=False, markup=False)
    return Status.OK


def identify(bags: Sequence[StudyBag], options: IdentifyOptions, client: Any) -> Identification:
    """Identify a material from bags on the workers of a cluster.

    Args:
        bags: with recorded forces.
        options: of the command.
        client: of the workers.
    """
    changes = {key: yaml.safe_load(value) for key, value in options.changes.items()}
    if _MESH_KEY in changes:
        changes[_MESH_KEY] = str(Path(changes[_MESH_KEY]).resolve())
    observations = [_observe(bag) for bag in bags]
    material = _material(bags[0], options.changes)
    names = options.parameters or tuple(
        name for name in PARAMETERS if getattr(material, name) > 0.0
    )
    priors = {name: prior_of(name, getattr(material, name)) for name in names}
    folder = options.output.resolve()
    refined = [
        write_refined(read_recording(str(bag.path), bag.hash).bag, folder, options.changes)
        for bag in bags
    ]
    running = _Running(bags, names, changes, client, refined, on_refined=options.refine)
    fit = Fit(observations, priors, options.noise, running.compute)
    with np.errstate(divide='ignore'):
        recorded = np.log([getattr(material, name) for name in names])
    problem = fit.solve(recorded, confidence=0.95)
    other, without = running.on_other_mesh(problem.at)
    notes = [without] if without else []
    if not without:
        problem = fit.with_mesh(problem, other, is_refined=options.refine)
    forces = fit.forces(problem.at)
    return Identification(
        estimates=estimates_of(problem, priors),
        sentences=[*identifiability(problem), *notes, *running.failures()],
        computed=running.computed,
        cpu=running.cpu,
        problem=problem,
        observations=observations,
        forces=forces,
    )


class _Running:
    """Re-simulations of bags under constants."""

    def __init__(
        self,
        bags: Sequence[StudyBag],
        names: Sequence[str],
        changes: Mapping[str, Any],
        client: Any,
        refined: Sequence[Path],
        *,
        on_refined: bool,
    ) -> None:
        self.computed, self.cpu = 0, 0.0
        self._bags, self._names, self._changes, self._client = bags, names, changes, client
        self._refined, self._on_refined = refined, on_refined
        self._reasons: dict[str, int] = {}

    def compute(self, wanted: Iterable[tuple[int, Point]]) -> dict[tuple[int, Point], Floats]:
        """Return computed forces by bag and point, NaN where they cannot be computed."""
        return self._series(wanted, self._on_refined)

    def on_other_mesh(self, at: Floats) -> tuple[list[Floats], str]:
        """Return the forces of all bags on the mesh that is not searched on, refined or as
        recorded, and why there are none, or ''.
        """
        point = tuple(np.exp(at).tolist())
        found = self._series([(i, point) for i in range(len(self._bags))], not self._on_refined)
        forces = [found[number, point] for number in range(len(self._bags))]
        if any(np.isnan(each).any() for each in forces):
            return [], (
                'on the other mesh some bags could not be computed: intervals are without the '
                'error of the mesh'
            )
        return forces, ''

    def failures(self) -> list[str]:
        """Return the reasons of re-simulations that failed."""
        return [
            f'{count} re-simulation{"s" if count > 1 else ""} failed: {reason}'
            for reason, count in self._reasons.items()
        ]

    def _changed(self, bag: int, point: Point, refined: bool) -> dict[str, Any]:
        pairs = zip(self._names, point, strict=True)
        mesh = {_MESH_KEY: str(self._refined[bag])} if refined else {}
        return {**self._changes, **{f'{_KEY}.{name}': value for name, value in pairs}, **mesh}

    def _series(
        self, wanted: Iterable[tuple[int, Point]], refined: bool
    ) -> dict[tuple[int, Point], Floats]:
        from cutting_trainer.studies.cluster import compute

        here, keys, jobs = identity_of_worker(), {}, []
        for number, key in enumerate(wanted, 1):
            bag = self._bags[key[0]]
            setting = Setting(number, self._changed(*key, refined))
            keys[bag.hash, setting.identity] = key
            jobs.append(Job(str(bag.path), bag.hash, setting, here, series=True))
        found = {}
        for job, result in compute(self._client, jobs):
            key = keys[job.bag_hash, job.setting.identity]
            self.computed += 1
            self.cpu += result.cpu
            if result.series is not None:
                found[key] = result.series.vectors
            else:
                self._reasons[result.failure] = self._reasons.get(result.failure, 0) + 1
                found[key] = np.full((_ticks(self._bags[key[0]]), 3), np.nan)
        return found


def _ticks(bag: StudyBag) -> int:
    return len(read_recording(str(bag.path), bag.hash).felt.times)


def _observe(bag: StudyBag) -> Observation:
    try:
        felt = read_recording(str(bag.path), bag.hash).felt
    except BagError as error:
        raise BagError(f'{bag.name}: {error}') from None
    return Observation((felt.times - felt.times[0]) * 1e-9, felt.vectors)


def _material(bag: StudyBag, changes: Mapping[str, str]) -> MaterialSettings:
    recording = read_recording(str(bag.path), bag.hash)
    with tempfile.TemporaryDirectory(prefix='trainer-') as temporary:
        scene = load_scene(str(restore_scene(recording.bag, Path(temporary), changes)))
        return scene.tissue.material


def _workers(options: IdentifyOptions) -> AbstractContextManager[Any]:
    from cutting_trainer.studies.cluster import others_cluster, own_cluster

    if options.scheduler:
        return others_cluster(options.scheduler)
    return own_cluster(options.workers or len(os.sched_getaffinity(0)))


def _plain(estimate: Estimate) -> dict[str, object]:
    values = asdict(estimate)
    return {k: None if v != v else v for k, v in values.items()}


def _digits(value: float) -> float:
    return float(f'{value:.4g}')


def _table(estimates: Mapping[str, Estimate]) -> Table:
    table = Table(box=box.SIMPLE_HEAD)
    for name in ('', 'value', '95 % interval', 'prior'):
        table.add_column(name, justify='right' if name else 'left')
    for name, e in estimates.items():
        interval = f'{e.low:.4g} to {e.high:.4g}'
        unit = PARAMETERS[name]
        prior = f'{e.prior.median:.3g} ({e.prior.source})'
        table.add_row(f'{name} ({unit})', f'{e.value:.4g}', interval, prior)
    return table
