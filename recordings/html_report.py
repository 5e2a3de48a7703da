"""`trainer report`: a session on one page, for trainee and teacher."""

import math
import tempfile
from datetime import UTC, datetime
from html import escape
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cutting_trainer.bags.metadata import recorded_code
from cutting_trainer.bags.playback_messages import first_time
from cutting_trainer.bags.reader import Bag, open_bag
from cutting_trainer.bags.recorded_tissue import first_tissue, tissue_at
from cutting_trainer.bags.repair import repair_note
from cutting_trainer.bags.topic_names import (
    CONTACT,
    CUTS,
    POSE,
    SERVO_CF,
    further_tools,
    of_session,
)
from cutting_trainer.exercises.bag_feed import read_attempt
from cutting_trainer.exercises.score import UNITS, in_words, score
from cutting_trainer.haptic_bridge.emulated_arm.scene_schema import ScriptSettings
from cutting_trainer.haptic_bridge.force_kernels import INSIDE, NONE
from cutting_trainer.node_common.cdr_codec import (
    ContactCodec,
    PoseStampedCodec,
    WrenchStampedCodec,
)
from cutting_trainer.recordings.html_page import image, page, table
from cutting_trainer.recordings.incision_metrics import (
    distance_to_paths,
    extent,
    planned_paths,
    surface_length,
)
from cutting_trainer.recordings.picture import STYLE, Story, draw_tissue, read_story, spans
from cutting_trainer.recordings.recorded_scene import restore_scene
from cutting_trainer.session.bag_measurements import read_evidence
from cutting_trainer.session.errors import SessionError
from cutting_trainer.session.scene_loader import Scene, load_scene
from cutting_trainer.session.summary import NodeSummary, Summary, summarise
from cutting_trainer.tissue_sim.mesh.depth import SurfaceDepth
from cutting_trainer.tissue_sim.mesh.pieces import pieces_of
from cutting_trainer.tissue_sim.mesh.replica import MeshReplica

Floats = NDArray[np.float64]

_MM = 1e3
_SAMPLE_STRIDE = 20
"""Every 20th contact is a sample of depth and speed: 20 ms."""
_MAX_PEAKS = 5
_MIN_PEAK_DISTANCE_S = 0.5  # [s]


def write_report(folder: Path, file: Path) -> Summary:
    """Write the page of a bag; return the summary of the session.

    Args:
        folder: folder of the bag.
        file: file to write, .html.

    Raises:
        BagError: it is not a bag.
        SessionError: there is no tissue in it, or the file cannot be written.
    """
    if file.suffix != '.html':
        raise SessionError(f'{file} is no page: end its name in .html')
    if file.parent != folder and not file.parent.is_dir():
        raise SessionError(f'{file.parent} does not exist: make it first, the report goes into it')
    bag = open_bag(folder)
    story = read_story(folder, None)
    summary = summarise(read_evidence(folder))
    scene = recorded(bag)
    touched = _first_contact(story)
    before = tissue_at(bag, None if touched is None else max(touched, first_tissue(bag)))
    with mpl.rc_context(STYLE):
        body = _body(bag, story, before, summary, scene)
    title = f'Session {folder.resolve().name}'
    file.write_text(page(title, body), encoding='utf-8')
    return summary


def recorded(bag: Bag) -> Scene | None:
    """Return the recorded scene, None where the bag has none."""
    if 'scene' not in bag.custom_data:
        return None
    with tempfile.TemporaryDirectory(prefix='trainer-') as temporary:
        return load_scene(str(restore_scene(bag, Path(temporary))))


