"""A session is computed again from its bag bit for bit, and one change in the bag is caught."""

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from bag_copies import is_of_this_processor, moved_by, rewritten
from made_session import make_session
from rclpy.serialization import deserialize_message, serialize_message
from rich.console import Console

from cutting_trainer.bags.comparison import MAX_ROUNDING, Comparison, compare
from cutting_trainer.bags.errors import BagError
from cutting_trainer.bags.message_class import message_class
from cutting_trainer.bags.reader import Recorded, open_bag
from cutting_trainer.bags.recorded_frames import read_run
from cutting_trainer.bags.repair import copy_bag
from cutting_trainer.bags.resimulation import answer_frames, as_recorded
from cutting_trainer.bags.topic_names import (
    CONTACT,
    CUTS,
    FORCE,
    INPUTS,
    MESH,
    POSE,
    SERVO_CF,
    UPDATES,
)
from cutting_trainer.cli import main as cli
from cutting_trainer.node_common.cdr_codec import ContactCodec, ForceSampleCodec, WrenchStampedCodec
from cutting_trainer.node_common.code_identity import identity_here
from cutting_trainer.node_common.stamps import nanoseconds
from cutting_trainer.recordings import view_bag_command
from cutting_trainer.recordings.recorded_scene import restore_scene
from cutting_trainer.recordings.resimulate_command import pose_check, recomputation, verdict
from cutting_trainer.recordings.what_if import Run, recorded_run, run_experiment
from cutting_trainer.session.errors import SessionError
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.session.scene_overrides import parse_changes

pytestmark = pytest.mark.long

SAMPLES = Path(__file__).parents[1] / 'bags' / 'samples'
OF_TISSUE = (INPUTS, MESH, UPDATES, FORCE)
BAGS = sorted(path.parent for path in SAMPLES.glob('format_*/*/metadata.yaml'))
NEWEST = BAGS[-1].parent
CUT = SAMPLES / 'format_7' / 'straight_cut'
FORMER_CUT = SAMPLES / 'format_2' / 'straight_cut'


def resimulated(folder: Path, temporary: Path) -> Comparison:
    bag = open_bag(folder)
    scene = load_scene(str(restore_scene(bag, temporary)))
    return compare(bag, recomputation(scene), pose_check(scene))


def loaded_frame(folder: Path, share: float) -> SimpleNamespace:
    """A frame of the sample that some share of the way through its cut has a contact in it."""
    bag = open_bag(folder)
    inputs = [bag.read(m) for m in bag.messages([INPUTS])]
    states = {
        s.stamp_ns: s.values[ForceSampleCodec.fields['state']][0]
        for s in (ForceSampleCodec().decode(m.data) for m in bag.messages([FORCE]))
    }
    held = [m for m in inputs if m.has_contact and states[nanoseconds(m.header.stamp)]]
    return held[int(share * len(held))]


