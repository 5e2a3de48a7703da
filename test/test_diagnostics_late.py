"""A node whose loop leaves its executor no time is not silent on /diagnostics."""

from types import SimpleNamespace
from typing import Any

import pytest

ros = pytest.importorskip('cutting_trainer.node_common.ros')


class Clock:
    """A node without a graph, and the time."""

    def __init__(self) -> None:
        self.now = 0.0
        self.said: list[float] = []

    def create_publisher(self, *_: Any) -> SimpleNamespace:
        return SimpleNamespace(publish=lambda _: self.said.append(self.now))

    def create_timer(self, *_: Any, clock: Any) -> None:
        assert clock.clock_type == ros.ClockType.STEADY_TIME  # that of a simulation may stand still

    def get_fully_qualified_name(self) -> str:
        return '/a'


def test_a_loop_speaks_for_an_executor_that_is_late_and_for_no_other(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    node = Clock()
    monkeypatch.setattr(ros.time, 'monotonic', lambda: node.now)
    diagnostics = ros.Diagnostics(node, lambda: (b'\0', 'well', {}))
    for node.now in (0.5, 1.0, 1.4):
        diagnostics.catch_up()
    assert not node.said
    for node.now in (1.6, 2.0, 3.0, 3.2):
        diagnostics.catch_up()
    assert node.said == [1.6, 3.2]
    node.now = 4.5
    diagnostics.publish()  # the executor has its turn
    node.now = 5.9
    diagnostics.catch_up()
    assert node.said == [1.6, 3.2, 4.5]
