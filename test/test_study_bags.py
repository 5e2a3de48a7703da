"""Bags of studies: folders, globs, URLs, attempts."""

import shutil
import sys
from pathlib import Path

import pytest
from rich.console import Console
from study_world import GOOD, SAMPLES, study

from cutting_trainer.bags.errors import BagError
from cutting_trainer.exercises.attempt_store import AttemptRow
from cutting_trainer.session.attempts import open_store
from cutting_trainer.session.errors import SessionError
from cutting_trainer.studies import evaluation
from cutting_trainer.studies.bag_collection import find_attempts, find_bags, hash_of_bag
from cutting_trainer.studies.evaluation import read_recording
from cutting_trainer.studies.remote_bags import UnavailableError, without_copies
from cutting_trainer.studies.study_command import bags_of


def test_an_mcap_file_in_place_of_its_bag_is_named(tmp_path: Path) -> None:
    (tmp_path / 'bag').mkdir()
    (tmp_path / 'bag' / 'bag_0.mcap').touch()
    with pytest.raises(SessionError, match=r'a bag is the folder of its \.mcap file'):
        find_bags(['bag/bag_0.mcap'], tmp_path)


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
    said = without_copies(f"no message in '{found[0].path}/palpation_0.mcap'")
    assert said == "no message in 'palpation/palpation_0.mcap'"
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
