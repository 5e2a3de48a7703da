"""The cutting node is killed with the blade in the tissue, and started again: the cut goes on."""

import signal
import subprocess
from collections.abc import Iterator
from typing import Any

import meshio
import pytest
from cutting_trainer_msgs.msg import ForceSample
from live import (
    ROOT,
    SPOT,
    LiveSession,
    Recording,
    deaths,
    free_domain,
    onlooker,
    phase,
    wait_for,
    write_scene,
)
from meshes import irregular_box

from cutting_trainer.bags.reader import open_bag
from cutting_trainer.cutting.cut_invariants import check_mesh, cut_faces
from cutting_trainer.node_common.ros import FORCE, take
from cutting_trainer.session.exit_status import Status
from cutting_trainer.session.node_commands import node_environment
from cutting_trainer.tissue_sim.contact.tool import ContactState
from cutting_trainer.tissue_sim.mesh.replica import MeshReplica
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh

pytestmark = [pytest.mark.real_time, pytest.mark.thorough]

SECONDS = 48.0
"""Longer than it takes, even on a busy machine: the test interrupts the session."""
UNDER_WAY = 0.5
"""[s] in which what the killed process had answered has arrived."""
MAX_TRIES = 10
"""Refusals of the new process, of one frame each, while it has no mesh yet."""


def slow_cut() -> list[Any]:
    """In at one side, and ever more slowly through the block."""
    x, y = SPOT[0], 0.003
    middle, end = (-0.004, y, 0.007), (0.019, y, 0.007)
    return [
        phase('approach', (x, y, 0.018, 1.0), share=1.0),
        phase('cut', (x, y, 0.005, 1.0), (x, y, 0.007, 0.5), (*middle, 3.0), share=4.0),
        phase('cut', (*end, 1.0), share=42.0),
        phase('retract', (*end[:2], 0.040, 1.0), share=1.0),
    ]


@pytest.fixture(scope='module')
def session(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveSession]:
    folder = tmp_path_factory.mktemp('restart')
    nodes, tetrahedra = irregular_box((10, 10, 3), 0.004, 1, jitter=0.1)
    nodes[:, :2] -= 0.02
    nodes[:, 2] *= 0.010 / 0.012
    mesh = folder / 'block.msh'
    meshio.write_points_cells(mesh, nodes, [('tetra', tetrahedra)], file_format='gmsh')
    scene = write_scene(folder, slow_cut(), SECONDS, 0.2, 'combined', mesh=mesh)
    session = LiveSession(folder, scene, free_domain())
    yield session
    session.clean()


def wait_for_topology(session: LiveSession, least: int) -> int:
    """Returns the number of changes by cuts once there are so many, the blade being inside."""
    with onlooker(session.domain, ForceSample, FORCE) as samples:

        def has_cut() -> int:
            assert session.launcher.poll() is None, session.said
            sample = take(samples)
            inside = sample is not None and sample.state == ContactState.INSIDE
            return sample.topology if inside and sample.topology >= least else 0

        return int(wait_for(has_cut, f'change {least} by the cut'))


@pytest.fixture(scope='module')
def killed_at(session: LiveSession) -> int:
    """Kills the node once it has cut something, starts it again, and lets it cut on.

    Returns:
        When it was killed [ns since the epoch].
    """
    topology = wait_for_topology(session, 1)
    command = session.command('cutting')
    killed = session.kill('cutting')
    wait_for(lambda: deaths(session.said), 'the launcher to say so')
    with subprocess.Popen(
        command,
        cwd=ROOT,
        env=node_environment(session.domain),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as again:
        try:
            wait_for_topology(session, topology + 3)
            session.interrupt()
            assert session.end() == Status.NODE_DIED
        finally:
            again.send_signal(signal.SIGINT)
            said, _ = again.communicate(timeout=20)
            print(session.said, said)
    assert again.returncode == 0
    assert said.count('refused') <= MAX_TRIES
    assert deaths(session.said) == ['cutting']
    return killed


@pytest.fixture(scope='module')
def recording(session: LiveSession, killed_at: int) -> Recording:
    return Recording(session.bag)


def test_the_cut_goes_on_after_the_node_is_back(
    session: LiveSession, recording: Recording, killed_at: int
) -> None:
    killed = recording.at(killed_at)
    samples = list(decoded(session, '/tissue/force'))
    times = [recording.at(s.header.stamp.sec * 10**9 + s.header.stamp.nanosec) for s in samples]
    settled = killed + UNDER_WAY
    before = max(s.topology for t, s in zip(times, samples, strict=True) if t <= settled)
    again = next(t for t, s in zip(times, samples, strict=True) if s.topology > before)
    print(f'killed at {killed:.1f} s, cut again from {again:.1f} s')
    assert settled < again
    meanwhile = {s.state for t, s in zip(times, samples, strict=True) if settled < t < again}
    assert meanwhile == {ContactState.INSIDE}


def test_the_mesh_is_whole_at_every_revision_and_the_deltas_lead_to_its_last_hash(
    session: LiveSession, recording: Recording, killed_at: int
) -> None:
    keyframes = list(decoded(session, '/tissue/mesh'))
    replica = MeshReplica()
    replica.load(keyframes[0])
    mesh = mesh_of(replica)
    volume, old, checked = float(mesh.volumes().sum()), cut_faces(mesh), 0
    hashes = {frame.revision: frame.state_hash for frame in keyframes}
    deltas = list(decoded(session, '/tissue/mesh_updates'))
    for delta in deltas:
        assert replica.apply(delta)
        known = delta.state_hash or hashes.get(delta.revision, 0)
        assert known in (0, replica.hash())
        if delta.state_hash:
            mesh = mesh_of(replica)
            check_mesh(mesh, volume, old)
            checked += 1
            stamp = delta.header.stamp
            if stamp.sec * 10**9 + stamp.nanosec < killed_at:
                old = cut_faces(mesh)
    assert checked >= 4
    assert replica.revision == deltas[-1].revision


def decoded(session: LiveSession, topic: str) -> Iterator[Any]:
    """The messages of a topic, in order."""
    bag = open_bag(session.bag)
    return (bag.read(message) for message in bag.messages([topic]))


def mesh_of(replica: MeshReplica) -> TetMesh:
    """The tissue that a replica has."""
    mesh = TetMesh(replica.rest, replica.tetrahedra, replica.fixed)
    mesh.set_kinds(replica.triangles, replica.triangle_kind)
    return mesh
