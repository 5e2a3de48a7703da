"""Trials of `./trainer identify`: known materials, emulated hands, a mesh twice as fine.

    ./trainer run python -m bench.trials.identification --trials 10

A trial draws a material and ten hands: palpations and cuts from the sample bags, moved, pressed
deeper or less deep, with tremor. The forces come from another mesh of half the spacing, whose
diagonals run the other way and whose inner nodes are displaced, and have the noise of a sensor.
Both meshes have the default model: the `linear` one of the samples locks, so that its force depends
on the mesh. Further draws of noise reuse the Jacobians of their trial.
"""

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import meshio
import numpy as np
from distributed import Client
from numpy.typing import NDArray

from bench.common.meshes import kuhn_block
from cutting_trainer.bags.reader import Bag, open_bag
from cutting_trainer.bags.recorded_indexings import recorded_indexings
from cutting_trainer.bags.resimulation_start import find_beginning
from cutting_trainer.bags.topic_names import POSE, SERVO_CF
from cutting_trainer.bags.writer import BagWriter
from cutting_trainer.node_common.cdr_codec import (
    PoseStampedCodec,
    StampedMessage,
    WrenchStampedCodec,
)
from cutting_trainer.recordings.recorded_hand import computable_poses
from cutting_trainer.recordings.recorded_scene import restore_scene
from cutting_trainer.recordings.resimulate_command import recomputation
from cutting_trainer.recordings.what_if import move_hand
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.studies.bag_collection import find_bags
from cutting_trainer.studies.cluster import own_cluster
from cutting_trainer.studies.evaluation import warm_up
from cutting_trainer.studies.identification import Linearised, window_means
from cutting_trainer.studies.identify_command import Identification, IdentifyOptions, identify

Floats = NDArray[np.float64]

SAMPLES = Path(__file__).parents[2] / 'bags' / 'samples' / 'format_7'
SIZE = (0.04, 0.03, 0.01)
CELLS = (12, 9, 3)
"""Bricks of the mesh that identifies; the one that emulates has twice as many along each axis."""
SCENE = {'tissue.model': 'stiffening', 'tissue.integrator': 'symplectic_euler'}
NOISE = 0.003
"""Noise of one component of the force, rms [N], as of a small six-axis sensor."""
TREMOR = 5e-5
"""Amplitude of each of the sines between 8 and 12 Hz that make the tremor [m]."""
RANGES = {'youngs_modulus': (8000.0, 16000.0), 'toughness': (5e-4, 1.1e-3),
          'blade_friction': (1.0, 4.0)}  # fmt: skip
"""Toughness is drawn over Young's modulus [m]. These hands do not enter a softer tissue, and do not
cut a tougher one."""
HANDS = ('palpation',) * 4 + ('straight_cut',) * 6
MOVED = 0.004
"""Largest displacement of a hand along x and y; along z it is a fifth of it [m]."""
DRAWS = 10
"""Draws of noise for each trial, the first of them fitted, the others on its Jacobians."""
_WORKERS = 2


def block(file: Path, factor: int, random: np.random.Generator | None) -> Path:
    """Write a mesh of the sample's block.

    Args:
        file: to write.
        factor: bricks for each of `CELLS`.
        random: displaces inner nodes and mirrors the diagonals; None: neither.
    """
    a, b, c = (n * factor for n in CELLS)
    mesh = kuhn_block((a, b, c), SIZE)
    rest = mesh.rest - np.array([SIZE[0] / 2, SIZE[1] / 2, 0.0])
    tetrahedra = np.asarray(mesh.tetrahedra, np.int64)
    if random is not None:
        spacing = SIZE[2] / c
        half = np.array([SIZE[0] / 2, SIZE[1] / 2])
        inside = (np.abs(rest[:, :2]) < half - 1e-9).all(axis=1)
        inside &= (rest[:, 2] > 1e-9) & (rest[:, 2] < SIZE[2] - 1e-9)
        rest[inside] += random.uniform(-0.15, 0.15, (int(inside.sum()), 3)) * spacing
        rest[:, 0] *= -1.0
        tetrahedra = tetrahedra[:, [0, 2, 1, 3]]
    meshio.Mesh(rest, [('tetra', tetrahedra)]).write(file, file_format='vtk')
    return file


