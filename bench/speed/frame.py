"""Cost of whole frames of `tissue_sim` in a row: palpated, and cut at one place.

All that the node does in a frame but to hand bytes to the middleware: the cut's answer applied, the
tissue moved, delta and force made and serialised, the whole mesh every five seconds. What the node
`cutting` computes for it is given apart.
"""

import time
from dataclasses import replace

import numpy as np

from bench.common.clock import Figure, figure
from bench.speed.strokes import blade_contact
from bench.speed.tissue import (
    BOX_SIZE_M,
    FREQUENCY_GROWTH,
    TOUGHNESS,
    box,
    edge_of,
    liver_material,
)
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.cutting.warm_up import warm_up as warm_up_cutting
from cutting_trainer.mesh_import.imported_scene import DAMPING_PER_EDGE
from cutting_trainer.session.in_process import answer
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.tissue_sim.contact.blade import Resistance
from cutting_trainer.tissue_sim.contact.tool import ContactState, ToolContact, indenter_contact
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.motion.active_region import ActiveSettings
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping
from cutting_trainer.tissue_sim.simulation.cut_transaction import CutTransaction
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation
from cutting_trainer.tissue_sim.streaming.messages import DeltaEncoder, force_message, mesh_message
from cutting_trainer.tissue_sim.warm_up import warm_up

FRAME_PERIOD_MS = 1e3 / 30
"""Period of a frame."""
_WARM, _KEYFRAME = 20, 150
_UP = np.array([0.0, 0.0, 1.0])
_BLADE_STEP, _STROKE_LENGTH, _LANE_DISTANCE = 1e-3, 0.03, 0.006
"""Path of the blade in a frame, at 30 mm/s; length of a stroke; distance between strokes [m]."""
_CUT_DEPTH = 0.010
_MAX_WHOLE, _MAX_COMPARED = 25_000, 100_000
"""Largest mesh where all nodes move, and largest mesh where that is measured beside a region."""


def frame(sizes: list[int], frames: int = 300) -> list[Figure]:
    """Return the processor time of frames: median and 99th percentile.

    Args:
        sizes: in tetrahedra.
        frames: of each load, after some that warm up.
    """
    warm_up()  # as the nodes do before a session
    warm_up_cutting(CuttingSettings())
    figures: list[Figure] = []
    for size in sizes:
        regions = [0] if size <= _MAX_WHOLE else [0, 1000] if size <= _MAX_COMPARED else [500, 1000]
        for nodes in regions:
            for cut in (False, True):
                figures += _Load(size, nodes, cut).measure(frames)
    return figures


class _Load:
    """Tissue under a tool.

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
            Resistance(tissue.cut_threshold if cut else 10.0, TOUGHNESS, m.blade_friction),
            model='linear',
            stepping=TimeStepping(
                'symplectic_euler',
                max_substeps=2000,
                frequency_growth=FREQUENCY_GROWTH,
            ),
            active=ActiveSettings('budget', nodes) if nodes else ActiveSettings(),
        )
        some = f'{nodes} nodes move' if nodes else 'all nodes move'
        self._label = f'{"cut" if cut else "palpated"}, {len(self._mesh.tetrahedra)}, {some}'
        self._cut = cut
        self._method = make_method(CuttingSettings())
        self._encoder = DeltaEncoder(self._mesh, self._simulation.displacement)
        self._asks = CutTransaction(self._simulation)

    def _material(self) -> Material:
        """Return that of `liver`, the highest frequency damped as its mesh has it: beta by the
        edge.
        """
        material, edge = liver_material(), edge_of(len(self._mesh.tetrahedra))
        return replace(material, beta=min(DAMPING_PER_EDGE * edge, material.beta))

    def measure(self, frames: int) -> list[Figure]:
        """Return figures of so many frames."""
        rows = np.array([self._frame(number) for number in range(_WARM + frames)])[_WARM:]
        whole, answers = rows[:, 0], rows[rows[:, 1] > 0, 1]
        late = float(np.percentile(whole, 99))
        share = float(np.mean(whole <= FRAME_PERIOD_MS))
        budget = f'{FRAME_PERIOD_MS:.1f} ms'
        median = figure(
            f'frame, {self._label}', 'ms', whole, np.median(whole) / FRAME_PERIOD_MS, budget
        )
        figures = [
            median,
            figure(
                f'  one in a hundred above, {self._label}',
                'ms',
                [late],
                late / FRAME_PERIOD_MS,
                budget,
            ),
            figure(f'  share within {budget}, {self._label}', '-', [share]),
            figure(f'  substeps, {self._label}', '-', rows[:, 2]),
        ]
        if self._cut:
            count = self._simulation.elements_cut
            figures.append(figure(f'  computed by cutting, {self._label}', 'ms', answers))
            figures.append(figure(f'  elements cut, {self._label}', '-', [count]))
        return figures

    def _frame(self, number: int) -> tuple[float, float, int]:
        """Return processor time of frame and cutting [ms], and substeps."""
        from rclpy.serialization import serialize_message

        simulation, mesh, touched, spent = self._simulation, self._mesh, None, 0.0
        contact = self._blade(number) if self._cut else self._press(number)
        begin = time.thread_time()
        if self._asks.due and self._asks.asked is not None:
            start = time.thread_time()
            answered = answer(self._method, self._asks.asked, simulation)
            spent = time.thread_time() - start
            touched = self._asks.resolve(*answered)
        made = simulation.frame(contact)
        self._asks.ask(made)
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
        """Press 1 to 3 mm deep while it slides to and fro over 4 cm."""
        turn = 2 * np.pi * number / 120
        place = np.array([0.05 + 0.02 * np.sin(turn), 0.05, BOX_SIZE_M[2]])
        depth = (2.0 - np.cos(3 * turn)) * 1e-3
        return indenter_contact(self._mesh, place, -_UP, depth)

    def _blade(self, number: int) -> ToolContact:
        """Cut in, along x, and out; the next stroke is beside it, alternating over four lanes."""
        ins, along = round(_CUT_DEPTH / _BLADE_STEP), round(_STROKE_LENGTH / _BLADE_STEP)
        stroke, step = divmod(number, ins + along + 3)
        place = np.array([0.035, 0.04 + _LANE_DISTANCE * (stroke % 4), BOX_SIZE_M[2]])
        way, deep = max(step - ins, 0) * _BLADE_STEP, min(step, ins) * _BLADE_STEP
        tip = place + np.array([min(way, _STROKE_LENGTH), 0.0, -deep])
        state = ContactState.TOUCHING if step <= ins + along else ContactState.NONE
        return blade_contact(self._mesh, state, place, tip, _UP)
