"""`trainer fuzz-cuts`: random strokes against the invariants of a cut."""

import zipfile
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from bench.cuts.random_strokes import Scene, play, run
from cutting_trainer.cutting.method_interface import CASES
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.session.errors import SessionError
from cutting_trainer.session.exit_status import Status


def run_strokes(strokes: int, seed: int, method: str, folder: Path) -> Status:
    """Cut random strokes and print the results.

    Args:
        strokes: how many.
        seed: of everything random.
        method: of cutting.
        folder: where scenes that break an invariant are saved.

    Raises:
        SessionError: there is no such method or folder.
    """
    _check_method(method)
    if not folder.is_dir():
        raise SessionError(f'{folder} is no folder: make it first, broken scenes are saved in it')
    console = Console(soft_wrap=True, highlight=False)
    bar = Progress(
        TextColumn('strokes'),
        BarColumn(bar_width=30),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )
    with bar:
        task = bar.add_task('', total=strokes)
        report = run(
            strokes,
            seed,
            lambda done: bar.update(task, completed=done),
            method=method,
            folder=folder,
        )
    console.print(f'{report.strokes} strokes by {method}, {report.batches} batches')
    console.print(f'cases: {_counted(report.cases)}')
    for sentence, path in zip(report.violations, report.saved, strict=True):
        console.print(f'{sentence}\n  ./trainer bench fuzz-cuts --method {method} --replay {path}')
    console.print(f'{len(report.violations)} violations')
    return Status.FAILED if report.violations else Status.OK


def replay_scene(file: Path, method: str) -> Status:
    """Cut a saved scene again and print the result.

    Args:
        file: that `run_strokes` saved.
        method: of cutting.

    Raises:
        SessionError: there is no such method, or the file is no scene.
    """
    _check_method(method)
    try:
        scene = Scene.load(file)
    except (OSError, EOFError, KeyError, TypeError, ValueError, zipfile.BadZipFile) as error:
        raise SessionError(
            f'{file} is no scene that fuzz-cuts has saved ({type(error).__name__}: {error})'
        ) from None
    console = Console(soft_wrap=True, highlight=False)
    console.print(f'{len(scene.tetrahedra)} tetrahedra, {len(scene.strokes)} strokes by {method}')
    try:
        batches, cases = play(scene, method)
    except Exception as error:  # a scene may be saved for any error
        console.print(f'{type(error).__name__}: {error}')
        return Status.FAILED
    console.print(f'{batches} batches, no violation; cases: {_counted(cases)}')
    return Status.OK


def _check_method(method: str) -> None:
    known = get_args(CuttingSettings.model_fields['method'].annotation)
    if method not in known:
        raise SessionError(f'there is no method {method!r}; there are {", ".join(known)}')


def _counted(cases: NDArray[np.int64]) -> str:
    return ', '.join(f'{name} {count}' for name, count in zip(CASES, cases, strict=True))
