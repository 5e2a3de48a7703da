"""Data sets for learning: the files of LeRobot's format, and their agreement with the bags."""

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from bag_copies import copies_by_subjects

from bench.files.lerobot_loader import differences, figures_of
from cutting_trainer.bags.errors import BagError
from cutting_trainer.session.errors import SessionError
from cutting_trainer.studies.bag_collection import StudyBag, find_bags
from cutting_trainer.studies.dataset import EPISODES_FILE, INFO_FILE, write_dataset
from cutting_trainer.studies.evaluation import read_recording

SAMPLES = Path(__file__).resolve().parents[1] / 'bags' / 'samples' / 'format_7'


def test_data_set_has_the_files_of_its_format_and_the_figures_of_its_bags(tmp_path: Path) -> None:
    bags = find_bags(['palpation', 'straight_cut'], SAMPLES)
    write_dataset(bags, tmp_path / 'set', 'CC-BY-4.0')
    info = json.loads((tmp_path / 'set' / INFO_FILE).read_text())
    assert (info['codebase_version'], info['fps'], info['license']) == ('v3.0', 100, 'CC-BY-4.0')
    episodes = pq.read_table(tmp_path / 'set' / 'meta/episodes/chunk-000/file-000.parquet')
    ends = episodes.column('dataset_to_index').to_pylist()
    assert episodes.column('dataset_from_index').to_pylist() == [0, ends[0]]
    assert info['total_frames'] == ends[1] and info['total_episodes'] == 2
    tasks = pq.read_table(tmp_path / 'set' / 'meta/tasks.parquet')
    assert tasks.column('__index_level_0__').to_pylist() == ['palpation', 'straight_cut']
    for number, bag in enumerate(bags):
        place = info['data_path'].format(chunk_index=0, file_index=number)
        data = pq.read_table(tmp_path / 'set' / place)
        features = {name: of['shape'] for name, of in info['features'].items()}
        assert set(features) == set(data.column_names)
        forces = np.array(data.column('observation.force').to_pylist())
        felt = read_recording(str(bag.path), bag.hash).felt
        assert np.linalg.norm(forces, axis=1).max() == pytest.approx(felt.forces.max(), rel=1e-9)
        steps = np.diff(data.column('timestamp').to_numpy())
        assert steps == pytest.approx(0.01, abs=1e-5)
    about = json.loads((tmp_path / 'set' / EPISODES_FILE).read_text())
    assert [of['bag_hash'] for of in about] == [bag.hash for bag in bags]
    with pytest.raises(SessionError, match='exists already'):
        write_dataset(bags, tmp_path / 'set', '')
    assert [path.name for path in tmp_path.iterdir()] == ['set']


def test_an_export_that_fails_leaves_nothing(tmp_path: Path) -> None:
    bags = find_bags(['palpation'], SAMPLES)
    broken = StudyBag('broken', tmp_path / 'broken', '')
    with pytest.raises(BagError, match='broken'):
        write_dataset([*bags, broken], tmp_path / 'set', '')
    assert not list(tmp_path.iterdir())


def test_subjects_are_numbered_and_their_names_stay_out(tmp_path: Path) -> None:
    copies_by_subjects(SAMPLES / 'palpation', tmp_path / 'bags', 'Ann Doe', 'Bob', 'Ann Doe')
    write_dataset(find_bags(['bags'], tmp_path), tmp_path / 'set', '')
    about = json.loads((tmp_path / 'set' / EPISODES_FILE).read_text())
    assert [of['subject'] for of in about] == ['subject-1', 'subject-2', 'subject-1']
    assert not any(b'Ann' in p.read_bytes() for p in (tmp_path / 'set').rglob('*') if p.is_file())


def test_figures_of_a_loader_that_differ_from_a_bag_are_named() -> None:
    bags = find_bags(['palpation'], SAMPLES) * 3
    right = {**figures_of(bags[0]), 'wrong': 0.0}
    heavier = {**right, 'largest_force': 1.001 * right['largest_force']}
    assert differences(bags[:1], {'0': right}) == []
    missing, force, order = differences(bags, {'1': heavier, '2': {**right, 'wrong': 4.0}})
    assert (
        missing == 'episode 0 is missing' and order == 'episode 2: 4 frames have other neighbours'
    )
    assert force.startswith('episode 1: largest_force 0.0')