@pytest.fixture(scope='module')
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session with a cut, of this machine and this version."""
    folder = tmp_path_factory.mktemp('made')
    return make_session(CUT, folder / 'bag', folder)


def test_a_session_with_cuts_is_computed_again_bit_for_bit(made: Path, tmp_path: Path) -> None:
    result = resimulated(made, tmp_path)
    assert result.identical
    assert not result.missing
    assert result.frames == result.forces == result.meshes == len(read_run(open_bag(made))[0])
    assert result.hashes > 5
    bag = open_bag(made)
    assert sum(bag.read(m).cut_step > 0 for m in bag.messages([UPDATES])) > 3


@pytest.mark.parametrize('folder', BAGS, ids=lambda path: f'{path.parent.name}-{path.name}')
def test_samples_of_every_format_are_computed_again_as_far_as_this_version_agrees(
    folder: Path, tmp_path: Path
) -> None:
    result = resimulated(folder, tmp_path)
    assert not result.missing
    if folder.parent == NEWEST:
        told = result.difference
        assert told is None or (not is_of_this_processor(folder) and told.size < 1e-3)
    # Until the tool is there, nothing that later versions compute otherwise has any say.
    assert result.frames > 5
    if result.difference is not None:
        told = result.difference
        assert np.isfinite(told.size) or 'tetra' in told.what or 'the cut of frame' in told.what


def test_a_pose_changed_by_a_tenth_of_a_micrometre_is_caught_at_the_frame_that_it_loaded(
    made: Path,
    tmp_path: Path,
) -> None:
    frame = loaded_frame(made, 0.5)
    change = moved_by(1e-7, nanoseconds(frame.contact_stamp))
    result = resimulated(rewritten(made, tmp_path / 'bag', change), tmp_path)
    assert result.difference is not None
    assert result.difference.step == frame.step
    assert 'pose of the device' in result.difference.what


@pytest.mark.parametrize('share', [0.5])
def test_a_contact_changed_is_caught_in_the_force_of_the_frame_that_it_loaded(
    made: Path, tmp_path: Path, share: float
) -> None:
    frame, codec = loaded_frame(made, share), ContactCodec('tissue')
    tool = [ContactCodec.fields[name] for name in ('device', 'blade_root', 'blade_tip')]

    def change(m: Recorded) -> bytes | None:
        if m.topic == POSE:
            return None
        sample = codec.decode(m.data) if m.topic == CONTACT else None
        if sample is None or sample.values[0] != frame.contact_sequence:
            return m.data
        values = list(sample.values)
        for place in tool:
            values[place] = [value + 1e-9 for value in values[place]]
        return codec.encode(sample.stamp_ns, values)

    result = resimulated(rewritten(made, tmp_path / 'bag', change), tmp_path)
    assert result.missing['poses of the device'] > 0
    assert result.difference is not None
    assert result.difference.step == frame.step
    assert 'differs by' in result.difference.what


def test_messages_that_nobody_could_read_are_passed_over(made: Path, tmp_path: Path) -> None:
    time = next(open_bag(made).messages([CONTACT])).log_time
    garbage = [(topic, time, bytes(range(96))) for topic in (CONTACT, POSE, FORCE)]
    result = resimulated(rewritten(made, tmp_path / 'bag', added=garbage), tmp_path)
    assert result.identical


def test_a_force_that_is_not_the_recorded_one_is_caught_and_measured(
    made: Path, tmp_path: Path
) -> None:
    frame, codec = loaded_frame(made, 0.3), ForceSampleCodec('tissue')

    def change(m: Recorded) -> bytes:
        sample = codec.decode(m.data) if m.topic == FORCE else None
        if sample is None or sample.values[0] != frame.step:
            return m.data
        values = list(sample.values)
        values[ForceSampleCodec.fields['force'].start] += 0.25
        return codec.encode(sample.stamp_ns, values)

    difference = resimulated(rewritten(made, tmp_path / 'bag', change), tmp_path).difference
    assert difference is not None and difference.step == frame.step
    assert difference.what.startswith('force differs by 0.25 N')


def test_a_missing_delta_is_noticed_and_healed_by_the_next_keyframe(
    made: Path, tmp_path: Path
) -> None:
    bag = open_bag(made)
    keyframe = [bag.read(m) for m in bag.messages([MESH])][-1]
    missing = keyframe.step - 20

    def change(m: Recorded) -> bytes | None:
        return None if m.topic == UPDATES and bag.read(m).step == missing else m.data

    result = resimulated(rewritten(made, tmp_path / 'bag', change), tmp_path)
    assert result.identical
    assert result.missing['deltas that do not fit the one before'] > 0
    assert result.missing['meshes'] == 20
    assert result.forces == result.frames


def test_frames_lost_by_the_recorder_end_the_computation_with_their_number(
    made: Path, tmp_path: Path
) -> None:
    bag = open_bag(made)

    def change(m: Recorded) -> bytes | None:
        return None if m.topic == INPUTS and bag.read(m).step == 30 else m.data

    result = resimulated(rewritten(made, tmp_path / 'bag', change), tmp_path)
    assert result.frames == 29
    assert result.difference is not None and 'lacks frame 30' in result.difference.what
    assert verdict(result, 1.0, None)[0].startswith('identical for 29 frames; ')


@pytest.mark.parametrize('back', [0, 7])
def test_a_session_in_which_the_simulation_was_started_again_is_compared_up_to_there(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], back: int
) -> None:
    """The other process goes on where the first ended, or from some frames before."""
    bag = open_bag(made)
    inputs = [(m, bag.read(m)) for m in bag.messages([INPUTS])]
    last = loaded_frame(made, 0.4).step
    at = next(m.log_time for m, frame in inputs if frame.step > last)
    numbers: Counter[str] = Counter()

    def renumbered(m: Recorded) -> int:
        """As publishers count; that of another process from 1 again."""
        again = m.log_time >= at and m.topic in OF_TISSUE
        numbers[f'{m.topic} {again}'] += 1
        return numbers[f'{m.topic} {again}']

    def change(m: Recorded) -> bytes:
        if m.log_time < at or m.topic not in OF_TISSUE:
            return m.data
        message = deserialize_message(m.data, message_class(m.type))
        if m.topic == FORCE:
            message.force[0] += 1.0  # of another process, from another state
        else:
            message.step -= back
        return serialize_message(message)

    folder = rewritten(made, tmp_path / 'bag', change, number=renumbered)
    result = resimulated(folder, tmp_path)
    assert result.identical
    assert result.frames == result.meshes == last
    assert not result.missing
    assert result.restart is not None and result.restart.step == last + 1 - back
    with pytest.raises(SystemExit) as stopped:
        cli.main(['resimulate', str(folder)])
    assert stopped.value.code == 0
    said = capsys.readouterr().out
    assert said.startswith(f'identical up to the restart at {result.restart.seconds:.2f} s\n')
    assert 'not compared: the tissue began again' in said


def test_a_bag_of_format_2_that_begins_in_the_middle_says_why_it_is_not_computed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = open_bag(FORMER_CUT)
    middle = [m.log_time for m in bag.messages([INPUTS])][30]
    late = rewritten(
        FORMER_CUT, tmp_path / 'late', lambda m: m.data if m.log_time > middle else None
    )
    with pytest.raises(SystemExit) as stopped:
        cli.main(['resimulate', str(late)])
    assert stopped.value.code == 2
    assert 'begins at frame 3' in (said := capsys.readouterr().err) and 'from format 3 on' in said
    with pytest.raises(SystemExit) as stopped:
        cli.main(['report', str(late), '-o', str(tmp_path / 'report.html')])
    assert stopped.value.code in (0, None)


def test_a_bag_without_a_scene_is_refused(tmp_path: Path) -> None:
    nameless = open_bag(CUT)
    del nameless.custom_data['scene']
    with pytest.raises(BagError, match='has no scene'):
        restore_scene(nameless, tmp_path)


def test_a_planned_method_is_that_which_the_bag_names_and_none_that_is_planned_anew(
    tmp_path: Path,
) -> None:
    bag = open_bag(CUT)
    bag.custom_data['scene'] = bag.custom_data['scene'].replace(
        'tissue:', 'tissue:\n  method: auto'
    )
    taken = {
        'model': 'corotational',
        'integrator': 'rk4',
        'active_region.mode': 'budget',
        'active_region.nodes': 77,
        'active_region.tolerance': 1e-3,
    }
    bag.custom_data['parameters'] = yaml.safe_dump({'/tissue_sim': {'seed': 0, **taken}})
    tissue = load_scene(str(restore_scene(bag, tmp_path))).tissue
    assert tissue.method == 'given'
    assert tissue.method_taken == taken | {'contact': 'triangle'}
    changes = parse_changes(['tissue.model=linear'])
    assert load_scene(str(restore_scene(bag, tmp_path, changes))).tissue.model == 'linear'
    del bag.custom_data['parameters']
    with pytest.raises(SessionError, match='the bag does not name the planned method'):
        recomputation(load_scene(str(restore_scene(bag, tmp_path))))


@pytest.mark.parametrize('said', [{}, {'contact': 'footprint'}])
def test_a_session_that_does_not_name_its_contact_had_that_of_triangles(
    tmp_path: Path, said: dict[str, str]
) -> None:
    bag = open_bag(CUT)
    bag.custom_data['parameters'] = yaml.safe_dump({'/tissue_sim': {'seed': 0, **said}})
    tissue = load_scene(str(restore_scene(bag, tmp_path))).tissue
    assert tissue.contact == said.get('contact', 'triangle')


def with_changes(temporary: Path, *changes: str) -> Run:
    bag = open_bag(CUT)
    scene = load_scene(str(restore_scene(bag, temporary, parse_changes(list(changes)))))
    return run_experiment(bag, scene, recomputation(scene))


@pytest.mark.thorough
def test_the_same_hand_on_the_same_tissue_gives_the_same_and_on_a_tougher_one_more_force(
    tmp_path: Path,
) -> None:
    first, second = with_changes(tmp_path), with_changes(tmp_path)
    np.testing.assert_array_equal(first.forces, second.forces)
    tougher = with_changes(tmp_path, 'tissue.material.toughness=12')
    assert tougher.mean > 1.2 * first.mean
    assert first.area > 0.5e-4
    # What the hand felt live is met by the open-ended computation but for the timing of frames.
    codec, live = ForceSampleCodec(), []
    for m in open_bag(CUT).messages([FORCE]):
        live.append(np.linalg.norm(codec.decode(m.data).values[codec.fields['force']]))
    assert first.peak == pytest.approx(max(live), rel=0.3)


@pytest.mark.parametrize(
    'name', ['straight_cut', pytest.param('crossing_cuts', marks=pytest.mark.thorough)]
)
def test_beside_a_changed_session_stands_the_recorded_one(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its cuts as its service reported them, its force as it was commanded."""
    folder = NEWEST / name
    bag = open_bag(folder)
    reports = [r.report for m in bag.messages([CUTS]) for r in bag.read(m).response]
    codec = WrenchStampedCodec()
    commands = [
        codec.decode(m.data).values[codec.fields['force']] for m in bag.messages([SERVO_CF])
    ]
    with pytest.raises(SystemExit) as stopped:
        cli.main(['resimulate', str(folder), '--with', 'tissue.material.toughness=30', '--json'])
    assert stopped.value.code == 0
    told = json.loads(capsys.readouterr().out)
    recorded = told['recorded']
    assert recorded['elements_cut'] == sum(report.removed for report in reports) > 100
    same = is_of_this_processor(folder)  # others round otherwise
    area = sum(report.area for report in reports)
    assert recorded['incision_area'] == pytest.approx(area, rel=1e-12 if same else 1e-4)
    assert recorded['largest_force'] == max(np.linalg.norm(commands, axis=1))
    assert told['changed']['elements_cut'] != recorded['elements_cut']
    assert told['differs_from_frame'] is None or not same


