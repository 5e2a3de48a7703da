"""Studies without their workers: files, settings, bags, journal, effects."""

import json
import os
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import meshio
import numpy as np
import pyarrow.parquet as pq
import pytest
from rich.console import Console

from cutting_trainer.bags.errors import BagError
from cutting_trainer.bags.reader import open_bag
from cutting_trainer.bags.recorded_tissue import tissue_at
from cutting_trainer.exercises.attempt_store import AttemptRow
from cutting_trainer.exercises.scene_schema import ExerciseSettings
from cutting_trainer.node_common.errors import SceneError
from cutting_trainer.session.attempts import open_store
from cutting_trainer.session.errors import SessionError
from cutting_trainer.session.scene_loader import Scene, load_scene
from cutting_trainer.studies import evaluation
from cutting_trainer.studies.accuracy_and_cost import tradeoff_figure, tradeoffs
from cutting_trainer.studies.bag_collection import StudyBag, find_attempts, find_bags, hash_of_bag
from cutting_trainer.studies.cluster import lost
from cutting_trainer.studies.description import Study, read_study
from cutting_trainer.studies.designs import RECORDED, Setting, settings_of
from cutting_trainer.studies.effects import effects_of_keys, effects_of_settings, interval
from cutting_trainer.studies.evaluation import Job, Result, read_recording
from cutting_trainer.studies.identity import identity_of_worker
from cutting_trainer.studies.journal import JOURNAL_FILE, Journal, key_of, open_journal
from cutting_trainer.studies.outputs import FIGURES, OUTPUTS
from cutting_trainer.studies.remote_bags import UnavailableError
from cutting_trainer.studies.study_command import Plan, bags_of
from cutting_trainer.studies.summary import as_text, summarise, write_page
from cutting_trainer.studies.table import Row, write_table

ROOT = Path(__file__).resolve().parents[1]
SAMPLES = ROOT / 'bags' / 'samples' / 'format_7'
GOOD = """\
bags: [bags]
settings:
  grid:
    tissue.material.toughness: [100, 200]
    cutting.method: [combined, delete]
  latin_hypercube:
    samples: 5
    ranges:
      tissue.material.toughness: {low: 50, high: 400, scale: log}
outputs: [largest_force]
"""
BAD_EDITS = [
    # what is wrong, text, its replacement, line, and what the sentence must say
    ('unknown section', 'outputs', 'output', 10, ['output', 'did you mean outputs?']),
    ('no bags', 'bags: [bags]\n', '', 1, ['the file', 'bags is missing']),
    ('empty bags', '[bags]', '[]', 1, ['bags', 'at least 1 item']),
    ('unknown design', 'latin_hypercube', 'latin_cube', 6, ['did you mean latin_hypercube?']),
    ('unknown output', 'largest_force', 'largest_forces', 10, ['did you mean largest_force?']),
    ('unknown scene section', 'cutting.method', 'cuting.method', 5, ['did you mean cutting?']),
    ('unknown scene key', 'cutting.method', 'cutting.metod', 5, ['did you mean method?']),
    ('no scene key', 'cutting.method', 'cutting', 5, ['give section and key']),
    ('key of a value', 'cutting.method', 'cutting.method.x', 5, ['x is not a key of a scene']),
    ('the hand', 'cutting.method', 'arm.script', 5, ['arm', 'recorded hands']),
    ('no values', '[100, 200]', '[]', 4, ['toughness', 'at least 1 item']),
    ('a value, not a list', '[100, 200]', '100', 4, ['toughness is 100', 'valid array']),
    ('range the wrong way', 'low: 50', 'low: 500', 9, ['high is 400', 'above low, 500']),
    ('logarithm of nothing', 'low: 50', 'low: 0', 9, ['scale log', 'above 0']),
    ('one sample', 'samples: 5', 'samples: 1', 7, ['samples', '1', 'number of settings']),
    ('samples of Sobol', 'latin_hypercube', 'sobol', 6, ['samples is 5', 'as 4 or 8']),
    (
        'value below its bound',
        '[100, 200]',
        '[100, -1]',
        4,
        ['-1', 'greater than or equal to 0', 'J/m^2'],
    ),
    ('word for a number', '[100, 200]', '[100, tough]', 4, ['tough', 'valid number']),
    ('unknown choice', '[combined, delete]', '[combined, delet]', 5, ['delet', "'delete'"]),
    (
        'range of whole numbers',
        'tissue.material.toughness: {low: 50',
        'tissue.integration.min_substeps: {low: 1',
        9,
        ['min_substeps', 'use a grid'],
    ),
    ('key in a list', 'cutting.method', 'tissue.regions.toughness', 5, ['give the whole list']),
    ('mesh that is none', '[100, 200]', '[100, 200]\n    tissue.mesh: [3]', 5, ['is no path']),
    (
        'reference that is none',
        'outputs:',
        'reference: {tissue.model: linaer}\noutputs:',
        10,
        ['reference.tissue.model', 'linaer', "'linear'"],
    ),
    ('end of a range', 'high: 400', 'high: 1e7', 9, ['high', '100000']),
    ('no YAML', 'bags: [bags]', 'bags: [bags', 2, ['not valid YAML']),
]


