"""Emulated novices and experts: the script of a scene with the errors of a hand.

Published: rms of physiological tremor at 8 to 12 Hz, 50 to 200 um, and rms error of pointing of two
microsurgeons, 144 um in three dimensions (Wells et al., Comparison of baseline tremor under various
microsurgical conditions, IEEE SMC 2013, 1482-1487, PMC3989364). Both are of surgeons: that the
lower end is the expert's tremor and the upper the novice's is chosen. Novices exert 22.7 % more
force than experts (Golahmadi et al., Tool-tissue forces in surgery: a systematic review, 2021,
PMC8058906, mean of averages of 45 studies). Force goes with the depth of the dent, so theirs is
deeper by as much.

Chosen, since no source gives them in these units: the novice's errors of place and depth, ten times
the expert's; durations; pauses; how often a lump is recognised, or imagined. They were fixed before
any score of these people was computed, and not changed after. Both look for a bridge that still
holds a lesion, and cut it, in place of the blind last cut of the script: this was added when
attempts at `excision` with the seeds 2000 to 2019 were known; how they cut was chosen with experts
of the seeds 1000 to 1013.
"""

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from bench.training.player import Person, expert_script, scene_of
from cutting_trainer.haptic_bridge.emulated_arm.scene_schema import Phase, ScriptSettings, Waypoint

Floats = NDArray[np.float64]
Kind = Literal['expert', 'novice', 'nothing', 'everything', 'wild']
SKILLED: tuple[Kind, ...] = ('expert', 'novice')
MUST_FAIL: tuple[Kind, ...] = ('nothing', 'everything', 'wild')


@dataclass(frozen=True)
class Skill:
    """Errors of a hand.

    Attributes:
        tremor: rms over three axes [m].
        place: rms of the error of a place in the horizontal plane, each axis [m].
        depth: rms of the error of depth [m].
        pressing: depth of dents over that of the script.
        slowness, spread: duration over that of the script, and its relative deviation.
        pauses: mean number in an attempt.
        recognised: chance that a lump under the tip is marked.
        imagined: chance that a place without a lump is.
    """

    tremor: float
    place: float
    depth: float
    pressing: float
    slowness: float
    spread: float
    pauses: float
    recognised: float
    imagined: float


SKILLS: dict[str, Skill] = {
    'expert': Skill(50e-6, 0.1e-3, 0.15e-3, 1.0, 1.0, 0.1, 0.5, 0.97, 0.03),
    'novice': Skill(200e-6, 1.0e-3, 1.5e-3, 1.227, 1.5, 0.2, 4.0, 0.6, 0.4),
    'wild': Skill(200e-6, 5.0e-3, 4.0e-3, 1.5, 0.25, 0.1, 0.0, 0.5, 0.5),
}
_MEMORY = 0.7
"""Correlation of the errors at one waypoint and the next."""
_PAUSE_SHARE = 0.03
"""Duration of a pause, as a share of the script."""
_SEVERED_M = 0.006
"""Way of a stroke through a bridge before and behind its middle [m]."""
_LANES, _BORDER_M = 7, 0.008
"""Lanes of one who cuts everything, and how far beyond the scene's own way [m]."""


def person(scene: str, kind: Kind, seed: int) -> Person:
    """Return one who makes an attempt.

    Args:
        scene: name or path.
        kind: of person.
        seed: of all errors.
    """
    good = expert_script(scene)
    if kind == 'nothing':
        rest = Phase(kind='rest')
        return replace(good, script=good.script.model_copy(update={'phases': (rest,)}))
    if kind == 'everything':
        return replace(good, script=_everything(scene, good.script))
    skill = SKILLS[kind]
    random = np.random.default_rng([seed, sorted(SKILLS).index(kind)])
    touching = _touching_height(scene)
    slowness = skill.slowness * float(np.exp(skill.spread * random.normal()))
    hand = good.hand.model_copy(update={'tremor': skill.tremor / 3**0.5})
    if kind not in SKILLED or scene_of(scene).exercise.lesion is None:
        return Person(_with_errors(good.script, skill, touching, random, slowness), hand, seed)
    sighted, blind = _without_last_cut(good.script), good.script

    def sever(place: Floats, along: Floats, seen: int) -> ScriptSettings:
        random = np.random.default_rng([seed, sorted(SKILLS).index(kind), seen])
        way = _way_through(blind, place, along, pressed=seen % 2 == 1)
        return _with_errors(way, skill, touching, random, slowness)

    return Person(_with_errors(sighted, skill, touching, random, slowness), hand, seed, sever)


def _without_last_cut(script: ScriptSettings) -> ScriptSettings:
    """Return a script without its last cut, and the way to it: one that nobody looks for."""
    last = max(k for k, phase in enumerate(script.phases) if phase.kind == 'cut')
    kept = script.phases[: last - 1] + script.phases[last + 1 :]
    share = sum(phase.share for phase in kept) / sum(phase.share for phase in script.phases)
    return script.model_copy(update={'phases': kept, 'seconds': share * script.seconds})


