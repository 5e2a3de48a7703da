"""Measure the figures of a subject: `./trainer run python -m bench.figures SUBJECT [--json]`."""

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from functools import partial
from multiprocessing import get_context
from typing import NamedTuple

from bench.figures.figure import Figure, figures_of


class Subject(NamedTuple):
    """Modules that measure a subject.

    Attributes:
        modules: in this folder, each with `measure() -> list[Figure]`; one after the other.
        not_covered: reason why a claim has no figure here, by its number.
        together: modules that measure no time; at the same time, in processes of their own.
    """

    modules: tuple[str, ...]
    not_covered: dict[int, str]
    together: tuple[str, ...] = ()


SUBJECTS = {
    'arms': Subject(
        modules=('arms_two_tools',),
        together=('arms_energy', 'arms_clutch', 'arms_placement'),
        not_covered={
            1: 'of it: 60 s take `python -m bench.figures.arms_two_tools --seconds 60`',
            2: 'of it: a thousand take `python -m bench.figures.arms_clutch --rounds 40 --each 25`',
            3: 'foreign programs are not run here',
            5: 'it takes a quiet machine: `./trainer bench speed`',
            6: 'it needs readers who have not seen the code',
        },
    ),
    'blade': Subject(
        modules=(),
        together=('blade_phases', 'blade_severance', 'blade_law', 'blade_contact', 'blade_force'),
        not_covered={
            3: 'of the law: edge, spine and flat do not differ',
            4: 'of it: 64 strokes take 4 minutes: `python -m bench.haptics.random_cuts`',
            5: 'of it: live under load, which takes minutes: `./trainer bench same-cut BAG`',
            7: 'it takes minutes: `./trainer validate`',
            8: 'the pieces are not measured here',
            9: 'it takes a quiet machine: `./trainer bench speed`',
        },
    ),
    'house': Subject(
        modules=('house',),
        not_covered={
            1: 'it needs readers who have not seen the code',
            4: 'starting from empty caches takes minutes, and so does `./trainer test`',
        },
    ),
    'scale': Subject(
        modules=('scale_far_field', 'scale_threads'),
        not_covered={
            1: 'of it: 197,472 tetrahedra cut, and their frame, which take minutes: '
            '`python -m bench.accuracy.far_field_session 197472`',
            2: 'it needs a live session on a quiet machine: `./trainer bench timing`',
            3: 'of it: eight cores, on paper in docs/performance.md',
            4: 'a thousand strokes take minutes: `./trainer bench strokes`',
            5: 'it needs a live session on a quiet machine: '
            '`python -m bench.figures.scale_governor`',
            6: 'it needs a reader',
        },
    ),
    'studies': Subject(
        modules=('studies_dask', 'studies_arrays'),
        not_covered={
            1: 'of it: 20 bags, 10 settings and 20 kills take minutes',
            2: 'of it: jobs of Slurm: `./trainer test --all -k slurm`',
            3: 'it takes minutes: `python -m bench.trials.identification`',
            4: "of it: LeRobot's own loader, in an environment of its own: "
            '`python -m bench.files.lerobot_loader`',
            5: 'it needs readers who have not seen the code',
        },
    ),
    'tissue': Subject(
        modules=('tissue_contact', 'tissue_friction', 'tissue_law', 'tissue_relaxation'),
        not_covered={
            4: 'the blade in tissue that stiffens is not measured here',
            7: 'it takes minutes: `./trainer validate`',
        },
    ),
    'training': Subject(
        modules=('training',),
        not_covered={
            1: 'it needs a browser: `./trainer test --all -k test_page_training`',
            2: 'of it: the other four exercises, those who cut everything, and 40 attempts of each '
            'kind: an hour or more by `python -m bench.training -o FILE`',
            3: 'it needs eyes that have not seen the code',
            4: 'it needs a browser',
            5: 'it needs a browser',
            6: 'of it: a crash in an attempt: `./trainer test --all -k test_attempt_crash`',
        },
    ),
    'trust': Subject(
        modules=('trust_bridge', 'trust_output'),
        together=('trust_page', 'trust_files'),
        not_covered={7: 'it needs a browser: `./trainer test --all -k test_page_session`'},
    ),
}


def main() -> int:
    """Measure, print, and return 1 where a figure falls short of its bound."""
    parser = argparse.ArgumentParser(prog='bench.figures', description=__doc__)
    parser.add_argument('subject', choices=sorted(SUBJECTS))
    parser.add_argument('--json', action='store_true', help='print one JSON object')
    options = parser.parse_args()
    subject = SUBJECTS[options.subject]
    began = time.monotonic()
    figures: list[Figure] = []
    errors: dict[str, str] = {}
    for name, measured in _measure(subject):
        try:
            figures += measured()
        except Exception as error:  # one that cannot be measured falls short; the rest go on
            errors[name] = f'{type(error).__name__}: {error}'
    seconds = time.monotonic() - began
    if options.json:
        print(as_json(options.subject, subject, figures, errors, seconds))
    else:
        print_table(subject, figures, errors, seconds)
    return 0 if figures and not errors and all(figure.passes for figure in figures) else 1


def _measure(subject: Subject) -> Iterator[tuple[str, Callable[[], list[Figure]]]]:
    """Yield each module of a subject, and the function that returns its figures."""
    for name in subject.modules:
        yield name, partial(figures_of, name)
    with ProcessPoolExecutor(max(len(subject.together), 1), get_context('spawn')) as pool:
        running = [(name, pool.submit(figures_of, name)) for name in subject.together]
        yield from ((name, future.result) for name, future in running)


def as_json(
    name: str, subject: Subject, figures: list[Figure], errors: dict[str, str], seconds: float
) -> str:
    """Return the figures as one JSON object."""
    rows = [asdict(figure) | {'passes': figure.passes} for figure in figures]
    content = {
        'subject': name,
        'seconds': round(seconds, 1),
        'figures': rows,
        'errors': errors,
        'not_covered': {str(line): why for line, why in subject.not_covered.items()},
    }
    return json.dumps(content, indent=2)


def print_table(
    subject: Subject, figures: list[Figure], errors: dict[str, str], seconds: float
) -> None:
    """Print the figures for people."""
    for figure in sorted(figures, key=lambda figure: figure.line):
        verdict = 'ok   ' if figure.passes else 'SHORT'
        unit = f' {figure.unit}' if figure.unit else ''
        print(
            f'{verdict} line {figure.line}: {figure.name}: {figure.value:.4g}{unit}, '
            f'{figure.side} {figure.bound:.4g}{unit} (n = {figure.samples})'
        )
        if figure.reference:
            print(f'      as a ratio to {figure.reference}; {figure.absolute}')
    for name, error in errors.items():
        print(f'SHORT {name} could not be measured: {error}')
    for line, why in subject.not_covered.items():
        print(f'      line {line} is not covered: {why}')
    print(f'{seconds:.1f} s')


if __name__ == '__main__':
    sys.exit(main())
