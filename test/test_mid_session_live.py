"""A recorder that comes while the blade cuts: its bag is reported, replayed and computed again."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from cutting_trainer_msgs.msg import Contact
from live import PATIENCE, ROOT, LiveSession, free_domain, onlooker, wait_for
from ruamel.yaml import YAML

from cutting_trainer.bags.reader import open_bag
from cutting_trainer.bags.recorded_frames import read_run
from cutting_trainer.bags.resimulation_start import find_beginning
from cutting_trainer.bags.topic_names import INPUTS
from cutting_trainer.cli import main as cli
from cutting_trainer.node_common.cdr_codec import ContactCodec, ForceSampleCodec
from cutting_trainer.node_common.ros import CONTACT, take_raw
from cutting_trainer.tissue_sim.contact.tool import ContactState

pytestmark = [pytest.mark.real_time, pytest.mark.thorough]

SAMPLE = ROOT / 'bags' / 'samples' / 'straight_cut.yaml'
SECONDS = 24.0
"""Of the script: a recorder needs a few of them to start, and must come while the blade cuts."""


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The bag of a recorder that was started when the tool first touched."""
    folder, domain = tmp_path_factory.mktemp('live'), free_domain()
    slow = YAML(typ='safe').load(SAMPLE)
    slow['tissue']['mesh'] = str(SAMPLE.parent / slow['tissue']['mesh'])
    slow['arm']['script']['seconds'] = slow['session']['seconds'] = SECONDS
    YAML().dump(slow, scene := folder / 'slow.yaml')
    session = LiveSession(folder, scene, domain)
    state = ContactCodec.fields['state']
    try:
        with onlooker(domain, Contact, f'/{CONTACT}') as contacts:

            def touches() -> bool:
                raw = take_raw(contacts)
                return bool(raw and ContactCodec().decode(raw).values[state][0])

            wait_for(touches, 'the tool to touch')
        record_shortly(folder / 'short', scene, domain)
        late = folder / 'late'
        words = ['-o', str(late), '--scene', str(scene), '--domain', str(domain)]
        recorder = subprocess.Popen(
            [sys.executable, '-m', 'cutting_trainer.cli', 'record', *words],
            cwd=ROOT,
            env=os.environ | {'COLUMNS': '200'},
        )
        assert session.end() == 0, session.said
        recorder.send_signal(signal.SIGINT)
        assert recorder.wait(PATIENCE) == 0
        yield late
    finally:
        session.clean()


def record_shortly(bag: Path, scene: Path, domain: str | int) -> None:
    """Record from now on, and end as soon as the recorder is ready."""
    words = ['-o', str(bag), '--scene', str(scene), '--domain', str(domain)]
    recorder = subprocess.Popen(
        [sys.executable, '-m', 'cutting_trainer.cli', 'record', *words],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert recorder.stdout is not None
    assert any('recording into' in line for line in recorder.stdout)
    recorder.send_signal(signal.SIGINT)
    recorder.communicate(timeout=PATIENCE)
    assert recorder.returncode == 0


def ran(*words: str) -> int:
    with pytest.raises(SystemExit) as stopped:
        cli.main(list(words))
    return int(stopped.value.code or 0)


def test_a_bag_that_was_begun_in_a_stroke_is_computed_again_bit_for_bit(
    bag: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    opened = open_bag(bag)
    beginning = find_beginning(opened)
    assert beginning.tissue is not None and beginning.cutting is not None
    records = {record.step: record for record in read_run(opened)[0]}
    before = records[beginning.step - 1].force
    assert before is not None
    assert before.values[ForceSampleCodec.fields['state']][0] == ContactState.INSIDE
    assert min(records) < beginning.step < min(records) + 20
    assert ran('resimulate', str(bag)) == 0
    said = capsys.readouterr().out
    assert said.startswith('identical\n')
    assert f'begins at frame {beginning.step}, ' in said
    computed = len(records) - (beginning.step - min(records))
    assert f'compared bit for bit: {computed} frames, {computed} forces' in said


def test_a_recorder_that_ends_at_once_waits_for_the_state(bag: Path) -> None:
    short = open_bag(bag.parent / 'short')
    beginning = find_beginning(short)
    assert beginning.tissue is not None
    assert beginning.step > 1


def test_it_is_reported_pictured_and_computed_with_another_tissue(
    bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert ran('report', str(bag), '-o', str(tmp_path / 'report.html')) == 0
    assert 'by code that the bag does not name' not in (tmp_path / 'report.html').read_text()
    assert ran('picture', str(bag), '-o', str(tmp_path / 'picture.png')) == 0
    assert ran('resimulate', str(bag), '--with', 'tissue.material.toughness=12') == 0
    assert 'area of the incision' in capsys.readouterr().out


def test_its_hand_drives_the_simulation_from_the_tissue_as_it_was(
    bag: Path, tmp_path: Path
) -> None:
    # A process of its own: a replay takes real-time priority.
    replayed = tmp_path / 'replayed'
    words = ['replay', str(bag), '--domain', 'free', '-o', str(replayed)]
    replay = [sys.executable, '-m', 'cutting_trainer.cli', *words]
    assert subprocess.run(replay, cwd=ROOT, timeout=PATIENCE, check=False).returncode == 0
    opened = open_bag(replayed)
    first = next(opened.read(m) for m in opened.messages([INPUTS]))
    assert isinstance(first, SimpleNamespace) or first.step > 0
