"""The documents name what is there: commands, files, topics, keys."""

import ast
import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

from haptic_bridge.operating_state import crtk_types
from session import scene_reference
from session.status import Status
from tissue_sim import ros

ROOT = Path(__file__).resolve().parents[1]
PAGES = (ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', *sorted((ROOT / 'docs').glob('*.md')))
TEXTS = {page: page.read_text(encoding='utf-8') for page in PAGES}
CRTK = {'OperatingState': 'operating_state', 'StringStamped': 'command'}


def launched(*arguments: str) -> str:
    command = [sys.executable, str(ROOT / 'trainer'), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def help_of(command: str) -> str:
    module = [sys.executable, '-m', 'session.cli', command, '--help']
    done = subprocess.run(module, cwd=ROOT, capture_output=True, text=True, check=False)
    return done.stdout if done.returncode == 0 else ''


def test_every_command_and_option_in_the_documents_exists() -> None:
    known = set(re.findall(r'^  ([\w-]+) ', launched('--help'), re.MULTILINE))
    used: dict[str, set[str]] = {}
    for text in TEXTS.values():
        for command, rest in re.findall(r'\./trainer ([a-z][\w-]*)([^`\n]*)', text):
            used.setdefault(command, set()).update(re.findall(r'(?<![\w-])--?\w[\w-]*', rest))
    assert {'demo', 'test', 'picture'} <= used.keys() <= known
    for command, options in used.items():
        if options and command not in ('test', 'run'):  # whose options are another's
            shown = set(re.findall(r'--?\w[\w-]*', help_of(command)))
            assert options <= shown, command


def test_options_that_the_readme_tells_of_exist() -> None:
    paragraph = next(p for p in TEXTS[ROOT / 'README.md'].split('\n\n') if p.startswith('`demo`'))
    options = set(re.findall(r'`(--\w+)`', paragraph))
    assert options and options <= set(re.findall(r'--\w+', help_of('demo')))


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
        r'(?:tissue_sim|haptic_bridge|cutting|bags|viewer|session|config|launch|msg_defs|docs|test)'
    )
    for name in re.findall(rf'`({folders}/[\w./-]*\w\.(?:py|md|yaml|xml|msg|srv))`', TEXTS[page]):
        if name != 'config/devices/my_arm.yaml':
            assert (ROOT / name).is_file(), f'{page.name}: {name}'


# Topics and services: what the tables say, and what the nodes make.


def rows(page: Path, pattern: str) -> set[tuple[str, str]]:
    """Names and short types of a table: one row may name more than one topic."""
    found = set()
    for names, kind in re.findall(pattern, TEXTS[page], re.MULTILINE):
        for name in re.findall(r'`([^`]+)`', names):
            found.add((name.lstrip('/'), kind.rpartition('/')[2]))
    return found


BESIDE = (
    'crtk.py',
    'probe_node.py',
    'omni_node.py',
    'player_node.py',
    'dds_loopback.py',
    'mesh_follower.py',
    'operator.py',
    'fuzz_graph.py',
)
"""Modules whose topics carry a device's name, or another's messages, or are counted below."""


def made() -> set[tuple[str, str]]:
    """Names and short types of what the sources publish or serve."""
    found = set()
    for folder in ('tissue_sim', 'haptic_bridge', 'cutting', 'bags', 'session'):
        for path in (ROOT / folder).rglob('*.py'):
            for call in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
                maker = isinstance(call, ast.Call) and getattr(call.func, 'attr', '')
                if maker in ('create_publisher', 'create_service') and path.name not in BESIDE:
                    kind, name = (ast.unparse(argument) for argument in call.args[:2])
                    topic = eval(name, {'ros': ros, **vars(ros)})
                    found.add((topic.lstrip('/'), kind))
    found |= {(ros.MARKERS, 'MarkerArray'), (ros.HAND, 'PoseStamped')}  # of the viewer
    found |= {(service, 'GetMesh') for service in ros.MESH_KEEPERS}
    for owner in (ros.ARM, 'haptic_bridge'):
        found.add((f'{owner}/operating_state', 'OperatingState'))
        found.add((f'{owner}/state_command', 'StringStamped'))
    return found


def test_table_of_topics_in_the_readme_is_what_the_nodes_make() -> None:
    table = rows(ROOT / 'README.md', r'^\| (`[a-z/][^|]*`) \| (?:CRTK )?`([\w/]+)`')
    assert table == made()


def test_types_in_the_readme_exist() -> None:
    for full in re.findall(r'`(\w+/(?:msg|srv)/\w+)`', TEXTS[ROOT / 'README.md']):
        package, kind, name = full.split('/')
        assert hasattr(importlib.import_module(f'{package}.{kind}'), name), full
    for name, field in CRTK.items():
        assert getattr(crtk_types(), field).__name__ == name


def test_table_of_messages_in_the_architecture_names_no_other_topics() -> None:
    text = TEXTS[ROOT / 'docs' / 'architecture.md']
    named = set(re.findall(r'`((?:arm|haptic_bridge|tissue|tool|cutting)/\w+)`', text))
    assert named <= {name for name, _ in made()}


# Scenes.


def test_scene_reference_is_that_of_the_models() -> None:
    text = TEXTS[scene_reference.FILE]
    assert scene_reference.MARK in text
    tables = text.partition(scene_reference.MARK)[2].strip()
    renew = 'run `python -m session.scene_reference`'
    assert tables == scene_reference.reference().strip(), renew


def test_every_section_of_a_scene_has_its_model() -> None:
    from tissue_sim.scene_file import SECTIONS

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
