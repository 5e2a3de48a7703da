"""Claims about the index of attempts: filters, curves, missing bags, deletion, export."""

import json
import math
import os
import shutil
import sqlite3
from contextlib import closing
from dataclasses import replace
from html import escape
from pathlib import Path

import pyarrow.parquet as pq
import pytest
import yaml
from rich.console import Console

from cutting_trainer.bags.metadata import METADATA_FILE
from cutting_trainer.bags.writer import BagWriter
from cutting_trainer.cli.main import main
from cutting_trainer.exercises.attempt_store import (
    AttemptRow,
    AttemptStore,
    attempt_number,
    learning_curves,
    new_pseudonym,
)
from cutting_trainer.node_common.share_folder import PACKAGES
from cutting_trainer.recordings.attempts_command import (
    chosen,
    comparison_table,
    delete,
    export_rows,
    find,
    index_bags,
)
from cutting_trainer.session.attempts import STORE_FILE, attempt_data, next_attempt, open_store
from cutting_trainer.session.errors import SessionError

SAMPLE = PACKAGES / 'bags' / 'samples' / 'format_7' / 'straight_cut'


def row(bag, subject='a', points=50.0, number=1, exercise='circle') -> AttemptRow:
    return AttemptRow(
        str(bag), subject, exercise, number, float(number), 'scored', points, points >= 70,
        'Ä note', ('time: too long',), {'time': 12.5},
    )  # fmt: skip


def test_rows_come_back_as_they_were_put_and_are_filtered(tmp_path) -> None:
    store = AttemptStore(tmp_path / 'deep' / 'index.sqlite')
    rows = [row('/x/1'), row('/x/2', 'b', number=2), row('/x/3', 'a', number=3, exercise='pad')]
    store.put(rows)
    assert store.rows() == rows
    assert store.rows('a') == [rows[0], rows[2]]
    assert store.rows('a', 'pad') == [rows[2]]
    assert store.next_attempt('a', 'circle') == 2
    assert store.next_attempt('c', 'circle') == 1


def test_a_bag_that_was_deleted_by_hand_is_noticed(tmp_path) -> None:
    store = open_store(tmp_path)
    kept, gone = tmp_path / 'kept', tmp_path / 'gone'
    kept.mkdir()
    store.put([row(kept), row(gone)])
    index_bags(store, tmp_path)
    assert {r.bag: r.state for r in store.rows()} == {
        str(kept): 'scored',
        str(gone): 'bag is gone',
    }


def test_a_deleted_subject_leaves_no_row_no_bag_and_no_byte(tmp_path) -> None:
    store = open_store(tmp_path)
    mine, others = tmp_path / 'mine', tmp_path / 'others'
    outside = tmp_path.parent / f'{tmp_path.name}-outside'
    for folder in (mine, others, outside):
        folder.mkdir()
    store.put([row(mine, 'subject-of-mine'), row(outside, 'subject-of-mine'), row(others, 'b')])
    assert delete(store, tmp_path, 'subject-of-mine') == [str(mine)]
    assert not mine.exists() and others.exists() and outside.exists()
    assert [r.subject for r in store.rows()] == ['b']
    assert b'subject-of-mine' not in (tmp_path / STORE_FILE).read_bytes()
    with pytest.raises(SessionError, match='no attempt of'):
        delete(store, tmp_path, 'subject-of-mine')


def test_an_attempt_that_is_being_recorded_is_not_deleted(tmp_path) -> None:
    bag, file = tmp_path / 'now', tmp_path / 'now' / 'straight_cut_0.mcap'
    shutil.copytree(SAMPLE, bag)
    file.write_bytes(file.read_bytes()[:-2000])  # no end yet
    store = open_store(tmp_path)
    store.put([row(bag, 'subject-of-mine')])
    with pytest.raises(SessionError, match='now is being recorded: end that session first'):
        delete(store, tmp_path, 'subject-of-mine')
    assert bag.exists() and store.rows()
    for each in bag.iterdir():
        os.utime(each, (1e9, 1e9))  # its recorder was killed long ago
    assert delete(store, tmp_path, 'subject-of-mine') == [str(bag)]


def test_a_subject_with_a_linked_bag_is_deleted_in_whole_or_not_at_all(tmp_path) -> None:
    folder, outside = tmp_path / 'bags', tmp_path / 'outside'
    for each in (folder / 'mine', outside):
        each.mkdir(parents=True)
    (folder / 'linked').symlink_to(outside)
    store = open_store(folder)
    store.put([row(folder / 'mine', 'p'), row(folder / 'linked', 'p', number=2)])
    with pytest.raises(SessionError, match=r'linked is a link to .*outside: nothing is deleted'):
        delete(store, folder, 'p')
    assert (folder / 'mine').exists() and len(store.rows('p')) == 2


