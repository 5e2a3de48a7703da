"""Frames of 20,000 triangles at 30 Hz, through the viewer to pages: how many come, what they cost.

Run `python -m bench.view_frames [--seconds 10]`. A process stands for the simulation: a sheet all
of whose nodes move in each frame. `one never reads` has two pages, and the figures are those of
the other one.
"""

import argparse
import multiprocessing
import os
import tempfile
import time
from pathlib import Path

import numpy as np
import rclpy
from cutting_trainer_msgs.msg import Mesh, MeshDelta
from rclpy.node import Node
from rich.console import Console
from rich.table import Table

from bench.open_page import OpenPage, OtherProcess
from bench.view_load import PORT, SETTLING, pause, viewer_process, viewer_time
from session.domain import reserved_domain
from session.graph import LOCAL, node_environment, viewer_command
from session.processes import Supervisor
from session.scene import load_scene
from tissue_sim.messages import packed
from tissue_sim.ros import FRAME, LATCHED, MESH, MESH_UPDATES, UPDATES
from tissue_sim.timing import PeriodicLoop

SQUARES = 100
"""Along an edge of the sheet: 20,000 triangles."""
RATE = 30.0
CONDITIONS = {'1 page': (1, 0), '3 pages': (3, 0), '2, one never reads': (1, 1)}
"""Pages that read, and pages that do not."""


def sheet() -> tuple[np.ndarray, np.ndarray]:
    """Nodes [m], shape (n, 3), and triangles, shape (k, 3)."""
    line = np.linspace(0.0, 0.1, SQUARES + 1)
    x, y = np.meshgrid(line, line)
    row = np.arange(SQUARES)
    a = (row[:, None] * (SQUARES + 1) + row).ravel()
    b, c, d = a + 1, a + SQUARES + 1, a + SQUARES + 2
    triangles = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])
    return np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1), triangles


def simulate(domain: int) -> None:
    """Publishes the sheet, and waves on it, until the process is ended."""
    rclpy.init(domain_id=domain, signal_handler_options=rclpy.SignalHandlerOptions.NO)
    node = Node('tissue_sim')
    rest, triangles = sheet()
    nodes, count = len(rest), len(triangles)
    mesh = Mesh(scene='sheet', revision=0, rest=packed('d', rest))
    mesh.displacement, mesh.fixed = packed('d', 0 * rest), packed('B', np.zeros(nodes))
    mesh.triangles, mesh.triangle_kind = packed('I', triangles), packed('B', np.zeros(count))
    mesh.header.frame_id = FRAME
    mesh.header.stamp = node.get_clock().now().to_msg()
    whole = node.create_publisher(Mesh, MESH, LATCHED)
    updates = node.create_publisher(MeshDelta, MESH_UPDATES, UPDATES)
    whole.publish(mesh)
    loop, moved, step = PeriodicLoop(RATE), 0 * rest, 0
    loop.start()
    while True:
        loop.wait()
        if not updates.get_subscription_count():
            continue
        moved[:, 2] = 0.002 * np.sin(100 * rest[:, 0] - 0.2 * step)
        delta = MeshDelta(base_revision=step, revision=step + 1, node_count=nodes)
        delta.triangle_count, delta.displacement = count, packed('d', moved)
        delta.header.frame_id = FRAME
        delta.header.stamp = node.get_clock().now().to_msg()
        updates.publish(delta)
        step += 1


def memory(supervisor: Supervisor) -> float:
    """Of the viewer [MB]."""
    words = Path(f'/proc/{viewer_process(supervisor)}/statm').read_text().split()
    return int(words[1]) * os.sysconf('SC_PAGE_SIZE') / 1e6


def main() -> None:
    """Prints one line a condition."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seconds', type=float, default=10.0)
    seconds = parser.parse_args().seconds
    columns = ('', 'frames [Hz]', 'viewer: share of a core', 'its memory grows by [MB]')
    out = Table(*columns)
    url = f'http://{LOCAL}:{PORT}'
    with reserved_domain('free') as domain, tempfile.TemporaryDirectory() as folder:
        os.environ.update(node_environment(domain))
        spawn = multiprocessing.get_context('spawn')
        simulation = spawn.Process(target=simulate, args=(domain,), daemon=True)
        simulation.start()
        viewer = viewer_command(load_scene('block').path, LOCAL, PORT, session=False)
        with Supervisor([viewer], Path(folder) / 'log', dict(os.environ)) as supervisor:
            assert supervisor.start(), supervisor.outcome
            for name, (reading, stuck) in CONDITIONS.items():
                others = [OpenPage(url, reads=False) for _ in range(stuck)]
                pages = OtherProcess(url, reading, 0)
                pause(supervisor, SETTLING)
                began, busy, before = time.monotonic(), viewer_time(supervisor), memory(supervisor)
                pause(supervisor, seconds)
                share = (viewer_time(supervisor) - busy) / (time.monotonic() - began)
                grown = memory(supervisor) - before
                rates = pages.close()['rates']
                out.add_row(
                    name, ', '.join(f'{r:.1f}' for r in rates), f'{share:.2f}', f'{grown:.1f}'
                )
                for page in others:
                    page.close()
        simulation.terminate()
    Console().print(out)


if __name__ == '__main__':
    main()
