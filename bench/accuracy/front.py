"""Whether the methods of the shipped scenes lie on the front of the chart."""

import csv
from dataclasses import fields
from pathlib import Path
from typing import Any

from bench.accuracy.measure import EQUAL_ERROR_RATIO, Point, is_beaten
from bench.accuracy.vibration import Vibration
from cutting_trainer.session.scene_loader import SCENES, load_scene
from cutting_trainer.tissue_sim.scene_schema import TissueSettings

PANELS = {
    'block': ('indentation', 'after_cut'),
    'circle': ('large_rotation',),
    'excision': ('large_rotation',),
    'flap': ('large_rotation',),
    'liver': ('large_strain',),
    'liver_suspended': ('large_strain',),
    'pad': ('large_strain',),
    'lumps': ('indentation',),
    'palpation': ('indentation',),
    'two_tools': ('large_strain',),
    'vessel': ('large_rotation',),
}
"""Problems of the chart that resemble a scene."""


def read_points(path: Path) -> list[Point]:
    """Return points that `trainer chart` has written."""
    kinds = {field.name: field.type for field in fields(Point)}
    with path.open(newline='', encoding='utf-8') as table:
        return [
            Point(**{name: _value(kinds[name], text) for name, text in row.items()})
            for row in csv.DictReader(table)
        ]


def _value(kind: object, text: str) -> Any:
    if kind is bool:
        return text == 'True'
    if kind is int:
        return int(text)
    return float(text) if kind is float else text


def reasons_off_front(points: list[Point], problem: str, method: tuple[str, str]) -> list[str]:
    """Return the reasons why a method is not on the front of a problem; none: it is.

    No method may beat it on any mesh, and one of its meshes must be on the front of all. To beat it
    is to be faster and as near, at rest and in free vibration. Nothing moves in the other panels:
    they do not show that a long implicit step damps motion.

    Args:
        points: of the chart.
        problem: name of the panel.
        method: model and integrator.
    """
    moving = motion_errors(points)
    panel = [p for p in points if p.problem == problem]
    own = [p for p in panel if (p.model, p.integrator) == method]
    if not own:
        return ['it has not been measured there']

    def beaten_by(p: Point, other: Point) -> bool:
        damping, own_damping = (moving.get(q.integrator, 0.0) for q in (other, p))
        return is_beaten(p, other) and damping <= EQUAL_ERROR_RATIO * own_damping

    found = [
        f'{other.model} by {other.integrator} is faster and as near with {p.tetrahedra} tetrahedra'
        for p in own
        for other in panel
        if other.resolution == p.resolution and beaten_by(p, other)
    ]
    if all(any(beaten_by(p, other) for other in panel) for p in own):
        found.append('on each mesh another method on another mesh is faster and as near')
    return found


def motion_errors(points: list[Point]) -> dict[str, float]:
    """Return the error of each integrator in free vibration, on the finest mesh, by its best model.

    The implicit integrator has one step a frame, as in the other panels.
    """
    swings = [
        p
        for p in points
        if p.problem == Vibration.name and (p.integrator != 'implicit' or p.substeps == 1)
    ]
    finest = max((p.resolution for p in swings), default=0)
    errors: dict[str, float] = {}
    for p in swings:
        if p.resolution == finest:
            error = errors.get(p.integrator, p.displacement_error)
            errors[p.integrator] = min(error, p.displacement_error)
    return errors


def scenes() -> dict[str, TissueSettings]:
    """Return the tissue settings of the shipped scenes."""
    return {path.stem: load_scene(path.stem).tissue for path in sorted(SCENES.glob('*.yaml'))}


def standing(points: list[Point], scene: str, tissue: TissueSettings) -> dict[str, list[str]]:
    """Return the reasons why the method of a scene is not on the front, by panel; none: it is."""
    method = (tissue.model, tissue.integrator)
    return {problem: reasons_off_front(points, problem, method) for problem in PANELS[scene]}
