"""What a whole frame of `tissue_sim` costs, hundreds in a row: palpated, and cut at one place.

All that the node does in a frame but to hand bytes to the middleware: the cut's answer applied, the
tissue moved, delta and force made and serialised, the whole mesh every five seconds. What the node
`cutting` computes for it is given apart.
"""

import time
from dataclasses import replace

import numpy as np

from cutting.methods import make_method
from cutting.settings import CuttingSettings
from cutting.warm_up import warm_up as warm_up_cutting
from session.measure.bench_clock import Figure, figure
from session.measure.bench_strokes import blade_contact
from session.measure.bench_tissue import SIZE, box, edge_of, liver_material
from session.organs.imported_scene import DAMPING
from session.scene import load_scene
from tissue_sim.active_region import ActiveSettings
from tissue_sim.blade import Resistance
from tissue_sim.contact import Command, Frame, State, ToolContact, press_triangle
from tissue_sim.dynamics import TimeStepping
from tissue_sim.material import Material
from tissue_sim.messages import DeltaEncoder, force_message, mesh_message
from tissue_sim.simulation import TissueSimulation
from tissue_sim.warm_up import warm_up

BUDGET = 1e3 / 30
"""[ms] of a frame."""
_WARM, _KEYFRAME = 20, 150
_UP = np.array([0.0, 0.0, 1.0])
_STEP, _WAY, _LANE = 1e-3, 0.03, 0.006
"""[m]: the blade's way in a frame, 30 mm/s; the length of a stroke; from one to the next."""
_DEEP = 0.010
_WHOLE, _LARGE = 25_000, 100_000
"""Tetrahedra up to which all nodes move, and up to which that is measured beside a region."""


def frame(sizes: list[int], frames: int = 300) -> list[Figure]:
    """Frames by processor time: median, and what one in a hundred exceeds.

    Args:
        sizes: in tetrahedra.
        frames: of each load, after some that warm up.
    """
    warm_up()  # as the nodes do before a session
    warm_up_cutting(CuttingSettings())
    figures: list[Figure] = []
    for size in sizes:
        regions = [0] if size <= _WHOLE else [0, 1000] if size <= _LARGE else [500, 1000]
        for nodes in regions:
            for cut in (False, True):
                figures += _Load(size, nodes, cut).measure(frames)
    return figures


class _Load:
    """A tissue and what is done to it.

    Args:
        size: tetrahedra, about.
        nodes: that may move; 0: all.
        cut: whether a blade is drawn through it, or a tool presses and slides.
    """

    def __init__(self, size: int, nodes: int, cut: bool) -> None:
        tissue = load_scene('liver').tissue
        self._mesh = box(size)
        m = tissue.material
        self._simulation = TissueSimulation(
            self._mesh,
            self._material(),
            Resistance(tissue.cut_threshold if cut else 10.0, m.toughness, m.blade_friction),
            model='linear',
            stepping=TimeStepping(
                'symplectic_euler',
                max_substeps=2000,
                frequency_growth=tissue.integration.frequency_growth,
            ),
            active=ActiveSettings('budget', nodes) if nodes else ActiveSettings(),
        )
        some = f'{nodes} nodes move' if nodes else 'all nodes move'
        self._label = f'{"cut" if cut else "palpated"}, {len(self._mesh.tetrahedra)}, {some}'
        self._cut = cut
        self._method = make_method(CuttingSettings())
        self._encoder = DeltaEncoder(self._mesh, self._simulation.displacement)
        self._asked: Frame | None = None

    def _material(self) -> Material:
        """That of `liver`, the highest frequency damped as its mesh has it: beta by the edge."""
        material, edge = liver_material(), edge_of(len(self._mesh.tetrahedra))
        return replace(material, beta=min(DAMPING * edge, material.beta))

    def measure(self, frames: int) -> list[Figure]:
        """Figures of so many frames."""
        rows = np.array([self._frame(number) for number in range(_WARM + frames)])[_WARM:]
        whole, answers = rows[:, 0], rows[rows[:, 1] > 0, 1]
        late = float(np.percentile(whole, 99))
        share = float(np.mean(whole <= BUDGET))
        budget = f'{BUDGET:.1f} ms'
        median = figure(f'frame, {self._label}', 'ms', whole, np.median(whole) / BUDGET, budget)
        figures = [
            median,
            figure(f'  one in a hundred above, {self._label}', 'ms', [late], late / BUDGET, budget),
            figure(f'  share within {budget}, {self._label}', '-', [share]),
            figure(f'  substeps, {self._label}', '-', rows[:, 2]),
        ]
        if self._cut:
            count = self._simulation.elements_cut
            figures.append(figure(f'  computed by cutting, {self._label}', 'ms', answers))
            figures.append(figure(f'  elements cut, {self._label}', '-', [count]))
        return figures

    def _frame(self, number: int) -> tuple[float, float, int]:
        """Processor time of frame and cutting [ms], and substeps."""
        from rclpy.serialization import serialize_message

        simulation, mesh, touched, spent = self._simulation, self._mesh, None, 0.0
        contact = self._blade(number) if self._cut else self._press(number)
        begin = time.thread_time()
        asked, self._asked = self._asked, None
        if asked is not None:
            positions = simulation.positions
            start = time.thread_time()
            if asked.command is Command.ADVANCE and asked.sweep is not None:
                result = self._method.advance(mesh, positions, asked.sweep)
            else:
                result = self._method.finish(mesh, positions)
            spent = time.thread_time() - start
            if result.delta.empty:
                simulation.cut_done()
            else:
                touched = simulation.apply_cut(result.delta)
        made = simulation.frame(contact)
        self._asked = made if made.command is not None else None
        delta = self._encoder.encode(simulation.displacement, made.step, 0, touched, made.step)
        revision = self._encoder.revision
        serialize_message(force_message(made, revision, mesh.topology, None, 0))
        if delta is not None:
            serialize_message(delta)
        if number % _KEYFRAME == 0:
            shape = simulation.displacement
            serialize_message(mesh_message(mesh, shape, 'bench', revision, made.step, 0))
        whole = time.thread_time() - begin - spent
        return 1e3 * whole, 1e3 * spent, made.substeps

    def _press(self, number: int) -> ToolContact:
        """Presses 1 to 3 mm deep while it slides to and fro over 4 cm."""
        turn = 2 * np.pi * number / 120
        place = np.array([0.05 + 0.02 * np.sin(turn), 0.05, SIZE[2]])
        depth = (2.0 - np.cos(3 * turn)) * 1e-3
        return press_triangle(self._mesh, place, -_UP, depth)

    def _blade(self, number: int) -> ToolContact:
        """Goes in, along x, and out; the next stroke lies beside it, to and fro over four lanes."""
        ins, along = round(_DEEP / _STEP), round(_WAY / _STEP)
        stroke, step = divmod(number, ins + along + 3)
        place = np.array([0.035, 0.04 + _LANE * (stroke % 4), SIZE[2]])
        way, deep = max(step - ins, 0) * _STEP, min(step, ins) * _STEP
        tip = place + np.array([min(way, _WAY), 0.0, -deep])
        state = State.TOUCHING if step <= ins + along else State.NONE
        return blade_contact(self._mesh, state, place, tip, _UP)