def _body(
    bag: Bag,
    story: Story,
    before: MeshReplica,
    summary: Summary,
    scene: Scene | None,
) -> str:
    script = scene.arm.script if scene else None
    tool = story.tool[::_SAMPLE_STRIDE]
    depth = SurfaceDepth(before).depths(tool[:, 4:10].reshape(-1, 2, 3))
    begun = datetime.fromtimestamp(first_time(bag) * 1e-9, UTC)
    data = bag.custom_data
    about = ', '.join(
        f'{word} {escape(data[key])}'
        for word, key in (
            ('scene', 'scene_file'),
            ('seed', 'seed'),
            ('bag format', 'format_version'),
        )
        if key in data
    )
    code = recorded_code(data)
    about += f', {escape(code.sentence)}' if code else ', by code that the bag does not name'
    if scene and scene.tissue.method == 'given':
        about += f', {scene.tissue.model} by {scene.tissue.integrator}'
    parts = [
        f'<h1>Session {escape(Path(summary.bag).resolve().name)}</h1>',
        f'<p class="note">{begun:%Y-%m-%d %H:%M:%S} UTC, {summary.duration:.1f} s; {about}</p>',
        table(_numbers(story, summary, depth)),
        *_exercise(bag, scene),
        '<h2>The cut</h2>',
        table(_cut_numbers(bag, story, depth, tool, script)),
        *_further_tools(bag),
        image(_path_figure(story, script), 'Path of the tip from above, and the plan.'),
        '<h2>Force, depth, speed</h2>',
        image(
            _time_figure(story, tool, depth, hand_speed(bag)),
            "Grey: contact; red: the blade is in the tissue. Depth is that of the blade's end "
            'under the surface at rest. Marked are the largest peaks of the force.',
        ),
        table(_peaks(story), ('peak at [s]', 'force [N]', 'while')),
        '<h2>Tissue before and after</h2>',
        image(_tissue_figure(story, before), 'Dark red: cut faces.'),
        '<h2>Rates</h2>',
        table(
            [_node_row(node) for node in summary.nodes.values() if not math.isnan(node.rate)],
            ('node', 'rate / lowest [Hz]', 'in time [%]', 'period p99 / worst [ms]', 'missed'),
        ),
        f'<p class="note">{escape(_losses(summary, repair_note(data)))}</p>',
    ]
    return '\n'.join(parts)


def _numbers(story: Story, summary: Summary, depth: Floats) -> list[tuple[str, ...]]:
    inside = spans(story.tool, INSIDE)
    return [
        ('contact [s]', f'{summary.contact_time:.1f}'),
        ('blade in the tissue [s]', f'{np.diff(inside, axis=1).sum():.1f}'),
        ('largest force on the hand [N]', f'{summary.largest_force:.2f}'),
        ('mean force in contact [N]', f'{_mean_force(story):.2f}'),
        ("largest depth of the blade's end [mm]", f'{depth.max(initial=0.0) * _MM:.1f}'),
        ('tetrahedra taken out by cuts', str(summary.elements_cut)),
    ]


def _exercise(bag: Bag, scene: Scene | None) -> list[str]:
    """Return the score of an attempt and its reasons; nothing where the scene is no exercise."""
    if scene is None or not scene.exercise.title:
        return []
    attempt = read_attempt(bag, scene.exercise)
    got = score(scene.exercise, attempt.measures())
    verdict = 'broken off' if attempt.broken_off else 'passed' if got.passed else 'failed'
    rows: list[tuple[str, ...]] = [
        (UNITS[each.measure][2], in_words(each.measure, each.value), f'{each.given:.1f}')
        for each in got.deductions
    ]
    return [
        f'<h2>{escape(scene.exercise.title)}: {verdict} with {got.points:.1f} points</h2>',
        table(rows, ('measure', 'value', 'points')),
        ''.join(f'<p class="note">{escape(reason)}</p>' for reason in got.reasons),
    ]


def _cut_numbers(
    bag: Bag, story: Story, depth: Floats, tool: Floats, script: ScriptSettings | None
) -> list[tuple[str, ...]]:
    inside = tool[:, 10] == INSIDE
    tips = tool[:, 1:4]
    steps = np.linalg.norm(np.diff(tips, axis=0, prepend=tips[:1]), axis=1)
    rows: list[tuple[str, ...]] = [
        ('area of the incision, one side, at rest [cm²]', f'{incision_area(bag) * 1e4:.2f}'),
        ('length of the incision on the surface, at rest [mm]', _mm(surface_length(story.replica))),
        ('path of the tip with the blade in the tissue [mm]', _mm(steps[inside].sum())),
    ]
    pieces = pieces_of(story.replica, story.replica.rest)
    rows.append(('pieces that came off', str(len(pieces))))
    rows += [(f'volume of piece {p.number} [cm³]', f'{p.volume * 1e6:.3g}') for p in pieces]
    if inside.any():
        rows.append(("mean depth of the blade's end in it [mm]", _mm(depth[inside].mean())))
    paths = planned_paths(script) if script else []
    if not paths:
        return [*rows, ('planned line', 'the scene has none')]
    planned = sum(extent(path) for path in paths)
    rows.append(('length of the planned lines, from above [mm]', _mm(planned)))
    if inside.any():
        off = distance_to_paths(tips[inside], paths)
        rows += [
            ('distance from the nearest planned line, from above, mean [mm]', _mm(off.mean())),
            ('the same, largest [mm]', _mm(off.max())),
        ]
    return rows


