"""Cost of messages, and of a whole session."""

import time

import numpy as np

from bench.common.clock import Figure, by_turns, figure, stream
from bench.speed.tissue import BOX_SIZE_M, TOUGHNESS, box, liver_material
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.haptic_bridge.force_path import ForcePath
from cutting_trainer.haptic_bridge.scene_schema import DeviceSettings, HapticsSettings, ToolSettings
from cutting_trainer.session.in_process import TICK_S, InProcess, Tissue
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.tissue_sim.contact.blade import Resistance
from cutting_trainer.tissue_sim.mesh.replica import MeshReplica, state_hash
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, TopologyDelta, Touched
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation
from cutting_trainer.tissue_sim.streaming.messages import DeltaEncoder, mesh_message


def codec(sizes: list[int]) -> list[Figure]:
    """Return a delta of all nodes, one with a cut and a whole mesh.

    Made, sent as bytes, and taken.
    """
    return [row for size in sizes for row in _codec(box(size))]


def _codec(mesh: TetMesh) -> list[Figure]:
    from rclpy.serialization import deserialize_message, serialize_message

    u = np.random.default_rng(0).standard_normal((2, mesh.node_count, 3)) * 1e-4
    whole = mesh_message(mesh, u[0], 'bench', 0, 0, 0)
    moved = DeltaEncoder(mesh, u[0]).encode(u[1], 1, 0, None, 0)
    assert moved is not None
    mesh_bytes, delta_bytes = serialize_message(whole), serialize_message(moved)
    touched = mesh.apply(TopologyDelta(removed_tetrahedra=np.array([0])))
    before, after = u[:, : mesh.node_count]

    def encode(cut: Touched | None) -> None:
        DeltaEncoder(mesh, before).encode(after, 1, 0, cut, 0)

    def take() -> None:
        replica = MeshReplica()
        replica.load(whole)
        replica.apply(moved)

    tasks = {
        'encode a delta of all nodes': lambda: encode(None),
        'encode a delta with a cut': lambda: encode(touched),
        '  of it the hash': lambda: state_hash(mesh.rest, after, mesh.tetrahedra),
        'serialise the delta': lambda: serialize_message(moved),
        'read the delta': lambda: deserialize_message(delta_bytes, type(moved)),
        'serialise the mesh': lambda: serialize_message(whole),
        'read the mesh': lambda: deserialize_message(mesh_bytes, type(whole)),
        'take mesh and delta into a replica': take,
    }
    times = by_turns(*tasks.values(), stream(len(delta_bytes)), repeats=5)
    base = float(np.median(times[:, -1]))
    against = f'reading the {len(delta_bytes)} bytes of the delta'
    label = f'{len(mesh.tetrahedra)} tetrahedra'
    return [
        figure(f'{name}, {label}', 'ms', 1e3 * column, float(np.median(column)) / base, against)
        for name, column in zip(tasks, times.T, strict=False)
    ]


def session(sizes: list[int], seconds: float = 2.0) -> list[Figure]:
    """Return figures of force loop and tissue in one process: a press, then a cut by the blade."""
    figures = []
    scene = load_scene('liver')
    m = scene.tissue.material
    for size in sizes:
        mesh = box(size)
        simulation = TissueSimulation(
            mesh,
            liver_material(),
            Resistance(scene.tissue.cut_threshold, TOUGHNESS, m.blade_friction),
            model='linear',
            stepping=TimeStepping('symplectic_euler', max_substeps=1000),
        )
        device, haptics = DeviceSettings(), HapticsSettings()
        tool = ToolSettings(
            blade_root=(0.0, 0.0, 0.02), blade_tip=(0.0, 0.0, -0.004), coupling_stiffness=200.0
        )
        path = ForcePath(tool, device, haptics, device.load_profile())
        loop = InProcess(path, Tissue(simulation, make_method(CuttingSettings())), 30.0)
        ticks = round(seconds / TICK_S)
        spent = np.empty(ticks)
        for i in range(ticks):
            down = min(2 * i / ticks, 1.0) * 0.012
            along = max(2 * i / ticks - 1, 0.0) * 0.02
            hand = np.array([0.04 + along, 0.05, BOX_SIZE_M[2] + 0.005 - down])
            start = time.thread_time()
            loop.tick(hand)
            spent[i] = time.thread_time() - start
        frames = [part.sum() for part in np.array_split(spent, round(30 * seconds))]
        label = f'about {size} tetrahedra, some cut'
        figures += [
            figure(
                f'a thirtieth of a second, {label}',
                'ms',
                1e3 * np.array(frames),
                float(spent.sum() / seconds),
                'real time',
            ),
            figure(f'  tick without a frame, {label}', 'us', 1e6 * np.sort(spent)[: ticks // 2]),
            figure(f'  elements cut, {label}', '-', [simulation.elements_cut]),
        ]
    return figures