def designed(designs: dict[str, object]) -> Study:
    return Study.model_validate({'bags': ['bags'], 'settings': designs})


def study(tmp_path: Path, text: str) -> Study:
    file = tmp_path / 'study.yaml'
    file.write_text(text)
    return read_study(file)


@pytest.mark.parametrize(('text', 'instead', 'line', 'said'), [e[1:] for e in BAD_EDITS],
                         ids=[e[0] for e in BAD_EDITS])  # fmt: skip
def test_bad_study_file_gives_one_sentence_with_its_place(
    text: str, instead: str, line: int, said: list[str], tmp_path: Path
) -> None:
    assert text in GOOD
    with pytest.raises(SceneError) as caught:
        study(tmp_path, GOOD.replace(text, instead, 1))
    sentence = str(caught.value)
    assert '\n' not in sentence
    found = int(sentence.partition('study.yaml:')[2].partition(':')[0])
    assert found == line, sentence
    assert all(words in sentence for words in said), sentence


@pytest.mark.parametrize(
    'file', sorted((ROOT / 'config' / 'studies').glob('*.yaml')), ids=lambda file: file.stem
)
def test_a_shipped_study_has_settings(file: Path) -> None:
    assert len(settings_of(read_study(file), file.parent)) > 5


@pytest.mark.parametrize('designs', ['{}', '{grid: {}}', '{cases: []}'])
def test_study_file_without_a_design_names_the_designs(tmp_path: Path, designs: str) -> None:
    with pytest.raises(SceneError, match='there is no design: give grid, cases'):
        study(tmp_path, f'bags: [bags]\nsettings: {designs}\n')


def test_an_mcap_file_in_place_of_its_bag_is_named(tmp_path: Path) -> None:
    (tmp_path / 'bag').mkdir()
    (tmp_path / 'bag' / 'bag_0.mcap').touch()
    with pytest.raises(SessionError, match=r'a bag is the folder of its \.mcap file'):
        find_bags(['bag/bag_0.mcap'], tmp_path)


def test_settings_are_those_of_all_designs_each_once(tmp_path: Path) -> None:
    text = GOOD.replace('  latin', '  cases: [{tissue.model: linear}, {}, {}]\n  latin')
    settings = settings_of(study(tmp_path, text))
    assert [s.number for s in settings] == list(range(1, 12))
    first = {'tissue.material.toughness': 100, 'cutting.method': 'combined'}
    assert settings[0].changes == first
    assert settings[4].changes == {'tissue.model': 'linear'} and settings[5].changes == {}
    turned = dict(reversed(first.items()))
    assert Setting(7, turned).identity == settings[0].identity  # the order of keys is none


