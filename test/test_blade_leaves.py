"""Each sweep of the edge in the tissue is paid for and asked for, up to where it leaves."""

from dataclasses import replace

import numpy as np
import pytest
from meshes import irregular_box
from test_blade import TOUGHNESS, contact_at
from test_blade_lag import eased

from cutting_trainer.tissue_sim.contact.blade import Blade, Resistance, Sweep
from cutting_trainer.tissue_sim.contact.tool import CutCommand
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.mesh.locate import NearElements, find_tetrahedra
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation

RATE, GRID, TOP = 30.0, 40, 0.02


def at_rest(simulation: TissueSimulation, points: np.ndarray) -> np.ndarray:
    """Where points in the tissue now are at rest [m], NaN for those in the air, shape (p, 3)."""
    mesh = simulation.mesh
    found, weights = find_tetrahedra(simulation.positions, mesh.tetrahedra, mesh.neighbors, points)
    rest = np.einsum('pk,pkc->pc', weights, mesh.rest[mesh.tetrahedra[found]])
    rest[found < 0] = np.nan
    return np.asarray(rest)


def area_at_rest(simulation: TissueSimulation, sweep: Sweep) -> float:
    """Area at rest of the part of a sweep that is in the tissue now [m^2]."""
    s = np.linspace(0.0, 1.0, GRID + 1)
    before = sweep.tip_from + s[:, None] * (sweep.root_from - sweep.tip_from)
    after = sweep.tip_to + s[:, None] * (sweep.root_to - sweep.tip_to)
    points = (1 - s)[:, None, None] * before + s[:, None, None] * after
    rest = at_rest(simulation, points.reshape(-1, 3)).reshape(points.shape)
    cells = np.cross(rest[1:, 1:] - rest[:-1, :-1], rest[1:, :-1] - rest[:-1, 1:])
    return float(np.nansum(np.linalg.norm(cells, axis=2))) / 2


class Drawn:
    """A blade on a soft spring that is drawn through a block, uncut, and out of its side.

    Args:
        shift: by which it begins farther along [m].
        lost: how many answers are lost once the blade has left.
        youngs_modulus: of the block [Pa].

    Attributes:
        commands: of the frames.
        areas: of the sweeps, at rest and in the tissue [m^2].
        paid: work of cutting over toughness [m^2].
        gaps: from the ends of sweeps to the begin of the next, at rest [m].
        ahead: from the line at which a sweep ended to the begin of the next, at the same height,
            along x, in which the blade is drawn; at rest [m].
    """

    def __init__(self, shift: float, lost: int = 0, youngs_modulus: float = 30000.0) -> None:
        nodes, tets = irregular_box((12, 6, 4), 0.005, 3, jitter=0.1)
        simulation = TissueSimulation(
            TetMesh(nodes, tets, nodes[:, 2] < 1e-9),
            Material(youngs_modulus, 0.4, 1000.0, 5.0, 2e-4),
            Resistance(0.05, TOUGHNESS, 0.0),
        )
        start = np.array([0.042 + shift, 0.0138, TOP + 0.001])
        deep = start - [0.0, 0.0, 0.009]
        out = start + np.array([0.045, 0.0, -0.009])
        ways = [eased(start, deep, 0.6, RATE), eased(deep, out, 0.5, RATE), [out] * 5]
        self.commands: list[CutCommand] = []
        self.areas: list[float] = []
        self.gaps: list[float] = []
        self.ahead: list[float] = []
        self.paid, end = 0.0, np.full((40, 3), np.nan)
        for tip in np.concatenate(ways):
            contact = replace(contact_at(simulation, tip), stiffness=80.0)
            inside = simulation.blade
            frame = simulation.frame(contact)
            self.paid = self.paid if inside is None else inside.paid / TOUGHNESS
            if frame.command is None:
                continue
            self.commands.append(frame.command)
            if frame.command == CutCommand.FINISH:
                break
            assert frame.sweep is not None
            self.areas.append(area_at_rest(simulation, frame.sweep))
            begin = places(frame.sweep.tip_from, frame.sweep.root_from)
            begin = at_rest(simulation, begin)
            self.gaps += list(np.linalg.norm(begin - end, axis=1))
            line = end[np.isfinite(end[:, 0])]
            if len(line):
                x = np.interp(begin[:, 2], line[:, 2], line[:, 0], left=np.nan, right=np.nan)
                self.ahead += list(begin[:, 0] - x)
            end = at_rest(simulation, places(frame.sweep.tip_to, frame.sweep.root_to))
            if lost and (simulation.blade is None or simulation.blade.immersed == 0.0):
                lost -= 1
                simulation.cut_failed()
            else:
                simulation.cut_done()


