"""Claims about the exercise on the page: what is sent of it, and where the tissue carries it."""

import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bench.page.open_page import read_tissue
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.tissue_sim.assembly import make_simulation
from cutting_trainer.viewer.appearance import shown_exercise
from cutting_trainer.viewer.attempt_progress import AttemptProgress
from cutting_trainer.viewer.drawn_surface import CUT, OUTER, TissueSource
from cutting_trainer.viewer.tool_state import Moment


def test_page_has_the_curves_zones_lesion_and_limits_of_the_scene() -> None:
    circle = shown_exercise(load_scene('circle').exercise)
    assert circle is not None
    assert circle['title'] == 'Precision cutting' and '3 mm' in circle['instruction']
    points = np.array(circle['targets'][0]['points'])
    assert np.linalg.norm(points[:, :2], axis=1) == pytest.approx(0.025, abs=2e-6)
    assert circle['targets'][0]['margin'] == 0.003
    assert (circle['time_limit'], circle['end']['radius']) == (300, 0.008)
    vessel = shown_exercise(load_scene('vessel').exercise)
    assert vessel is not None and vessel['zones'][0]['radius'] == 0.002
    excision = shown_exercise(load_scene('excision').exercise)
    assert excision is not None and excision['lesion']['radius'] == 0.006
    assert shown_exercise(load_scene('block').exercise) is None


def test_hidden_lumps_are_not_given_away_to_the_page() -> None:
    exercise = load_scene('lumps').exercise
    said = json.dumps(shown_exercise(exercise))
    assert exercise.lumps and 'Hidden lumps' in said
    for lump in exercise.lumps:
        assert lump.name not in said
        assert not all(str(place) in said for place in lump.centre[:2])


def test_places_at_rest_belong_to_the_vertices_of_the_outside_and_come_with_faces_only() -> None:
    rest = np.array([[0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 1], [0, 0, 0]], float)
    tissue = SimpleNamespace(
        rest=rest,
        displacement=np.full((5, 3), 0.25),
        triangles=np.array([[4, 1, 2], [1, 3, 2]], np.int32),
        triangle_kind=np.array([CUT, OUTER], np.uint8),
        revision=0,
    )
    source = TissueSource('tissue')
    frame = source.frame(tissue)
    assert frame is not None
    _, parts, _, places = read_tissue(frame.whole)
    outer = parts[0][0]
    assert np.array_equal(places + 0.25, outer[:, :2]) and len(places) == 3
    assert not len(read_tissue(frame.moved)[3])


def moment(tip: list[float], contact: int, force: float) -> Moment:
    place = np.array(tip)
    blade = place + np.array([[0, 0, 0.02], [0, 0, -0.004]])
    return Moment(place, np.array([1.0, 0, 0, 0]), blade, place, contact, np.array([0, 0, force]))


def attempt_of(scene: str, way: list[tuple[list[float], int, float]]) -> Any:
    """Newest report on an attempt whose tip goes through places, half a second at each."""
    simulation = make_simulation(load_scene(scene).tissue)[0]
    replica = SimpleNamespace(**replica_fields(simulation.mesh), step=7, topology=0)
    progress = AttemptProgress(load_scene(scene).exercise)
    content, now = None, 100.0
    for tip, contact, force in way:
        for _ in range(16):
            content = progress.see(now, replica, moment(tip, contact, force)) or content
            now += 1 / 30
    return content, progress, replica, now


def replica_fields(mesh: Any) -> dict[str, Any]:
    return {
        name: np.asarray(getattr(mesh, name))
        for name in ('rest', 'tetrahedra', 'triangles', 'triangle_kind', 'fixed')
    }


def rows(content: Any) -> dict[str, tuple[str, bool]]:
    return {row['name']: (row['value'], row['over']) for row in content['rows']}


def test_progress_of_an_attempt_is_shown_and_the_score_once_the_tip_is_back() -> None:
    start, above, inside = [-0.018, 0.0, 0.040], [-0.018, 0.0, 0.030], [0.0, 0.0, 0.012]
    way = [(start, 0, 0.0), (above, 0, 0.0), (inside, 2, 3.5), (above, 0, 0.0)]
    content, progress, replica, now = attempt_of('vessel', way)
    shown = rows(content)
    assert content['score'] is None
    assert shown['peak force'] == ('3.5 N', True)
    assert shown['target that is opened'] == ('0 %', False)
    assert shown['forbidden zones cut'] == ('0', False)
    assert float(shown['time'][0].split()[0]) == pytest.approx(1.5, abs=0.6)
    end = moment([0.018, 0, 0.040], 0, 0.0)
    content = progress.see(now + 1, replica, end)
    assert content is not None and content['score'] is None  # the last cut may be under way
    content = progress.see(now + 1.5, replica, moment(inside, 2, 1.0))  # on in the tissue
    assert content is not None and content['score'] is None
    replica.step += 6
    content = progress.see(now + 2, replica, moment(inside, 2, 1.0))
    assert content is not None and content['score'] is None  # it has not ended
    content = progress.see(now + 2.5, replica, end)
    replica.step += 6
    content = progress.see(now + 3, replica, end)
    assert content is not None and content['score']['passed'] is False
    assert any('target that is opened' in reason for reason in content['score']['reasons'])
    replica.step = 0  # a new tissue
    content = progress.see(now + 4, replica, moment([-0.018, 0, 0.040], 0, 0.0))
    assert content is not None and content['score'] is None
    assert rows(content)['time'] == ('0 s', False)


def test_marks_are_counted_and_not_judged_before_the_end() -> None:
    up, down = [0.02, 0.02, 0.030], [0.02, 0.02, 0.022]  # no lump is below
    way = [([0.0, 0.0, 0.045], 0, 0.0), (up, 0, 0.0), *[(down, 1, 0.4)] * 3, (up, 0, 0.0)]
    content, *_ = attempt_of('lumps', way)
    assert rows(content)['marks'] == ('1', False)
    assert 'lump' not in json.dumps(content['rows'])