def emulate(
    sample: Path,
    target: Path,
    mesh: Path,
    truth: dict[str, float],
    seed: tuple[int, ...],
    moved: float,
) -> None:
    """Write a bag in which a moved hand feels a known material.

    Args:
        sample: bag with the hand.
        target: new bag.
        mesh: that emulates.
        truth: constants of the material.
        seed: of hand and noise.
        moved: largest displacement of the hand [m].
    """
    bag, random = open_bag(sample), np.random.default_rng(seed)
    move = _hand(random, moved)
    records, poses = computable_poses(bag)
    changes = {f'tissue.material.{name}': str(value) for name, value in truth.items()}
    with tempfile.TemporaryDirectory() as folder:
        changed = {**changes, **SCENE, 'tissue.mesh': str(mesh)}
        scene = load_scene(str(restore_scene(bag, Path(folder), changed)))
        computed = recomputation(scene, find_beginning(bag), changed=True)
        turned = [_moved(pose, move) for pose in poses]
        run = move_hand(records, turned, recorded_indexings(bag), scene, computed)
    felt = run.vectors + NOISE * random.standard_normal(run.vectors.shape)
    stamps = [pose.stamp_ns for pose in poses]
    _write(bag, target, move, dict(zip(stamps, felt, strict=True)))


def _hand(random: np.random.Generator, moved: float) -> Callable[[int], Floats]:
    offset = random.uniform(-moved, moved, 3) * np.array([1.0, 1.0, 0.2])
    frequency, phase = random.uniform(8.0, 12.0, 3), random.uniform(0.0, 2.0 * np.pi, 3)

    def move(stamp: int) -> Floats:
        seconds = stamp % 10**12 * 1e-9
        return np.asarray(offset + TREMOR * np.sin(2.0 * np.pi * frequency * seconds + phase))

    return move


def _moved(pose: StampedMessage, move: Callable[[int], Floats]) -> StampedMessage:
    values = np.array(pose.values)
    values[:3] += move(pose.stamp_ns)
    return StampedMessage(pose.stamp_ns, pose.frame_id, tuple(values.tolist()))


def _write(bag: Bag, target: Path, move: Callable[[int], Floats], felt: dict[int, Floats]) -> None:
    writer = BagWriter(target, custom_data=bag.custom_data)
    for name, kind in bag.topics().items():
        writer.add_topic(name, kind, bag.schemas[kind], '', bag.profiles(name))
    poses, wrenches = PoseStampedCodec(), WrenchStampedCodec()
    for recorded in bag.messages():
        data = recorded.data
        if recorded.topic == SERVO_CF:
            continue  # one for each pose takes its place
        if recorded.topic == POSE:
            pose = poses.decode(data)
            data = poses.encode(pose.stamp_ns, _moved(pose, move).values)
            if pose.stamp_ns in felt:
                force = wrenches.encode(pose.stamp_ns, (*felt[pose.stamp_ns].tolist(), 0, 0, 0))
                writer.write(SERVO_CF, recorded.log_time, recorded.log_time, force)
        writer.write(
            recorded.topic, recorded.log_time, recorded.publish_time, data, recorded.sequence
        )
    writer.close()
    if writer.failure:
        raise OSError(writer.failure)


def further_draws(
    found: Identification, random: np.random.Generator, draws: int
) -> Iterator[Linearised]:
    """Yield the problem of a trial with other noise, on its Jacobians.

    The noise of the trial's own draw remains in its residuals: they have twice its variance.
    """
    for _ in range(draws):
        residuals = []
        for bag, observed, deviations in zip(
            found.problem.residuals, found.observations, found.problem.deviations, strict=True
        ):
            noise = NOISE * random.standard_normal(observed.felt.shape)
            residuals.append(bag + (window_means(observed.times, noise) / deviations).ravel())
        yield replace(found.problem, residuals=residuals)


