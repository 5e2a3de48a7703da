"""Frames of 20,000 triangles at 30 Hz, through the viewer to pages: how many come, what they cost.

Run `python -m bench.graph.view_frames [--seconds 10]`. A process stands for the simulation: a
sheet all of whose nodes move in each frame. `one never reads` has two pages, and the figures are
those of the other one.
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

from bench.graph.view_load import (
    PORT,
    SETTLING_TIME_S,
    TOKEN,
    URL,
    pause,
    viewer_process,
    viewer_time,
)
from bench.page.open_page import OpenPage, OtherProcess
from bench.page.stand_in import resident, sheet
from cutting_trainer.node_common.qos import LATCHED, UPDATES
from cutting_trainer.node_common.ros import FRAME, MESH, MESH_UPDATES
from cutting_trainer.node_common.timing import PeriodicLoop
from cutting_trainer.session.domain import reserved_domain
from cutting_trainer.session.node_commands import LOCAL, node_environment, viewer_command
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.session.supervisor import Supervisor
from cutting_trainer.tissue_sim.streaming.messages import packed
from cutting_trainer.viewer.access_control import TOKEN_VARIABLE

RATE_HZ = 30.0
CONDITIONS = {'1 page': (1, 0), '3 pages': (3, 0), '2, one never reads': (1, 1)}
"""Pages that read, and pages that do not."""


def simulate(domain: int) -> None:
    """Publish the sheet, and waves on it, until the process is ended."""
    rclpy.init(domain_id=domain, signal_handler_options=rclpy.SignalHandlerOptions.NO)
    node = Node('tissue_sim')
    tissue = sheet()
    rest, triangles = tissue.rest, tissue.triangles
    nodes, count = len(rest), len(triangles)
    mesh = Mesh(scene='sheet', revision=0, rest=packed('d', rest))
    mesh.displacement, mesh.fixed = packed('d', 0 * rest), packed('B', np.zeros(nodes))
    mesh.triangles, mesh.triangle_kind = packed('I', triangles), packed('B', np.zeros(count))
    mesh.header.frame_id = FRAME
    mesh.header.stamp = node.get_clock().now().to_msg()
    whole = node.create_publisher(Mesh, MESH, LATCHED)
    updates = node.create_publisher(MeshDelta, MESH_UPDATES, UPDATES)
    whole.publish(mesh)
    loop, moved, step = PeriodicLoop(RATE_HZ), 0 * rest, 0
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


def main() -> None:
    """Print one line a condition."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seconds', type=float, default=10.0)
    seconds = parser.parse_args().seconds
    columns = ('', 'frames [Hz]', 'viewer: share of a core', 'its memory grows by [MB]')
    out = Table(*columns)
    with reserved_domain('free') as domain, tempfile.TemporaryDirectory() as folder:
        os.environ.update(node_environment(domain) | {TOKEN_VARIABLE: TOKEN})
        spawn = multiprocessing.get_context('spawn')
        simulation = spawn.Process(target=simulate, args=(domain,), daemon=True)
        simulation.start()
        viewer = viewer_command(load_scene('block').path, LOCAL, PORT, session=False)
        with Supervisor([viewer], Path(folder) / 'log', dict(os.environ)) as supervisor:
            assert supervisor.start(), supervisor.outcome
            for name, (reading, stuck) in CONDITIONS.items():
                others = [OpenPage(URL, reads=False) for _ in range(stuck)]
                pages = OtherProcess(URL, reading, 0)
                pause(supervisor, SETTLING_TIME_S)
                began, busy, before = (
                    time.monotonic(),
                    viewer_time(supervisor),
                    resident(viewer_process(supervisor)),
                )
                pause(supervisor, seconds)
                share = (viewer_time(supervisor) - busy) / (time.monotonic() - began)
                grown = resident(viewer_process(supervisor)) - before
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
