"""Every command of README and docs is run: here, by another test, by a script in CI, or not, and
why.
"""

import ast
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import typer
from bag_copies import is_of_this_processor
from test_docs import PAGES, TEXTS
from test_integrate import LARGEST
from typer.main import get_command

from bench.commands import app as bench
from cutting_trainer.cli import main as cli
from cutting_trainer.session.domain import reserved_domain
from cutting_trainer.session.node_commands import node_environment

pytestmark = pytest.mark.long

ROOT = Path(__file__).resolve().parents[1]
SESSION = ROOT / 'bags' / 'samples' / 'format_7' / 'straight_cut'
PROGRAMS = (
    r'(?:\./trainer|python|ros2|colcon|sudo|pip|source|eval|rviz2|ssh|pre-commit|cd|\.trainer/)'
)
PLACES = {
    r'bags/sessions/(NAME|OTHER|first)\b': 'BAG',
    r'(picture BAG -o) first': r'\1 liver',
    r'(report BAG -o) first': r'\1 report',
    r'\b(SCENE|NAME)\b': 'block',
    r'-side --scene liver --peer [\d.]+': '-side --scene --peer',
    r'\bFOLDER_OF_ITS_SOURCES\b': 'crtk_msgs',
    r'\bKEY=VALUE\b': 'tissue.material.toughness=40',
    r'/path/of/scene.yaml': 'config/scenes/block.yaml',
}
"""What stands for something of the user's own, and what the tests take for it."""


@dataclass(frozen=True)
class Elsewhere:
    """Another test runs it.

    Attributes:
        name: `file::test`.
        files: where the words of the command stand, if not in the test's own.
    """

    name: str
    files: tuple[str, ...] = ()


@dataclass(frozen=True)
class Script:
    """A script in CI runs it.

    Attributes:
        file: of the script.
        line: what stands there, if not the command itself.
    """

    file: str
    line: str = ''


@dataclass(frozen=True)
class Nowhere:
    """It is not run here; the reason."""

    reason: str