def test_settings_with_other_names_for_one_value_are_one_and_meshes_count_by_content(
    tmp_path: Path,
) -> None:
    assert Setting(1, {'a.b': 3}).identity == Setting(2, {'a.b': 3.0}).identity
    design = {'grid': {'tissue.mesh': ['fine.vtk']}}
    before, after = '', ''
    for text in ('one', 'another'):
        (tmp_path / 'fine.vtk').write_text(text)
        (setting,) = settings_of(designed(design), tmp_path)
        before, after = after, setting.identity
    assert setting.changes['tissue.mesh'] == str(tmp_path / 'fine.vtk')
    assert before != after
    (tmp_path / 'moved.vtk').write_text(text)
    design['grid']['tissue.mesh'] = ['moved.vtk']
    (setting,) = settings_of(designed(design), tmp_path)
    assert setting.identity == after


def test_keys_that_share_their_last_word_are_told_apart() -> None:
    settings = [
        Setting(1 + 2 * i + k, {'haptics.rate': x, 'tissue.rate': y, 'a.b': x * y})
        for i, x in enumerate((1, 2))
        for k, y in enumerate((3, 5))
    ]
    effects = effects_of_settings(
        made_rows(2, settings[::3], np.zeros((2, 3))), ['largest_force'], 0.95
    )
    assert effects[0].cause == 'haptics.rate=1, tissue.rate=3, b=3'
    alone = [Setting(1, {'haptics.rate': 60}), Setting(2, {'tissue.rate': 60})]
    effects = effects_of_settings(made_rows(2, alone, np.zeros((2, 3))), ['largest_force'], 0.95)
    assert [effect.cause for effect in effects] == ['haptics.rate=60', 'tissue.rate=60']
    rows = made_rows(3, settings, np.array([[0, 10, 12, 11, 13]] * 3))
    found, _ = effects_of_keys(rows, ['largest_force'], 0.95)
    assert {e.cause: e.mean for e in found if 'rate' in e.cause} == pytest.approx(
        {'haptics.rate 1 -> 2': 1.0, 'tissue.rate 3 -> 5': 2.0}
    )


def test_a_reference_counts_for_its_keys_where_the_designs_have_them(tmp_path: Path) -> None:
    values = [(3, {'a.b': 3}), (1, {'a.b': 1}), (2, {'a.b': 2})]
    text = GOOD.replace('outputs: [', 'reference: {}\noutputs: [force_rms_difference, ')
    asked = study(tmp_path, text)
    for of_reference, cause, mean in (({}, 'b 1 -> 3', 4.0), ({'a.c': 0}, 'b 1 -> 2', 3.0)):
        settings = [Setting(n, changes | (of_reference if n == 3 else {})) for n, changes in values]
        rows = [
            replace(row, result=replace(row.result, reference=settings[0].identity))
            for row in made_rows(2, settings, np.array([[0, 9, 5, 8]] * 2))
        ]
        (found,) = summarise(rows, asked, len(rows)).keys
        assert (found.output, found.cause, found.mean) == (
            'largest_force',
            cause,
            pytest.approx(mean),
        )


def test_one_key_has_an_effect_of_its_own() -> None:
    settings = [Setting(1, {'a.b': 1}), Setting(2, {'a.b': 2})]
    rows = made_rows(2, settings, np.array([[0, 5, 8]] * 2))
    found, _ = effects_of_keys(rows, ['largest_force'], 0.95)
    assert [(effect.cause, effect.mean) for effect in found] == [('b 1 -> 2', 3.0)]
    rows = made_rows(2, settings[:1], np.array([[0, 5]] * 2))
    assert effects_of_keys(rows, ['largest_force'], 0.95) == ([], '')


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


