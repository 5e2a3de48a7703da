"""The command line: every command explains itself, and every mistake is one line."""

import errno
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from cutting_trainer.bags.errors import BagError
from cutting_trainer.cli import main as cli
from cutting_trainer.cli import user_commands
from cutting_trainer.cli.bag_errors import reading
from cutting_trainer.cli.test_command import (
    ALONE,
    NO_TESTS,
    TESTS,
    TESTS_FAILED,
    Check,
    all_checks,
    run_checks,
    verdict,
)
from cutting_trainer.node_common.share_folder import SCENES
from cutting_trainer.session.errors import SessionError
from cutting_trainer.session.exit_status import Status
from cutting_trainer.session.scene_loader import find_scene, load_scene

ROOT = Path(__file__).resolve().parents[1]


def trainer(*arguments: str) -> int:
    with pytest.raises(SystemExit) as stopped:
        cli.main(list(arguments))
    return int(stopped.value.code or 0)


def test_help_shows_each_command_with_one_line_and_the_exit_statuses(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert trainer('--help') == 0
    text = capsys.readouterr().out
    assert re.search(r'demo +Run a session', text)
    assert re.search(r'test +Run the checks', text)
    for status in Status:
        assert status.meaning.split()[0] in text and str(int(status)) in text


def test_help_shows_the_units_of_what_is_asked_for(capsys: pytest.CaptureFixture[str]) -> None:
    assert trainer('demo', '--help') == 0
    assert 'Duration [s]' in capsys.readouterr().out


@pytest.mark.parametrize(
    'arguments', [('dmeo',), ('demo', '--sceen', 'liver'), ('demo', '--seed', 'x')]
)
def test_misspelt_command_option_or_number_is_bad_input(arguments: tuple[str, ...]) -> None:
    assert trainer(*arguments) == Status.BAD_INPUT


def one_error_line(capsys: pytest.CaptureFixture[str]) -> str:
    captured = capsys.readouterr()
    assert captured.out == ''
    lines = captured.err.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith('error: '), captured.err
    return lines[0]


@pytest.mark.parametrize(
    ('arguments', 'said'),
    [
        (('picture', 'nobag'), 'nobag'),
        (('report', 'nobag'), 'nobag'),
        (('picture', 'BAG', '-o', 'nowhere/x.png'), 'nowhere does not exist'),
        (('report', 'BAG', '-o', '/proc/x.html'), '/proc/x.html: no such file'),
        (('export', 'BAG', '/proc/x.vtk'), '/proc/x.vtk: no such file'),
        (('import-mesh', 'no.stl', '-o', 'x'), 'no.stl'),
        (('plan', '/etc'), '/etc is a folder'),
    ],
)
def test_file_that_cannot_be_read_or_written_is_one_line_with_a_remedy(
    arguments: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    sample = str(ROOT / 'bags' / 'samples' / 'format_2' / 'palpation')
    assert trainer(*(sample if a == 'BAG' else a for a in arguments)) == Status.BAD_INPUT
    line = one_error_line(capsys)
    assert said in line
    assert 'make it first, the' not in line or 'nowhere' in line


def test_error_of_the_system_without_a_file_is_a_bug_and_raised(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise OSError(errno.EIO, 'input/output error')

    monkeypatch.setattr(cli, 'app', fail)
    with pytest.raises(OSError, match='input/output'):
        cli.main([])


def test_unknown_scene_names_the_near_match_and_all_there_are(
    capsys: pytest.CaptureFixture[str],
) -> None:
    known = sorted(path.stem for path in SCENES.glob('*.yaml'))
    assert trainer('demo', '--scene', known[0] + 'x') == Status.BAD_INPUT
    line = one_error_line(capsys)
    assert f'did you mean {known[0]}?' in line
    assert ', '.join(known) in line


def test_scene_file_that_is_not_there_is_named(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert trainer('demo', '--scene', str(tmp_path / 'mine.yaml')) == Status.BAD_INPUT
    assert f'{tmp_path / "mine.yaml"} does not exist' in one_error_line(capsys)


def test_mistake_in_a_scene_is_told_with_its_line(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    text = find_scene('liver').read_text().replace('../meshes', str(SCENES.parent / 'meshes'))
    scene = tmp_path / 'mine.yaml'
    scene.write_text(re.sub(r'^session:.*?(?=^\S|\Z)', '', text, flags=re.M | re.S))
    with scene.open('a') as file:
        file.write('\nsession:\n  secnds: 5\n')
    assert trainer('demo', '--scene', str(scene)) == Status.BAD_INPUT
    line = one_error_line(capsys)
    assert str(scene) in line and 'did you mean seconds?' in line


@pytest.mark.parametrize(
    ('option', 'value', 'says'),
    [
        ('--scene', '', ["scene '' is not known", 'give the path of a .yaml file']),
        ('--scene', '{}/folder.yaml', ['is a folder', 'name the file in it']),
        ('--scene', '{}/words.yaml', ['words.yaml:2', 'not valid YAML', 'check indentation']),
        ('--scene', '{}/no_mesh.yaml', ['nix.msh does not exist', 'check the path']),
        ('--bag', '', ['--bag names no folder', 'give the path']),
        ('--bag', '{}/folder.yaml', ['exists already', 'name a new folder']),
        ('--bag', '{}/words.yaml/bag', ['words.yaml is a file', 'name a folder']),
        ('--bag', '/proc/bag', ['/proc/bag cannot be made', 'name another folder']),
        ('--bag', '{}/' + 'x' * 300, ['cannot be made (file name too long)', 'name another']),
    ],
)
def test_scene_or_bag_that_cannot_be_is_refused_in_one_sentence_with_a_remedy(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, option: str, value: str, says: list[str]
) -> None:
    (tmp_path / 'folder.yaml').mkdir()
    (tmp_path / 'words.yaml').write_text('tissue: [a\n')
    (tmp_path / 'no_mesh.yaml').write_text('tissue: {mesh: nix.msh}\n')
    assert trainer('demo', '--domain', 'free', option, value.format(tmp_path)) == Status.BAD_INPUT
    line = one_error_line(capsys)
    assert all(words in line for words in says), line


def test_folder_that_may_not_be_written_is_refused_before_a_node_starts(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(folder: Path, **_: object) -> None:
        raise PermissionError(errno.EACCES, 'Permission denied', str(folder))

    monkeypatch.setattr(Path, 'mkdir', refuse)
    assert trainer('demo', '--bag', str(tmp_path / 'bag')) == Status.BAD_INPUT
    assert 'bag cannot be made (permission denied)' in one_error_line(capsys)
    assert trainer('demo') == Status.BAD_INPUT
    assert 'cannot be made (permission denied)' in one_error_line(capsys)


@pytest.mark.parametrize('seconds', ['0', '-3', 'nan', 'inf', '1e9'])
def test_duration_that_cannot_be_is_refused(
    capsys: pytest.CaptureFixture[str], seconds: str
) -> None:
    assert trainer('demo', '--seconds', seconds) == Status.BAD_INPUT
    assert 'from 1 to 86400' in one_error_line(capsys)


def test_a_bug_is_not_dressed_up_as_a_mistake_of_the_user(monkeypatch: pytest.MonkeyPatch) -> None:
    def stumble(options: object) -> Status:
        raise ValueError('a bug')

    monkeypatch.setattr('cutting_trainer.session.demo_command.run_demo', stumble)
    with pytest.raises(ValueError, match='a bug'):
        cli.main(['demo'])


def test_interrupt_outside_a_session_has_the_status_of_an_interrupt(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def interrupted(options: object) -> Status:
        raise KeyboardInterrupt

    monkeypatch.setattr('cutting_trainer.session.demo_command.run_demo', interrupted)
    assert trainer('demo') == Status.INTERRUPTED


def test_start_of_the_command_line_does_not_load_the_core() -> None:
    code = 'import cutting_trainer.cli.main, sys; print(*sys.modules)'
    loaded = subprocess.run(
        [sys.executable, '-c', code], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split()
    assert not {'numpy', 'numba', 'rclpy', 'pydantic'} & set(loaded)


@pytest.mark.parametrize('name', sorted(path.stem for path in SCENES.glob('*.yaml')))
def test_every_shipped_scene_is_valid(name: str) -> None:
    scene = load_scene(name)
    assert scene.name == name
    assert scene.tissue.mesh.is_file()


def python(code: str) -> tuple[str, ...]:
    return (sys.executable, '-c', code)


def test_test_command_runs_every_check_and_has_the_status_of_the_first_that_failed(
    tmp_path: Path,
) -> None:
    checks = [
        Check('lint', python('pass')),
        Check('types', python('raise SystemExit(7)')),
        Check('links', python('raise SystemExit(5)')),
    ]
    announced: list[str] = []
    results = run_checks(checks, tmp_path, announced.append)
    assert announced == ['lint', 'types', 'links']
    assert verdict(results) == (7, 'failed: types, links')
    assert verdict({'lint': 0, 'tests': 0}) == (0, 'all passed: lint, tests')


def test_test_command_of_an_installation_says_that_the_tests_are_in_the_source(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(user_commands, '__file__', str(tmp_path / 'session' / 'cli.py'))
    assert trainer('test') == Status.BAD_INPUT
    assert 'in a checkout of its source' in one_error_line(capsys)


def test_extra_arguments_of_the_test_command_reach_pytest() -> None:
    *others, beside, live, alone = all_checks(
        ['-k', 'patch', '--maxfail=1'], Path('/tmp/x'), 'usual'
    )
    assert [check.name for check in others] == ['ruff check', 'ruff format']
    for tests, part in ((beside, 'beside'), (live, 'live'), (alone, 'alone')):
        assert tests.argv[1:3] == ('-m', 'pytest')
        assert tests.argv[-3:] == ('-k', 'patch', '--maxfail=1')
        assert {'--tier=usual', f'--part={part}', f'--basetemp=/tmp/x/{part}'} < set(tests.argv)
    assert '--numprocesses=auto' in beside.argv and '--numprocesses=2' in live.argv
    assert not any(a.startswith('--numprocesses') for a in alone.argv)


@pytest.mark.parametrize('ends', ['def test_ends(): os._exit(1)', 'os._exit(1)'])
def test_process_that_ends_before_its_tests_have_run_is_no_success(
    tmp_path: Path, ends: str
) -> None:
    # A new process ran that test first, and so on: tests that had stopped for ever took CI's time.
    (tmp_path / 'conftest.py').symlink_to(Path(__file__).with_name('conftest.py'))
    (tmp_path / 'test_0.py').write_text(f'import os\n{ends}\ndef test_after(): pass\n')
    for number in range(1, 6):
        (tmp_path / f'test_{number}.py').write_text('def test_one(): pass\ndef test_two(): pass\n')
    *_, beside, _, _ = all_checks([], tmp_path, 'usual')
    argv = [a.replace('=auto', '=2') for a in beside.argv]
    ran = subprocess.run(argv, cwd=tmp_path, capture_output=True, text=True, timeout=100)
    assert verdict({TESTS: ran.returncode})[0] not in (0, TESTS_FAILED, NO_TESTS), ran.stdout


def test_the_quick_tier_needs_no_graph() -> None:
    checks = all_checks([], Path('/tmp/x'), 'quick')
    assert [check.name for check in checks] == ['ruff check', 'ruff format', TESTS]
    assert verdict({'lint': 0, TESTS: NO_TESTS})[0] == NO_TESTS


def test_arguments_may_choose_tests_of_one_part_but_not_of_none() -> None:
    assert verdict({'lint': 0, TESTS: NO_TESTS, ALONE: 0})[0] == 0
    assert verdict({'lint': 0, TESTS: 0, ALONE: NO_TESTS})[0] == 0
    assert verdict({'lint': 0, TESTS: NO_TESTS, ALONE: 1}) == (1, f'failed: {ALONE}')
    assert verdict({'lint': 0, TESTS: NO_TESTS, ALONE: NO_TESTS})[0] == NO_TESTS


def test_nodes_get_their_parameters_quoted_and_one_environment(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from cutting_trainer.session.node_commands import node_environment, session_nodes

    nodes = session_nodes(Path('/a b/c: d.yaml'), Path('/bags/x'), 3, 12)
    assert [node.name for node in nodes][-1] == 'recorder' and nodes[-1].records
    for node in nodes:
        assert 'scene:="/a b/c: d.yaml"' in node.argv
    given = [json.loads(a.partition(':=')[2]) for a in nodes[0].argv if a.startswith('seconds:=')]
    assert given == [12.0] and isinstance(given[0], float)
    monkeypatch.delenv('ROS_AUTOMATIC_DISCOVERY_RANGE', raising=False)
    environment = node_environment(5)
    assert environment['ROS_DOMAIN_ID'] == '5'
    assert environment['FASTRTPS_DEFAULT_PROFILES_FILE'].endswith('config/dds/localhost.xml')
    assert environment['PYTHONPATH'].split(os.pathsep)[0] == str(ROOT)


def test_a_sentence_of_the_trainer_about_a_bag_stays_as_it_is() -> None:
    with (
        pytest.raises(SessionError, match=r'^the bag has no cut: record one$'),
        reading(Path('bag')),
    ):
        raise SessionError('the bag has no cut: record one')
    with pytest.raises(BagError, match='cannot be used'), reading(Path('bag')):
        int('nothing')


@pytest.mark.long
def test_tests_that_failed_alone_run_again_by_themselves_and_only_they(tmp_path: Path) -> None:
    (tmp_path / 'test_two.py').write_text(
        'from pathlib import Path\n'
        'RUNS = Path(__file__).parent / "runs"\n'
        'def test_passes(): RUNS.open("a").write("p")\n'
        'def test_fails_once():\n'
        '    RUNS.open("a").write("f")\n'
        '    assert RUNS.read_text().count("f") > 1\n'
    )
    *_, alone = all_checks(['test_two.py'], tmp_path / 'made', 'usual')
    kept = [a for a in alone.argv if not a.startswith(('--tier', '--part'))]
    (tmp_path / 'made').mkdir()
    results = run_checks(
        [Check(ALONE, tuple(kept), alone.repetitions)], tmp_path, lambda name: None
    )
    assert results == {ALONE: 0}
    assert (tmp_path / 'runs').read_text() == 'pff'


def test_scene_for_a_real_arm_needs_no_script_and_the_emulated_arm_says_that_it_does(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    text = (SCENES / 'palpation.yaml').read_text()
    mesh = f'{SCENES.parent}/meshes/'
    scene = tmp_path / 'real_arm.yaml'
    scene.write_text(text[: text.index('\narm:')].replace('../meshes/', mesh) + '\n')
    assert load_scene(str(scene)).arm.script is None
    assert trainer('demo', '--scene', str(scene), '--bag', str(tmp_path / 'bag')) == 2
    assert 'has no arm.script' in one_error_line(capsys)
