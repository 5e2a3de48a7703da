"""Claims about the exercise on the page: what is sent of it, and where the tissue carries it."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from bench.page.open_page import read_tissue
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.viewer.appearance import shown_exercise
from cutting_trainer.viewer.drawn_surface import CUT, OUTER, TissueSource


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