def trial(
    seed: int,
    folder: Path,
    client: Client,
    hands: tuple[str, ...] = HANDS,
    *,
    refine: bool = False,
) -> tuple[dict[str, float], Identification]:
    """Emulate bags of one material and identify it; return the truth and the outcome."""
    random = np.random.default_rng(seed)
    truth = {
        name: float(np.exp(random.uniform(np.log(low), np.log(high))))
        for name, (low, high) in RANGES.items()
    }
    truth['toughness'] *= truth['youngs_modulus']
    fine = block(folder / 'fine.vtk', 2, random)
    coarse = block(folder / 'coarse.vtk', 1, None)
    moved = MOVED if len(hands) > 2 else 0.0
    client.gather([
        client.submit(
            emulate, SAMPLES / hand, folder / f'bag_{number}', fine, truth, (seed, number), moved
        )
        for number, hand in enumerate(hands)
    ])  # fmt: skip
    changes = {**SCENE, 'tissue.mesh': str(coarse)}
    options = IdentifyOptions((str(folder),), folder, tuple(RANGES), NOISE, changes, refine)
    return truth, identify(find_bags(options.bags, folder), options, client)


def _judge(truth: dict[str, float], problem: Linearised) -> dict[str, tuple[float, float, bool]]:
    """Return relative error, relative width and coverage of each constant."""
    judged = {}
    for name, at, half in zip(problem.names, problem.estimates, problem.half_widths, strict=True):
        value, true = float(np.exp(at)), truth[name]
        width = (np.exp(at + half) - np.exp(at - half)) / value
        judged[name] = (value / true - 1.0, float(width), bool(abs(at - np.log(true)) <= half))
    return judged


def main(arguments: list[str] | None = None) -> int:
    """Run the trials, print one line of JSON for each, and a summary."""
    parser = argparse.ArgumentParser(description='Trials of ./trainer identify.')
    parser.add_argument('--trials', type=int, default=10)
    parser.add_argument('--first', type=int, default=1, help='seed of the first trial')
    parser.add_argument('--refine', action='store_true', help='as the option of identify')
    parser.add_argument('--hands', nargs='+', default=HANDS, help='sample bags, one each hand')
    options = parser.parse_args(arguments)
    warm_up()
    every: dict[str, list[tuple[float, float, bool]]] = {name: [] for name in RANGES}
    with own_cluster(_WORKERS) as client:
        for seed in range(options.first, options.first + options.trials):
            began = time.monotonic()
            with tempfile.TemporaryDirectory() as folder:
                truth, found = trial(
                    seed, Path(folder), client, tuple(options.hands), refine=options.refine
                )
            random = np.random.default_rng([seed, 1])
            problems = [found.problem, *further_draws(found, random, DRAWS - 1)]
            judged = [_judge(truth, problem) for problem in problems]
            for name, kept in every.items():
                kept += [one[name] for one in judged]
            line = {'seed': seed, 'truth': truth, 'error_width_inside': judged[0],
                    'inside': {n: sum(one[n][2] for one in judged) for n in RANGES},
                    'resimulations': found.computed, 'processor_time': found.cpu,
                    'wall': time.monotonic() - began, 'notes': found.sentences}  # fmt: skip
            print(json.dumps(line), flush=True)
    for name, kept in every.items():
        errors, widths, inside = (np.array(column) for column in zip(*kept, strict=True))
        print(
            f'{name}: inside {inside.sum()} of {len(inside)}, median error '
            f'{100 * np.median(np.abs(errors)):.1f} %, median width {100 * np.median(widths):.0f} %'
        )
    return 0


if __name__ == '__main__':
    sys.exit(main())
