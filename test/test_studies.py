"""Studies without their workers: files, settings, journal, table."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from study_world import GOOD, bags, designed, result, study

from cutting_trainer.node_common.errors import SceneError
from cutting_trainer.session.errors import SessionError
from cutting_trainer.studies.description import read_study
from cutting_trainer.studies.designs import RECORDED, Setting, settings_of
from cutting_trainer.studies.identity import identity_of_worker
from cutting_trainer.studies.journal import JOURNAL_FILE, Journal, key_of, open_journal
from cutting_trainer.studies.table import Row, write_table

ROOT = Path(__file__).resolve().parents[1]

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


def test_hypercube_has_one_sample_in_each_part_of_a_range_and_sobol_too(tmp_path: Path) -> None:
    text = GOOD.replace('samples: 5', 'samples: 16\n    seed: 3')
    for design in ('latin_hypercube', 'sobol'):
        made = study(tmp_path, text.replace('latin_hypercube', design))
        values = [s.changes['tissue.material.toughness'] for s in settings_of(made)[4:]]
        shares = np.log(np.array(values, float) / 50) / np.log(400 / 50)
        assert sorted(np.floor(16 * shares)) == list(range(16))
        assert settings_of(made) == settings_of(made)


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


def test_reading_rows_needs_no_library_of_ours(tmp_path: Path) -> None:
    with open_journal(tmp_path, identity_of_worker()) as journal:
        journal.append(('a', ''), result(1.5))
    (line,) = (tmp_path / JOURNAL_FILE).read_text().splitlines()
    read = json.loads(line)
    assert read['key'] == ['a', ''] and read['outputs']['largest_force'] == 1.5
