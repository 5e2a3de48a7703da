"""Named materials; each number has its source beside it."""

from dataclasses import dataclass, field
from typing import Literal

PresetName = Literal[
    'liver_yi2007',
    'liver_elastography',
    'liver_human',
    'liver_porcine',
    'liver_bovine',
    'kidney_human',
    'fat_human',
    'skin_human',
    'gelatine_1_to_20',
    'silicone_pdms_33_to_1',
]
How = Literal['table', 'page', 'abstract', 'computed', 'borrowed', 'chosen']
"""Way in which a number was had: read in a table, on a page, in an abstract; computed from such a
number; borrowed from another species; chosen here for want of a source."""


@dataclass(frozen=True)
class Number:
    """A number of a material.

    Attributes:
        value: in the unit of the scene key.
        how: way in which it was had.
        source: paper, DOI and table, and how they were converted.
    """

    value: float
    how: How
    source: str


@dataclass(frozen=True)
class Preset:
    """A named material.

    Attributes:
        numbers: by key of `material`.
        not_found: quantities that were looked for without success.
    """

    numbers: dict[str, Number]
    not_found: tuple[str, ...] = field(default=())

    @property
    def values(self) -> dict[str, float]:
        """Numbers by key of `material`."""
        return {key: number.value for key, number in self.numbers.items()}


_YI = 'J. Yi, MASc thesis, Carleton University 2007, section 7.2'
_ACOUSTIC = 'doi 10.1088/1361-6560/ab5010, table 1'
_REVIEW = 'doi 10.1186/s10033-022-00767-4, table 2'
_DENSITIES = 'medicalalgorithms.com/density-of-various-organs-and-tissues, after Kaye and Laby'
_NU = Number(0.45, 'chosen', 'nearly incompressible; linear tetrahedra lock above it')
_LIVER_E = f'human liver, three times the shear modulus of 1.8 +- 0.4 kPa: {_ACOUSTIC}'
_HUMAN_LIVER = {
    'youngs_modulus': Number(5400.0, 'computed', _LIVER_E),
    'poissons_ratio': _NU,
    'density': Number(1060.0, 'table', f'human liver: {_ACOUSTIC}'),
}
_OTHER_LIVER = {
    'youngs_modulus': Number(5400.0, 'borrowed', _LIVER_E),
    'poissons_ratio': _NU,
    'density': Number(1060.0, 'borrowed', f'human liver: {_ACOUSTIC}'),
}
_HARDENS = (
    'human liver, from E and the ultimate stress of 0.27 MPa at a true strain of 0.38, taken as '
    f'true stress of an incompressible bar: {_ACOUSTIC}'
)
_STIFFENS = Number(9.2, 'borrowed', _HARDENS)
_BLADE = f'middle of 187 to 225 J/m^2, porcine liver, blade: {_REVIEW}'
_TIME = ('prony', 'friction')
_LARGE = ('stiffening', *_TIME)

PRESETS: dict[PresetName, Preset] = {
    'liver_yi2007': Preset(
        {
            'youngs_modulus': Number(642.55, 'page', _YI),
            'poissons_ratio': Number(0.47, 'page', _YI),
            'density': Number(1050.0, 'page', _YI),
            'toughness': Number(200.0, 'borrowed', f'within 187 to 225 J/m^2, porcine: {_REVIEW}'),
        },
        _LARGE,
    ),
    'liver_elastography': Preset(
        {
            **_HUMAN_LIVER,
            'toughness': Number(200.0, 'borrowed', f'within 187 to 225 J/m^2, porcine: {_REVIEW}'),
        },
        _LARGE,
    ),
    'liver_human': Preset(
        {
            **_HUMAN_LIVER,
            'stiffening': Number(9.2, 'computed', _HARDENS),
            'toughness': Number(206.0, 'borrowed', _BLADE),
        },
        _TIME,
    ),
    'liver_porcine': Preset(
        {
            **_OTHER_LIVER,
            'stiffening': _STIFFENS,
            'toughness': Number(206.0, 'computed', _BLADE),
        },
        _TIME,
    ),
    'liver_bovine': Preset(
        {
            **_OTHER_LIVER,
            'stiffening': _STIFFENS,
            'toughness': Number(
                164.0, 'abstract', '164 +- 6 J/m^2, needle: doi 10.1016/j.medengphy.2011.09.030'
            ),
        },
        _TIME,
    ),
    'kidney_human': Preset(
        {
            'youngs_modulus': Number(
                14700.0,
                'computed',
                'three times the shear modulus of 4.9 +- 0.5 kPa at 45 Hz: '
                'doi 10.1002/jmri.22670, abstract',
            ),
            'poissons_ratio': _NU,
            'density': Number(1050.0, 'page', _DENSITIES),
        },
        ('toughness', *_LARGE),
    ),
    'fat_human': Preset(
        {
            'youngs_modulus': Number(
                2256.0,
                'computed',
                'three times the shear modulus of 752 Pa at 50 Hz: '
                'doi 10.1016/j.jmbbm.2023.105924, abstract',
            ),
            'poissons_ratio': _NU,
            'density': Number(923.0, 'page', _DENSITIES),
            'toughness': Number(4100.0, 'borrowed', f'porcine adipose, trouser tear: {_REVIEW}'),
        },
        _LARGE,
    ),
    'skin_human': Preset(
        {
            'youngs_modulus': Number(
                40000.0,
                'abstract',
                'dermis at 0.2 to 1 kHz: In vivo stiffness measurement of epidermis, dermis, and '
                'hypodermis using broadband Rayleigh-wave optical coherence elastography, '
                'preprint 2022',
            ),
            'poissons_ratio': _NU,
            'density': Number(1150.0, 'page', _DENSITIES),
            'toughness': Number(1136.0, 'borrowed', f'porcine skin, needle: {_REVIEW}'),
        },
        _LARGE,
    ),
    'gelatine_1_to_20': Preset(
        {
            'youngs_modulus': Number(
                4340.0,
                'abstract',
                'one part of powder to 20 of water, instantaneous 4.34 +- 0.64 kPa: '
                'arXiv 2512.20502',
            ),
            'poissons_ratio': _NU,
        },
        ('density', 'toughness', *_LARGE),
    ),
    'silicone_pdms_33_to_1': Preset(
        {
            'youngs_modulus': Number(
                570000.0,
                'abstract',
                'PDMS, 33 parts of base to one of curing agent: doi 10.1002/app.41050',
            ),
            'poissons_ratio': _NU,
        },
        ('density', 'toughness', *_LARGE),
    ),
}
"""Materials by name. What was not found is absent: the scene gives it or has its default."""