def _way_through(
    script: ScriptSettings, place: Floats, along: Floats, *, pressed: bool
) -> ScriptSettings:
    """Return a stroke through tissue that still holds a lesion, as long as an expert takes.

    It begins in the open cut and follows the border, so that it presses on no loose tissue. A
    bridge that gives way to such a stroke is pressed down upon, and the stroke begins there.

    Args:
        script: of the scene, which has the depths.
        place: of the tissue [m], shape (3,).
        along: direction of the border, shape (3,).
        pressed: whether the stroke begins on the bridge.
    """
    cuts = [phase for phase in script.phases if phase.kind == 'cut'][-1].waypoints
    deepest = min(point.position[2] for point in cuts)
    level, up = cuts[-1].position[2], script.start.position[2]
    direction = along[:2] / np.linalg.norm(along[:2])

    def at(beyond: float, height: float, share: float = 1.0) -> Waypoint:
        x, y = place[:2] + beyond * direction
        return Waypoint(position=(float(x), float(y), height), share=share)

    begin, end = (0.0 if pressed else -_SEVERED_M), _SEVERED_M
    down = (at(begin, deepest, 2), at(begin, level)) if pressed else (at(begin, level),)
    phases = (
        Phase(kind='approach', share=1.5, waypoints=(at(begin, up),)),
        Phase(kind='cut', share=3, waypoints=(*down, at(end, level, 2))),
        Phase(kind='retract', share=2, waypoints=(at(end, up), script.phases[-1].waypoints[-1])),
    )
    seconds = sum(phase.share for phase in phases)
    return script.model_copy(update={'seconds': seconds, 'phases': phases})


def _touching_height(scene: str) -> float:
    """Return the height of the tip at which it touches: of surface and sphere [m]."""
    said = scene_of(scene)
    task = said.exercise
    if task.targets:
        return float(task.targets[0].corners()[0, 2]) + said.tool.radius
    return max(lump.centre[2] + lump.radius for lump in task.lumps) + 0.003 + said.tool.radius


def _with_errors(
    script: ScriptSettings,
    skill: Skill,
    touching: float,
    random: np.random.Generator,
    slowness: float,
) -> ScriptSettings:
    error = random.normal(size=3)
    places = sum(len(phase.waypoints) for phase in script.phases)
    pause = random.random(places) < skill.pauses / places
    phases, number = [], 0
    before: tuple[float, ...] = script.start.position
    for phase in script.phases:
        points: list[Waypoint] = []
        length = sum(point.share for point in phase.waypoints)
        for point in phase.waypoints:
            error = _MEMORY * error + (1 - _MEMORY**2) ** 0.5 * random.normal(size=3)
            x, y, z = point.position
            held = point.position == before
            if not held and z < touching:
                z = touching - (touching - z) * skill.pressing + skill.depth * error[2]
            place = (x + skill.place * error[0], y + skill.place * error[1], z)
            if held and phase.kind == 'palpate':
                place = points[-1].position
                keep = random.random() < skill.recognised
                points += [point.model_copy(update={'position': place})] if keep else []
            else:
                points.append(point.model_copy(update={'position': place}))
                following = phase.kind == 'palpate' and z < touching and not _is_held(phase, point)
                if following and random.random() < skill.imagined:
                    points.append(points[-1].model_copy(update={'share': 3.0}))
            if pause[number]:
                share = max(_PAUSE_SHARE * length, 1e-3)
                points.append(points[-1].model_copy(update={'share': share}))
            before = point.position
            number += 1
        phases.append(phase.model_copy(update={'waypoints': tuple(points)}))
    seconds = slowness * script.seconds
    return script.model_copy(update={'phases': tuple(phases), 'seconds': seconds})


def _is_held(phase: Phase, point: Waypoint) -> bool:
    """Return whether the script itself holds at a waypoint."""
    places = [each.position for each in phase.waypoints]
    return places.count(point.position) > 1 and any(
        a == b == point.position for a, b in pairwise(places)
    )


def _everything(scene: str, script: ScriptSettings) -> ScriptSettings:
    """Return a script that cuts, or marks, the whole area of a scene in lanes, in its time."""
    points = np.array([p.position for phase in script.phases for p in phase.waypoints])
    low, high = points.min(axis=0), points.max(axis=0)
    left, right = low[0] - _BORDER_M, high[0] + _BORDER_M
    lanes = np.linspace(low[1] - _BORDER_M, high[1] + _BORDER_M, _LANES)
    up, task = script.start.position[2], scene_of(scene).exercise
    ways: list[Waypoint] = []
    for lane in lanes:
        if not task.lumps:
            stops = [(left, up), (left, low[2]), (right, low[2]), (right, up)]
            ways += [Waypoint(position=(x, float(lane), float(z))) for x, z in stops]
            continue
        for x in np.linspace(left, right, _LANES):
            for z, share in ((up - 0.015, 1.0), (low[2], 1.0), (low[2], 3.0), (up - 0.015, 1.0)):
                ways.append(Waypoint(position=(float(x), float(lane), float(z)), share=share))
    phases = (Phase(kind='palpate' if task.lumps else 'cut', waypoints=tuple(ways)),)
    # Each lump is held for half of the time of its place: that takes most of what is allowed.
    seconds = 0.95 * task.time_limit if task.lumps else 60.0
    return script.model_copy(update={'phases': phases, 'seconds': seconds})
