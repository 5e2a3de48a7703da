"""Sessions as arrays: a foreign reader opens the file and finds the figures of the bags."""

import json
import re
import shutil
import subprocess
import sys
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from bag_copies import copies_by_subjects

from cutting_trainer.bags.playback_messages import first_time
from cutting_trainer.bags.reader import Bag, Recorded, open_bag
from cutting_trainer.bags.recorded_tissue import tissue_at, tissue_messages
from cutting_trainer.bags.topic_names import SERVO_CF
from cutting_trainer.exercises.opened_tissue import cut_faces
from cutting_trainer.node_common.cdr_codec import ContactCodec, ForceSampleCodec
from cutting_trainer.recordings.export_command import STREAMS
from cutting_trainer.recordings.html_report import incision_area
from cutting_trainer.session.bag_measurements import read_evidence
from cutting_trainer.session.errors import SessionError
from cutting_trainer.studies.bag_collection import find_bags
from cutting_trainer.studies.growing_arrays import GrowingArray, RaggedArray, check_arrays
from cutting_trainer.studies.session_arrays import UNITS, write_sessions

ROOT = Path(__file__).resolve().parents[1]
STUDIES = ROOT / 'docs' / 'studies.md'
SAMPLES = ROOT / 'bags' / 'samples' / 'format_7'
FOREIGN_READER = ROOT / 'bench' / 'files' / 'hdf5_reader.py'


def volume(tissue) -> float:
    corners = tissue.positions()[tissue.tetrahedra]
    return np.linalg.det(corners[:, 1:] - corners[:, :1]).sum() / 6


def test_a_foreign_reader_rebuilds_each_frame_and_finds_the_figures_of_the_bags(
    tmp_path: Path,
) -> None:
    bags = find_bags(['.'], SAMPLES)
    assert write_sessions(bags, tmp_path / 'set.h5', 'CC-BY-4.0') == [tmp_path / 'set.h5']
    assert [path.name for path in tmp_path.iterdir()] == ['set.h5']
    command = [sys.executable, '-I', str(FOREIGN_READER), str(tmp_path / 'set.h5')]
    read = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)
    assert list(read) == [bag.hash for bag in bags] and len(bags) == 3
    for bag in bags:
        found, opened = read[bag.hash], open_bag(bag.path)
        evidence = read_evidence(bag.path)
        assert found['largest_force'] == evidence.forces[:, 1].max() > 0.05
        assert found['force_samples'] == len(evidence.forces)
        assert found['cut_area'] == pytest.approx(incision_area(opened), rel=1e-12)
        messages = {(m.log_time - first_time(opened)) * 1e-9 for m in tissue_messages(opened)}
        frames = found['states']
        assert {time for time, *_ in frames} <= messages and len(frames) > 70
        for time, its_volume, its_area in [*frames[::20], frames[-1]]:
            tissue = tissue_at(opened, time + 1e-6)
            assert its_volume == pytest.approx(volume(tissue), rel=1e-12)
            assert its_area == pytest.approx(cut_faces(tissue).areas.sum(), rel=1e-9)
        assert (frames[-1][2] > 1e-5) == (bag.path.name != 'palpation')


