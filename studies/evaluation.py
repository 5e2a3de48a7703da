"""One row of a study, computed by a worker: a bag under a setting."""

import json
import re
import tempfile
import time
import traceback
from dataclasses import dataclass, field
from functools import cache, lru_cache
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.bags.errors import BagError
from cutting_trainer.bags.reader import Bag, open_bag
from cutting_trainer.bags.recorded_frames import FrameRecord
from cutting_trainer.bags.recorded_indexings import recorded_indexings
from cutting_trainer.bags.resimulation_start import ComputationStart, find_beginning
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.cutting.warm_up import warm_up as warm_up_cutting
from cutting_trainer.exercises.bag_feed import read_attempt
from cutting_trainer.exercises.metrics import Attempt
from cutting_trainer.haptic_bridge.indexing import Indexing
from cutting_trainer.haptic_bridge.scene_schema import (
    DeviceSettings,
    HapticsSettings,
    SettingsError,
    ToolSettings,
)
from cutting_trainer.haptic_bridge.warm_up import warm_up as warm_up_force_path
from cutting_trainer.node_common.cdr_codec import StampedMessage
from cutting_trainer.node_common.errors import MeshError, SceneError
from cutting_trainer.recordings.recorded_hand import RecordedForce, computable_poses, recorded_force
from cutting_trainer.recordings.recorded_scene import restore_scene
from cutting_trainer.recordings.resimulate_command import recomputation, refuse_lost_changes
from cutting_trainer.recordings.what_if import Run, as_felt, move_hand, recompute
from cutting_trainer.session.errors import SessionError
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.studies.bag_collection import folder_of, hash_of_bag, require
from cutting_trainer.studies.designs import RECORDED, Setting
from cutting_trainer.studies.identity import Identity, identity_of_worker
from cutting_trainer.studies.kept_files import contents_of
from cutting_trainer.studies.outputs import FileName, measures_of, outputs_of
from cutting_trainer.studies.remote_bags import UnavailableError, without_copies
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation
from cutting_trainer.tissue_sim.warm_up import warm_up as warm_up_tissue

Floats = NDArray[np.float64]


_SENTENCES = (BagError, SessionError, SceneError, MeshError, SettingsError)
_PASSING = (UnavailableError, OSError, MemoryError)
"""Errors of a machine, which another start may not meet."""
_TEMPORARY = 'trainer-'
_OWN_FOLDER = re.compile(rf'{re.escape(tempfile.gettempdir())}/{_TEMPORARY}\w+/')
"""Folder of one row: reasons of equal rows are equal."""
_MAX_REASON = 500
"""Characters of a reason."""
_KEPT_BAGS = 2
"""Bags that a worker keeps in memory: all settings of one follow one another."""


@dataclass(frozen=True)
class Job:
    """A row to be computed.

    Attributes:
        bag: folder of the bag, or its URL.
        bag_hash: hash of its content.
        setting: changes of the scene.
        identity: code of whoever asks; a worker with other code refuses.
        series: the force over time is wanted, too.
        reference: setting whose force this one is compared with.
        keep: names of the files that are wanted, too.
    """

    bag: str
    bag_hash: str
    setting: Setting
    identity: Identity
    series: bool = False
    reference: Setting = RECORDED
    keep: tuple[FileName, ...] = ()


@dataclass(frozen=True)
class Result:
    """A computed row.

    Attributes:
        outputs: by name; empty for a failure.
        failure: reason why there are none; ''.
        differs_from_frame: of the session as recorded, the first frame that was computed otherwise
            than recorded; 0: none.
        identity: code and machine that computed it.
        cpu: processor time of the row [s], without the warm-up of a new worker and the reference.
        warm_up: processor time of that, and of the reference, where this row was the first [s].
        memory: largest resident memory of the worker so far [bytes].
        lost: no worker has computed it, for a reason that is not that of bag or setting.
        series: force on the hand at each pose [N], shape (n, 3), where the job asks for it.
        reference: identity of the setting that it is compared with.
        files: content of the files that the job asks for, by name; they go no further than to
            whoever asks.
        kept: their hashes, by name, once they are kept.
    """

    outputs: dict[str, float]
    failure: str
    differs_from_frame: int
    identity: Identity
    cpu: float
    warm_up: float
    memory: int
    lost: bool = False
    series: Floats | None = None
    reference: str = ''
    files: dict[FileName, bytes] = field(default_factory=dict)
    kept: dict[str, str] = field(default_factory=dict)


class OtherCodeError(RuntimeError):
    """A worker has another version of the trainer or its libraries."""


@dataclass(frozen=True)
class Recording:
    """A bag as read once for all of its settings.

    Attributes:
        beginning: start of its computation.
        records: frames.
        poses: of the device.
        indexings: changes of how the hand moves the tool.
        felt: recorded force.
    """

    bag: Bag
    beginning: ComputationStart
    records: list[FrameRecord]
    poses: list[StampedMessage]
    indexings: list[Indexing]
    felt: RecordedForce