@pytest.mark.parametrize(('text', 'number'), [('', 0), ('x', 0), ('12', 12), ('1000000000', 10**9)])
def test_a_bag_names_the_number_of_its_attempt_or_none(text, number) -> None:
    assert attempt_number(text) == number
    with pytest.raises(ValueError, match='above 1000000000'):
        attempt_number('9' * 20)


def test_a_curve_is_the_mean_of_the_last_five_and_knows_when_it_stays_above() -> None:
    points = [40, 50, 90, 60, 80, 90, 90, 90]
    rows = [row(f'/x/{i}', points=p, number=i + 1) for i, p in enumerate(points)]
    rows.append(row('/x/none', points=math.nan, number=9))
    (curve,) = learning_curves(rows, 70.0)
    assert curve.average[:5] == pytest.approx([40, 45, 60, 60, 64])
    assert curve.average[-1] == pytest.approx((60 + 80 + 90 + 90 + 90) / 5)
    assert curve.first_pass == 6
    assert learning_curves(rows[:2], 70.0)[0].first_pass is None
    failed = replace(row('/x/10', points=90, number=1), passed=False)  # a required one is missed
    assert learning_curves([failed], 70.0)[0].first_pass is None
    assert learning_curves([failed, rows[7]], 70.0)[0].first_pass == 8


def test_exports_have_a_row_for_each_attempt(tmp_path) -> None:
    rows = [row('/x/1'), row('/x/2', points=math.nan)]
    export_rows(rows, tmp_path / 'a.csv')
    lines = (tmp_path / 'a.csv').read_text(encoding='utf-8').splitlines()
    assert len(lines) == 3 and lines[0].startswith('bag,subject,exercise')
    export_rows(rows, tmp_path / 'a.parquet')
    table = pq.read_table(tmp_path / 'a.parquet').to_pydict()
    assert table['points'] == [50.0, None] and table['time'] == [12.5, 12.5]
    with pytest.raises(SessionError, match='csv or'):
        export_rows(rows, tmp_path / 'a.xls')


def test_a_file_that_is_no_index_is_named(tmp_path) -> None:
    (tmp_path / STORE_FILE).write_bytes(b'no index at all' * 100)
    with pytest.raises(SessionError, match='is no index'):
        open_store(tmp_path)


def test_a_damaged_index_and_one_with_other_columns_are_named(tmp_path) -> None:
    file = tmp_path / STORE_FILE
    with closing(sqlite3.connect(file)) as other, other:
        other.execute('CREATE TABLE attempts (subject TEXT, exercise TEXT, begun REAL)')
    with pytest.raises(SessionError, match='is no index'):
        open_store(tmp_path)
    file.unlink()
    open_store(tmp_path).put(row(f'/x/{number}', number=number) for number in range(100))
    content = bytearray(file.read_bytes())
    content[8192:] = b'\xaa' * (len(content) - 8192)
    file.write_bytes(content)
    with pytest.raises(SessionError, match='is no index'):
        open_store(tmp_path)


def test_nobody_is_told_to_delete_an_index_that_is_in_use_or_a_folder(tmp_path) -> None:
    file = tmp_path / STORE_FILE
    with closing(sqlite3.connect(file, isolation_level=None)) as other:
        other.execute('BEGIN EXCLUSIVE')
        with pytest.raises(SessionError, match='in use by another program'):
            open_store(tmp_path)
    file.unlink(missing_ok=True)
    file.mkdir()
    with pytest.raises(SessionError, match='cannot be opened'):
        open_store(tmp_path)


def test_a_comparison_names_the_exercises_and_shows_no_nan() -> None:
    console = Console(width=100)
    with console.capture() as captured:
        console.print(comparison_table(row('/x/1'), row('/x/2', points=math.nan, exercise='pad')))
    text = captured.get()
    assert 'circle' in text and 'pad' in text and 'nan' not in text


