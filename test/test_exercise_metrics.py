"""Claims about the measures of an attempt: shapes and motions whose measures are known exactly."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from meshes import box

from cutting_trainer.bags.reader import open_bag
from cutting_trainer.exercises.bag_feed import read_attempt
from cutting_trainer.exercises.metrics import Attempt
from cutting_trainer.exercises.motion import (
    RATE_HZ,
    holds,
    idle_share,
    log_dimensionless_jerk,
    tremor,
)
from cutting_trainer.exercises.opened_tissue import (
    Curve,
    bridge,
    cut_faces,
    distance_to_line,
    lesion_margin,
    zones_touched,
)
from cutting_trainer.exercises.scene_schema import (
    BallSettings,
    CircleSettings,
    CriterionSettings,
    ExerciseSettings,
    TargetSettings,
    ZoneSettings,
)
from cutting_trainer.exercises.score import score
from cutting_trainer.node_common.share_folder import PACKAGES

SAMPLE = PACKAGES / 'bags' / 'samples' / 'format_7' / 'straight_cut'


def wall(line: np.ndarray, depth: float, cells: int = 4) -> SimpleNamespace:
    """Both cut faces under a line on the surface, down to a depth."""
    top = np.asarray(line, float)
    rows = [top - [0, 0, depth * k / cells] for k in range(cells + 1)]
    rest = np.concatenate(rows)
    n, faces = len(top), []
    for k in range(cells):
        for i in range(n - 1):
            a, b = k * n + i, k * n + i + 1
            faces += [[a, b, a + n], [b, b + n, a + n]]
    faces = np.array(faces)
    both = np.concatenate([faces, faces[:, ::-1]])
    return SimpleNamespace(
        rest=rest,
        triangles=both,
        triangle_kind=np.ones(len(both), np.uint8),
        tetrahedra=np.zeros((0, 4), int),
        fixed=np.zeros(len(rest), np.uint8),
    )


def straight(start: float, end: float, y: float = 0.0) -> np.ndarray:
    xs = np.linspace(start, end, 21)
    return np.column_stack([xs, np.full(21, y), np.zeros(21)])


LINE = TargetSettings(
    name='line', points=((0.0, 0, 0), (0.1, 0, 0)), margin=0.002, depth=(0.004, 0.006)
)


def test_area_of_cut_faces_is_that_of_one_side() -> None:
    opened = cut_faces(wall(straight(0, 0.1), 0.005))
    assert opened.areas.sum() == pytest.approx(0.1 * 0.005, rel=1e-12)


@pytest.mark.parametrize(
    ('start', 'end', 'share'), [(0, 0.1, 1), (0, 0.05, 0.5), (0.02, 0.05, 0.3)]
)
def test_coverage_is_the_share_of_the_line_that_is_opened(start, end, share) -> None:
    coverage = Curve(LINE).coverage(cut_faces(wall(straight(start, end), 0.005)))
    assert coverage.opened == pytest.approx(share, abs=0.016)
    assert coverage.depth_error == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(('depth', 'error'), [(0.005, 0.0), (0.002, 0.002), (0.010, 0.004)])
def test_error_of_depth_is_the_distance_from_the_band(depth, error) -> None:
    coverage = Curve(LINE).coverage(cut_faces(wall(straight(0, 0.1), depth)))
    assert coverage.depth_error == pytest.approx(error, abs=0.0003)


def test_a_cut_beside_the_margin_covers_nothing_and_is_all_excess() -> None:
    exercise = ExerciseSettings(
        title='t', targets=(LINE,), criteria=(CriterionSettings(measure='time', good=1, bad=2),)
    )
    attempt = Attempt(exercise)
    attempt.see_tissue(0.0, wall(straight(0, 0.1, y=0.003), 0.005))
    measures = attempt.measures()
    assert measures['coverage'] == 0.0
    assert measures['excess'] == 1.0
    assert measures['damage'] == pytest.approx(0.0005, rel=1e-9)


def test_half_of_a_cut_that_is_twice_as_deep_as_allowed_is_excess() -> None:
    exercise = ExerciseSettings(
        title='t', targets=(LINE,), criteria=(CriterionSettings(measure='time', good=1, bad=2),)
    )
    attempt = Attempt(exercise)
    attempt.see_tissue(0.0, wall(straight(0, 0.1), 0.012))
    assert attempt.measures()['excess'] == pytest.approx(0.5, abs=0.03)


@pytest.mark.parametrize(('radius', 'covered'), [(0.020, 1.0), (0.0215, 1.0), (0.0245, 0.0)])
def test_a_circle_is_covered_by_circles_within_its_margin(radius, covered) -> None:
    target = TargetSettings(
        name='circle',
        circle=CircleSettings(centre=(0, 0, 0), radius=0.02),
        margin=0.002,
        depth=(0.001, 0.006),
    )
    angle = np.linspace(0, 2 * np.pi, 200)
    line = radius * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    coverage = Curve(target).coverage(cut_faces(wall(line, 0.004)))
    assert coverage.opened == pytest.approx(covered, abs=0.01)


def test_distance_to_a_line_of_segments() -> None:
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0]])
    points = np.array([[0.5, 0.2, 0], [2.0, 0.5, 0], [-3.0, 0, 4.0]])
    assert distance_to_line(points, corners) == pytest.approx([0.2, 1.0, 5.0])


def test_a_zone_is_touched_where_a_cut_reaches_into_its_radius() -> None:
    opened = cut_faces(wall(straight(0, 0.1), 0.005))
    beside = ZoneSettings(
        name='beside', points=((0, 0.004, -0.003), (0.1, 0.004, -0.003)), radius=0.003
    )
    below = ZoneSettings(name='below', points=((0, 0, -0.007), (0.1, 0, -0.007)), radius=0.003)
    assert zones_touched(opened, (beside, below)) == ['below']


def test_margin_of_a_lesion_is_that_to_the_cut_and_none_while_it_is_held() -> None:
    corners = np.array([[-1.0, -1, -1], [3, -1, -1], [-1, 3, -1], [-1, -1, 3]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    tissue = SimpleNamespace(
        rest=corners,
        tetrahedra=np.array([[0, 1, 2, 3]]),
        triangles=faces,
        triangle_kind=np.array([1, 0, 0, 0]),
        fixed=np.zeros(4, np.uint8),
    )
    lesion = BallSettings(name='lesion', centre=(0, 0, 0), radius=0.1)
    # The face at z = -1 is cut, and sampled at 40 parts of its longest edge.
    assert lesion_margin(tissue, lesion) == pytest.approx(0.9, abs=0.01)
    tissue.fixed[0] = 1
    assert math.isnan(lesion_margin(tissue, lesion))


@pytest.mark.parametrize('degrees', [-150, 24, 90])
def test_a_bridge_is_found_where_a_lesion_is_still_held(degrees: int) -> None:
    nodes, tetrahedra = box((40, 40, 2), 0.002)
    nodes -= [0.04, 0.04, 0]
    middles = nodes[tetrahedra].mean(axis=1)
    angle = np.degrees(np.arctan2(middles[:, 1], middles[:, 0]))
    radius = np.linalg.norm(middles[:, :2], axis=1)
    apart = (abs(radius - 0.02) < 0.0035) & (abs((angle - degrees + 180) % 360 - 180) > 8)
    tissue = SimpleNamespace(
        rest=nodes,
        tetrahedra=tetrahedra[~apart],
        fixed=(abs(nodes[:, :2]).max(axis=1) > 0.0395).astype(np.uint8),
    )
    lesion = BallSettings(name='lesion', centre=(0, 0, 0.002), radius=0.005)
    circle = CircleSettings(centre=(0, 0, 0.004), radius=0.02)
    ring = TargetSettings(name='ring', circle=circle, depth=(0.003, 0.005))
    edge = bridge(tissue, lesion, (ring,))
    assert edge is not None
    x, y, _ = tissue.rest[list(edge)].mean(axis=0)
    assert np.hypot(x, y) == pytest.approx(0.02, abs=0.002)
    assert abs((np.degrees(np.arctan2(y, x)) - degrees + 180) % 360 - 180) < 10
    tissue.tetrahedra = tetrahedra[abs(radius - 0.02) >= 0.0035]
    assert bridge(tissue, lesion, (ring,)) is None


def minimum_jerk(seconds: float, length: float) -> np.ndarray:
    s = np.arange(int(seconds * RATE_HZ) + 1) / (seconds * RATE_HZ)
    x = length * s**3 * (10 - 15 * s + 6 * s**2)
    return np.column_stack([x, 0 * x, 0 * x])


@pytest.mark.parametrize(('seconds', 'length'), [(2.0, 0.1), (4.0, 0.1), (4.0, 0.02)])
def test_jerk_of_a_minimum_jerk_motion_is_that_in_closed_form(seconds, length) -> None:
    # T^3 / v^2 * integral of j^2 = T^3 / (1.875 L / T)^2 * 720 L^2 / T^5 = 204.8
    assert log_dimensionless_jerk(minimum_jerk(seconds, length)) == pytest.approx(
        -math.log(204.8), abs=0.04
    )


def test_two_motions_are_less_smooth_than_one() -> None:
    one, half = minimum_jerk(4.0, 0.1), minimum_jerk(2.0, 0.05)
    two = np.concatenate([half, half[1:] + np.array([0.05, 0, 0])])
    assert log_dimensionless_jerk(two) < log_dimensionless_jerk(one) - 1


@pytest.mark.parametrize('hertz', [9.0, 10.0, 11.0])
def test_tremor_is_the_effective_value_of_a_sine_in_its_band(hertz) -> None:
    time = np.arange(2000) / RATE_HZ
    path = np.zeros((2000, 3))
    path[:, 1] = 1e-4 * np.sin(2 * np.pi * hertz * time)
    assert tremor(path) == pytest.approx(1e-4 / math.sqrt(2), rel=0.1)


@pytest.mark.parametrize('hertz', [0.5, 3.0, 20.0])
def test_motion_outside_of_its_band_is_no_tremor(hertz) -> None:
    time = np.arange(2000) / RATE_HZ
    path = np.zeros((2000, 3))
    path[:, 1] = 1e-4 * np.sin(2 * np.pi * hertz * time)
    assert tremor(path) < 2e-6


def test_a_hand_that_rests_half_of_the_time_is_idle_by_a_half() -> None:
    moving = np.column_stack([np.linspace(0, 0.02, 201), np.zeros(201), np.zeros(201)])
    path = np.concatenate([moving, np.repeat(moving[-1:], 200, axis=0)])
    assert idle_share(path) == pytest.approx(0.5)


def test_a_mark_is_a_hold_under_force_and_counts_once() -> None:
    times = np.arange(1000) / RATE_HZ
    path = np.zeros((1000, 3))
    path[:, 0] = np.interp(times, [0, 1, 4, 5, 8, 10], [0, 0.01, 0.01, 0.03, 0.03, 0.05])
    pressed = (times > 1) & (times < 9)
    still_pressed = holds(times, path, pressed, 1.0, 0.001)
    assert still_pressed[:, 0] == pytest.approx([0.01], abs=0.001)
    released = pressed & ~((times > 4.4) & (times < 4.6))
    assert holds(times, path, released, 1.0, 0.001)[:, 0] == pytest.approx([0.01, 0.03], abs=0.001)
    assert not len(holds(times, path, np.zeros(1000, bool), 1.0, 0.001))


def exercise() -> ExerciseSettings:
    criteria = (
        CriterionSettings(measure='coverage', good=1.0, bad=0.5, weight=3, required=True),
        CriterionSettings(measure='time', good=10, bad=20, weight=1),
    )
    return ExerciseSettings(title='t', targets=(LINE,), criteria=criteria, time_limit=30)


@pytest.mark.parametrize(
    ('coverage', 'time', 'points', 'passed', 'reasons'),
    [
        (1.0, 5, 100.0, True, 0),
        (0.75, 15, 50.0, False, 2),
        (0.5, 5, 25.0, False, 1),
        (1.0, 31, 75.0, False, 2),
        (float('nan'), 0, 25.0, False, 1),
    ],
)
def test_score_is_in_proportion_and_says_why(coverage, time, points, passed, reasons) -> None:
    got = score(exercise(), dict.fromkeys(('coverage',), coverage) | {'time': time})
    assert got.points == pytest.approx(points)
    assert got.passed is passed
    assert len(got.reasons) == reasons


def test_an_attempt_is_broken_off_until_the_tip_is_back_at_its_end() -> None:
    end = BallSettings(name='end', centre=(0, 0, 0.05), radius=0.005)
    attempt = Attempt(exercise().model_copy(update={'end': end}))
    assert not attempt.broken_off  # nothing was touched: there is nothing to break off
    motion = np.zeros((300, 11))
    motion[:, 0] = np.arange(300) / RATE_HZ
    motion[100:200, 10] = 1
    attempt.add_motion(motion[:250])
    assert attempt.broken_off
    motion[250:, 3] = 0.05
    attempt.add_motion(motion[250:])
    assert not attempt.broken_off


@pytest.mark.parametrize('does', ['nothing', 'moves', 'touches', 'begins late'])
def test_an_attempt_ends_with_its_time_limit_and_fails(does: str) -> None:
    end = BallSettings(name='end', centre=(0, 0, 0.05), radius=0.005)
    task = exercise().model_copy(update={'end': end})
    attempt = Attempt(task)
    motion = np.zeros((500, 11))
    motion[:, 0] = np.arange(500) / 10.0
    if does in ('moves', 'touches'):
        motion[50:, 1] = 0.02
    if does == 'touches':
        motion[100:, 10] = 1
    if does == 'begins late':
        motion[400:, 1] = 0.02
    attempt.add_motion(motion[:300])
    assert not attempt.over  # after 30 s, the limit
    attempt.add_motion(motion[300:])
    assert attempt.over and not attempt.broken_off
    measures = attempt.measures()
    assert measures['time'] == pytest.approx(30.1)
    got = score(task, measures)
    assert not got.passed and any('the limit is 30 s' in reason for reason in got.reasons)


def test_an_attempt_says_that_the_lesion_is_still_held_and_not_that_it_has_no_tissue() -> None:
    task = ExerciseSettings(
        title='t',
        targets=(LINE,),
        criteria=(CriterionSettings(measure='lesion_margin', good=3e-3, bad=0.0),),
        lesion=BallSettings(name='lesion', centre=(0, 0, 0), radius=0.006),
        time_limit=30,
    )
    (reason,) = score(task, Attempt(task).measures()).reasons
    assert reason.startswith(
        'tissue around the lesion: the lesion is still held; full marks at 3 mm'
    )


def test_measures_do_not_depend_on_how_samples_were_batched() -> None:
    random = np.random.default_rng(4)
    motion = np.cumsum(random.normal(size=(3000, 11)) * 1e-4, axis=0)
    motion[:, 0] = np.arange(3000) * 1e-3
    motion[:, 10] = random.integers(0, 3, 3000)
    forces = np.column_stack([motion[:, 0], random.uniform(0, 8, 3000)])
    whole, parts = Attempt(exercise()), Attempt(exercise())
    whole.add_motion(motion)
    whole.add_forces(forces)
    for part in np.array_split(np.arange(3000), 17):
        parts.add_motion(motion[part])
        parts.add_forces(forces[part])
        parts.measures()
    np.testing.assert_equal(whole.measures(), parts.measures())


def test_measures_of_a_bag_are_the_same_bits_and_see_its_cut() -> None:
    target = TargetSettings(
        name='line', points=((-0.02, 0, 0.01), (0.02, 0, 0.01)), margin=0.03, depth=(0.001, 0.02)
    )
    task = exercise().model_copy(update={'targets': (target,)})
    first, second = (read_attempt(open_bag(SAMPLE), task).measures() for _ in range(2))
    np.testing.assert_equal(first, second)
    assert first['coverage'] > 0.3
    assert first['time'] > 1
    assert first['peak_force'] > 0