def evaluate(job: Job) -> Result:
    """Compute a row. An error about bag or setting is a result, too.

    Raises:
        OtherCodeError: this worker has other code than whoever asks.
    """
    here = identity_of_worker()
    if differences := job.identity.differences(here):
        raise OtherCodeError('; '.join(differences))
    began = time.thread_time()
    warm_up()
    warm, differs, failure, outputs = time.thread_time(), 0, '', dict[str, float]()
    lost, series, files = False, None, dict[FileName, bytes]()
    try:
        reference, why_not = _reference_forces(job) if job.reference.number else (None, '')
        warm = time.thread_time()
        if why_not:
            raise SessionError(why_not)
        done = _compute(job.bag, job.bag_hash, job.setting, watched=not job.series)
        run, simulation, differs = done.run, done.simulation, done.differs
        if reference is None:
            reference = read_recording(job.bag, job.bag_hash).felt.forces
        outputs = outputs_of(run, reference, simulation.mesh)
        cpu = time.thread_time() - warm
        if done.attempt is not None:
            outputs |= measures_of(done.attempt)
        series = run.vectors if job.series else None
        files = contents_of(run, simulation, job.keep)
    except Exception as error:  # a row with its reason: the study goes on
        cpu, outputs = time.thread_time() - warm, {}
        failure = _reason(error)[:_MAX_REASON]
        lost = isinstance(error, _PASSING)
    return Result(
        outputs=outputs,
        failure=failure,
        differs_from_frame=differs,
        identity=here,
        cpu=cpu,
        warm_up=warm - began,
        memory=_largest_memory(),
        lost=lost,
        series=series,
        reference=job.reference.identity,
        files=files,
    )


def _largest_memory() -> int:
    """Return the largest resident memory of this process so far [bytes].

    `getrusage` would count that of the process that started it.
    """
    status = Path('/proc/self/status').read_text(encoding='ascii', errors='replace')
    return int(status.partition('VmHWM:')[2].split()[0]) * 1024


@cache
def warm_up() -> None:
    """Load all kernels in one order, once for each process.

    Of a kernel inlined in several others a process runs the copy loaded first, and copies may
    differ in the last bit. So the order must not depend on the rows that a worker happens to get.
    """
    warm_up_tissue()
    for method in get_args(CuttingSettings.model_fields['method'].annotation):
        warm_up_cutting(CuttingSettings(method=method))
    device = DeviceSettings()
    warm_up_force_path(ToolSettings(), device, HapticsSettings(), device.load_profile())


def _reference_forces(job: Job) -> tuple[Floats | None, str]:
    """Return the norm of the force under the reference of a row [N], shape (n,), or why there is
    none.
    """
    reference = job.reference
    return _forces_under(reference.identity, json.dumps(reference.changes), job.bag, job.bag_hash)


@lru_cache(maxsize=_KEPT_BAGS)
def _forces_under(
    identity: str, changes: str, bag: str, bag_hash: str
) -> tuple[Floats | None, str]:
    """Compute the forces of a setting. Its identity stands for the content of its mesh."""
    try:
        done = _compute(bag, bag_hash, Setting(1, json.loads(changes)), watched=False)
    except UnavailableError as error:
        raise UnavailableError(f'the reference: {error}') from None
    except (OSError, MemoryError):
        raise
    except Exception as error:
        return None, f'the reference: {_reason(error)}'
    return done.run.forces, ''


@dataclass(frozen=True)
class _Session:
    """Session under a setting.

    Attributes:
        simulation: tissue at the end.
        attempt: at the exercise of its scene; None: it has none.
        differs: of a session as recorded, the first frame that differs; 0: there is none.
    """

    run: Run
    simulation: TissueSimulation
    attempt: Attempt | None
    differs: int


def _compute(place: str, bag_hash: str, setting: Setting, *, watched: bool) -> _Session:
    """Compute a session under a setting; its exercise, if that is watched."""
    recording = read_recording(place, bag_hash)
    bag, beginning, felt = recording.bag, recording.beginning, recording.felt
    if setting.mesh is not None:
        require(setting.mesh)
    with tempfile.TemporaryDirectory(prefix=_TEMPORARY) as temporary:
        scene = load_scene(str(restore_scene(bag, Path(temporary), setting.in_yaml)))
        changed, differs = setting.number > 0, None
        attempt = Attempt(scene.exercise) if watched and scene.exercise.title else None
        refuse_lost_changes(bag, setting.changes)
        computed = recomputation(scene, beginning, changed=changed)
        if changed:
            recorded = recording.records, recording.poses, recording.indexings
            run = move_hand(*recorded, scene, computed, attempt)
        else:
            differs = recompute(recording.records, computed)
            run = as_felt(felt, computed)
            if attempt is not None:
                attempt = read_attempt(bag, scene.exercise, (felt.times, felt.forces))
    return _Session(run, computed.simulation, attempt, differs or 0)


@lru_cache(maxsize=_KEPT_BAGS)
def read_recording(place: str, expected_hash: str) -> Recording:
    """Read a bag.

    Raises:
        UnavailableError: it is not there.
        BagError: it is unreadable, or another one than that of the study.
        SessionError: the bag has no poses, or no forces of the hand.
    """
    folder = folder_of(place)
    if hash_of_bag(folder) != expected_hash:
        raise BagError(f'{place} is not the bag that the study was started with: it has changed')
    bag = open_bag(folder)
    records, poses = computable_poses(bag)
    felt = recorded_force(bag, poses)
    return Recording(bag, find_beginning(bag), records, poses, recorded_indexings(bag), felt)


def _reason(error: Exception) -> str:
    """Return a sentence about a failure, with its place where the sentence is not ours."""
    text = _OWN_FOLDER.sub('', without_copies(' '.join(str(error).split())))
    if isinstance(error, _SENTENCES):
        return text
    place = traceback.extract_tb(error.__traceback__)[-1]
    return f'{type(error).__name__} in {Path(place.filename).name}:{place.lineno}: {text}'