def test_the_program_of_the_documentation_builds_a_state_of_a_session(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (bag,) = find_bags(['crossing_cuts'], SAMPLES)
    write_sessions([bag], tmp_path / 'study.h5', '')
    monkeypatch.chdir(tmp_path)
    (program,) = re.findall(r'```python\n(import h5py.*?)```', STUDIES.read_text(), re.DOTALL)
    names: dict[str, Any] = {}
    exec(program, names)
    with h5py.File(tmp_path / 'study.h5') as file:
        time = float(file['sessions/0000/tissue/time'][names['state']])
    tissue = tissue_at(open_bag(bag.path), time + 1e-6)
    assert np.array_equal(names['places'], tissue.positions())
    assert np.array_equal(names['tetrahedra'], tissue.tetrahedra)
    assert names['block'] > 0, 'after cuts'


def test_the_file_says_units_licence_and_the_hash_of_the_tissue(tmp_path: Path) -> None:
    (bag,) = find_bags(['straight_cut'], SAMPLES)
    write_sessions([bag], tmp_path / 'set.h5', 'CC-BY-4.0')
    with h5py.File(tmp_path / 'set.h5') as file:
        session = file['sessions/0000']
        assert file.attrs['licence'] == 'CC-BY-4.0'
        assert session.attrs['tissue_hash'] == f'{tissue_at(open_bag(bag.path)).hash():016x}'
        arrays: list[h5py.Dataset] = []
        file.visititems(lambda _, of: arrays.append(of) if isinstance(of, h5py.Dataset) else None)
        assert len(arrays) > 60 and all('unit' in array.attrs for array in arrays)
        assert session['streams/arm_servo_cf/force'].attrs['unit'] == 'N'


def test_the_file_says_how_many_messages_were_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    all_of_them = Bag.messages

    def with_gaps(bag: Bag, *arguments: Any, **options: Any) -> Iterator[Recorded]:
        for recorded in all_of_them(bag, *arguments, **options):
            if recorded.topic != SERVO_CF or recorded.sequence not in (100, 101, 300):
                yield recorded

    monkeypatch.setattr(Bag, 'messages', with_gaps)
    (bag,) = find_bags(['straight_cut'], SAMPLES)
    write_sessions([bag], tmp_path / 'set.h5', '')
    with h5py.File(tmp_path / 'set.h5') as file:
        lost = dict(file['sessions/0000/lost_messages'].attrs)
    assert lost.pop('about') and lost == {SERVO_CF: 3} == read_evidence(bag.path).lost


def test_units_are_those_of_the_message_definitions() -> None:
    for codec in (ContactCodec, ForceSampleCodec):
        name = codec.__name__.removesuffix('Codec')
        text = (ROOT / 'msg_defs' / 'msg' / f'{name}.msg').read_text()
        for field in codec.fields:
            given = re.search(rf'^\S+ {field} .*?# \[(.*?)\]', text, re.MULTILINE)
            if not field.startswith('contact_stamp'):
                assert UNITS.get(field, '1') == (given[1] if given else '1'), field
    fields = {field for codec in STREAMS.values() for field in codec.fields}
    assert UNITS.keys() <= fields


def test_subjects_have_numbers_and_their_names_stay_out(tmp_path: Path) -> None:
    copies_by_subjects(SAMPLES / 'palpation', tmp_path / 'bags', 'Ann Doe', 'Bob', 'Ann Doe')
    write_sessions(find_bags(['bags'], tmp_path), tmp_path / 'set.h5', '')
    with h5py.File(tmp_path / 'set.h5') as file:
        subjects = [session.attrs['subject'] for session in file['sessions'].values()]
    assert subjects == ['subject-1', 'subject-2', 'subject-1']
    content = (tmp_path / 'set.h5').read_bytes()
    assert not any(word in content for word in (b'Ann', b'Doe', b'Bob'))


def test_an_array_needs_no_memory_for_the_rows_that_are_written(tmp_path: Path) -> None:
    block = np.random.default_rng(1).random((2000, 3))
    with h5py.File(tmp_path / 'set.h5', 'w') as file:
        rows = GrowingArray(file, 'rows', np.float64, (3,), 'm')
        ragged = RaggedArray(file, 'offset', rows)
        tracemalloc.start()
        for _ in range(400):
            ragged.append(block)
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        rows.flush()
        ragged.offset.flush()
        assert np.array_equal(file['rows'], np.tile(block, (400, 1)))
        assert file['offset'][-1] == 2000 * 400
    assert most < 1e6, '19 MB of rows'


def test_a_file_that_reads_otherwise_than_it_was_written_is_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / 'set.h5', 'w') as file:
        rows = GrowingArray(file, 'rows', np.float64)
        rows.append(np.arange(5.0))
        rows.flush()
    digests = {rows.name: rows.digest()}
    check_arrays(tmp_path / 'set.h5', digests)
    with h5py.File(tmp_path / 'set.h5', 'a') as file:
        file['rows'][3] = 3.5
    with pytest.raises(SessionError, match='another /rows than its bag'):
        check_arrays(tmp_path / 'set.h5', digests)


def test_a_disk_that_is_nearly_full_ends_the_export_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = shutil.disk_usage(tmp_path)._replace(free=50 << 20)
    monkeypatch.setattr(shutil, 'disk_usage', lambda _: full)
    with pytest.raises(OSError, match='No space left on device'):
        write_sessions(find_bags(['palpation'], SAMPLES), tmp_path / 'set.h5', '')
    assert not list(tmp_path.iterdir())


def test_a_file_that_cannot_be_written_is_refused_in_a_sentence(tmp_path: Path) -> None:
    bags = find_bags(['palpation'], SAMPLES)
    with pytest.raises(SessionError, match=r'set: a file of arrays ends in \.h5'):
        write_sessions(bags, tmp_path / 'set', '')
    with pytest.raises(SessionError, match='none does not exist: make it first'):
        write_sessions(bags, tmp_path / 'none' / 'set.h5', '')
    (tmp_path / 'set.h5').touch()
    with pytest.raises(SessionError, match='exists already'):
        write_sessions(bags, tmp_path / 'set.h5', '')
