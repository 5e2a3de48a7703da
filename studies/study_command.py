"""`trainer study`: recorded hands on many changed tissues, on all processors."""

import contextlib
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol

from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from cutting_trainer.session.demo_command import SESSIONS
from cutting_trainer.session.errors import SessionError
from cutting_trainer.session.exit_status import Status
from cutting_trainer.studies.bag_collection import StudyBag, find_attempts, find_bags
from cutting_trainer.studies.description import Study, read_study
from cutting_trainer.studies.designs import RECORDED, Key, Setting, settings_of
from cutting_trainer.studies.evaluation import Job, Result
from cutting_trainer.studies.identity import identity_of_worker
from cutting_trainer.studies.journal import Journal, key_of, open_journal
from cutting_trainer.studies.kept_files import are_kept, keep
from cutting_trainer.studies.summary import PAGE_FILE, StudySummary, as_text, summarise, write_page
from cutting_trainer.studies.table import COSTS_FILE, TABLE_FILE, Row, write_costs, write_table

_TABLE_PERIOD_S = 5.0
_MAX_TABLE_SHARE = 0.05
"""Share of the time that may go into tables of partial results."""
NO_DASK = (
    'a study needs Dask, which is not installed: `./trainer setup` installs it, and elsewhere '
    '`pip install "cutting_trainer[study]"`'
)


class WorkerOptions(Protocol):
    """Options of a command about its workers."""

    @property
    def workers(self) -> int:
        """Number of own workers; 0: one for each processor."""

    @property
    def scheduler(self) -> str:
        """Address of a scheduler with workers; '': own workers."""


@dataclass(frozen=True)
class StudyOptions:
    """Options of the command.

    Attributes:
        file: study file.
        output: folder of the results; None: that of the file's name beside it.
        workers: number of own workers; 0: one for each processor.
        scheduler: address of a scheduler with workers; '': own workers.
        as_json: print the outcome as JSON.
    """

    file: Path
    output: Path | None = None
    workers: int = 0
    scheduler: str = ''
    as_json: bool = False

    @property
    def folder(self) -> Path:
        """Folder of the results."""
        return self.output or self.file.with_suffix('')


@dataclass
class Plan:
    """Rows of a study, done or not.

    Attributes:
        reference: setting whose force the others are compared with.
        folder: of the results.
        lost: results that no worker could compute this time, by key.
    """

    study: Study
    bags: list[StudyBag]
    settings: list[Setting]
    reference: Setting
    journal: Journal
    folder: Path
    lost: dict[Key, Result]

    @property
    def size(self) -> int:
        """Number of rows."""
        return len(self.bags) * len(self.settings)

    def jobs(self) -> list[Job]:
        """Return the rows to be computed, bag by bag, the session as recorded first."""
        here, wanted = identity_of_worker(), tuple(self.study.keep)
        return [
            Job(bag.place, bag.hash, setting, here, reference=self.reference, keep=wanted)
            for bag in self.bags
            for setting in self.settings
            if not self._is_done(key_of(bag.hash, setting))
        ]

    def _is_done(self, key: Key) -> bool:
        """Return whether a row is in the journal, and its files are in their folder."""
        result = self.journal.rows.get(key)
        if result is None or result.failure:
            return result is not None
        return are_kept(self.folder, key, self.study.keep, result.kept)

    def rows(self) -> list[Row]:
        """Return the rows that are done, in the order of bags and settings."""
        results = self.journal.rows | self.lost
        return [
            Row(bag, setting, results[key])
            for bag in self.bags
            for setting in self.settings
            if (key := key_of(bag.hash, setting)) in results
        ]

    def take(self, job: Job, result: Result) -> None:
        """Keep a result."""
        key = key_of(job.bag_hash, job.setting)
        if result.lost:
            self.lost[key] = result
            return
        with _writing(self.folder):
            kept = keep(self.folder, key, result.files)
        self.journal.append(key, replace(result, files={}, kept=kept))


def run_study(options: StudyOptions) -> Status:
    """Compute a study, or go on with it, and print its summary.

    Raises:
        SceneError: the study file is not valid.
        SessionError: there are no bags, no scheduler, or no Dask.
    """
    if find_spec('distributed') is None:
        raise SessionError(NO_DASK)
    study = read_study(options.file)
    notes = Console(stderr=True, soft_wrap=True)
    beside = options.file.resolve().parent
    bags = bags_of(study, beside, notes)
    settings = [RECORDED, *settings_of(study, beside)]
    reference = settings[1] if study.reference is not None else RECORDED
    if not options.folder.parent.is_dir() or options.folder.is_file():
        raise SessionError(
            f'{options.folder} cannot be made: name a folder with --output in one that exists'
        )
    options.folder.mkdir(exist_ok=True)
    with open_journal(options.folder, identity_of_worker(), reference.identity) as journal:
        plan = Plan(study, bags, settings, reference, journal, options.folder, {})
        interrupted = not _compute(plan, options, notes)
        _write_tables(options.folder, plan)
        rows = plan.rows()
        summary = summarise(rows, study, plan.size)
        with _writing(options.folder):
            write_page(options.folder / PAGE_FILE, options.file.stem, summary)
    _tell(options, plan, rows, summary)
    if interrupted:
        notes.print('interrupted: the same command goes on with what is left', highlight=False)
        return Status.INTERRUPTED
    return Status.FAILED if summary.failures else Status.OK


