"""Figures of files: data that `repair` keeps of damaged bags, memory that hostile files take."""

import shutil
import tempfile
from pathlib import Path

from bench.figures.figure import Figure
from bench.files.commands import READING, run
from bench.files.damaged_bags import KINDS, damage, outcome, small_bag
from bench.files.hostile_bags import HOSTILE_BAGS
from bench.files.hostile_files import HOSTILE_YAML
from cutting_trainer.cli import bag_commands
from cutting_trainer.recordings import (
    html_report,
    picture,
    repair_command,
    resimulate_command,
)

SAMPLE = Path(__file__).parents[2] / 'bags' / 'samples' / 'format_7' / 'palpation'
TOPICS = ('/tissue/mesh', '/tissue/force', '/tool/contact')
COPIES = 36
MESSAGES, IN_CHUNK = 120, 10
BAGS = (
    *('zstd: 100 kB to 3 GB', 'zstd: 100 kB to 3 GB, says 1 kB', 'a chunk that says it is 2^60'),
    *('four billion empty structures', 'a type that contains itself', 'a mesh of words'),
)
SCENES = ('aliases', 'lists 900 deep', 'blocks 900 deep', 'ten megabytes')
MAX_MEMORY_MB = 500.0
"""Memory limit for a hostile file."""
LOADED = (bag_commands, html_report, picture, repair_command, resimulate_command)
"""Imported here, so that they do not count as memory of a file."""


def measure() -> list[Figure]:
    """Measure damaged copies of a bag, then hostile files."""
    with tempfile.TemporaryDirectory() as temporary:
        return [*_damaged(Path(temporary)), *_hostile(Path(temporary))]


def _damaged(folder: Path) -> list[Figure]:
    source = small_bag(SAMPLE, folder / 'small', TOPICS, MESSAGES, IN_CHUNK)
    kept = refused = 0
    for i in range(COPIES):
        bag = Path(shutil.copytree(source, folder / 'copy' / 'small'))
        damage(bag, KINDS[i % len(KINDS)], i)
        came = outcome(bag)
        kept += not came.missing
        refused += bool(came.refused)
        shutil.rmtree(folder / 'copy')
    share = kept / COPIES
    return [
        Figure(6, 'damaged bags of which all that readers get is kept', share, 1.0, 'at least',
               '', COPIES),
        Figure(6, 'repaired or called whole, and refused by a reader that checks', refused, 0,
               'at most', '', COPIES),
    ]  # fmt: skip


def _hostile(folder: Path) -> list[Figure]:
    ended = []
    for number, kind in enumerate(BAGS):
        bag = folder / str(number) / 'bag'
        HOSTILE_BAGS[kind](bag)
        ended.append(run(READING[('report', 'export mesh')[number % 2]](bag, folder)))
    for kind in SCENES:
        scene, text = folder / 'scene.yaml', HOSTILE_YAML[kind]
        scene.write_bytes(text if isinstance(text, bytes) else text.encode())
        ended.append(run(['plan', str(scene)]))
    sentences = sum(each.one_sentence for each in ended) / len(ended)
    memory = max(each.memory for each in ended)
    return [
        Figure(6, 'hostile files refused in one sentence', sentences, 1.0, 'at least', '',
               len(ended)),
        Figure(6, 'memory that a hostile file takes', memory, MAX_MEMORY_MB, 'at most', 'MB',
               len(ended)),
    ]  # fmt: skip