def test_an_output_that_some_bags_lack_has_the_effects_of_the_others() -> None:
    settings = [Setting(1, {'s.x': 1}), Setting(2, {'s.x': 2})]
    rows = made_rows(3, settings, np.array([[0.0, 1.0, 2.0]] * 3))
    for n, row in enumerate(rows[3:]):  # two of three bags are of an exercise
        row.result.outputs['exercise.score'] = 50.0 + 5.0 * (n % 3)
    found = effects_of_settings(rows, ['exercise.score', 'largest_force'], 0.95)
    assert [(e.mean, e.bags) for e in found] == [(5.0, 2), (1.0, 3), (10.0, 2), (2.0, 3)]
    keys, _ = effects_of_keys(rows, ['exercise.score', 'largest_force', 'exercise.order'], 0.95)
    assert [(e.output, e.bags) for e in keys] == [('exercise.score', 2), ('largest_force', 3)]
    assert [e.mean for e in keys] == pytest.approx([5.0, 1.0])


def test_hypercube_has_one_sample_in_each_part_of_a_range_and_sobol_too(tmp_path: Path) -> None:
    text = GOOD.replace('samples: 5', 'samples: 16\n    seed: 3')
    for design in ('latin_hypercube', 'sobol'):
        made = study(tmp_path, text.replace('latin_hypercube', design))
        values = [s.changes['tissue.material.toughness'] for s in settings_of(made)[4:]]
        shares = np.log(np.array(values, float) / 50) / np.log(400 / 50)
        assert sorted(np.floor(16 * shares)) == list(range(16))
        assert settings_of(made) == settings_of(made)


def test_bags_are_found_below_folders_and_by_globs_each_content_once(tmp_path: Path) -> None:
    shutil.copytree(SAMPLES / 'palpation', tmp_path / 'a' / 'b' / 'first')
    shutil.copytree(SAMPLES / 'palpation', tmp_path / 'a' / 'copy')
    shutil.copytree(SAMPLES / 'straight_cut', tmp_path / 'a' / 'c')
    (tmp_path / 'a' / 'c' / 'report.html').write_text('what is beside a bag is not of it')
    found = find_bags(['a', 'a/*'], tmp_path)
    assert [bag.name for bag in found] == ['a/b/first', 'a/c']
    assert found[1].hash == hash_of_bag(SAMPLES / 'straight_cut')
    for pattern, said in (('x*', 'no file matches'), ('aa', 'does not exist'), ('.git', 'exist')):
        with pytest.raises(SessionError, match=said):
            find_bags([pattern], tmp_path)
    for name, sample in (('cut[1]', 'palpation'), ('cut1', 'straight_cut')):
        shutil.copytree(SAMPLES / sample, tmp_path / name)
    (named,) = find_bags(['cut[1]'], tmp_path)  # a name, though it is a pattern, too
    assert named.name == 'cut[1]'
    (tmp_path / 'empty').mkdir()
    with pytest.raises(SessionError, match='there is no bag in it'):
        find_bags(['empty'], tmp_path)


def test_bags_at_a_url_are_copied_once_and_anew_when_they_change(
    tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path / 'cache'))
    there = tmp_path / 'there'
    for name in ('palpation', 'straight_cut'):
        shutil.copytree(SAMPLES / name, there / 'day 1' / name)
    shutil.copytree(SAMPLES / 'palpation', there / 'day 1' / 'straight_cut' / 'inner')
    (there / 'day 1' / 'palpation' / 'report.html').write_text('what is beside a bag is not of it')
    url = f'file://{there}'
    (there / 'day 1').rename(there / 'day [1]')
    found = find_bags([f'{url}/', f'{url}/*/pal*', f'{url}/day [1]'], tmp_path)
    assert [bag.name for bag in found] == [
        f'{url}/day [1]/palpation', f'{url}/day [1]/straight_cut'
    ]  # fmt: skip
    assert [bag.hash for bag in found] == [hash_of_bag(SAMPLES / n.path.name) for n in found]
    kept = [(bag.path, bag.path.stat().st_mtime_ns) for bag in found]
    assert all(path.is_relative_to(tmp_path / 'cache') for path, _ in kept)
    assert len(list(found[0].path.iterdir())) == 2
    again = find_bags([url], tmp_path)
    assert [(bag.path, bag.path.stat().st_mtime_ns) for bag in again] == kept
    first = read_recording(found[0].place, found[0].hash)
    assert first.bag.path.parent == found[0].path and first.felt.forces.max() > 0.0
    with (there / 'day [1]' / 'palpation' / 'metadata.yaml').open('a') as file:
        file.write('# changed\n')
    (found[1].path / 'metadata.yaml').unlink()  # somebody tidies up
    changed, same = find_bags([url], tmp_path)
    assert changed.hash == hash_of_bag(there / 'day [1]' / 'palpation') != found[0].hash
    assert changed.path != found[0].path and same == found[1]
    evaluation.read_recording.cache_clear()
    with pytest.raises(BagError, match='has changed'):
        read_recording(found[0].place, found[0].hash)