PACKAGED = Nowhere('needs ROS from packages, which cannot be installed beside the wheels')
PEERS = Nowhere('the peers are no dependency; test_peers.py tries what needs none of them')
HERE = (
    'picture BAG -o liver.png',
    'picture bags/samples/format_7/crossing_cuts -o crossing_cuts.png',
    'picture BAG',
    'film BAG -o cut.mp4',
    'report BAG -o report.html',
    'resimulate BAG',
    'resimulate BAG --with tissue.material.toughness=40',
    'resimulate bags/samples/format_7/crossing_cuts --with tissue.integration.frequency_growth=2',
    'export BAG tables',
    'export BAG mesh.vtu --at 1',
    'repair BAG',
    'plan block',
    'doctor',
    'completion bash',
    '--help',
)
"""Commands of `./trainer` that a test runs in this process."""
PROGRAMS_OF_OWN = {
    './trainer run python my_node.py': 'mine',
    './trainer run python largest_force.py bags/samples/format_7/straight_cut': 'N after',
}
"""Run here by a process, and what they say."""
SHOWN = {
    'view --bag BAG': 'http://127.0.0.1:',
    'view --bag BAG --beside BAG': 'http://127.0.0.1:',
    'view --bag BAG --resimulate': 'http://127.0.0.1:',
    'view --bag BAG --with tissue.material.toughness=40': 'http://127.0.0.1:',
    'view --attach': 'viewer is ready',
}
"""Run here, with a port that is free, until they say this; then ended by Ctrl-C."""
SERVED_ALIKE = (
    'view --bag BAG',
    'view --bag BAG --resimulate',
    'view --bag BAG --with tissue.material.toughness=40',
)
"""Of these, what test_view_replay.py and test_resimulation.py claim without a process."""
COMPUTED_ALIKE = tuple(c for c in HERE if c.startswith(('film ', 'resimulate ')))
"""Of `HERE`, what test_film.py and test_resimulation.py claim of shorter films and other bags."""
SCHEDULER = Nowhere('`python -m bench.figures studies` starts them with a free port')
DRIVES = Elsewhere(
    'test_integrate.py::test_example_that_drives_the_tool_presses_and_follows_the_mesh',
    ('../session/node_commands.py',),
)
SMALL = 'scene:=bags/samples/palpation.yaml'
NODES = (('tissue_sim', ''), ('cutting', ''), ('haptic_bridge', ' -p auto_enable:=true'))
CUTS_AGAIN = Elsewhere('test_replay.py::test_the_recorded_hand_cuts_the_tissue_again')
ELSEWHERE: dict[str, Elsewhere | Script | Nowhere] = {
    './trainer test': Script('.ci/run'),
    './trainer test -k proxy -x': Nowhere('the arguments are those of pytest'),
    **{
        f'./trainer test --{which}': Nowhere('the tests do not run themselves')
        for which in ('quick', 'all', 'last-failed')
    },
    **{
        f'./trainer overlay{folder}': Elsewhere(
            'test_overlay.py::test_the_launcher_builds_an_overlay_that_the_nodes_then_use',
        )
        for folder in ('', ' crtk_msgs')
    },
    'git clone https://github.com/collaborative-robotics/crtk_msgs': Nowhere('needs the network'),
    './trainer run python -m bench.files.damaged_bags BAG 300': Nowhere(
        'takes minutes: test_damaged_bags.py does it to fewer copies'
    ),
    'python -m bench.page.demo_film': Nowhere(
        'it takes a demo and a minute: test_film.py makes shorter films'
    ),
    'python -m bench.page.frame_rate BAG': Nowhere('it measures the speed of a browser'),
    'python -m bench.page.latency URL': Nowhere('it measures the speed of a browser and a graph'),
    'python -m bench.cuts.severance': Nowhere(
        'takes minutes: test_cutting_severance.py does it to fewer cuts'
    ),
    'python -m bench.figures.scale_threads': Nowhere('it measures the speed of a quiet machine'),
    'python -m bench.haptics.random_cuts': Nowhere(
        'takes minutes: `bench.figures blade` does it to two strokes'
    ),
    'python -m bench.cuts.loose_pieces': Nowhere(
        'takes minutes: test_pieces.py does it to fewer pieces'
    ),
    './trainer run python -m bench.training -o rows.jsonl -n 40': Nowhere(
        'takes an hour: test_training_bench.py tries its parts'
    ),
    **{
        f'./trainer attempts{options}': Elsewhere(
            'test_attempt_store.py::test_the_command_lists_compares_exports_and_deletes'
        )
        for options in (
            '',
            ' --compare BAG BAG',
            ' --curves',
            ' -o attempts.csv',
            ' --delete SUBJECT',
        )
    },
    'for s in 6 7 8 9 10 11 12 13 14 15; do ./trainer demo --scene '
    'bags/samples/straight_cut.yaml --seconds $s --bag bags/sessions/study/cut_$s; done': Nowhere(
        'takes minutes: other sessions are recorded here'
    ),
    './trainer study config/studies/toughness.yaml -o bags/sessions/toughness': Nowhere(
        'takes a minute, and ten bags: test_studies_on_dask.py computes another study'
    ),
    './trainer study config/studies/models.yaml -o bags/sessions/models': Nowhere(
        'takes two minutes, and ten bags: test_study_rows.py computes rows beside another reference'
    ),
    './trainer run python -m pip install paramiko': Nowhere('changes the environment'),
    './trainer identify bags/sessions/study -o bags/sessions/identified': Nowhere(
        'takes minutes, and ten bags: test_identification.py identifies another one'
    ),
    './trainer export bags/sessions/study bags/sessions/dataset --format lerobot --licence '
    'CC-BY-4.0': Nowhere('needs ten bags: test_dataset.py exports others'),
    './trainer export bags/sessions/study bags/sessions/study.h5 --format hdf5 --licence '
    'CC-BY-4.0': Nowhere('needs ten bags: test_session_arrays.py exports others'),
    'python -m bench.trials.identification': Nowhere('takes an hour'),
    'python -m bench.trials.study': Nowhere('takes ten minutes, and needs the machine for itself'),
    **{
        f'./trainer run python -m bench.files.lerobot_loader{more}': Nowhere('it downloads 4 GB')
        for more in ('', ' --episodes 3 --video')
    },
    './trainer export bags/sessions/study bags/sessions/dataset --format lerobot --video': Nowhere(
        'needs ten bags: test_dataset_video.py exports another one'
    ),
    './trainer run dask scheduler': SCHEDULER,
    './trainer run dask worker tcp://HOST:8786 --nthreads 1': SCHEDULER,
    './trainer study config/studies/toughness.yaml --scheduler tcp://HOST:8786': SCHEDULER,
    './trainer run python config/studies/slurm.py 2': Elsewhere(
        'test_studies_on_dask.py::test_a_study_on_jobs_of_slurm_makes_the_same_table_to_the_bit'
    ),
    './trainer clean': Elsewhere('test_launcher.py::test_clean_leaves_nothing_but_the_lock'),
    './trainer record -o BAG --scene block': Elsewhere(
        'test_bags_live.py::'
        'test_record_says_of_each_topic_what_came_was_written_was_lost_and_was_sent_before'
    ),
    './trainer replay BAG': CUTS_AGAIN,
    './trainer replay BAG --domain free': CUTS_AGAIN,
    './trainer replay BAG --as-recorded': Elsewhere(
        'test_replay.py::test_keys_of_a_terminal_pause_a_replay_step_it_and_end_it'
    ),
    './trainer run python press.py': DRIVES,
    **{
        f'./trainer run python -m cutting_trainer.{node}.node --ros-args -p {SMALL}{more}': DRIVES
        for node, more in NODES
    },
    **{
        f'./trainer {side} --scene --peer': Elsewhere(
            'test_two_hosts.py::test_the_session_completes_and_cuts',
            ('../bench/graph/two_hosts.py',),
        )
        for side in ('bridge-side', 'sim-side')
    },
    './trainer run PROGRAM ...': Nowhere('PROGRAM stands for what others of these commands run'),
    './trainer probe-device --arm /MTML --profile dvrk_mtm': Nowhere('needs a real arm'),
    './trainer probe-device --arm /MTML --place my_scene.yaml': Nowhere('needs a real arm'),
    './trainer view --arm /MTML --scene my_scene.yaml --record': Nowhere('needs a real arm'),
    './trainer import-mesh organ.msh --unit m -o organs/organ': Nowhere(
        'test_regions.py imports labelled tetrahedra by the same function'
    ),
    'sudo apt install python3-venv python3-dev cmake build-essential': Nowhere('system packages'),
    'sudo apt install chromium': Nowhere('a system package; .ci/run installs it likewise'),
    'source .trainer/sourced/env/bin/activate': PACKAGED,
    'colcon build': Script('.github/workflows/ci.yml'),
    'cd ../.. && colcon build': Script('.github/workflows/ci.yml', 'colcon build'),
    'pip install -r docs/requirements.txt': Script('.github/workflows/docs.yml'),
    'mkdocs build --strict': Script('.github/workflows/docs.yml'),
    'pre-commit install': Nowhere('changes the hooks of a clone'),
    'uv pip compile --universal --python-version 3.11 --generate-hashes --no-annotate '
    '--no-emit-index-url -o requirements-lock.txt requirements.txt requirements-ros.txt '
    'requirements-mesh.txt requirements-test.txt': Nowhere('renews the lock, by hand'),
    'rviz2 -d config/rviz/trainer.rviz': PACKAGED,
    'python3 -m venv peers': PEERS,
    'peers/bin/pip install -r requirements.txt -r bench/requirements-peers.txt': PEERS,
    'peers/bin/python -m bench.accuracy.peers': PEERS,
    './trainer view --host 0.0.0.0 --allow-host trainer.lan': Nowhere(
        'opens this machine to others'
    ),
    'ssh -L 8080:127.0.0.1:8080 trainer': Nowhere('needs a second machine'),
}


