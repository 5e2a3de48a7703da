"""Figures of one recorded hand whose frames begin at other times: is the cut the same?"""

from bench.figures.figure import Figure
from bench.speed.script import Pose, opened_lines, script_ticks
from cutting_trainer.cutting.cut_invariants import cut_face_area
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.session.in_process import InProcess, Tissue, make_force_path
from cutting_trainer.session.scene_loader import Scene, load_scene
from cutting_trainer.tissue_sim.assembly import make_simulation

_LATER = (11, 22)
"""[ms] by which the frames begin later than those of the recorded session: thirds of a frame."""
_FRAMES = 100
"""[ms] of three frames: a hand that waits for them meets frames as they were recorded."""


def measure() -> list[Figure]:
    """Return the figures of line 5."""
    scene = load_scene('liver')
    recorded = _session(scene)
    hand = [pose for _, pose in script_ticks(scene, recorded)]
    runs = [_opened(scene, recorded), *(_opened(scene, _later(scene, hand, by)) for by in _LATER)]
    areas, count = [area for area, _ in runs], len(runs)
    spread = (max(areas) - min(areas)) * count / sum(areas)
    least = min(share for _, lines in runs for share in lines)
    name = 'one hand, frames begun up to 22 ms later: difference of opened areas over their mean'
    return [
        Figure(5, name, spread, 0.01, 'at most', '', count),
        Figure(5, 'the same, share of a line opened, least', least, 0.95, 'at least', '', count),
    ]


def _session(scene: Scene) -> InProcess:
    simulation, _ = make_simulation(scene.tissue)
    tissue = Tissue(simulation, make_method(scene.cutting))
    return InProcess(make_force_path(scene), tissue, scene.tissue.integration.rate)


def _later(scene: Scene, hand: list[Pose], by: int) -> InProcess:
    """Return a session that the same hand has made, with frames that begin some [ms] later."""
    session = _session(scene)
    for pose in [hand[0]] * (_FRAMES - by) + hand:
        session.tick(*pose)
    return session


def _opened(scene: Scene, session: InProcess) -> tuple[float, list[float]]:
    """Return the area that a session has opened [m^2], and which share of each planned line."""
    mesh = session.tissue.simulation.mesh
    return cut_face_area(mesh), opened_lines(scene, mesh)