def bags_of(study: Study, folder: Path, notes: Console) -> list[StudyBag]:
    """Return the bags that a study names and those of its attempts, each content once."""
    found = {bag.hash: bag for bag in find_bags(study.bags or (), folder)}
    if (wanted := study.attempts) is not None:
        attempts, problems = find_attempts(
            folder / wanted.folder if wanted.folder else SESSIONS, wanted.subject, wanted.exercise
        )
        for problem in problems:
            notes.print(f'left out: {escape(problem)}', highlight=False)
        for bag in find_bags(attempts, folder):
            found.setdefault(bag.hash, bag)
    return list(found.values())


def _compute(plan: Plan, options: StudyOptions, notes: Console) -> bool:
    """Compute the rest of a study; return False where it was interrupted."""
    jobs = plan.jobs()
    done = plan.size - len(jobs)
    wanted = {key_of(job.bag_hash, job.setting) for job in jobs}
    if outdated := len(plan.journal.outdated & wanted):
        notes.print(
            f'{outdated} rows of {escape(str(options.folder))} are of other code or libraries, or '
            'beside another reference, and are computed again',
            highlight=False,
        )
    if fileless := len(plan.journal.rows.keys() & wanted):
        notes.print(f'{fileless} rows lack files, and are computed again', highlight=False)
    if not jobs:
        return True
    from cutting_trainer.studies.cluster import compute

    if done:
        notes.print(f'{done} of {plan.size} rows are done already', highlight=False)
    try:
        with workers_of(options, len(jobs)) as client, _progress(notes) as bar:
            threads = sum(client.nthreads().values())
            notes.print(
                f'{len(plan.bags)} bags, {len(plan.settings) - 1} settings, {threads} workers; '
                f'dashboard: {escape(client.dashboard_link)}',
                highlight=False,
            )
            task = bar.add_task('rows', total=plan.size, completed=done, failed='')
            save = _saving(lambda: _write_tables(options.folder, plan))
            failed = 0
            for job, result in compute(client, jobs):
                plan.take(job, result)
                failed += bool(result.failure)
                bar.update(task, advance=1, failed=f'{failed} failed' if failed else '')
                save()
    except KeyboardInterrupt:
        return False
    return True


def workers_of(options: WorkerOptions, most: int | None = None) -> AbstractContextManager[Any]:
    """Return a client of the workers that options ask for, no more own ones than `most`.

    Raises:
        SessionError: there is no scheduler, or both kinds of workers are asked for.
    """
    from cutting_trainer.studies.cluster import others_cluster, own_cluster

    if options.scheduler and options.workers:
        raise SessionError(
            '--workers starts own workers, and --scheduler has those of others: give one of them'
        )
    if options.scheduler:
        return others_cluster(options.scheduler)
    own = options.workers or len(os.sched_getaffinity(0))
    return own_cluster(own if most is None else min(own, most))


def _progress(notes: Console) -> Progress:
    columns = (
        TextColumn('{task.description}'),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn('{task.fields[failed]}'),
    )
    return Progress(*columns, console=notes, transient=True)


def _saving(write: Callable[[], None]) -> Callable[[], None]:
    """Return a function that writes if the last time was long enough ago."""
    period, last = _TABLE_PERIOD_S, time.monotonic()

    def save() -> None:
        nonlocal period, last
        began = time.monotonic()
        if began - last >= period:
            write()
            last = time.monotonic()
            period = max(_TABLE_PERIOD_S, (last - began) / _MAX_TABLE_SHARE)

    return save


def _write_tables(folder: Path, plan: Plan) -> None:
    rows = plan.rows()
    with _writing(folder):
        write_table(folder / TABLE_FILE, rows, plan.study.outputs)
        write_costs(folder / COSTS_FILE, rows)


@contextlib.contextmanager
def _writing(folder: Path) -> Iterator[None]:
    """Turn an error of the disk into a sentence; pyarrow's has no number."""
    try:
        yield
    except OSError as error:
        raise SessionError(
            f'{folder} cannot take the results ({error}): mend that, and start the study again; it '
            'goes on with what is left'
        ) from None


def _tell(options: StudyOptions, plan: Plan, rows: list[Row], summary: StudySummary) -> None:
    files = [str(options.folder / name) for name in (TABLE_FILE, COSTS_FILE, PAGE_FILE)]
    if options.as_json:
        report = {
            'written': files,
            'bags': len(plan.bags),
            'settings': len(plan.settings) - 1,
            'rows': len(rows),
            'planned': plan.size,
            'failures': summary.failures,
            'tradeoffs': [without_nan(one) for one in summary.tradeoffs],
            'effects': [without_nan(effect) for effect in summary.settings],
            'effects_of_keys': [without_nan(effect) for effect in summary.keys],
            'notes': summary.notes,
        }
        json.dump(report, sys.stdout, indent=2)
        print()
        return
    console = Console(soft_wrap=True)
    console.print(as_text(summary), highlight=False)
    for file in files:
        console.print(f'wrote {escape(file)}', highlight=False)


def without_nan(found: Any) -> dict[str, object]:
    """Return a data class for JSON, which has no NaN."""
    return {k: None if v != v else v for k, v in asdict(found).items()}