def documented() -> dict[str, str]:
    """Every command of the documents, in their normal form, with its page."""
    found: dict[str, str] = {}
    for page in PAGES:
        text = TEXTS[page]
        blocks = re.findall(r'^ *```sh\n(.*?)^ *```', text, re.S | re.M)
        lines = [line for b in blocks for line in b.replace('\\\n', ' ').splitlines()]
        prose = re.sub(r'^ *```.*?^ *```', '', text, flags=re.S | re.M)
        lines += re.findall(rf'`({PROGRAMS}[^`\n]* [^`\n]*)`', prose)
        for line in filter(None, map(str.strip, lines)):
            if completion := re.fullmatch(r'eval "\$\((.*)\)"', line):
                line = completion.group(1)
            line = ' '.join(line.split())
            for pattern, instead in PLACES.items():
                line = re.sub(pattern, instead, line)
            found.setdefault(line, page.name)
    return found


def scripted() -> set[str]:
    """The lines of the script for what takes long."""
    lines = (ROOT / '.ci' / 'commands').read_text().splitlines()
    own = {re.sub(r'^until_page |^timeout -s INT \d+ ', '', line.strip()) for line in lines}
    return own | {line.removeprefix('./trainer run ') for line in own}


def covered() -> set[str]:
    """Commands that are run somewhere, or for which there is a reason."""
    here = {f'./trainer {words}' for words in (*HERE, *SHOWN)}
    return here | PROGRAMS_OF_OWN.keys() | ELSEWHERE.keys() | scripted()


