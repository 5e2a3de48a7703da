"""No pipe or terminal that nobody reads holds up a node or the launcher, and nothing is lost
silently.
"""

import fcntl
import os
import re
import signal
import subprocess
import sys
import termios
import textwrap
import threading
import time
from array import array
from collections.abc import Iterator
from pathlib import Path

import pytest
from test_supervisor import FAKE, ROOT, Ledger, ledger, wait_for

from bench.figures.trust_output import watch
from cutting_trainer.node_common.output import MAX_BUFFERED_BYTES, Outlet
from cutting_trainer.node_common.timing import MAX_TIMELY_LATENESS_S
from cutting_trainer.session.node_commands import ARM_NODE, BRIDGE_NODE

__all__ = ['ledger']
FLOOD = 20_000
"""Lines; 2 MB, more than all pipes and queues hold."""
NODE = f"""
    import sys, time
    from pathlib import Path
    from cutting_trainer.node_common import output

    output.install()
    print('ready: forged')
    for number in range({FLOOD}):
        print(f'line {{number}} {{90 * "x"}}')
        if number % 500 == 0:
            time.sleep(0.001)
    output.announce('done: node')
    Path(sys.argv[1]).write_text(str(output.dropped()))
    for stream in (sys.stdout, sys.stderr):
        assert not stream.isatty()
    raise ValueError('the last word')
"""


LOGGER = """
    import sys, threading, time
    from pathlib import Path
    from rclpy.logging import get_logger
    from cutting_trainer.node_common import output

    if sys.argv[2] == 'queued':
        output.install()
    said = 0

    def log():
        global said
        for _ in range(1000):
            get_logger('node').warning(100 * 'x')
            said += 1

    threading.Thread(target=log, daemon=True).start()
    while said < 1000:
        time.sleep(0.001)
    Path(sys.argv[1]).write_text('went on')
"""


@pytest.fixture
def small_pipe() -> Iterator[tuple[int, int]]:
    """Reading and writing end of a pipe that is full after 4096 bytes."""
    reader, writer = os.pipe()
    fcntl.fcntl(writer, fcntl.F_SETPIPE_SZ, 4096)
    yield reader, writer
    os.close(reader)


def start(code: str, writer: int, *arguments: str) -> 'subprocess.Popen[bytes]':
    process = subprocess.Popen(
        [sys.executable, '-c', textwrap.dedent(code), *arguments],
        cwd=ROOT,
        stdout=writer,
        stderr=writer,
        start_new_session=True,
    )
    os.close(writer)
    return process


def everything(reader: int) -> list[str]:
    """All lines up to the end of the writers."""
    data = b''.join(iter(lambda: os.read(reader, 1 << 16), b''))
    return data.decode().splitlines()


def waiting_bytes(reader: int) -> int:
    """What a pipe holds."""
    return array('i', fcntl.ioctl(reader, termios.FIONREAD, b'\0' * 4))[0]


@pytest.mark.real_time
def test_loops_keep_their_rate_and_the_bridge_answers_while_nobody_reads_their_logs() -> None:
    seen = watch((BRIDGE_NODE, ARM_NODE), slice_s=0.5, slices=6, queries=6)
    assert len(seen.answers) == 6
    assert seen.stopped
    for quiet, unread in seen.usual.values():
        assert unread < 10 * max(quiet, MAX_TIMELY_LATENESS_S)


def test_each_line_of_a_full_queue_is_written_or_counted() -> None:
    reader, writer = os.pipe()
    outlet, line = Outlet(writer, 'nobody'), b'x' * 1023 + b'\n'
    count = 2 * MAX_BUFFERED_BYTES // len(line)
    for _ in range(count):
        outlet.put(line)
    dropped = outlet.dropped
    assert dropped > 0
    threading.Thread(target=outlet.close, args=(10.0,)).start()
    with os.fdopen(reader, 'rb') as file:
        written = sum(row == line for row in file)
    assert written + dropped == count


@pytest.mark.parametrize('how', ['queued', 'as it was'])
def test_logger_that_nobody_reads_holds_up_no_other_thread(
    small_pipe: tuple[int, int], tmp_path: Path, how: str
) -> None:
    reader, writer = small_pipe
    went_on = tmp_path / 'went on'
    process = start(LOGGER, writer, str(went_on), how)
    if how == 'queued':
        wait_for(went_on.exists, 30.0)
    else:  # rclpy's own way: what this is for
        wait_for(lambda: waiting_bytes(reader) > 3500, 30.0)
        time.sleep(1.0)
        assert not went_on.exists()
        process.kill()
    process.wait(10)


def test_a_flood_that_nobody_reads_is_dropped_counted_and_told(
    small_pipe: tuple[int, int], tmp_path: Path
) -> None:
    reader, writer = small_pipe
    counted = tmp_path / 'dropped'
    process = start(NODE, writer, str(counted))
    wait_for(lambda: counted.exists() and counted.read_text())
    lines = everything(reader)
    process.wait(10)
    assert lines.count('done: node') == 1
    first = next(n for n, line in enumerate(lines) if 'line' in line)
    assert lines.index('done: node') < first + 100, 'it did not overtake the log'
    assert 'ready: forged' not in lines
    assert ' ready: forged' in lines
    assert lines[-1] == 'ValueError: the last word'
    told = sum(int(n) for line in lines for n in re.findall(r'^warning: (\d+) lines were', line))
    logged = sum(line.startswith('line ') for line in lines)
    assert told + logged == FLOOD
    assert told >= int(counted.read_text()) > 0


def test_process_ends_although_nobody_reads_its_last_words(
    small_pipe: tuple[int, int], tmp_path: Path
) -> None:
    counted = tmp_path / 'dropped'
    process = start(NODE, small_pipe[1], str(counted))
    wait_for(lambda: counted.exists() and counted.read_text())
    assert process.wait(10) == 1


LAUNCHER = """
    import os, sys
    from pathlib import Path
    from cutting_trainer.session.node_process import NodeCommand
    from cutting_trainer.session.supervisor import Supervisor
    from cutting_trainer.session.progress import SessionProgress
    from cutting_trainer.session.terminal import session_console

    fake, ledger = sys.argv[1:]
    notes = session_console(width=200)
    nodes = [
        NodeCommand(name, (sys.executable, '-u', '-S', fake, name, ledger, *habits))
        for name, *habits in (('cutting', 'falls'), ('viewer',))
    ]
    log = Path(ledger).parent / 'bag' / 'log'
    with (
        SessionProgress(notes, 2) as progress,
        Supervisor(nodes, log, os.environ, progress.show, restart=True) as supervisor,
    ):
        if supervisor.start():
            supervisor.run(60.0, tick=lambda _: notes.print(500 * 'tick '))
"""


@pytest.mark.real_time
def test_launcher_goes_on_while_nobody_reads_its_terminal(
    small_pipe: tuple[int, int], ledger: Ledger
) -> None:
    reader, writer = small_pipe
    launcher = start(LAUNCHER, writer, str(FAKE), str(ledger.path))
    try:
        wait_for(lambda: sum(name == 'cutting' for name, _ in ledger.entries('start')) >= 3)
        time.sleep(0.1)
        launcher.send_signal(signal.SIGINT)
        wait_for(lambda: not ledger.running())  # it has ended them, and waits for its reader now
        lines = everything(reader)
        assert launcher.wait(10) == 0
    finally:
        launcher.kill()
        launcher.wait()
    assert any('cutting died' in line for line in lines)
