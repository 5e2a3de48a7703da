"""Two independent readers read every bag that the tests of this run have made; it runs last.

Bags are found where the tests make them, in pytest's folder of temporary files: `trainer test` has
one for each part. One that was cut off, as a test wanted it, is repaired first, in a
copy.
"""

import shutil
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import pytest
from independent_readers import (
    ROOT,
    Topics,
    by_us,
    check_by_mcap_core,
    check_by_rosbags,
    mcap_core,
)

from cutting_trainer.bags.errors import BagError
from cutting_trainer.bags.reader import open_bag
from cutting_trainer.bags.repair import repair_bag

pytestmark = pytest.mark.alone

MAGIC = b'\x89MCAP0\r\n'


@pytest.fixture(scope='module')
def every_bag(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> dict[Path, Topics]:
    """What our reader finds in the samples and in all bags made so far, whole or made whole."""
    found = {path.parent: path for path in ROOT.glob('bags/samples/*/*/*.mcap')}
    known = {path.read_bytes() for path in found.values()}
    made, mended = tmp_path_factory.getbasetemp(), tmp_path_factory.mktemp('mended')
    if request.config.getoption('part'):
        made = made.parent
    for path in sorted(made.rglob('*.mcap')):
        data = path.read_bytes()
        if data in known or not data.startswith(MAGIC):
            continue  # a copy, or what a test has passed off as a bag
        known.add(data)
        folder = path.parent
        try:
            bag = open_bag(folder)
        except BagError:
            continue  # refused: tests of damage and of lacking files claim that
        if len(list(folder.glob('*.mcap'))) > 1:
            continue  # the reader of one file has no other; test_bag_order.py reads several
        if not data.endswith(MAGIC):
            if not bag.span[0]:
                continue  # it was cut off before its first chunk was written
            folder = shutil.copytree(folder, mended / str(len(found)) / folder.name)
            assert not repair_bag(folder).whole, path
        assert open_bag(folder).complete, path
        found[folder] = path
    with processes() as several:
        return dict(zip(found, several.map(by_us, found), strict=True))


def processes() -> ProcessPoolExecutor:
    """One for each processor, without the threads that this one has by now."""
    return ProcessPoolExecutor(mp_context=get_context('spawn'))


def test_rosbags_reads_every_bag_as_we_do(every_bag: dict[Path, Topics]) -> None:
    with processes() as several:
        list(several.map(check_by_rosbags, every_bag, every_bag.values()))


@pytest.mark.thorough
def test_mcap_core_reads_every_bag_as_we_do_by_index_and_by_stream(
    every_bag: dict[Path, Topics],
) -> None:
    mcap_core()
    shares = [dict(list(every_bag.items())[i::4]) for i in range(4)]
    with processes() as several:
        list(several.map(check_by_mcap_core, filter(None, shares)))
