"""Our bags in the hands of the MCAP project's own reader under Node, which shares no code with us.

Its packages are pinned in test/mcap_core/package-lock.json and installed into .trainer/ once.
"""

import hashlib
import json
import shutil
import subprocess
from pathlib import Path

import pytest

from bags.reader import open_bag
from bags.repair import repair_bag

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / 'test' / 'mcap_core'
SAMPLES = sorted(path.parent for path in ROOT.glob('bags/samples/*/*/metadata.yaml'))


@pytest.fixture(scope='session')
def reader() -> Path:
    """The installed script, or the reason why there is none."""
    if not (shutil.which('node') and shutil.which('npm')):
        pytest.skip('node and npm are not installed: @mcap/core cannot read the bags')
    home = ROOT / '.trainer' / 'mcap_core'
    lock = (SOURCE / 'package-lock.json').read_bytes()
    marker = home / 'installed-lock.json'
    home.mkdir(parents=True, exist_ok=True)
    for file in SOURCE.iterdir():
        if file.is_file():
            shutil.copy(file, home)
    if not marker.is_file() or marker.read_bytes() != lock:
        command = ['npm', 'ci', '--ignore-scripts', '--no-audit', '--no-fund', '--prefix', home]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
        except subprocess.TimeoutExpired:
            pytest.skip('npm gets no packages within 60 s: @mcap/core cannot read the bags')
        if done.returncode:
            pytest.skip(f'npm gets no packages: {done.stderr.strip().splitlines()[-1:]}')
        marker.write_bytes(lock)
    return home / 'read_bag.mjs'


def read_by_mcap_core(script: Path, folder: Path) -> tuple[list[list[object]], dict[str, object]]:
    done = subprocess.run(
        ['node', str(script), str(next(folder.glob('*.mcap')))],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert done.stderr == ''
    *messages, summary = map(json.loads, done.stdout.splitlines())
    return messages, summary


def expected(folder: Path) -> list[list[object]]:
    return [
        [
            *(m.topic, m.type, str(m.log_time), str(m.publish_time), m.sequence),
            hashlib.sha256(m.data).hexdigest(),
        ]
        for m in open_bag(folder).messages()
    ]


def check(script: Path, folder: Path) -> None:
    messages, summary = read_by_mcap_core(script, folder)
    wanted = expected(folder)
    assert sorted(map(tuple, messages)) == sorted(map(tuple, wanted))
    assert [m[2] for m in messages] == [m[2] for m in wanted]
    assert summary['messageCount'] == summary['streamed'] == str(len(wanted))
    assert summary['chunkCount'] == summary['indexes'] and summary['done']


@pytest.mark.parametrize('folder', SAMPLES, ids=lambda path: path.name)
def test_mcap_core_reads_every_sample_by_index_and_by_stream(reader: Path, folder: Path) -> None:
    check(reader, folder)


def test_mcap_core_reads_a_repaired_bag(reader: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(SAMPLES[0], tmp_path / 'bag')
    (path,) = folder.glob('*.mcap')
    with path.open('r+b') as file:
        file.truncate(path.stat().st_size - 1000)
    assert not repair_bag(folder).whole
    check(reader, folder)
