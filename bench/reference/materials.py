"""Writes docs/materials.md from the presets.

Run as `python -m bench.reference.materials` in the checkout after a change of the presets.
"""

from cutting_trainer.node_common.share_folder import PACKAGES
from cutting_trainer.tissue_sim.material_presets import PRESETS
from cutting_trainer.tissue_sim.scene_schema import MaterialSettings

FILE = PACKAGES / 'docs' / 'materials.md'
_PAGE = """# Materials

<!-- Written by `python -m bench.reference.materials` from the presets. -->

Values of `tissue.material.preset`. In brackets: the number of the source, and how the value was
had. It was read in a *t*able, on a *p*age or in an *a*bstract, *c*omputed from such a number,
*b*orrowed from another species, or chosen (*x*) for want of a source. A dash was looked for and not
found, for each preset also {nowhere}. The scene must then give `density`;
`toughness` has its default of {toughness:g} J/m^2, the others 0. Beside `tissue.regions[].preset`
an absent value is that of `tissue.material`.

{numbers}

{sources}
"""
_MARKS = {
    'table': 't',
    'page': 'p',
    'abstract': 'a',
    'computed': 'c',
    'borrowed': 'b',
    'chosen': 'x',
}


def page() -> str:
    """Return the page: a row for each preset, and a numbered list of the sources."""
    keys = list(dict.fromkeys(key for preset in PRESETS.values() for key in preset.numbers))
    missing = dict.fromkeys(k for p in PRESETS.values() for k in p.not_found if k not in keys)
    sources: dict[str, int] = {}
    rows = [_row(['preset', *(f'`{key}`' for key in keys)]), '|---' * (1 + len(keys)) + '|']
    for name, preset in PRESETS.items():
        cells = [f'`{name}`']
        for key in keys:
            number = preset.numbers.get(key)
            if number is None:
                cells.append('-' if key in preset.not_found else '')
            else:
                place = sources.setdefault(number.source, 1 + len(sources))
                cells.append(f'{number.value:g} [{place}{_MARKS[number.how]}]')
        rows.append(_row(cells))
    return _PAGE.format(
        nowhere=' and '.join(f'`{key}`' for key in missing),
        toughness=MaterialSettings.model_fields['toughness'].default,
        numbers='\n'.join(rows),
        sources='\n'.join(f'{place}. {source}' for source, place in sources.items()),
    )


def _row(cells: list[str]) -> str:
    return f'| {" | ".join(cells)} |'


if __name__ == '__main__':
    FILE.write_text(page(), encoding='utf-8')