def is_covered(command: str, known: set[str]) -> bool:
    """Whether it is known, or a mere mention of one that is: some of its words, none other."""
    if command in known or command.startswith('ros2 '):
        return True
    words = command.split()
    return any(
        other.split()[:2] == words[:2] and set(words) <= set(other.split()) for other in known
    )


def test_every_documented_command_is_run_somewhere_or_has_a_reason() -> None:
    known, commands = covered(), documented()
    assert len(commands) > 60
    unknown = {c: page for c, page in commands.items() if not is_covered(c, known)}
    assert not unknown


def test_no_command_is_kept_that_the_documents_have_no_more() -> None:
    listed = {f'./trainer {w}' for w in (*HERE, *SHOWN)} | ELSEWHERE.keys() | PROGRAMS_OF_OWN.keys()
    assert listed <= documented().keys()


@pytest.mark.parametrize(
    'command', [c for c, how in ELSEWHERE.items() if isinstance(how, Elsewhere)], ids=str
)
def test_named_test_exists_and_has_the_words_of_the_command(command: str) -> None:
    how = ELSEWHERE[command]
    assert isinstance(how, Elsewhere)
    file, _, name = how.name.partition('::')
    trees = [ast.parse((ROOT / 'test' / f).read_text()) for f in (file, *how.files)]
    assert name in {n.name for n in trees[0].body if isinstance(n, ast.FunctionDef)}
    said = {
        part
        for tree in trees
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
        for part in node.value.split()
    }
    words = [w for w in command.split()[1:] if ':=' not in w and w not in ('BAG', 'run', 'python')]
    assert set(words) <= said


@pytest.mark.parametrize(
    'command', [c for c, how in ELSEWHERE.items() if isinstance(how, Script)], ids=str
)
def test_named_script_has_the_command(command: str) -> None:
    how = ELSEWHERE[command]
    assert isinstance(how, Script)
    assert (how.line or command) in (ROOT / how.file).read_text()


def test_script_for_what_takes_long_is_run_by_the_workflow_and_has_no_unknown_command() -> None:
    assert 'bash .ci/commands' in (ROOT / '.github' / 'workflows' / 'ci.yml').read_text()
    subprocess.run(['bash', '-n', str(ROOT / '.ci' / 'commands')], check=True)
    known = commands_of(cli.app) | {'setup', 'chart', 'validate'}
    for line in scripted():
        if line.startswith('./trainer bench '):
            assert line.split()[2] in commands_of(bench), line
        elif line.startswith('./trainer '):
            assert line.split()[1] in known, line


