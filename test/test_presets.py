"""Named materials: each number has a source, and the page lists them."""

from typing import get_args

import pytest
from pydantic import ValidationError

from bench.reference import materials
from cutting_trainer.tissue_sim.material_presets import PRESETS, PresetName
from cutting_trainer.tissue_sim.scene_schema import MaterialSettings

PLACES = ('doi 10.', 'arXiv ', 'thesis', '.com/', 'preprint')


def test_each_number_of_a_preset_is_a_key_of_the_scene_and_has_a_source() -> None:
    assert tuple(PRESETS) == get_args(PresetName)
    for name, preset in PRESETS.items():
        for key, number in preset.numbers.items():
            assert key in MaterialSettings.model_fields, (name, key)
            found = any(place in number.source for place in PLACES)
            assert found or number.how == 'chosen', (name, key)
        assert not set(preset.not_found) & set(preset.numbers), name


@pytest.mark.parametrize('name', PRESETS)
def test_a_preset_fills_a_material_or_the_missing_key_is_named(name: PresetName) -> None:
    preset = PRESETS[name]
    needed = {k for k, f in MaterialSettings.model_fields.items() if f.is_required()}
    missing = needed - preset.numbers.keys()
    assert missing <= set(preset.not_found)
    if missing:
        with pytest.raises(ValidationError) as refused:
            MaterialSettings.model_validate({'preset': name})
        assert all(key in str(refused.value) for key in missing)
    given = dict.fromkeys(missing, 1000.0)
    material = MaterialSettings.model_validate({'preset': name} | given)
    assert {key: getattr(material, key) for key in preset.values} == preset.values


def test_the_page_of_the_materials_is_that_of_the_presets() -> None:
    assert materials.FILE.read_text(encoding='utf-8') == materials.page()