def _further_tools(bag: Bag) -> list[str]:
    """Return contact and force of each further tool as a table; [] where there is none."""
    state = ContactCodec.fields['state'].start
    force = WrenchStampedCodec.fields['force']
    rows: list[tuple[str, ...]] = []
    for tool in further_tools(bag.topics()):
        contacts = [ContactCodec().decode(m.data) for m in bag.messages([f'{tool}{CONTACT}'])]
        states = np.array([sample.values[state] for sample in contacts])
        times = np.array([sample.stamp_ns for sample in contacts]) * 1e-9
        steps = np.diff(times, append=times[-1:])
        wrench = of_session(f'{tool}{SERVO_CF}', bag.topics())
        forces = [WrenchStampedCodec().decode(m.data).values[force] for m in bag.messages([wrench])]
        most = np.linalg.norm(np.reshape(forces, (-1, 3)), axis=1).max(initial=0.0)
        touched, held = (float(steps[mask].sum()) for mask in (states != NONE, states == INSIDE))
        rows.append((escape(tool[1:]), f'{touched:.1f}', f'{held:.1f}', f'{most:.2f}'))
    if not rows:
        return []
    head = ('tool', 'contact [s]', 'holds the tissue, or is in it [s]', 'largest force [N]')
    return ['<h2>The other tools</h2>', table(rows, head)]


def incision_area(bag: Bag) -> float:
    """Return the cut area of all answers of the cutting service [m^2]; 0 if none are recorded."""
    if CUTS not in bag.topics():
        return 0.0
    events = (bag.read(recorded) for recorded in bag.messages([CUTS]))
    return sum(event.response[0].report.area for event in events if event.response)


def _first_contact(story: Story) -> float | None:
    touched = np.flatnonzero(story.tool[:, 10] != NONE)
    return float(story.tool[touched[0], 0]) if len(touched) else None


def _mean_force(story: Story) -> float:
    touched = _state_at(story, story.forces[:, 0]) != NONE
    return float(story.forces[touched, 1].mean()) if touched.any() else 0.0


def _state_at(story: Story, times: Floats) -> Floats:
    """Return the contact state at some times [s]."""
    if not len(story.tool):
        return np.full(len(times), float(NONE))
    at = np.searchsorted(story.tool[:, 0], times, 'right') - 1
    return story.tool[np.maximum(at, 0), 10]


def hand_speed(bag: Bag) -> Floats:
    """Return time [s] and mean speed [m/s] of the device over periods of 20 ms, shape (n, 2)."""
    topic, codec = of_session(POSE, bag.topics()), PoseStampedCodec()
    recorded = list(bag.messages([topic]))[::_SAMPLE_STRIDE]
    if len(recorded) < 2:
        return np.zeros((0, 2))
    samples = [codec.decode(message.data) for message in recorded]
    begin = (recorded[0].log_time - first_time(bag)) * 1e-9
    times = begin + np.array([sample.stamp_ns - samples[0].stamp_ns for sample in samples]) * 1e-9
    places = np.array([sample.values[:3] for sample in samples])
    lengths = np.linalg.norm(np.diff(places, axis=0), axis=1)
    steps = np.diff(times)
    return np.column_stack([times[1:], lengths / np.maximum(steps, 1e-6)])


def force_peaks(forces: Floats) -> Floats:
    """Return the peaks of the force, each the largest within half a second to either side.

    Args:
        forces: time [s] and norm [N], shape (m, 2).

    Returns:
        Time and norm, largest first, shape (p, 2).
    """
    left = forces[forces[:, 1] > 0.0]
    peaks: list[Floats] = []
    while len(left) and len(peaks) < _MAX_PEAKS:
        top = left[left[:, 1].argmax()]
        around = forces[np.abs(forces[:, 0] - top[0]) <= _MIN_PEAK_DISTANCE_S]
        if top[1] >= around[:, 1].max():  # else it is the flank of a larger peak
            peaks.append(top)
        left = left[np.abs(left[:, 0] - top[0]) > _MIN_PEAK_DISTANCE_S]
    return np.array(peaks, float).reshape(-1, 2)


