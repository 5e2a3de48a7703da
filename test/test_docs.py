"""The documents name what is there: commands, files, topics, keys."""

import ast
import re
import subprocess
import sys
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.main import get_command

from bench.commands import app as bench
from bench.reference import scenes as scene_reference
from cutting_trainer.cli.completion import LAUNCHERS_OWN
from cutting_trainer.cli.main import app
from cutting_trainer.haptic_bridge.scene_schema import DeviceSettings
from cutting_trainer.node_common import ros
from cutting_trainer.node_common.operating_state import crtk_types
from cutting_trainer.session.exit_status import Status

pytestmark = pytest.mark.long

ROOT = Path(__file__).resolve().parents[1]
PAGES = (
    *(ROOT / f'{name}.md' for name in ('README', 'CONTRIBUTING', 'SECURITY')),
    *sorted((ROOT / 'docs').glob('*.md')),
)
TEXTS = {page: page.read_text(encoding='utf-8') for page in PAGES}
CRTK = {'OperatingState': 'operating_state', 'StringStamped': 'command'}


def launched(*arguments: str) -> str:
    command = [sys.executable, str(ROOT / 'trainer'), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def options_of(command: Any) -> list[str]:
    return [option for p in command.params for option in (*p.opts, *p.secondary_opts)]


def measuring() -> set[str]:
    """Names of the commands of `./trainer bench`."""
    return set(get_command(bench).commands)


def test_every_command_and_option_in_the_documents_exists() -> None:
    commands = dict(get_command(app).commands)
    benches = get_command(bench).commands
    commands |= {f'bench {name}': command for name, command in benches.items()}
    commands['chart'] = benches['chart']
    commands['validate'] = benches['validate']
    known = {*commands, *LAUNCHERS_OWN}
    used: dict[str, set[str]] = {}
    for text in TEXTS.values():
        for command, rest in re.findall(r'\./trainer ((?:bench )?[a-z][\w-]*)([^`\n]*)', text):
            used.setdefault(command, set()).update(re.findall(r'(?<![\w-])--?\w[\w-]*', rest))
    assert {'demo', 'test', 'picture'} <= used.keys() <= known | {'bench'}
    for command, options in used.items():
        if command in commands and command not in ('test', 'run'):  # whose options are another's
            assert options <= {'--help', *options_of(commands[command])}, command


def test_options_that_the_readme_tells_of_exist() -> None:
    paragraph = next(p for p in TEXTS[ROOT / 'README.md'].split('\n\n') if p.startswith('`demo`'))
    options = set(re.findall(r'`(--\w+)`', paragraph))
    assert options and options <= {*options_of(get_command(app).commands['demo'])}


def anchors(page: Path) -> set[str]:
    headings = re.findall(r'^#+ (.+)$', page.read_text(encoding='utf-8'), re.MULTILINE)
    return {re.sub(r'[^\w\- ]', '', heading.lower()).replace(' ', '-') for heading in headings}


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.name)
def test_every_relative_link_leads_somewhere(page: Path) -> None:
    for target in re.findall(r'\]\(([^)]+)\)', TEXTS[page]):
        if target.startswith('https://'):
            continue
        path, _, anchor = target.partition('#')
        there = (page.parent / path).resolve() if path else page
        assert there.exists(), f'{page.name}: {target}'
        assert not anchor or anchor in anchors(there), f'{page.name}: {target}'


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.name)
def test_every_file_that_a_document_names_is_there(page: Path) -> None:
    folders = (
        r'(?:node_common|tissue_sim|haptic_bridge|cutting|bags|viewer|session|recordings|studies|'
        r'mesh_import|'
        r'cli|bench|config|launch|msg_defs|docs|test)'
    )
    for name in re.findall(rf'`({folders}/[\w./-]*\w\.(?:py|md|yaml|xml|msg|srv))`', TEXTS[page]):
        if name != 'config/devices/my_arm.yaml':
            assert (ROOT / name).is_file(), f'{page.name}: {name}'


@cache
def sources() -> dict[str, str]:
    """Text of each of our modules, by its path below the root."""
    folders = [ROOT / 'test', *(path.parent for path in ROOT.glob('*/__init__.py'))]
    paths = [path for folder in folders for path in folder.rglob('*.py')]
    return {f'/{path.relative_to(ROOT)}': path.read_text(encoding='utf-8') for path in paths}


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.name)
def test_every_module_and_method_that_a_document_names_is_there(page: Path) -> None:
    for name in re.findall(r'`((?:\w+/)*\w+\.py)`', TEXTS[page]):
        file = ROOT / name
        assert file.is_file() or any(path.endswith(f'/{name}') for path in sources()), name
    for owner, method in re.findall(r'`([A-Z]\w+)\.([a-z_]\w+)`', TEXTS[page]):
        homes = [text for text in sources().values() if re.search(rf'^class {owner}\b', text, re.M)]
        assert any(f'    def {method}(' in text for text in homes), f'{owner}.{method}'


