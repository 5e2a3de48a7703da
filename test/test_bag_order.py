"""Clock steps, messages that are there twice, and bags of several files change nothing."""

import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from bag_copies import rewritten
from diagnostic_msgs.msg import DiagnosticStatus
from made_session import make_session

from cutting_trainer.bags.comparison import Comparison, compare
from cutting_trainer.bags.errors import BagError
from cutting_trainer.bags.metadata import METADATA_FILE
from cutting_trainer.bags.reader import Recorded, mcap_file, open_bag
from cutting_trainer.bags.recorded_frames import read_run
from cutting_trainer.bags.recorder_node import Recorder
from cutting_trainer.bags.resimulation_start import find_beginning
from cutting_trainer.bags.steady_clock import SteadyClock
from cutting_trainer.bags.topic_names import CONTACT, INPUTS
from cutting_trainer.bags.writer import BagWriter
from cutting_trainer.cli import main as cli
from cutting_trainer.recordings.recorded_scene import restore_scene
from cutting_trainer.recordings.resimulate_command import pose_check, recomputation
from cutting_trainer.session.scene_loader import load_scene

pytestmark = pytest.mark.long

SAMPLE = Path(__file__).parents[1] / 'bags' / 'samples' / 'format_2' / 'palpation'
SECOND = 1_000_000_000