def _peaks(story: Story) -> list[tuple[str, ...]]:
    peaks = force_peaks(story.forces)
    states = _state_at(story, peaks[:, 0])
    return [
        (f'{time:.2f}', f'{force:.2f}', 'cutting' if state == INSIDE else 'touching')
        for (time, force), state in zip(peaks, states, strict=True)
    ]


def _time_figure(story: Story, tool: Floats, depth: Floats, speed: Floats) -> Figure:
    figure = Figure(figsize=(9.0, 6.4), layout='constrained')
    rows: Any = figure.subplots(3, 1, sharex=True)
    peaks = force_peaks(story.forces)
    times = tool[:, 0]
    curves: list[tuple[str, Floats, Floats]] = [
        ('force on the hand [N]', story.forces[:, 0], story.forces[:, 1]),
        ('depth [mm]', times, depth * _MM),
        ('speed of the hand [mm/s]', speed[:, 0], speed[:, 1] * _MM),
    ]
    for axes, (label, at, curve) in zip(rows, curves, strict=True):
        for state, colour in ((INSIDE, '#e8b4b0'), (None, '#dddddd')):
            for begin, end in spans(story.tool, state):
                axes.axvspan(begin, end, color=colour, lw=0)
        axes.plot(at, curve, color='#1f4e8c', lw=0.8)
        axes.set(ylabel=label)
    rows[0].plot(*peaks.T, 'v', color='#9e0914', ms=5)
    rows[2].set(xlabel='time [s]')
    return figure


def _path_figure(story: Story, script: ScriptSettings | None) -> Figure:
    figure = Figure(figsize=(6.5, 5.0), layout='constrained')
    axes: Any = figure.subplots()
    tool = story.tool[::_SAMPLE_STRIDE]
    tips = tool[:, 1:4] * _MM
    for number, path in enumerate(planned_paths(script) if script else []):
        corners = path[:, :2].T * _MM
        label = 'planned cut' if number == 0 else None
        axes.plot(*corners, color='#b9d0ea', lw=6.0, solid_capstyle='butt', label=label)
    axes.plot(tips[:, 0], tips[:, 1], color='#8a8a8a', lw=0.8, label='path of the tip')
    inside = np.where(tool[:, 10:] == INSIDE, tips, np.nan)
    axes.plot(inside[:, 0], inside[:, 1], color='#9e0914', lw=1.5, label='blade in the tissue')
    axes.set(xlabel='x [mm]', ylabel='y [mm]', aspect='equal')
    axes.legend(frameon=False, fontsize=8)
    return figure


def _tissue_figure(story: Story, before: MeshReplica) -> Figure:
    figure = Figure(figsize=(10.0, 4.6), layout='constrained')
    projection: Any = {'projection': '3d', 'computed_zorder': False}
    left, right = figure.subplots(1, 2, subplot_kw=projection)
    first = _first_contact(story) or 0.0
    draw_tissue(left, Story(replica=before, moment=first))
    draw_tissue(right, Story(replica=story.replica, moment=story.moment))
    return figure


def _node_row(node: NodeSummary) -> tuple[str, ...]:
    return (
        node.name,
        f'{node.rate:.4g} / {node.lowest_rate:.4g}',
        f'{node.within * 100:.4g}',
        f'{node.period_p99 * 1e3:.4g} / {node.worst_period_p99 * 1e3:.4g}',
        f'{node.missed:.0f}',
    )


def _losses(summary: Summary, repaired: str) -> str:
    lost = ', '.join(f'{count} of {topic}' for topic, count in summary.lost.items()) or 'none'
    whole = '' if summary.complete else ' The bag was not closed in order.'
    mended = f' {repaired[0].upper()}{repaired[1:]}.' if repaired else ''
    return f'{summary.messages} messages were recorded; lost: {lost}.{whole}{mended}'


def _mm(metres: float) -> str:
    return f'{metres * _MM:.1f}'
