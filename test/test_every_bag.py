"""Two independent readers read every bag that the tests of this run have made; it runs last.

Bags are found where the tests make them, in pytest's folder of temporary files. One that was cut
off, as a test wanted it, is repaired first, in a copy.
"""

import shutil
from pathlib import Path

import pytest
from independent_readers import ROOT, Topics, by_us, check_by_mcap_core, check_by_rosbags

from bags.reader import open_bag
from bags.repair import repair_bag

MAGIC = b'\x89MCAP0\r\n'


@pytest.fixture(scope='module')
def every_bag(tmp_path_factory: pytest.TempPathFactory) -> dict[Path, Topics]:
    """What our reader finds in the samples and in all bags made so far, whole or made whole."""
    found = {path.parent: path for path in ROOT.glob('bags/samples/*/*/*.mcap')}
    known = {path.read_bytes() for path in found.values()}
    made, mended = tmp_path_factory.getbasetemp(), tmp_path_factory.mktemp('mended')
    for path in sorted(made.rglob('*.mcap')):
        data = path.read_bytes()
        if data in known or not data.startswith(MAGIC):
            continue  # a copy, or what a test has passed off as a bag
        known.add(data)
        folder = path.parent
        if not data.endswith(MAGIC):
            if not open_bag(folder).span[0]:
                continue  # it was cut off before its first chunk was written
            folder = shutil.copytree(folder, mended / str(len(found)) / folder.name)
            assert not repair_bag(folder).whole, path
        assert open_bag(folder).complete, path
        found[folder] = path
    return {folder: by_us(folder) for folder in found}


def test_rosbags_reads_every_bag_as_we_do(every_bag: dict[Path, Topics]) -> None:
    for folder, topics in every_bag.items():
        check_by_rosbags(folder, topics)


def test_mcap_core_reads_every_bag_as_we_do_by_index_and_by_stream(
    every_bag: dict[Path, Topics],
) -> None:
    check_by_mcap_core(every_bag)