def commands_of(app: typer.Typer) -> set[str]:
    return set(get_command(app).commands)


def test_what_ros2_is_to_start_is_there_with_its_arguments() -> None:
    installed = (ROOT / 'CMakeLists.txt').read_text()
    for command in documented():
        words = command.split()
        if words[:3] == ['ros2', 'run', 'cutting_trainer']:
            assert f'install_executable({words[3]} ' in installed, command
        if words[:3] == ['ros2', 'launch', 'cutting_trainer']:
            said = (ROOT / 'launch' / words[3]).read_text()
            said += (ROOT / 'session' / 'launching.py').read_text()
            for argument in re.findall(r'(\w+):=', command):
                assert f"'{argument}'" in said, command


@pytest.fixture(scope='module')
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the commands name in it."""
    folder = tmp_path_factory.mktemp('checkout')
    shutil.copytree(SESSION, folder / 'BAG')
    (folder / 'bags').mkdir()
    (folder / 'bags' / 'samples').symlink_to(ROOT / 'bags' / 'samples')
    (folder / 'my_node.py').write_text('import rclpy, cutting_trainer_msgs\nprint("mine")\n')
    (folder / 'largest_force.py').write_text(LARGEST)
    trainer = folder / 'trainer'
    trainer.write_text(f'#!/bin/sh\nexec {sys.executable} -m cutting_trainer.cli.main "$@"\n')
    trainer.chmod(0o755)
    return folder


@pytest.mark.parametrize(
    'command',
    [pytest.param(c, marks=pytest.mark.thorough if c in COMPUTED_ALIKE else ()) for c in HERE],
)
def test_command_does_what_it_should(
    command: str, checkout: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(checkout)
    with pytest.raises(SystemExit) as stopped:
        cli.main(shlex.split(command))
    said, complaint = capfd.readouterr()
    differs = command == 'resimulate BAG' and not is_of_this_processor(SESSION)
    may_fail = differs or command == 'doctor'
    assert stopped.value.code in ((0, 1) if may_fail else (0, None)), complaint
    assert not differs or 'the processor is another one' in said
    for word in command.split():
        if re.fullmatch(r'\w+\.(png|html|vtu)|tables', word):
            assert (checkout / word).exists() and word in said.replace('\n', '')


@pytest.mark.parametrize(('command', 'answer'), PROGRAMS_OF_OWN.items())
def test_program_of_ones_own_runs(command: str, answer: str, checkout: Path) -> None:
    done = subprocess.run(
        command, shell=True, cwd=checkout, env=environment(0), capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    assert answer in done.stdout


def environment(domain: int) -> dict[str, str]:
    return node_environment(domain) | {'PYTHONUNBUFFERED': '1', 'COLUMNS': '200'}


@pytest.mark.parametrize(
    'command',
    [pytest.param(c, marks=pytest.mark.thorough if c in SERVED_ALIKE else ()) for c in SHOWN],
)
def test_page_is_served_until_ctrl_c(command: str, checkout: Path) -> None:
    with reserved_domain('free') as domain:
        pass
    viewing = subprocess.Popen(
        [*shlex.split(f'./trainer {command}'), '--port', '0'],
        cwd=checkout, env=environment(domain), stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        text=True,
    )  # fmt: skip
    try:
        said = list(until(viewing, SHOWN[command]))
        viewing.send_signal(signal.SIGINT)
        rest, _ = viewing.communicate(timeout=60)
    finally:
        viewing.kill()
    assert viewing.returncode == 0, [*said, rest]


def until(process: 'subprocess.Popen[str]', text: str) -> Iterator[str]:
    """The lines of a process up to one with a text in it."""
    assert process.stdout is not None
    for line in process.stdout:
        yield line
        if text in line:
            return
    raise AssertionError(f'the process ended without {text!r}')
