"""Claims about the page's connection and its E-STOP, with a network and a clock that are none."""

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from cutting_trainer import viewer

NODE = shutil.which('node')
pytestmark = pytest.mark.skipif(NODE is None, reason='needs node: sudo apt install nodejs')


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    static = Path(viewer.__file__).parent / 'static'
    for name in ('connection', 'stop'):
        shutil.copy(static / f'{name}.js', tmp_path / f'{name}.mjs')
    shutil.copy(Path(__file__).with_name('page_socket.mjs'), tmp_path)
    return tmp_path


def outcome(folder: Path, case: str) -> Any:
    command = [str(NODE), str(folder / 'page_socket.mjs'), case]
    return json.loads(subprocess.run(command, check=True, capture_output=True, timeout=60).stdout)


def test_a_stop_into_a_silent_network_is_sent_again_until_the_server_says_that_it_holds(
    folder: Path,
) -> None:
    found = outcome(folder, 'silence')
    assert found['into'] >= 16
    assert found['first'] == 'e_stop'  # of the next socket
    assert found['again'] >= 10 and found['after'] == 0
    assert 'not confirmed' in found['warnings'][0]
    assert any('NOT SENT' in text for text in found['warnings'])


def test_a_stop_is_not_given_up_while_nobody_confirms_it_and_does_not_come_back_after_a_reset(
    folder: Path,
) -> None:
    found = outcome(folder, 'restart')
    assert found['unheard'] > 60 and found['reset'] == 0
    assert len(found['warnings']) >= 4  # a warning is shown for 8 s


def test_a_stop_that_is_pressed_while_one_holds_waits_for_an_answer_of_its_own(
    folder: Path,
) -> None:
    found = outcome(folder, 'held')
    assert found['unheard'] >= 4 and found['reset'] == 0


def test_a_handshake_without_an_answer_is_given_up_and_tried_again(folder: Path) -> None:
    assert outcome(folder, 'connecting') == {'sockets': 2, 'closed': 2, 'status': 'open'}


def test_after_refused_handshakes_the_page_says_that_its_link_may_be_old(folder: Path) -> None:
    found = outcome(folder, 'refused')
    assert found['said'][:2] == ['', '']
    assert all('link is an old one' in text for text in found['said'][2:])
    assert found['at_last'] == ''
