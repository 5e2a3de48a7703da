"""Effects, beside exact ones; accuracy and cost."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from study_world import GOOD, bags, made_rows, result, study

from cutting_trainer.studies.accuracy_and_cost import tradeoff_figure, tradeoffs
from cutting_trainer.studies.cluster import lost
from cutting_trainer.studies.designs import RECORDED, Setting
from cutting_trainer.studies.effects import effects_of_keys, effects_of_settings, interval
from cutting_trainer.studies.evaluation import Job
from cutting_trainer.studies.identity import identity_of_worker
from cutting_trainer.studies.summary import as_text, summarise, write_page
from cutting_trainer.studies.table import Row


def test_keys_that_share_their_last_word_are_told_apart() -> None:
    settings = [
        Setting(1 + 2 * i + k, {'haptics.rate': x, 'tissue.rate': y, 'a.b': x * y})
        for i, x in enumerate((1, 2))
        for k, y in enumerate((3, 5))
    ]
    effects = effects_of_settings(
        made_rows(2, settings[::3], np.zeros((2, 3))), ['largest_force'], 0.95
    )
    assert effects[0].cause == 'haptics.rate=1, tissue.rate=3, b=3'
    alone = [Setting(1, {'haptics.rate': 60}), Setting(2, {'tissue.rate': 60})]
    effects = effects_of_settings(made_rows(2, alone, np.zeros((2, 3))), ['largest_force'], 0.95)
    assert [effect.cause for effect in effects] == ['haptics.rate=60', 'tissue.rate=60']
    rows = made_rows(3, settings, np.array([[0, 10, 12, 11, 13]] * 3))
    found, _ = effects_of_keys(rows, ['largest_force'], 0.95)
    assert {e.cause: e.mean for e in found if 'rate' in e.cause} == pytest.approx(
        {'haptics.rate 1 -> 2': 1.0, 'tissue.rate 3 -> 5': 2.0}
    )


def test_a_reference_counts_for_its_keys_where_the_designs_have_them(tmp_path: Path) -> None:
    values = [(3, {'a.b': 3}), (1, {'a.b': 1}), (2, {'a.b': 2})]
    text = GOOD.replace('outputs: [', 'reference: {}\noutputs: [force_rms_difference, ')
    asked = study(tmp_path, text)
    for of_reference, cause, mean in (({}, 'b 1 -> 3', 4.0), ({'a.c': 0}, 'b 1 -> 2', 3.0)):
        settings = [Setting(n, changes | (of_reference if n == 3 else {})) for n, changes in values]
        rows = [
            replace(row, result=replace(row.result, reference=settings[0].identity))
            for row in made_rows(2, settings, np.array([[0, 9, 5, 8]] * 2))
        ]
        (found,) = summarise(rows, asked, len(rows)).keys
        assert (found.output, found.cause, found.mean) == (
            'largest_force',
            cause,
            pytest.approx(mean),
        )


def test_one_key_has_an_effect_of_its_own() -> None:
    settings = [Setting(1, {'a.b': 1}), Setting(2, {'a.b': 2})]
    rows = made_rows(2, settings, np.array([[0, 5, 8]] * 2))
    found, _ = effects_of_keys(rows, ['largest_force'], 0.95)
    assert [(effect.cause, effect.mean) for effect in found] == [('b 1 -> 2', pytest.approx(3.0))]
    rows = made_rows(2, settings[:1], np.array([[0, 5]] * 2))
    assert effects_of_keys(rows, ['largest_force'], 0.95) == ([], '')


def test_an_output_that_some_bags_lack_has_the_effects_of_the_others() -> None:
    settings = [Setting(1, {'s.x': 1}), Setting(2, {'s.x': 2})]
    rows = made_rows(3, settings, np.array([[0.0, 1.0, 2.0]] * 3))
    for n, row in enumerate(rows[3:]):  # two of three bags are of an exercise
        row.result.outputs['exercise.score'] = 50.0 + 5.0 * (n % 3)
    found = effects_of_settings(rows, ['exercise.score', 'largest_force'], 0.95)
    assert [(e.mean, e.bags) for e in found] == [(5.0, 2), (1.0, 3), (10.0, 2), (2.0, 3)]
    keys, _ = effects_of_keys(rows, ['exercise.score', 'largest_force', 'exercise.order'], 0.95)
    assert [(e.output, e.bags) for e in keys] == [('exercise.score', 2), ('largest_force', 3)]
    assert [e.mean for e in keys] == pytest.approx([5.0, 1.0])


def test_settings_on_the_front_have_no_rival_that_is_nearer_for_the_same_time(
    tmp_path: Path,
) -> None:
    # Error [N] and time [s] of each setting; the first one is the reference.
    given = [(0.0, 8.0), (0.4, 1.0), (0.5, 2.0), (0.1, 2.0), (0.1, 4.0), (0.2, 1.0)]
    settings = [Setting(n, {'s.x': n}) for n in range(1, 7)]
    rows = []
    for n, bag in enumerate(bags(3), start=1):  # each bag lasts longer, and has more force
        for setting, (error, time) in zip(settings, given, strict=True):
            values = {'force_rms_difference': error, 'mean_force_in_contact': 2.0 * n}
            made = result(0.0)
            made = replace(made, cpu=n * time, reference=settings[0].identity)
            rows.append(Row(bag, setting, replace(made, outputs=made.outputs | values)))
    rows[-1] = replace(rows[-1], result=replace(rows[-1].result, failure='it diverged'))
    found = tradeoffs(rows, 0.95)
    assert [one.setting for one in found] == ['x=6', 'x=2', 'x=4', 'x=3', 'x=5', 'x=1']
    assert [one.on_front for one in found] == [False, True, True, False, False, True]
    assert [one.ratio for one in found] == [0.125, 0.125, 0.25, 0.25, 0.5, 1.0]
    assert (found[1].error, found[1].time, found[1].bags) == (pytest.approx(0.4), 2.0, 3)
    assert found[1].share == pytest.approx(0.4 * (1 / 2 + 1 / 4 + 1 / 6) / 3)
    assert (found[0].bags, found[0].time) == (2, 1.5)  # it failed for one bag, and has no star
    summary = summarise(rows, study(tmp_path, GOOD), len(rows))
    write_page(tmp_path / 'page.html', 'models', summary)
    text = (tmp_path / 'page.html').read_text()
    assert 'Accuracy and cost' in text and 'x=4 *' in text and 'x=3 *' not in text
    gone = lost(Job('', '', RECORDED, identity_of_worker(), reference=settings[0]), 'it died')
    assert tradeoffs([Row(bag, RECORDED, gone), *rows], 0.95) == found
    assert gone.reference == settings[0].identity
    assert not tradeoffs([replace(r, result=replace(r.result, reference='')) for r in rows], 0.95)
    only_the_best = [row for row in rows if row.setting.number in (1, 2)]
    slow = [replace(r, result=replace(r.result, cpu=9.0 - r.setting.number)) for r in only_the_best]
    assert tradeoff_figure(tradeoffs(slow, 0.95)) is not None


def test_effects_of_a_linear_output_are_its_coefficients_in_each_bag(tmp_path: Path) -> None:
    settings = [
        Setting(1 + 3 * i + k, {'s.x': x, 's.word': word})
        for i, x in enumerate((1.0, 2.0, 5.0))
        for k, word in enumerate(('a', 'b', 'c'))
    ]
    random = np.random.default_rng(5)
    level = random.normal(size=12)
    per_x, of_b, of_c = 0.3 + 0.1 * random.normal(size=(3, 12)) * [[1], [2], [0]]
    change = np.array([[per_x * s.changes['s.x'], of_b, of_c] for s in settings], dtype=object)
    columns = [level] + [
        level + c[0] + {'a': 0.0, 'b': c[1], 'c': c[2]}[s.changes['s.word']]
        for s, c in zip(settings, change, strict=True)
    ]
    rows = made_rows(12, settings, np.array(columns).T)
    found, why_not = effects_of_keys(rows, ['largest_force'], 0.95)
    by_cause = {effect.cause: effect for effect in found}
    assert not why_not and by_cause.keys() == {'x 1 -> 5', 'word a -> b', 'word a -> c'}
    assert by_cause['x 1 -> 5'].mean == pytest.approx(4 * per_x.mean())
    assert by_cause['word a -> b'].mean == pytest.approx(of_b.mean())
    steady = by_cause['word a -> c']
    assert (steady.mean, steady.low, steady.high) == pytest.approx((0.3, 0.3, 0.3))
    of_settings = effects_of_settings(rows, ['largest_force'], 0.95)
    assert of_settings[4].mean == pytest.approx((2 * per_x + of_b).mean())
    assert of_settings[4].low < of_settings[4].mean < of_settings[4].high
    assert of_settings[4].reference == pytest.approx(level.mean())

    summary = summarise(rows, study(tmp_path, GOOD), len(rows) + 1)
    assert f'{len(rows)} of {len(rows) + 1} rows' in summary.notes[0]
    assert as_text(summary).renderables
    write_page(tmp_path / 'page.html', '<study>', summary)
    text = (tmp_path / 'page.html').read_text()
    assert 'x=5, word=c' in text and '&lt;study&gt;' in text and text.count('<img') == 1


def test_failed_row_takes_its_bag_out_of_the_effect_of_its_setting_alone() -> None:
    settings = [Setting(1, {'s.x': 1}), Setting(2, {'s.x': 2})]
    forces = np.array([[0.0, 1.0, 2.0], [0.0, 3.0, 4.0], [0.0, 5.0, 6.0]])
    rows = made_rows(3, settings, forces)
    rows[4] = replace(rows[4], result=result(0.0, 'the haptic bridge comes to a FAULT'))
    first, second = effects_of_settings(rows, ['largest_force'], 0.9)
    assert (first.mean, first.bags) == (3.0, 2) and (second.mean, second.bags) == (4.0, 3)


def test_keys_that_change_together_have_no_effects_of_their_own() -> None:
    together = [Setting(1, {'s.x': 1, 's.y': 1}), Setting(2, {'s.x': 2, 's.y': 2})]
    forces = np.zeros((4, 3))
    assert effects_of_keys(made_rows(4, together, forces), ['largest_force'], 0.9) == (
        [],
        'the settings cannot tell the effects of their keys apart: add settings',
    )


def test_intervals_of_a_mean_cover_it_about_as_often_as_they_say() -> None:
    random = np.random.default_rng(1)
    covered = 0
    for _ in range(100):
        _, low, high = interval(random.exponential(size=30), 0.9)
        covered += low <= 1.0 <= high
    assert 78 <= covered <= 97  # 0.9 +- 3.5 standard deviations, less what skewness takes
    assert interval(np.array([2.0, 2.0]), 0.9) == (2.0, 2.0, 2.0)
    mean, low, high = interval(np.array([2.0]), 0.9)
    assert mean == 2.0 and np.isnan([low, high]).all()