def test_cuts_of_a_changed_session_are_answered_by_the_protocol_of_its_bag(made: Path) -> None:
    """Of bags before format 3: as late as the cut before was."""
    answer = {'step': 1, 'cut_step': 0, 'answer_frames': 0}
    old = [{}, {'step': 12, 'cut_step': 10}, {'step': 25, 'cut_step': 20}]
    frames = answer_frames([SimpleNamespace(**answer | record) for record in old])
    assert [frames(step) for step in (5, 10, 19, 20, 99)] == [2, 2, 2, 5, 5]
    assert answer_frames(read_run(open_bag(made))[0])(7) == 1
    fixed = [SimpleNamespace(**answer | record | {'answer_frames': 2}) for record in old]
    assert answer_frames(fixed)(20) == 2


def test_a_change_that_names_nothing_in_the_scene_is_one_line(
    capsys: pytest.CaptureFixture[str],
) -> None:
    for change, word in (('cuting.method=delete', 'cutting'), ('tougher', 'key=value')):
        with pytest.raises(SystemExit) as stopped:
            cli.main(['resimulate', str(CUT), '--with', change])
        assert stopped.value.code == 2
        assert word in capsys.readouterr().err


@pytest.mark.parametrize('share', [1e-13, 1e-7])
def test_what_another_processor_rounds_is_told_and_what_is_more_differs(
    made: Path, tmp_path: Path, share: float
) -> None:
    frame, codec = loaded_frame(made, 0.5), ForceSampleCodec('tissue')
    there = codec.fields['stiffness']

    def change(m: Recorded) -> bytes | None:
        sample = codec.decode(m.data) if m.topic == FORCE else None
        if sample is None or sample.values[0] != frame.step:
            return m.data
        values = list(sample.values)
        values[there] = [value * (1 + share) for value in values[there]]
        return codec.encode(sample.stamp_ns, values)

    result = resimulated(rewritten(made, tmp_path / 'bag', change), tmp_path)
    assert not result.identical
    said = verdict(result, 1.0, identity_here())
    if share > MAX_ROUNDING:
        assert result.difference is not None and result.difference.step == frame.step
        assert said[0].startswith('differs first')
        return
    assert result.difference is None and result.frames == len(read_run(open_bag(made))[0])
    assert result.rounding is not None and result.rounding.step == frame.step
    assert result.largest == pytest.approx(share, rel=0.01)
    assert said[0] == 'not identical: off by no more than 1e-13 of the recorded values'
    assert f'from frame {frame.step} ' in said[-2] and 'stiffness differs by' in said[-2]
    assert said[-1] == 'kernels, libraries and processor are those that the bag names'
    other = replace(identity_here(), target='another', cpu='Another CPU')
    said = verdict(result, 1.0, other)
    assert said[0] == 'identical but for rounding, as other processors and libraries do'
    assert said[-1].startswith('the processor is another one: bag Another CPU (another), here ')
    said = verdict(result, 1.0, replace(other, kernels='0123456789abcdef'))
    assert said[0].startswith('not identical: off by no more than ')
    assert said[-2].startswith("the trainer's own kernels have changed: bag 0123456789ab")
    assert 'does not name its code' in verdict(result, 1.0, None)[-1]