@pytest.fixture(scope='module')
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session of this machine, its messages numbered as publishers do."""
    folder = tmp_path_factory.mktemp('made')
    make_session(SAMPLE, folder / 'made', folder)
    return rewritten(folder / 'made', folder / 'bag', number=Numbers())


class Numbers:
    """Numbers messages by topic."""

    def __init__(self) -> None:
        self._last: dict[str, int] = {}

    def __call__(self, recorded: Recorded) -> int:
        number = self._last[recorded.topic] = self._last.get(recorded.topic, 0) + 1
        return number


def resimulated(folder: Path, temporary: Path) -> Comparison:
    bag = open_bag(folder)
    scene = load_scene(str(restore_scene(bag, temporary)))
    beginning = find_beginning(bag)
    return compare(bag, recomputation(scene, beginning), pose_check(scene), beginning=beginning)


def written(
    source: Path, folder: Path, messages: list[Recorded], log_time: dict[int, int] | None = None
) -> Path:
    """A bag with some of the messages of another, each with the log time that is given for it."""
    bag = open_bag(source)
    writer = BagWriter(folder, custom_data=bag.custom_data)
    for topic, kind in bag.topics().items():
        writer.add_topic(topic, kind, bag.schemas[kind], '', bag.profiles(topic))
    for number, m in enumerate(messages):
        time = (log_time or {}).get(number, m.log_time)
        writer.write(m.topic, time, m.publish_time, m.data, m.sequence)
    writer.close()
    return folder


@pytest.mark.parametrize('step', [-1 * SECOND, -3600 * SECOND, 5 * SECOND])
def test_a_clock_that_was_set_meanwhile_changes_nothing(
    made: Path, tmp_path: Path, step: int
) -> None:
    messages = list(open_bag(made).messages())
    half = len(messages) // 2
    times = {i: m.log_time + step for i, m in enumerate(messages) if i >= half}
    result = resimulated(written(made, tmp_path / 'bag', messages, times), tmp_path)
    assert result.identical and not result.missing and result.restart is None
    assert result.frames == result.meshes == len(read_run(open_bag(made))[0])


def test_messages_that_are_there_twice_are_passed_over_and_counted(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    messages = [m for m in open_bag(made).messages() for _ in range(2)]
    folder = written(made, tmp_path / 'bag', messages)
    result = resimulated(folder, tmp_path)
    frames = len(read_run(open_bag(made))[0])
    assert result.identical and not result.missing and result.restart is None
    assert result.frames == frames
    assert result.doubled > frames
    with pytest.raises(SystemExit) as stopped:
        cli.main(['resimulate', str(folder)])
    said = capsys.readouterr().out
    assert stopped.value.code == 0
    assert f'in the bag twice, and passed over: {result.doubled} messages' in said


def split(made: Path, folder: Path, parts: int) -> Path:
    """The same messages in several files."""
    messages = list(open_bag(made).messages())
    folder.mkdir()
    names, information = [], {}
    for part in range(parts):
        some = messages[part * len(messages) // parts : (part + 1) * len(messages) // parts]
        one = written(made, folder / f'part_{part}', some)
        name = f'bag_{part}.mcap'
        mcap_file(one).rename(folder / name)
        information = yaml.safe_load((one / METADATA_FILE).read_text())
        (one / METADATA_FILE).unlink()
        one.rmdir()
        names.append(name)
    information['rosbag2_bagfile_information']['relative_file_paths'] = names
    (folder / METADATA_FILE).write_text(yaml.safe_dump(information))
    return folder


def test_a_bag_of_several_files_is_read_as_one(made: Path, tmp_path: Path) -> None:
    folder = split(made, tmp_path / 'split', 3)
    whole, parts = open_bag(made), open_bag(folder)
    assert list(parts.messages()) == list(whole.messages())
    assert (parts.span, parts.topics(), parts.complete) == (whole.span, whole.topics(), True)
    since = whole.span[0] + (whole.span[1] - whole.span[0]) * 4 // 5
    some = list(parts.messages([CONTACT], since=since))
    assert some == list(whole.messages([CONTACT], since=since))
    assert resimulated(folder, tmp_path).identical
    with pytest.raises(SystemExit) as stopped:
        cli.main(['report', str(folder), '-o', str(tmp_path / 'report.html')])
    assert stopped.value.code in (0, None)


def test_a_bag_of_several_files_that_lacks_one_says_which(made: Path, tmp_path: Path) -> None:
    folder = split(made, tmp_path / 'split', 2)
    (folder / 'bag_1.mcap').unlink()
    with pytest.raises(BagError, match=r'lacks its file bag_1\.mcap'):
        open_bag(folder)
    shutil.rmtree(folder)  # test_every_bag.py reads all bags that are left


def test_frames_that_are_lacking_are_still_told_as_that(made: Path, tmp_path: Path) -> None:
    bag = open_bag(made)
    folder = rewritten(
        made,
        tmp_path / 'bag',
        lambda m: None if m.topic == INPUTS and bag.read(m).step == 20 else m.data,
    )
    result = resimulated(folder, tmp_path)
    assert result.difference is not None and 'lacks frame 20' in result.difference.what


def test_a_clock_that_is_set_does_not_move_what_is_recorded() -> None:
    system, steady = 10**18, 0

    def passes(seconds: float, *, is_set_by: float = 0.0) -> None:
        nonlocal system, steady
        system += round((seconds + is_set_by) * SECOND)
        steady += round(seconds * SECOND)

    clock = SteadyClock(lambda: system, lambda: steady)
    passes(1.0)
    assert clock.look() == 0 and clock.of(system) == 10**18 + SECOND
    before = system
    passes(0.004, is_set_by=-1.0)
    assert clock.look() == -SECOND
    assert clock.of(before) == before, 'a message that came before the clock was set'
    assert clock.of(system) == before + 4_000_000
    passes(60.0)
    assert clock.look() == 0 and clock.of(system) == before + 60_004_000_000
    passes(0.004, is_set_by=0.01)
    assert clock.look() == 0, 'a clock that is slewed'


def test_what_is_drawn_from_others_is_left_out_and_the_bag_is_whole() -> None:
    recorder: Any = SimpleNamespace(
        _streams={},
        _unrecorded={},
        _needless={},
        _hears_inputs=lambda: True,
        _states=(),
        _drawings='/viewer/markers',
        get_topic_names_and_types=lambda: [('/viewer/markers', ['any/msg/Type'])],
        accounts=dict,
        writer=SimpleNamespace(size=1, failure=''),
    )
    Recorder.discover(recorder)
    level, said, values = Recorder._collect(recorder)
    assert (level, said) == (DiagnosticStatus.OK, 'recording')
    assert 'drawn from' in str(values['not recorded /viewer/markers'])
    recorder._unrecorded['/odd'] = 'nobody knows its type'
    level, said, _ = Recorder._collect(recorder)
    assert (level, said) == (DiagnosticStatus.WARN, 'the bag is not whole')