@pytest.mark.parametrize(
    ('place', 'said'),
    [
        ('file://{}/none', r'/none: there is no bag'),
        ('file://{}', r'there is no bag, no folder with metadata\.yaml'),
        ('file://{}/*.x', r'there is no bag'),
        ('file://bags', r'give the whole path of a folder'),
        ('file:///', r'give the whole path of a folder'),
        ('ssh://me:secret@trainer.lan/bags', r'leave the password out'),
        ('nope://a/b', r'nope://a/b cannot be reached: Protocol not known: nope'),
    ],
)
def test_a_url_without_bags_gives_one_sentence(place: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(SessionError, match=said):
        find_bags([place.format(tmp_path)], tmp_path)


def test_a_protocol_without_its_package_names_it(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, 'paramiko', None)
    with pytest.raises(UnavailableError, match=r'paramiko.*: add that package with `\./trainer'):
        find_bags(['ssh://trainer.lan/bags'], tmp_path)


def test_attempts_are_bags_by_exercise_and_subject(tmp_path: Path) -> None:
    rows = [('a [1]', 'Ann', 'circle', 'scored'), ('b', 'Bob', 'circle', 'scored'),
            ('c', 'Ann', 'pad', 'scored'), ('d', 'Ann', 'circle', 'broken off')]  # fmt: skip
    store = open_store(tmp_path)
    for number, (name, subject, exercise, state) in enumerate(rows):
        bag = Path(shutil.copytree(SAMPLES / 'palpation', tmp_path / name))
        with (bag / 'metadata.yaml').open('a') as file:
            file.write(f'# {name}\n')
        measures = {'time': 1.0}
        store.put([AttemptRow(str(bag), subject, exercise, 1, number, state, measures=measures)])

    def found(subject: str, exercise: str) -> list[str]:
        return [bag.name for bag in find_bags(find_attempts(tmp_path, subject, exercise)[0],
                                              tmp_path)]  # fmt: skip

    assert found('', '') == ['a [1]', 'b', 'c']
    assert found('Ann', '') == ['a [1]', 'c'] and found('Ann', 'circle') == ['a [1]']
    with pytest.raises(SessionError, match=r'of exercise circles: it has exercises circle, pad$'):
        find_attempts(tmp_path, '', 'circles')
    with pytest.raises(SessionError, match=r'exercise pad and subject Bob: .*; subjects Ann, Bob'):
        find_attempts(tmp_path, 'Bob', 'pad')
    with pytest.raises(SessionError, match=r'attempts: .* does not exist'):
        find_attempts(tmp_path / 'none', '', '')


def test_a_study_takes_bags_and_attempts_each_content_once(tmp_path: Path) -> None:
    for name in ('one', 'same'):
        shutil.copytree(SAMPLES / 'palpation', tmp_path / 'kept' / name)
    shutil.copytree(SAMPLES / 'straight_cut', tmp_path / 'cut')
    store = open_store(tmp_path / 'kept')
    bags = [str(tmp_path / 'kept' / 'same'), str(tmp_path / 'kept' / 'one')]
    store.put([AttemptRow(b, 'Ann', 'pad', 1, 0, 'scored', measures={'time': 1.0}) for b in bags])
    text = GOOD.replace('bags: [bags]', 'bags: [cut]\nattempts: {folder: kept, subject: Ann}')
    found = bags_of(study(tmp_path, text), tmp_path, Console(quiet=True))
    assert [bag.name for bag in found] == ['cut', 'kept/one']


def result(force: float, failure: str = '') -> Result:
    values = dict.fromkeys(FIGURES, 0.0) | {'largest_force': force}
    return Result({} if failure else values, failure, 0, identity_of_worker(), 1.0, 0.0, 1)


def test_rows_are_read_back_and_those_of_other_code_or_cut_off_are_not(tmp_path: Path) -> None:
    here, setting = identity_of_worker(), Setting(1, {'tissue.model': 'linear'})
    old = replace(result(1.0), identity=replace(here, kernels='other'))
    elsewhere = replace(result(2.0), identity=replace(here, cpu='another processor'))
    kept = result(0.1 + 0.2)
    with open_journal(tmp_path, here) as journal:
        journal.append(key_of('a', RECORDED), old)
        journal.append(key_of('b', RECORDED), elsewhere)
        journal.append(key_of('b', setting), kept)
        with (
            pytest.raises(SessionError, match='another study'),
            open_journal(tmp_path, here) as _,
        ):
            pass
    file = tmp_path / JOURNAL_FILE
    whole = file.read_bytes()
    file.write_bytes(whole + whole.splitlines()[0][:-9])
    with open_journal(tmp_path, here) as journal:
        assert journal.rows == {('b', ''): elsewhere, ('b', setting.identity): kept}
        assert journal.outdated == {('a', '')}
        journal.append(key_of('a', RECORDED), kept)
    whole = file.read_bytes()
    with open_journal(tmp_path, here) as journal:
        assert not journal.outdated  # a row has been computed again
    assert file.read_bytes() == whole
    with open_journal(tmp_path, here, 'of another reference') as journal:
        assert not journal.rows and len(journal.outdated) == 3
    file.write_text('{"key": 3}\n')
    with (
        pytest.raises(SessionError, match=r'rows\.jsonl:1 is not a row'),
        open_journal(tmp_path, here) as _,
    ):
        pass


def test_full_disk_gives_one_sentence() -> None:
    full = os.open('/dev/full', os.O_WRONLY)
    journal = Journal(Path('rows.jsonl'), {}, set(), full)
    with pytest.raises(SessionError, match=r'No space left on device\): make room'):
        journal.append(('a', ''), result(1.0))
    os.close(full)
    assert not journal.rows


def bags(count: int) -> list[StudyBag]:
    return [StudyBag(f'bag{i}', Path(f'bag{i}'), f'{i:016x}') for i in range(count)]


def test_table_has_a_type_for_each_key_and_the_same_bytes_each_time(tmp_path: Path) -> None:
    settings = [
        RECORDED,
        Setting(1, {'a.number': 1, 'a.word': 'x', 'a.list': [1]}),
        Setting(2, {'a.number': 0.5, 'a.word': True}),
    ]
    rows = [Row(bags(1)[0], s, result(float(s.number))) for s in settings]
    rows[2] = replace(rows[2], result=result(0.0, 'it diverged'))
    write_table(tmp_path / 'a.parquet', rows, ['largest_force'])
    write_table(tmp_path / 'b.parquet', rows, ['largest_force'])
    assert (tmp_path / 'a.parquet').read_bytes() == (tmp_path / 'b.parquet').read_bytes()
    read = pq.read_table(tmp_path / 'a.parquet').to_pydict()
    assert read['a.number'] == [None, 1.0, 0.5]
    assert read['a.word'] == [None, 'x', 'true'] and read['a.list'] == [None, '[1]', None]
    assert read['largest_force'] == [0.0, 1.0, None]
    assert read['failure'] == ['', '', 'it diverged']
    assert {'target', 'kernels', 'code', 'numpy', 'devices'} <= read.keys()
    assert 'cpu' not in read  # two models of one kind of processor compute the same bits
    write_table(tmp_path / 'none.parquet', [], ['largest_force'])  # before the first row


# Accuracy and cost.


def test_settings_on_the_front_have_no_rival_that_is_nearer_for_the_same_time(
    tmp_path: Path,
) -> None:
    # Error [N] and time [s] of each setting; the first one is the reference.
    given = [(0.0, 8.0), (0.4, 1.0), (0.5, 2.0), (0.1, 2.0), (0.1, 4.0), (0.2, 1.0)]
    settings = [Setting(n, {'s.x': n}) for n in range(1, 7)]
    rows = []
    for n, bag in enumerate(bags(3), start=1):  # each bag lasts longer, and has more force
        for setting, (error, time) in zip(settings, given, strict=True):
            values = {'force_rms_difference': error, 'mean_force_in_contact': 2.0 * n}
            made = result(0.0)
            made = replace(made, cpu=n * time, reference=settings[0].identity)
            rows.append(Row(bag, setting, replace(made, outputs=made.outputs | values)))
    rows[-1] = replace(rows[-1], result=replace(rows[-1].result, failure='it diverged'))
    found = tradeoffs(rows, 0.95)
    assert [one.setting for one in found] == ['x=6', 'x=2', 'x=4', 'x=3', 'x=5', 'x=1']
    assert [one.on_front for one in found] == [False, True, True, False, False, True]
    assert [one.ratio for one in found] == [0.125, 0.125, 0.25, 0.25, 0.5, 1.0]
    assert (found[1].error, found[1].time, found[1].bags) == (pytest.approx(0.4), 2.0, 3)
    assert found[1].share == pytest.approx(0.4 * (1 / 2 + 1 / 4 + 1 / 6) / 3)
    assert (found[0].bags, found[0].time) == (2, 1.5)  # it failed for one bag, and has no star
    summary = summarise(rows, study(tmp_path, GOOD), len(rows))
    write_page(tmp_path / 'page.html', 'models', summary)
    text = (tmp_path / 'page.html').read_text()
    assert 'Accuracy and cost' in text and 'x=4 *' in text and 'x=3 *' not in text
    gone = lost(Job('', '', RECORDED, identity_of_worker(), reference=settings[0]), 'it died')
    assert tradeoffs([Row(bag, RECORDED, gone), *rows], 0.95) == found
    assert gone.reference == settings[0].identity
    assert not tradeoffs([replace(r, result=replace(r.result, reference='')) for r in rows], 0.95)
    only_the_best = [row for row in rows if row.setting.number in (1, 2)]
    slow = [replace(r, result=replace(r.result, cpu=9.0 - r.setting.number)) for r in only_the_best]
    assert tradeoff_figure(tradeoffs(slow, 0.95)) is not None


# Effects, beside exact ones.


def made_rows(count: int, settings: list[Setting], forces: np.ndarray) -> list[Row]:
    """Rows of bags and settings, the recorded one first, with forces [N], shape (bags, n)."""
    return [
        Row(bag, setting, result(float(forces[i, k])))
        for i, bag in enumerate(bags(count))
        for k, setting in enumerate([RECORDED, *settings])
    ]


def test_effects_of_a_linear_output_are_its_coefficients_in_each_bag(tmp_path: Path) -> None:
    settings = [
        Setting(1 + 3 * i + k, {'s.x': x, 's.word': word})
        for i, x in enumerate((1.0, 2.0, 5.0))
        for k, word in enumerate(('a', 'b', 'c'))
    ]
    random = np.random.default_rng(5)
    level = random.normal(size=12)
    per_x, of_b, of_c = 0.3 + 0.1 * random.normal(size=(3, 12)) * [[1], [2], [0]]
    change = np.array([[per_x * s.changes['s.x'], of_b, of_c] for s in settings], dtype=object)
    columns = [level] + [
        level + c[0] + {'a': 0.0, 'b': c[1], 'c': c[2]}[s.changes['s.word']]
        for s, c in zip(settings, change, strict=True)
    ]
    rows = made_rows(12, settings, np.array(columns).T)
    found, why_not = effects_of_keys(rows, ['largest_force'], 0.95)
    by_cause = {effect.cause: effect for effect in found}
    assert not why_not and by_cause.keys() == {'x 1 -> 5', 'word a -> b', 'word a -> c'}
    assert by_cause['x 1 -> 5'].mean == pytest.approx(4 * per_x.mean())
    assert by_cause['word a -> b'].mean == pytest.approx(of_b.mean())
    steady = by_cause['word a -> c']
    assert (steady.mean, steady.low, steady.high) == pytest.approx((0.3, 0.3, 0.3))
    of_settings = effects_of_settings(rows, ['largest_force'], 0.95)
    assert of_settings[4].mean == pytest.approx((2 * per_x + of_b).mean())
    assert of_settings[4].low < of_settings[4].mean < of_settings[4].high
    assert of_settings[4].reference == pytest.approx(level.mean())

    summary = summarise(rows, study(tmp_path, GOOD), len(rows) + 1)
    assert f'{len(rows)} of {len(rows) + 1} rows' in summary.notes[0]
    assert as_text(summary).renderables
    write_page(tmp_path / 'page.html', '<study>', summary)
    text = (tmp_path / 'page.html').read_text()
    assert 'x=5, word=c' in text and '&lt;study&gt;' in text and text.count('<img') == 1


def test_failed_row_takes_its_bag_out_of_the_effect_of_its_setting_alone() -> None:
    settings = [Setting(1, {'s.x': 1}), Setting(2, {'s.x': 2})]
    forces = np.array([[0.0, 1.0, 2.0], [0.0, 3.0, 4.0], [0.0, 5.0, 6.0]])
    rows = made_rows(3, settings, forces)
    rows[4] = replace(rows[4], result=result(0.0, 'the haptic bridge comes to a FAULT'))
    first, second = effects_of_settings(rows, ['largest_force'], 0.9)
    assert (first.mean, first.bags) == (3.0, 2) and (second.mean, second.bags) == (4.0, 3)


def test_keys_that_change_together_have_no_effects_of_their_own() -> None:
    together = [Setting(1, {'s.x': 1, 's.y': 1}), Setting(2, {'s.x': 2, 's.y': 2})]
    forces = np.zeros((4, 3))
    assert effects_of_keys(made_rows(4, together, forces), ['largest_force'], 0.9) == (
        [],
        'the settings cannot tell the effects of their keys apart: add settings',
    )


def test_intervals_of_a_mean_cover_it_about_as_often_as_they_say() -> None:
    random = np.random.default_rng(1)
    covered = 0
    for _ in range(100):
        _, low, high = interval(random.exponential(size=30), 0.9)
        covered += low <= 1.0 <= high
    assert 78 <= covered <= 97  # 0.9 +- 3.5 standard deviations, less what skewness takes
    assert interval(np.array([2.0, 2.0]), 0.9) == (2.0, 2.0, 2.0)
    mean, low, high = interval(np.array([2.0]), 0.9)
    assert mean == 2.0 and np.isnan([low, high]).all()


def test_reading_rows_needs_no_library_of_ours(tmp_path: Path) -> None:
    with open_journal(tmp_path, identity_of_worker()) as journal:
        journal.append(('a', ''), result(1.5))
    (line,) = (tmp_path / JOURNAL_FILE).read_text().splitlines()
    read = json.loads(line)
    assert read['key'] == ['a', ''] and read['outputs']['largest_force'] == 1.5