def test_the_command_says_identical(
    made: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as stopped:
        cli.main(['resimulate', str(made)])
    assert stopped.value.code == 0
    assert capsys.readouterr().out.startswith('identical\n')
    with pytest.raises(SystemExit):
        cli.main(['resimulate', str(made), '--json'])
    told = json.loads(capsys.readouterr().out)
    assert told['identical'] and told['difference'] is None and told['frames'] > 0


def test_a_frame_that_the_bag_lacks_ends_every_computation_in_one_sentence(
    made: Path, tmp_path: Path
) -> None:
    source, gone = open_bag(made), loaded_frame(made, 0.5)

    def change(m: Recorded) -> bytes | None:
        lost = m.topic == INPUTS and source.read(m).step == gone.step
        return None if lost else m.data

    bag = open_bag(rewritten(made, tmp_path / 'bag', change))
    scene = load_scene(str(restore_scene(bag, tmp_path)))
    lacks = f'lacks frame {gone.step}: '
    for changed in (False, True):
        with pytest.raises(BagError, match=lacks):
            view_bag_command.resimulated(bag, scene, Console(quiet=True), changed=changed)
    with pytest.raises(BagError, match=lacks):
        recorded_run(bag, recomputation(scene))
    left = [record for record in read_run(source)[0] if record.step != gone.step]
    with pytest.raises(BagError, match=lacks):
        list(as_recorded(left, recomputation(scene)))


def test_a_copy_has_the_same_messages(tmp_path: Path) -> None:
    copy_bag(CUT, tmp_path / 'copy')
    every = list(open_bag(CUT).messages())
    assert list(open_bag(tmp_path / 'copy').messages()) == every
    since = every[len(every) // 2].log_time
    copy_bag(CUT, tmp_path / 'part', since=since, without=['/diagnostics'])
    assert list(open_bag(tmp_path / 'part').messages()) == [
        m for m in every if m.log_time >= since and m.topic != '/diagnostics'
    ]
    assert '/diagnostics' not in open_bag(tmp_path / 'part').topics()
