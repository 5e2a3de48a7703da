"""The tissue on its way to a recorder and to the disk: parts of a state, and the checkpoint."""

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from cutting_trainer_msgs.msg import Mesh

from cutting_trainer.tissue_sim.simulation.checkpoint import Checkpoint, read_checkpoint
from cutting_trainer.tissue_sim.simulation.serialisation import ObjectState
from cutting_trainer.tissue_sim.streaming import state_publisher
from cutting_trainer.tissue_sim.streaming.state_publisher import StatePublisher, state_messages

DATA = bytes(range(11))
SECOND = 1_000_000_000


class Publisher:
    """Keeps what is published."""

    def __init__(self) -> None:
        self.messages: list[Any] = []
        self.subscribers = 0

    def publish(self, message: Any) -> None:
        self.messages.append(message)

    def get_subscription_count(self) -> int:
        return self.subscribers


@pytest.fixture(autouse=True)
def small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(state_publisher, '_MAX_PART_BYTES', 4)


def wait_for(what: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 20.0
    while not what():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_the_parts_of_a_state_are_its_bytes_in_order_and_none_is_too_large() -> None:
    messages = list(state_messages(ObjectState('tree', DATA), 7, 3 * SECOND + 5))
    assert b''.join(bytes(m.data) for m in messages) == DATA
    assert [(m.part, m.parts, m.step) for m in messages] == [(0, 3, 7), (1, 3, 7), (2, 3, 7)]
    assert [len(m.data) for m in messages] == [4, 4, 3]
    assert [m.tree for m in messages] == ['tree', '', '']
    assert (messages[0].header.stamp.sec, messages[0].header.stamp.nanosec) == (3, 5)
    (alone,) = state_messages(ObjectState('tree', b''), 7, 0)
    assert (alone.parts, bytes(alone.data)) == (1, b'')


def test_closing_waits_until_all_parts_of_a_state_are_published() -> None:
    publisher: Any = Publisher()
    states = StatePublisher(publisher)
    before = time.time()
    states.publish(ObjectState('tree', DATA), 7)
    states.close()
    assert b''.join(bytes(m.data) for m in publisher.messages) == DATA
    assert {m.step for m in publisher.messages} == {7}
    stamp = publisher.messages[0].header.stamp
    assert before - 1 < stamp.sec + stamp.nanosec / SECOND < time.time() + 1


def test_a_state_is_wanted_once_by_each_that_begins_to_listen(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(state_publisher, '_SUBSCRIPTION_DELAY_S', 0.05)
    publisher: Any = Publisher()
    states = StatePublisher(publisher)
    assert not states.is_wanted()
    for count in (1, 2):
        publisher.subscribers = count
        assert not states.is_wanted(), 'it does not hear the inputs yet'
        time.sleep(0.06)
        assert states.is_wanted()
        states.publish(ObjectState('tree', DATA), count)
        states.close()
        assert not states.is_wanted()


def test_a_checkpoint_is_the_newest_mesh_written_once(tmp_path: Path) -> None:
    path = tmp_path / 'mesh'
    assert read_checkpoint(path) == []
    before = set(threading.enumerate())
    checkpoint = Checkpoint(path)
    for step in (1, 2):
        checkpoint.offer(Mesh(step=step))
        wait_for(lambda step=step: [m.step for m in read_checkpoint(path)] == [step])
    time.sleep(0.05)
    written = path.stat()
    time.sleep(0.05)
    assert path.stat().st_ino == written.st_ino, 'nothing new was there to write'
    checkpoint.close()
    wait_for(lambda: set(threading.enumerate()) <= before)
    path.write_bytes(b'no mesh')
    assert read_checkpoint(path) == []
