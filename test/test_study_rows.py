"""Rows of studies: forces beside a reference, scores, kept files."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import meshio
import numpy as np
import pyarrow.parquet as pq
import pytest
from study_world import GOOD, SAMPLES, study

from cutting_trainer.bags.reader import open_bag
from cutting_trainer.bags.recorded_tissue import tissue_at
from cutting_trainer.exercises.scene_schema import ExerciseSettings
from cutting_trainer.session.scene_loader import Scene, load_scene
from cutting_trainer.studies import evaluation
from cutting_trainer.studies.bag_collection import find_bags, hash_of_bag
from cutting_trainer.studies.designs import RECORDED, Setting
from cutting_trainer.studies.evaluation import Job, read_recording
from cutting_trainer.studies.identity import identity_of_worker
from cutting_trainer.studies.journal import JOURNAL_FILE, open_journal
from cutting_trainer.studies.outputs import OUTPUTS
from cutting_trainer.studies.study_command import Plan


def test_a_bag_out_of_reach_is_no_row(monkeypatch) -> None:
    monkeypatch.setattr(evaluation, 'warm_up', lambda: None)
    job = Job('/nowhere', '0', RECORDED, identity_of_worker())
    (bag,) = find_bags(['palpation'], SAMPLES)
    gone = evaluation.evaluate(job)
    assert gone.lost and gone.failure.startswith('/nowhere is not there on this worker')
    mesh = replace(
        job,
        setting=Setting(1, {'tissue.mesh': '/nowhere/fine.vtk'}),
        bag=str(bag.path),
        bag_hash=bag.hash,
    )
    gone = evaluation.evaluate(mesh)
    assert gone.lost and gone.failure.startswith('/nowhere/fine.vtk is not there')
    monkeypatch.setattr(evaluation, 'read_recording', lambda *_: [][1])
    assert not evaluation.evaluate(job).lost


def test_a_row_is_compared_with_the_force_under_the_reference(monkeypatch) -> None:
    monkeypatch.setattr(evaluation, 'warm_up', lambda: None)
    (bag,) = find_bags(['palpation'], SAMPLES)
    best, cheap = (Setting(n, {'tissue.model': m}) for n, m in ((1, 'stiffening'), (2, 'linear')))
    asked = Job(str(bag.path), bag.hash, cheap, identity_of_worker(), series=True, reference=best)
    one, itself, recorded = (
        evaluation.evaluate(replace(asked, setting=s)) for s in (cheap, best, RECORDED)
    )
    assert not (one.failure or itself.failure or recorded.failure)
    felt, wanted = (np.linalg.norm(of.series, axis=1) for of in (one, itself))
    rms = np.sqrt(np.mean((felt - wanted) ** 2))
    assert rms > 1e-3 and one.outputs['force_rms_difference'] == pytest.approx(rms, rel=1e-12)
    assert itself.outputs['force_rms_difference'] == 0.0 and itself.reference == best.identity
    assert recorded.outputs['force_rms_difference'] > 1e-3
    alone = evaluation.evaluate(replace(asked, reference=RECORDED))
    assert alone.outputs['force_rms_difference'] < rms / 2  # it was recorded by the linear model
    never = Setting(1, {'tissue.material.youngs_modulus': -1})
    failed = evaluation.evaluate(replace(asked, reference=never))
    assert failed.failure.startswith('the reference: ') and 'youngs_modulus' in failed.failure
    monkeypatch.setattr(evaluation, '_compute', lambda *_: [][1])
    again = evaluation.evaluate(replace(asked, reference=never))
    assert again.failure == failed.failure and not again.lost  # it is not computed again


def test_a_reference_whose_mesh_has_changed_is_computed_anew(monkeypatch, tmp_path: Path) -> None:
    forces = iter((1.0, 2.0))
    monkeypatch.setattr(
        evaluation,
        '_compute',
        lambda *_, **__: SimpleNamespace(run=SimpleNamespace(forces=np.full(3, next(forces)))),
    )
    mesh = tmp_path / 'fine.vtk'
    for text, force in (('coarse', 1.0), ('fine', 2.0), ('fine', 2.0)):
        mesh.write_text(text)
        job = Job('bag', 'hash', RECORDED, identity_of_worker(),
                  reference=Setting(1, {'tissue.mesh': str(mesh)}))  # fmt: skip
        found, why_not = evaluation._reference_forces(job)
        assert not why_not and found is not None and found[0] == force


def test_a_row_has_the_score_of_its_exercise(monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setattr(evaluation, 'warm_up', lambda: None)
    exercise = {
        'title': 'cut along x',
        'targets': [{'name': 'line', 'points': [[-0.012, 0.003, 0.01], [0.01, 0.003, 0.01]],
                     'depth': [0.001, 0.006]}],
        'criteria': [{'measure': 'coverage', 'good': 1.0, 'bad': 0.0}],
    }  # fmt: skip
    bag = tmp_path / 'exercise'
    shutil.copytree(SAMPLES / 'straight_cut', bag)
    monkeypatch.setattr(evaluation, 'load_scene', with_exercise(exercise))
    again, recorded, tough = (
        evaluation.evaluate(Job(str(bag), hash_of_bag(bag), setting, identity_of_worker()))
        for setting in (
            Setting(1, {}),
            RECORDED,
            Setting(2, {'tissue.material.toughness': 1e4, 'tissue.cut_threshold': 90.0}),
        )
    )
    kept = {n: v for n, v in again.outputs.items() if n.startswith('exercise.')}
    assert kept.keys() <= OUTPUTS.keys() and kept['exercise.score'] > 80.0
    assert kept['exercise.score'] == pytest.approx(100 * kept['exercise.coverage'])
    for name, value in kept.items():  # the whole loop computed again is the session as recorded
        assert value == pytest.approx(recorded.outputs[name], rel=5e-3, abs=1e-6), name
    assert tough.outputs['exercise.score'] == 0.0 == tough.outputs['exercise.coverage']
    assert tough.outputs['exercise.path_length'] == pytest.approx(kept['exercise.path_length'])


def with_exercise(exercise: dict[str, object]) -> Callable[[str], Scene]:
    def load(path: str) -> Scene:
        return replace(load_scene(path), exercise=ExerciseSettings.model_validate(exercise))

    return load


def test_a_row_keeps_its_force_and_its_tissue(monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setattr(evaluation, 'warm_up', lambda: None)
    (bag,) = find_bags(['straight_cut'], SAMPLES)
    asked = study(tmp_path, GOOD.replace('outputs:', 'keep: [force, tissue]\noutputs:'))
    with open_journal(tmp_path, identity_of_worker()) as journal:
        plan = Plan(asked, [bag], [RECORDED], RECORDED, journal, tmp_path, {})
        (job,) = plan.jobs()
        row = evaluation.evaluate(job)
        plan.take(job, row)
        assert not plan.jobs()
        name = tmp_path / 'kept' / f'{bag.hash}_recorded_'
        force = pq.read_table(f'{name}force.parquet').to_pydict()
        felt = read_recording(bag.place, bag.hash).felt
        columns = [force[f'force_{axis}'] for axis in 'xyz']
        assert np.array_equal(np.array(columns).T, felt.vectors)
        assert np.diff(force['time']) == pytest.approx(0.01, abs=5e-3)
        tissue = meshio.read(f'{name}tissue.vtu')
        assert len(tissue.cells_dict['tetra']) == row.outputs['tetrahedra']
        recorded = tissue_at(open_bag(bag.path))
        assert tissue.points == pytest.approx(recorded.positions(), abs=1e-6)
        assert not any(result.files for result in journal.rows.values())
        Path(f'{name}tissue.vtu').write_bytes(b'of other code')
        assert [again.setting for again in plan.jobs()] == [RECORDED]
        assert 'force.parquet' not in (tmp_path / JOURNAL_FILE).read_text()
