"""What `bench faults` plants: one draw for a seed, real programs, every kind; resuming."""

import ast
import itertools
import signal
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest

from bench.faults import run
from bench.faults.candidates import KINDS, Fault, draw
from bench.faults.copy import Copy, Outcome, read_outcome
from bench.faults.suspects import affected_functions, likely_tests

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[1]
COUNT = 40


@pytest.fixture(scope='module')
def drawn() -> list[Fault]:
    return draw(ROOT, COUNT, 3)


@pytest.mark.thorough
def test_a_seed_gives_one_draw_of_every_kind_from_kernels_and_nodes(drawn: list[Fault]) -> None:
    assert draw(ROOT, COUNT, 3) == drawn != draw(ROOT, COUNT, 4)
    assert [fault.kind for fault in drawn] == list(itertools.islice(itertools.cycle(KINDS), COUNT))
    assert {fault.kernel for fault in drawn} == {True, False}
    assert len({fault.room for fault in drawn}) >= 10


@pytest.mark.thorough
def test_a_planted_fault_changes_its_line_alone_and_compiles(drawn: list[Fault]) -> None:
    for fault in drawn:
        source = (ROOT / fault.path).read_text()
        lines, planted = source.split('\n'), fault.plant(source).split('\n')
        ast.parse('\n'.join(planted))
        changed = [
            n for n, pair in enumerate(zip(lines, planted, strict=True), 1) if len(set(pair)) > 1
        ]
        span = fault.old.count('\n') + 1
        assert changed and set(changed) <= set(range(fault.line, fault.line + span))
        with pytest.raises(ValueError, match='any more'):
            fault.plant(source[: source.index('\n')])


@pytest.mark.thorough
def test_tests_that_name_a_function_are_tried_first() -> None:
    fault = Fault('cutting/broad_phase.py', 1, 0, 'swept_boxes', True, 'sign', '', '')
    near = likely_tests(ROOT, fault)
    assert len(near) == len(list((ROOT / 'test').glob('test_*.py')))
    assert near[0].startswith('test/test_cutting') or 'broad_phase' in near[0]


def test_kernels_that_call_a_faulty_one_at_any_depth_are_compiled_again_and_no_others() -> None:
    sources = {
        'a.py': 'def f(x):\n    return x\ndef g(x):\n    return x\nTABLE = f(1)\n',
        'b.py': 'from a import f\ndef h(x):\n    return f(x)\ndef i(x):\n    return TABLE\n',
        'c.py': 'import b\ndef k(x):\n    return b.h(x)\ndef m(x):\n    return g(x)\n',
    }
    affected = affected_functions(sources, 'f')
    assert affected == {'a.py': {'f', 'TABLE'}, 'b.py': {'h', 'i'}, 'c.py': {'k'}}


def test_an_outcome_names_the_test_that_failed_or_that_a_limit_ended() -> None:
    text = 'test/test_a.py::test_x PASSED [ 50%]\ntest/test_b.py::test_y '
    assert read_outcome(text, -27, 1.0) == Outcome('test/test_b.py::test_y', 1.0, timed_out=True)
    failed = 'test/test_a.py::test_x[1-2] FAILED\nFAILED test/test_a.py::test_x[1-2] - assert 0\n'
    assert read_outcome(failed, 1, 1.0).failed == 'test/test_a.py::test_x[1-2]'
    assert read_outcome('test/test_a.py::test_x PASSED\n', 0, 1.0).failed is None


class StubCopy:
    """Stands for the copy: the likely tests find the first fault, the second fails one anyway."""

    root = ROOT
    interrupt_at = 2

    def __init__(self, *_: Path) -> None:
        self.runs = 0

    def other_commit(self) -> str:
        return ''

    def run(
        self, tests: list[str], tier: str, number: int, fault: Fault | None, *options: str
    ) -> Outcome:
        self.runs += 1
        if number == self.interrupt_at:
            raise KeyboardInterrupt
        if tier == 'quick':
            unreliable = '--deselect=test/test_x.py::test_x' in options
            return Outcome(None if number and unreliable else 'test/test_x.py::test_x', 1.0)
        return Outcome('test/test_x.py::test_x' if fault or number else None, 1.0)


@pytest.mark.thorough
def test_an_interrupted_run_goes_on_with_the_fault_it_was_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, drawn: list[Fault]
) -> None:
    monkeypatch.setattr(run, 'Copy', StubCopy)
    monkeypatch.setattr(signal, 'signal', lambda *_: None)
    faults = [replace(fault, kernel=False) for fault in drawn[:3]]  # tried in this order
    monkeypatch.setattr(run, 'draw', lambda *_: faults)
    with pytest.raises(KeyboardInterrupt):
        run.run_faults(ROOT, tmp_path, 3, 0, 'quick')
    state = tmp_path / 'seed-0.jsonl'
    first, second, third = run.load_trials(state, list)
    assert (first.verdict, first.test) == ('found', 'test/test_x.py::test_x')
    assert (second.verdict, second.unreliable) == ('survived', ['test/test_x.py::test_x'])
    assert third.verdict == ''
    monkeypatch.setattr(StubCopy, 'interrupt_at', -1)
    assert run.run_faults(ROOT, tmp_path, 3, 0, 'quick') == run.Status.FAILED
    again = run.load_trials(state, list)
    assert again[:2] == [first, second] and again[2].verdict == 'survived'


def test_a_run_goes_on_only_at_the_commit_it_began_with(tmp_path: Path) -> None:
    def git(*words: str) -> None:
        named = ('-c', 'user.name=a', '-c', 'user.email=a@b')
        subprocess.run(['git', *named, *words], cwd=tmp_path / 'checkout', check=True)

    (tmp_path / 'checkout').mkdir()
    git('init', '--quiet')
    (tmp_path / 'checkout' / 'file').touch()
    git('add', 'file')
    git('commit', '--quiet', '-m', 'one')
    copy = Copy(tmp_path / 'checkout', tmp_path / 'faults')
    assert copy.other_commit() == ''
    git('commit', '--quiet', '--allow-empty', '-m', 'two')
    assert (
        'give another --folder' in Copy(tmp_path / 'checkout', tmp_path / 'faults').other_commit()
    )