# Topics and services: what the tables say, and what the nodes make.


BESIDE = (
    'crtk.py',
    'probe_node.py',
    'omni_node.py',
    'playback_publishers.py',
    'dds_loopback.py',
    'mesh_follower.py',
    'operator.py',
    'fuzz_graph.py',
)
"""Modules whose topics carry a device's name, or another's messages, or are counted below."""


def made() -> set[tuple[str, str]]:
    """Names and short types of what the sources publish or serve."""
    found = set()
    names = {'ros': ros, 'device': DeviceSettings(), 'self': SimpleNamespace(_prefix='')}
    for folder in ('node_common', 'tissue_sim', 'haptic_bridge', 'cutting', 'bags', 'session'):
        for path in (ROOT / folder).rglob('*.py'):
            for call in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
                maker = isinstance(call, ast.Call) and getattr(call.func, 'attr', '')
                if maker in ('create_publisher', 'create_service') and path.name not in BESIDE:
                    kind, name = (ast.unparse(argument) for argument in call.args[:2])
                    topic = eval(name, names | vars(ros))
                    found.add((topic.lstrip('/'), kind))
    # Of a device; the emulated arm has none.
    found |= {(f'{ros.ARM}/clutch', 'Joy'), (f'{ros.ARM}/jaw/measured_js', 'JointState')}
    found |= {(ros.MARKERS, 'MarkerArray'), (ros.HAND, 'PoseStamped')}  # of the viewer
    found |= {(ros.E_STOP, 'Empty'), (ros.DIAGNOSTICS.lstrip('/'), 'DiagnosticArray')}
    found |= {(service, 'GetMesh') for service in ros.MESH_RECOVERY_SERVICES}
    for owner in (ros.ARM, 'haptic_bridge'):
        found.add((f'{owner}/operating_state', 'OperatingState'))
        found.add((f'{owner}/state_command', 'StringStamped'))
    return found


def test_types_of_crtk_exist() -> None:
    for name, field in CRTK.items():
        assert getattr(crtk_types(), field).__name__ == name


def test_architecture_names_no_other_topics() -> None:
    text = TEXTS[ROOT / 'docs' / 'architecture.md']
    named = set(re.findall(r'`((?:arm|haptic_bridge|tissue|tool|cutting)/\w+)`', text))
    assert named <= {name for name, _ in made()}


# Scenes.


def test_scene_reference_is_that_of_the_models() -> None:
    text = TEXTS[scene_reference.FILE]
    assert scene_reference.MARK in text
    tables = text.partition(scene_reference.MARK)[2].strip()
    renew = 'run `python -m bench.reference.scenes`'
    assert tables == scene_reference.reference().strip(), renew


def test_every_section_of_a_scene_has_its_model() -> None:
    from cutting_trainer.node_common.scene_reader import SECTIONS

    assert tuple(scene_reference.MODELS) == SECTIONS


# Exit statuses.


def test_exit_statuses_are_those_of_the_commands_and_of_the_launcher() -> None:
    text = TEXTS[ROOT / 'docs' / 'troubleshooting.md'].partition('## Exit statuses')[2]
    rows = dict(re.findall(r'^\| (\d+) \| (.+) \|$', text, re.MULTILINE))
    assert {str(int(s)): s.meaning for s in Status}.items() <= rows.items()
    launcher = (ROOT / 'trainer').read_text(encoding='utf-8')
    numbers = re.findall(r'^(?:NO_\w+|DISK_FULL)[\w, ]* = ([\d, ]+)$', launcher, re.MULTILINE)
    own = {n for line in numbers for n in line.split(', ')}
    assert len(own) == 10 and own <= rows.keys()
    assert rows.keys() == own | {str(int(s)) for s in Status}


def test_every_test_that_the_table_of_hazards_names_exists() -> None:
    rows = [r for r in TEXTS[ROOT / 'docs' / 'hazards.md'].splitlines() if r.startswith('| ')]
    named = 0
    for row in rows:
        source = ''
        for file, name in re.findall(r'(test_\w+\.py)?(?:(?:::|, )(test_\w+)\b(?!\.py))?', row):
            if file:
                source = (ROOT / 'test' / file).read_text(encoding='utf-8')
            assert not name or f'def {name}(' in source, name
            named += bool(name)
    assert named > 50