def test_attempts_count_on_over_index_and_bags_that_are_not_in_it_yet(tmp_path) -> None:
    assert attempt_data(tmp_path, 'circle', '', 'n')['attempt'] == '1'
    store = open_store(tmp_path)
    store.put([row(tmp_path / 'indexed', number=2), row(tmp_path / 'other', 'b', number=7)])
    for name, subject, scene in [('1', 'a', 'circle'), ('2', 'a', 'pad'), ('3', 'b', 'circle')]:
        data = {'subject': subject, 'attempt': '3', 'scene_file': f'{scene}.yaml'}
        BagWriter(tmp_path / name, custom_data=data).close()
    (tmp_path / 'damaged').mkdir()
    (tmp_path / 'damaged' / 'metadata.yaml').write_text('no bag')
    numbers = [next_attempt(tmp_path, who, what) for who, what in
               [('a', 'circle'), ('a', 'pad'), ('b', 'circle'), ('c', 'circle')]]  # fmt: skip
    assert numbers == [4, 4, 8, 1]


def test_an_attempt_is_found_by_the_name_of_its_bag() -> None:
    assert find([row('/x/1'), row('/x/2')], '2').bag == '/x/2'
    with pytest.raises(SessionError, match='no attempt'):
        find([row('/x/1')], '3')


def test_pseudonyms_differ() -> None:
    assert len({new_pseudonym() for _ in range(100)}) > 95


EXERCISE = """
exercise:
  title: A line
  targets: [{name: line, points: [[-0.02, 0, 0.01], [0.02, 0, 0.01]], depth: [0.001, 0.02]}]
  criteria: [{measure: time, good: 1, bad: 1000}]
"""


def exercised(folder: Path, number: int) -> Path:
    """A recorded cut, as if its scene were an exercise."""
    shutil.copytree(SAMPLE, folder)
    file = folder / METADATA_FILE
    content = yaml.safe_load(file.read_text(encoding='utf-8'))
    data = content['rosbag2_bagfile_information']['custom_data']
    data['scene'] += EXERCISE
    data.update(subject='SUBJECT', attempt=str(number))
    file.write_text(yaml.safe_dump(content), encoding='utf-8')
    return folder


def test_the_report_has_the_points_of_the_list_and_their_reasons(tmp_path) -> None:
    bag = exercised(tmp_path / 'one', 1)
    index_bags(store := open_store(tmp_path), tmp_path)
    (attempt,) = store.rows()
    with pytest.raises(SystemExit) as ended:
        main(['report', str(bag), '-o', str(tmp_path / 'report.html')])
    assert not ended.value.code
    page = (tmp_path / 'report.html').read_text(encoding='utf-8')
    assert f'with {attempt.points:.1f} points' in page
    assert attempt.reasons and all(escape(reason) in page for reason in attempt.reasons)


def test_the_command_lists_compares_exports_and_deletes(tmp_path, capsys) -> None:
    one, two = exercised(tmp_path / 'one', 1), exercised(tmp_path / 'two', 2)

    def attempts(*options: str) -> str:
        with pytest.raises(SystemExit) as ended:
            main(['attempts', str(tmp_path), *options])
        assert not ended.value.code
        return capsys.readouterr().out

    listed = json.loads(attempts('--json'))
    assert [row['attempt'] for row in listed] == [1, 2]
    assert [row['state'] for row in listed] == ['scored', 'scored']
    assert 90 < listed[0]['points'] < 100
    assert 'SUBJECT' in attempts()
    assert 'peak force' in attempts('--compare', 'one', 'two')
    assert json.loads(attempts('--curves', '--json'))[0]['attempts'] == [1, 2]
    attempts('-o', str(tmp_path / 'attempts.csv'))
    assert len((tmp_path / 'attempts.csv').read_text(encoding='utf-8').splitlines()) == 3
    assert json.loads(attempts('--delete', 'SUBJECT', '--json'))['deleted'] == [str(one), str(two)]
    assert not one.exists() and not two.exists() and json.loads(attempts('--json')) == []


def test_an_attempt_is_found_by_name_and_by_any_path_and_a_wrong_exercise_is_named(
    tmp_path, monkeypatch
) -> None:
    store = open_store(tmp_path)
    one = row(tmp_path / 'sessions' / 'one')
    store.put([one])
    monkeypatch.chdir(tmp_path)
    for given in ('one', 'sessions/one', './sessions/one/', str(tmp_path / 'sessions' / 'one')):
        assert find([one], given) == one
    assert chosen(store, 'a', 'circle') == [one]
    with pytest.raises(SessionError, match="no attempt of 'circel': it has the exercises circle"):
        chosen(store, '', 'circel')
    assert chosen(open_store(tmp_path / 'empty'), '', 'circel') == []
