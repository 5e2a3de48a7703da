"""Writes docs/materials.md from the presets.

Run as `python -m bench.reference.materials` in the checkout after a change of the presets.
"""

from cutting_trainer.node_common.share_folder import PACKAGES
from cutting_trainer.tissue_sim.material_presets import PRESETS
from cutting_trainer.tissue_sim.scene_schema import MaterialSettings

FILE = PACKAGES / 'docs' / 'materials.md'
_PAGE = """# Materials

<!-- Written by `python -m bench.reference.materials` from the presets. -->

Values of `tissue.material.preset`, and the source of each number. A number is read in a table, on
a page or in an abstract, *computed* from one, *borrowed* from another species, or *chosen* for want
of a source. A number that was not found is absent. The scene must then give `density`;
`toughness` has its default of {toughness:g} J/m^2, `stiffening` and `friction` have 0. Beside
`tissue.regions[].preset` an absent value is that of `tissue.material`.

| preset | key | value | read in | source |
|---|---|---|---|---|
{numbers}

Looked for and not found:

| preset | numbers |
|---|---|
{missing}
"""


def page() -> str:
    """Return the page; presets with the same number, or the same gaps, share a row."""
    numbers: dict[str, list[str]] = {}
    missing: dict[str, list[str]] = {}
    for name, preset in PRESETS.items():
        for key, n in preset.numbers.items():
            row = f'`{key}` | {n.value:g} | {n.how} | {n.source} |'
            numbers.setdefault(row, []).append(f'`{name}`')
        missing.setdefault(', '.join(f'`{k}`' for k in preset.not_found), []).append(f'`{name}`')
    toughness = MaterialSettings.model_fields['toughness'].default
    return _PAGE.format(toughness=toughness, numbers=_rows(numbers), missing=_rows(missing, ' |'))


def _rows(presets: dict[str, list[str]], end: str = '') -> str:
    return '\n'.join(f'| {", ".join(names)} | {row}{end}' for row, names in presets.items())


if __name__ == '__main__':
    FILE.write_text(page(), encoding='utf-8')