def places(tip: np.ndarray, root: np.ndarray) -> np.ndarray:
    """Places of an edge 1 to 7 mm from its tip [m], shape (40, 3)."""
    way = np.linspace(0.001, 0.007, 40)[:, None]
    return np.asarray(tip + way * (root - tip) / np.linalg.norm(root - tip))


@pytest.mark.parametrize('shift', [0.0, 0.001, 0.002, 0.003])
def test_all_that_is_paid_for_is_asked_for_before_the_stroke_ends(shift: float) -> None:
    drawn = Drawn(shift)
    assert drawn.commands.count(CutCommand.FINISH) == 1
    assert drawn.paid > 1e-4
    assert sum(drawn.areas) == pytest.approx(drawn.paid, rel=0.1)


def test_the_last_sweep_is_asked_for_until_it_is_answered() -> None:
    once, again = Drawn(0.0), Drawn(0.0, lost=3)
    assert again.commands == [*once.commands[:-1], *[CutCommand.ADVANCE] * 3, CutCommand.FINISH]
    assert min(again.areas[-3:]) >= 0.95 * once.areas[-1] > 5e-6


def test_a_sweep_begins_where_the_last_one_ended_however_the_tissue_is_strained() -> None:
    drawn = Drawn(0.0, youngs_modulus=5000.0)
    gaps = np.array(drawn.gaps)
    assert np.isfinite(gaps).sum() > 100
    assert np.nanmax(gaps) < 8e-4


def test_nothing_is_left_out_between_two_sweeps_where_the_tissue_bends_the_edge() -> None:
    ahead = np.array(Drawn(0.0, youngs_modulus=5000.0).ahead)
    assert np.isfinite(ahead).sum() > 100
    assert np.nanmax(ahead) < 5e-5  # a hundredth of an edge


def test_an_edge_that_goes_in_along_itself_asks_for_nothing_whatever_its_tremor() -> None:
    """Its sweep would have the direction of the tremor; the first one begins at full depth."""
    nodes, tets = irregular_box((12, 6, 4), 0.005, 3, jitter=0.1)
    simulation = TissueSimulation(
        TetMesh(nodes, tets, nodes[:, 2] < 1e-9),
        Material(30000.0, 0.4, 1000.0, 5.0, 2e-4),
        Resistance(0.05, TOUGHNESS, 0.0),
    )
    start = np.array([0.020, 0.0138, TOP + 0.001])
    deep, along = start - [0.0, 0.0, 0.012], np.array([0.02, 0.0, 0.0])
    down, on = np.linspace(start, deep, 15), eased(deep, deep + along, 0.5, RATE)
    down[:, 1] += 1e-4 * np.sin(2.0 * np.pi * 9.0 / RATE * np.arange(len(down)))
    sweeps = []
    for number, tip in enumerate(np.concatenate([down, on])):
        frame = simulation.frame(contact_at(simulation, tip))
        if frame.sweep is not None:
            sweeps.append((number, frame.sweep))
            simulation.cut_done()
    assert sweeps[0][0] >= len(down)
    first = sweeps[0][1]
    assert first.tip_from[2] - first.tip_to[2] < 1e-3
    way = first.tip_to - first.tip_from
    assert way[0] > 3.0 * abs(way[1])  # the cut is led on behind it, along x


def test_an_edge_that_leaves_just_after_a_cut_does_not_ask_for_nodes_of_the_old_mesh() -> None:
    def box(cells: int) -> TetMesh:
        nodes, tets = irregular_box((cells, cells, cells), 0.02 / cells, 3, jitter=0.1)
        return TetMesh(nodes, tets)

    before, after = box(4), box(2)
    tip = np.array([0.01, 0.01, 0.012])
    edge = np.array([[0.01, 0.01, 0.024], tip])
    blade = Blade(Resistance(0.05, TOUGHNESS, 0.0), *edge, hint=0)
    still = np.zeros((2, 3))
    for mesh, height in ((before, 0.0), (after, 0.02)):
        blade.untie()  # the mesh is a new one
        near, opened = NearElements(mesh.tetrahedra), mesh.triangles[:0]
        device = edge + np.array([0.0, 0.0, height])
        blade.follow(mesh, near, opened, mesh.rest, device, still, 80.0, np.zeros(3))
    assert blade.immersed == 0.0
    kept = blade.kept()
    blade.carry(after.rest + np.array([0.001, 0.0, 0.0]))
    assert np.array_equal(blade.kept()['_tip'], kept['_tip'])
