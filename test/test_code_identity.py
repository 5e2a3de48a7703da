"""A bag names the code that computed it, and what differs is told as what it is."""

import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
from numba.core.registry import cpu_target

from cutting_trainer.bags.errors import BagError
from cutting_trainer.bags.metadata import recorded_code
from cutting_trainer.node_common import code_identity
from cutting_trainer.node_common.code_identity import (
    CodeIdentity,
    hash_of_sources,
    identity_here,
    identity_of,
)


def test_the_hash_follows_names_and_bytes_of_the_sources_and_nothing_else(tmp_path: Path) -> None:
    folder = tmp_path / 'kernels'
    folder.mkdir()
    (folder / 'a.py').write_text('x = 1\n')
    first = hash_of_sources([folder])
    (folder / '__pycache__').mkdir()
    (folder / '__pycache__' / 'a.pyc').write_text('compiled')
    assert hash_of_sources([folder]) == first
    (folder / 'a.py').write_text('x = 2\n')
    assert hash_of_sources([folder]) != first
    (folder / 'a.py').write_text('x = 1\n')
    assert hash_of_sources([folder]) == first
    (folder / 'a.py').rename(folder / 'b.py')
    assert hash_of_sources([folder]) != first


def test_the_processor_is_the_one_that_numba_compiles_for() -> None:
    here = identity_here()
    _, target, features = cpu_target.target_context.codegen().magic_tuple()
    enabled = {word[1:] for word in features.split(',') if word.startswith('+')}
    assert (here.target, set(here.features.split(','))) == (target, enabled)
    assert here.cpu and here.numba and here.llvmlite and here.numpy and here.python


def test_a_checkout_names_its_commit_and_whether_files_have_changed(tmp_path: Path) -> None:
    def git(*words: str) -> None:
        who = ('-c', 'user.name=nobody', '-c', 'user.email=nobody@example.org')
        subprocess.run(['git', '-C', str(tmp_path), *who, *words], check=True, capture_output=True)

    assert code_identity._commit(tmp_path) == ''
    git('init')
    file = tmp_path / 'a.py'
    file.write_text('x = 1\n')
    git('add', 'a.py')
    git('commit', '-m', 'first')
    clean = code_identity._commit(tmp_path)
    assert len(clean) == 40 and not clean.endswith('+')
    file.write_text('x = 2\n')
    assert code_identity._commit(tmp_path) == f'{clean}+'


def test_an_identity_survives_the_bag_and_a_bag_of_before_names_none() -> None:
    here = identity_here()
    assert identity_of(here.flat() | {'scene': 'text'}) == here
    assert recorded_code(here.flat()) == here
    assert recorded_code({'format_version': '2', 'numba_version': '0.61'}) is None


def test_the_code_is_that_of_the_simulation_where_the_recorder_ran_elsewhere() -> None:
    there = replace(identity_here(), cpu='of the other host', target='other')
    words = '\n'.join(f"  {key}: '{text}'" for key, text in there.flat().items())
    data = identity_here().flat() | {'parameters': f'/tissue_sim:\n{words}\n'}
    assert recorded_code(data) == there
    with pytest.raises(BagError, match='parameters'):
        recorded_code(identity_here().flat() | {'parameters': '[: no YAML'})


@pytest.mark.parametrize(
    ('change', 'sentence'),
    [
        ({'kernels': 'f' * 64}, "the trainer's own kernels have changed: bag ffffffffffff"),
        ({'numba': '0.1'}, 'Numba has another version: bag 0.1, here '),
        ({'numpy': '1.0'}, 'NumPy has another version: bag 1.0, here '),
        ({'cpu': 'Other', 'target': 'other'}, 'the processor is another one: bag Other (other)'),
        ({'features': 'sse'}, 'the processor is another one: bag '),
    ],
)
def test_each_difference_is_told_as_what_it_is(change: dict[str, str], sentence: str) -> None:
    here = identity_here()
    told = replace(here, **change).differences(here)
    assert len(told) == 1 and told[0].startswith(sentence)
    assert replace(here, **change).rounds_otherwise_only(here) == ('kernels' not in change)


def test_a_commit_alone_is_no_difference() -> None:
    here = identity_here()
    assert replace(here, commit='0' * 40, version='9').differences(here) == []
    assert CodeIdentity(kernels='a').differences(here)
