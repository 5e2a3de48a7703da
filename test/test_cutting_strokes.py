"""Random strokes keep every invariant of a cut, whatever the method."""

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, note, settings
from hypothesis import strategies as st

from bench.cuts.random_strokes import (
    KINDS,
    Scene,
    play,
    random_scene,
    random_stroke,
    run,
    shuffled_box,
)

pytestmark = pytest.mark.long


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    kinds=st.lists(st.sampled_from(KINDS), min_size=1, max_size=3),
    cells=st.tuples(*[st.integers(1, 4)] * 3),
    jitter=st.sampled_from([0.0, 0.1, 0.2]),
    motion=st.sampled_from([0.0, 0.01, 0.03]),
    seed=st.integers(0, 2**32),
)
def test_a_cut_keeps_the_mesh_sound_after_every_batch(kinds, cells, jitter, motion, seed):
    rng = np.random.default_rng(seed)
    nodes, tets = shuffled_box(np.array(cells), 0.002, jitter, rng)
    strokes = tuple(random_stroke(kind, nodes, 0.002, rng) for kind in kinds)
    scene = Scene(nodes, tets, strokes, motion, seed)
    try:
        play(scene)
    except Exception:
        path = Path(tempfile.gettempdir()) / 'cut-scene.npz'
        scene.save(path)
        note(f'replay with bench.cuts.random_strokes.play(Scene.load({str(path)!r}))')
        raise


@pytest.mark.parametrize('method', ['combined_midpoint', 'subdivide', 'separate'])
def test_the_other_methods_keep_the_mesh_sound_too(method, tmp_path):
    assert run(12, 1, method=method, folder=tmp_path).violations == ()


def test_random_strokes_meet_every_case(tmp_path):
    report = run(150, 0, folder=tmp_path)
    assert report.violations == ()
    assert (report.cases > 0)[[0, 1, 2, 3, 4, 5, 6, 7, 9]].all()


def test_a_scene_is_replayed_as_it_was_saved(tmp_path):
    scene = random_scene(np.random.default_rng(5))
    scene.save(tmp_path / 'scene.npz')
    again = Scene.load(tmp_path / 'scene.npz')
    assert play(again)[0] == play(scene)[0]
    assert (play(again)[1] == play(scene)[1]).all()


def test_a_scene_that_breaks_an_invariant_is_saved(tmp_path, monkeypatch):
    def broken(scene, method):
        raise AssertionError('broken')

    monkeypatch.setattr('bench.cuts.random_strokes.play', broken)
    report = run(1, 3, folder=tmp_path)
    assert report.violations == ('AssertionError: broken',)
    assert Scene.load(report.saved[0]).strokes
