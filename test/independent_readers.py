"""Our bags in the hands of two readers that share no code with us: `rosbags`, and `@mcap/core`, the
MCAP project's own reader under Node.

Node's packages are pinned in package-lock.json of test/mcap_core and installed into .trainer/ once.
"""

import hashlib
import json
import shutil
import struct
import subprocess
import warnings
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from rosbags.highlevel import AnyReader

from cutting_trainer.bags.reader import mcap_file, open_bag

ROOT = Path(__file__).parents[1]
LOG_TIME, REST = struct.Struct('<Q'), struct.Struct('<QI')


def mcap_core() -> Path:
    """The installed script; skips the test, with the reason, where there is none."""
    return installed('mcap_core') / 'read_bag.mjs'


@cache
def installed(name: str) -> Path:
    """Where the packages of a folder of test/ are; skips the test where there are none."""
    if not (shutil.which('node') and shutil.which('npm')):
        pytest.skip(f'node and npm are not installed: there is no {name}')
    source, home = ROOT / 'test' / name, ROOT / '.trainer' / name
    lock = (source / 'package-lock.json').read_bytes()
    marker = home / 'installed-lock.json'
    home.mkdir(parents=True, exist_ok=True)
    for file in source.iterdir():
        if file.is_file():
            shutil.copy(file, home)
    if not marker.is_file() or marker.read_bytes() != lock:
        command = ['npm', 'ci', '--ignore-scripts', '--no-audit', '--no-fund', '--prefix', home]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
        except subprocess.TimeoutExpired:
            pytest.skip(f'npm gets no packages within 60 s: there is no {name}')
        if done.returncode:
            pytest.skip(f'npm gets no packages: {done.stderr.strip().splitlines()[-1:]}')
        marker.write_bytes(lock)
    return home


Topics = dict[str, dict[str, Any]]
"""By topic: type, count, and hashes: `bytes` over log times and bytes, `rest` over the rest."""


def by_us(folder: Path) -> Topics:
    """What our reader finds in a bag."""
    topics: Topics = {}
    for m in open_bag(folder).messages():
        known = topics.get(m.topic) or _new(topics, m.topic, m.type)
        known['count'] += 1
        known['bytes'].update(LOG_TIME.pack(m.log_time) + m.data)
        known['rest'].update(REST.pack(m.publish_time, m.sequence))
    return _digested(topics)


def by_rosbags(folder: Path) -> list[tuple[str, str, int, bytes]]:
    """Topic, type, log time [ns] and bytes of each message; a warning is an error."""
    with warnings.catch_warnings(), AnyReader([folder]) as reader:
        warnings.simplefilter('error')
        return [(c.topic, c.msgtype, t, bytes(data)) for c, t, data in reader.messages()]


def check_by_rosbags(folder: Path, wanted: Topics) -> None:
    """Claims that rosbags finds in a bag what our reader does; it tells of no `rest`."""
    topics: Topics = {}
    for topic, kind, log_time, data in by_rosbags(folder):
        known = topics.get(topic) or _new(topics, topic, kind)
        known['count'] += 1
        known['bytes'].update(LOG_TIME.pack(log_time) + data)
    none = hashlib.sha256().hexdigest()
    assert _digested(topics) == {topic: seen | {'rest': none} for topic, seen in wanted.items()}


def check_by_mcap_core(wanted: Mapping[Path, Topics]) -> None:
    """Claims that @mcap/core finds in each bag what our reader does, by index and by stream."""
    paths = [str(mcap_file(folder)) for folder in wanted]
    command = ['node', str(mcap_core()), *paths]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    assert done.stderr == ''
    for (folder, topics), line in zip(wanted.items(), done.stdout.splitlines(), strict=True):
        said = json.loads(line)
        assert 'error' not in said, (folder, said)
        assert said['topics'] == topics, folder
        count = sum(seen['count'] for seen in topics.values())
        assert said['messageCount'] == said['streamed'] == count, folder
        assert said['chunkCount'] == said['indexes'] and said['done'], folder
        assert said['ordered'], folder


def _new(topics: Topics, topic: str, kind: str) -> dict[str, Any]:
    known = {'type': kind, 'count': 0, 'bytes': hashlib.sha256(), 'rest': hashlib.sha256()}
    return topics.setdefault(topic, known)


def _digested(topics: Topics) -> Topics:
    return {
        topic: seen | {name: seen[name].hexdigest() for name in ('bytes', 'rest')}
        for topic, seen in topics.items()
    }
