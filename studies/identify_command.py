"""`trainer identify`: the material under which recorded hands would feel the recorded forces."""

import json
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
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
from cutting_trainer.recordings.resimulate_command import refuse_lost_changes
from cutting_trainer.session.errors import SessionError
from cutting_trainer.session.exit_status import Status
from cutting_trainer.session.scene_overrides import load_changed, value_of
from cutting_trainer.studies.bag_collection import StudyBag, find_bags
from cutting_trainer.studies.designs import MESH_KEY, Setting
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
from cutting_trainer.studies.study_command import NO_DASK, without_nan, workers_of
from cutting_trainer.tissue_sim.scene_schema import TissueSettings

MATERIAL_FILE, RESULT_FILE = 'material.yaml', 'identification.json'
PAGE_FILE = 'identification.html'
CONFIDENCE = 0.95
ON_RECORDED_MESH = 'the intervals are without the error of the mesh: --refine adds it'
LOCKING = ('linear', 'corotational')
"""Models whose elements are too stiff where tissue hardly changes its volume."""
_KEY = 'tissue.material'


@dataclass(frozen=True)
class IdentifyOptions:
    """Options of the command.

    Attributes:
        bags: bags, folders with bags anywhere below, globs, or URLs of these.
        output: folder of the results.
        parameters: names of the constants; (): those that the scene has and hands may touch.
        noise: of the force for one sample of one component [N].
        changes: of the scene, by dotted key, in YAML.
        refine: search on, on the mesh refined once.
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
                name: {**without_nan(estimate), 'unit': PARAMETERS[name]}
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
    if options.output.exists() and not options.output.is_dir():
        raise SessionError(f'{options.output} is a file: name a folder with --output')
    options.output.mkdir(parents=True, exist_ok=True)
    with workers_of(options) as client:
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
    read = [_observe(bag, options) for bag in bags]
    observations, tissues = [one for one, _ in read], [tissue for _, tissue in read]
    tissue, material = tissues[0], tissues[0].material
    changes = {key: value_of(key, text) for key, text in options.changes.items()}
    names = tuple(dict.fromkeys(options.parameters)) or tuple(
        name for name in PARAMETERS if getattr(material, name) > 0.0
    )
    priors = {name: prior_of(name, getattr(material, name)) for name in names}
    with np.errstate(divide='ignore'):
        recorded = np.log([getattr(material, name) for name in names])
    running = _Running(bags, observations, names, changes, client)
    fit = Fit(observations, priors, options.noise, running.compute)
    begin = fit.start(recorded)
    running.check(fit.forces(begin))
    problem = fit.solve(begin, CONFIDENCE)
    notes = [] if options.refine else [ON_RECORDED_MESH]
    notes += [
        f'{bag.name} has another tissue than {bags[0].name}: only {", ".join(names)} are common'
        for bag, other in zip(bags, tissues, strict=True)
        if (other.model, other.material, other.regions) != (tissue.model, material, tissue.regions)
    ]
    if tissue.model in LOCKING:
        notes.append(
            f'the force of the model {tissue.model} depends on the mesh, and that of stiffening '
            'does not (--with tissue.model=stiffening)'
        )
    if options.refine:
        coarse = problem.estimates
        folder = options.output.resolve()
        refined = [
            str(write_refined(read_recording(bag.place, bag.hash).bag, folder, options.changes))
            for bag in bags
        ]
        again = partial(running.compute, meshes=refined)
        fit = Fit(observations, priors, options.noise, again, fit.slopes)
        problem = fit.solve(coarse, CONFIDENCE)
        problem = replace(problem, mesh_change=problem.estimates - coarse)
    forces = fit.forces(problem.at)
    running.check(forces)
    return Identification(
        estimates=estimates_of(problem, priors),
        sentences=[
            *identifiability(problem),
            *notes,
            *running.failures(),
            f'{running.computed} sessions were computed, of {len(bags)} recorded',
        ],
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
        observations: Sequence[Observation],
        names: Sequence[str],
        changes: Mapping[str, Any],
        client: Any,
    ) -> None:
        self.computed, self.cpu = 0, 0.0
        self._bags, self._observations, self._names = bags, observations, names
        self._changes, self._client = changes, client
        self._reasons: dict[str, int] = {}

    def failures(self) -> list[str]:
        """Return the reasons of re-simulations that failed."""
        return [
            f'{count} re-simulation{"s" if count > 1 else ""} failed: {reason}'
            for reason, count in self._reasons.items()
        ]

    def check(self, forces: Sequence[Floats]) -> None:
        """Refuse forces of the bags of which one could not be computed.

        Raises:
            SessionError: with the reasons.
        """
        for bag, computed in zip(self._bags, forces, strict=True):
            if np.isnan(computed).any():
                reasons = '; '.join(self.failures())
                raise SessionError(f'{bag.name} cannot be computed: {reasons}')

    def compute(
        self,
        wanted: Iterable[tuple[int, Point]],
        meshes: Sequence[str] = (),
        *,
        last: bool = False,
    ) -> dict[tuple[int, Point], Floats]:
        """Return computed forces by bag and point, NaN where they cannot be computed.

        Args:
            wanted: bags and points.
            meshes: file of each bag; (): those of the scenes.
            last: those that no worker could compute are not tried again.

        Raises:
            SessionError: there is one.
        """
        from cutting_trainer.studies.cluster import compute

        here, keys, jobs = identity_of_worker(), {}, []
        for number, key in enumerate(wanted, 1):
            bag, pairs = self._bags[key[0]], zip(self._names, key[1], strict=True)
            mesh = {MESH_KEY: meshes[key[0]]} if meshes else {}
            material = {f'{_KEY}.{name}': value for name, value in pairs}
            setting = Setting(number, {**self._changes, **material, **mesh})
            keys[bag.hash, setting.identity] = key
            jobs.append(Job(bag.place, bag.hash, setting, here, series=True))
        found, lost = dict[tuple[int, Point], Floats](), dict[tuple[int, Point], str]()
        for job, result in compute(self._client, jobs):
            key = keys[job.bag_hash, job.setting.identity]
            self.computed += 1
            self.cpu += result.cpu
            if result.lost:
                lost[key] = result.failure
            elif result.series is not None:
                found[key] = result.series
            else:
                self._reasons[result.failure] = self._reasons.get(result.failure, 0) + 1
                found[key] = np.full_like(self._observations[key[0]].felt, np.nan)
        if lost and last:
            (bag_number, _), reason = next(iter(lost.items()))
            raise SessionError(
                f'{self._bags[bag_number].name} cannot be computed now: {reason}: mend that, and '
                'start again'
            )
        return found | self.compute(lost, meshes, last=True) if lost else found


def _observe(bag: StudyBag, options: IdentifyOptions) -> tuple[Observation, TissueSettings]:
    """Return the recorded force of a bag, and the tissue of its scene with the changes."""
    try:
        recording = read_recording(bag.place, bag.hash)
        refuse_lost_changes(recording.bag, options.changes)
        if options.refine and recording.beginning.tissue is not None:
            raise SessionError(
                '--refine needs the beginning of the session, where its mesh is whole'
            )
    except (BagError, SessionError) as error:
        raise BagError(f'{bag.name}: {error}') from None
    with tempfile.TemporaryDirectory(prefix='trainer-') as temporary:
        file = restore_scene(recording.bag, Path(temporary), options.changes)
        tissue = load_changed(file, options.changes).tissue
    felt = recording.felt
    return Observation((felt.times - felt.times[0]) * 1e-9, felt.vectors), tissue


def _digits(value: float) -> float:
    return float(f'{value:.4g}')


def _table(estimates: Mapping[str, Estimate]) -> Table:
    table = Table(box=box.SIMPLE_HEAD)
    for name in ('', 'value', '95 % interval', 'prior'):
        table.add_column(name, justify='right' if name else 'left')
    for name, e in estimates.items():
        interval = f'{e.low:.4g} to {e.high:.4g}'
        unit = PARAMETERS[name]
        prior = f'{e.prior.text} ({e.prior.source})'
        table.add_row(f'{name} ({unit})', f'{e.value:.4g}', interval, prior)
    return table
