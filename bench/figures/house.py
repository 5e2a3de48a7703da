"""Figures of the source: its words, its lines, and that recorded sessions compute as before."""

import subprocess
import sys
from pathlib import Path

from bench.figures.figure import Figure
from bench.terminology import ROOT, docstrings, replaced_names, summaries_without_verb, what_clauses

PRODUCT_BEFORE, REPOSITORY_BEFORE = 48_519, 81_581
"""Lines of Python at commit 257699d, before the modules were moved."""
MAX_WHAT = 1.0
"""Docstrings of other libraries say "what" 0.1 times in a thousand words."""
SAMPLES = ('palpation', 'straight_cut')
"""Bags of bags/samples/format_7 that are computed again."""
_NOT_INSTALLED = ('test', 'bench', 'launch', 'setup.py', 'trainer')


def measure() -> list[Figure]:
    """Return the figures of lines 2, 3 and 5."""
    return [*_words(), *_lines(), *_sessions()]


def _words() -> list[Figure]:
    what, words = what_clauses()
    texts = sum(1 for _ in docstrings())
    return [
        Figure(2, 'names with a word of their own', len(replaced_names()), 0, 'at most', '', texts),
        Figure(
            2,
            '"what" in 1000 words of docstrings',
            1e3 * what / words,
            MAX_WHAT,
            'at most',
            '',
            words,
        ),
        Figure(
            2, 'summaries without a verb', len(summaries_without_verb()), 0, 'at most', '', texts
        ),
    ]


def _lines() -> list[Figure]:
    listed = subprocess.run(
        ['git', 'ls-files', '*.py', 'trainer'],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split()
    files = [Path(name) for name in listed if not (ROOT / name).is_symlink()]
    lines = {file: (ROOT / file).read_bytes().count(b'\n') for file in files}
    product = sum(count for file, count in lines.items() if file.parts[0] not in _NOT_INSTALLED)
    return [
        Figure(
            3,
            'lines that the product lost',
            PRODUCT_BEFORE - product,
            8000,
            'at least',
            '',
            len(files),
        ),
        Figure(
            3,
            'lines that the repository lost',
            REPOSITORY_BEFORE - sum(lines.values()),
            3000,
            'at least',
            '',
            len(files),
        ),
    ]


def _sessions() -> list[Figure]:
    same = sum(_is_identical(ROOT / 'bags' / 'samples' / 'format_7' / name) for name in SAMPLES)
    name = 'recorded sessions computed again, exactly or but for rounding'
    return [Figure(5, name, same, len(SAMPLES), 'at least', '', len(SAMPLES))]


def _is_identical(bag: Path) -> bool:
    command = [sys.executable, '-m', 'cutting_trainer.cli', 'resimulate', str(bag)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, check=False).returncode == 0
