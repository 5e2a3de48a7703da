"""Claims about the page of a bag: any moment of it, and the session computed again beside it."""

import time
from collections.abc import Iterator
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest
from bag_copies import rewritten
from made_session import make_session
from rich.console import Console

from bench.page.browser import CHROMIUM, chromium
from bench.page.open_page import OpenPage
from cutting_trainer.bags.errors import BagError
from cutting_trainer.bags.playback_messages import duration
from cutting_trainer.bags.reader import Bag, Recorded, open_bag
from cutting_trainer.bags.recorded_tissue import first_tissue, tissue_at
from cutting_trainer.bags.topic_names import CONTACT, MESH, UPDATES
from cutting_trainer.node_common.cdr_codec import ContactCodec
from cutting_trainer.recordings.picture import read_story
from cutting_trainer.recordings.recorded_scene import restore_scene
from cutting_trainer.recordings.view_bag_command import resimulated
from cutting_trainer.session.node_commands import LOCAL
from cutting_trainer.session.scene_loader import Scene, load_scene
from cutting_trainer.viewer.access_control import link, make_gate
from cutting_trainer.viewer.bag_timeline import ComputedTissue, RecordedTissue, RecordedTool
from cutting_trainer.viewer.recording import Recording, computed_beside, recorded_beside
from cutting_trainer.viewer.replay_page import ReplayPage

pytestmark = pytest.mark.long

CUT = Path(__file__).parents[1] / 'bags' / 'samples' / 'format_2' / 'straight_cut'
NOTES = Console(quiet=True)
GATE = make_gate(LOCAL, [])


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Bag:
    """A session with a cut, of this machine and this version."""
    folder = tmp_path_factory.mktemp('made')
    return open_bag(make_session(CUT, folder / 'bag', folder))


@pytest.fixture(scope='module')
def scene(bag: Bag, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return load_scene(str(restore_scene(bag, tmp_path_factory.mktemp('scene'))))


@pytest.fixture(scope='module')
def again(bag: Bag, scene: Scene) -> ComputedTissue:
    return resimulated(bag, scene, NOTES, changed=False)


def test_tissue_at_any_moment_is_the_same_forwards_and_back(bag: Bag) -> None:
    track, end = RecordedTissue(bag), duration(bag)
    wanted = {share: tissue_at(bag, share * end) for share in (0.3, 0.6, 0.9, 1.0)}
    assert wanted[1.0].topology > wanted[0.3].topology
    for share in (0.3, 0.9, 0.6, 0.6, 1.0, 0.3, 0.9):
        shown = track.go_to(share * end)
        assert (shown.revision, shown.hash()) == (wanted[share].revision, wanted[share].hash())


def test_tool_is_nowhere_before_the_device_has_been_heard(bag: Bag, tmp_path: Path) -> None:
    since = bag.span[0] + 0.1 * (bag.span[1] - bag.span[0])
    nothing = (0,) * len(ContactCodec().decode(next(bag.messages([CONTACT])).data).values)

    def change(m: Recorded) -> bytes:
        early = m.topic == CONTACT and m.log_time < since
        return ContactCodec('tissue').encode(0, nothing) if early else m.data

    late = rewritten(bag.path.parent, tmp_path / 'late', change)
    contact = RecordedTool(open_bag(late)).contact
    assert contact.at(0.05 * duration(bag)) is None
    assert contact.vectors('device').any(axis=1).all()
    assert read_story(late, None).tool[:, 1:4].any(axis=1).all()


def test_before_its_first_keyframe_a_bag_shows_that_one(bag: Bag) -> None:
    track = RecordedTissue(bag)
    track.go_to(duration(bag))
    assert track.go_to(-1.0).step == 0


def test_a_keyframe_of_before_the_recording_is_not_shown(bag: Bag, tmp_path: Path) -> None:
    """A recorder that joins a session first receives the keyframe that was published last."""
    keyframes = list(bag.messages([MESH]))
    late = keyframes[-1].log_time
    assert len(keyframes) > 1

    def change(m: Recorded) -> bytes | None:
        between = keyframes[0].log_time < m.log_time < late
        return None if between and m.topic in (MESH, UPDATES) else m.data

    joined = open_bag(rewritten(bag.path.parent, tmp_path / 'joined', change))
    at = (late - bag.span[0]) * 1e-9
    assert RecordedTissue(joined).go_to(0.0).hash() == tissue_at(bag, at + 1e-6).hash()
    assert first_tissue(joined) == pytest.approx(at)
    assert read_story(joined.path.parent, None).replica.hash() == tissue_at(bag).hash()


def test_session_computed_again_is_the_recorded_one_at_every_moment(
    bag: Bag, again: ComputedTissue
) -> None:
    recorded = RecordedTissue(bag)
    cuts = 0
    # Between two frames, so that neither is on the edge.
    for moment in np.array(again.times[5:-5:9]) + 0.01:
        now, then = again.go_to(moment), recorded.go_to(moment)
        np.testing.assert_array_equal(now.triangles, then.triangles)
        np.testing.assert_array_equal(now.triangle_kind, then.triangle_kind)
        np.testing.assert_allclose(now.displacement, then.displacement, atol=1e-8)
        cuts += then.triangle_kind.any()
    assert cuts > 3


def test_changed_tissue_goes_another_way(bag: Bag, scene: Scene, tmp_path: Path) -> None:
    changes = {'tissue.material.toughness': '2000'}
    tougher = load_scene(str(restore_scene(bag, tmp_path, changes)))
    computed = resimulated(bag, tougher, NOTES, changed=True)
    recorded = RecordedTissue(bag).go_to(duration(bag))
    assert (computed.stills[-1].triangle_kind == 1).sum() < (recorded.triangle_kind == 1).sum()


@pytest.fixture
def page(bag: Bag, scene: Scene, again: ComputedTissue) -> Iterator[ReplayPage]:
    recording = Recording(bag, scene.tool, scene.device, scene.exercise)
    page = ReplayPage(recording, computed_beside('computed again', again), LOCAL, 0, GATE)
    yield page
    page.server.stop()


def url(page: ReplayPage) -> str:
    return link(LOCAL, page.server.port, [], GATE.token)


def test_page_goes_where_the_time_line_is_put(page: ReplayPage, bag: Bag) -> None:
    end, tool = duration(bag), RecordedTool(bag)
    reader = OpenPage(url(page))
    for share in (0.8, 0.1, 0.4):
        reader.ask('seek', time=share * end)
        wanted = RecordedTissue(bag).go_to(share * end)
        contact = tool.contact.at(share * end)
        assert contact is not None
        tip = contact.values[ContactCodec.fields['device']]

        def shows(tip: object = tip) -> bool:
            page.update(time.monotonic())
            return np.array_equal(reader.values.get('moment', {}).get('tip'), tip)

        reader.wait(shows, 'the moment')
        used = np.unique(wanted.triangles[wanted.triangle_kind == 0])
        for name in ('tissue', 'beside'):
            moved = reader.values[name][0][0]
            np.testing.assert_allclose(moved, wanted.positions()[used], atol=1e-6)
    reader.close()


def test_two_sessions_stand_side_by_side_and_their_hands_begin_together(
    bag: Bag, scene: Scene
) -> None:
    first, other = (Recording(bag, scene.tool, scene.device, scene.exercise) for _ in range(2))
    waited = 0.4
    other.track.contact.times = other.track.contact.times + waited  # a hand that began later
    beside = recorded_beside(other, first)
    assert beside.later == pytest.approx(waited)
    page = ReplayPage(first, beside, LOCAL, 0, GATE)
    try:
        reader = OpenPage(url(page))
        page.seek(0.5 * first.end)

        def is_drawn() -> bool:
            page.update(time.monotonic())
            return {'beside', 'moment'} <= reader.values.keys()

        reader.wait(is_drawn, 'both tissues and the tools')
        moment = reader.values['moment']
        (further,) = moment['further']
        apart = np.subtract(further['tip'], moment['tip'])
        assert apart == pytest.approx([reader.values['hello']['tissues'][1]['offset'][0], 0, 0])
        assert further['wxyz'] == pytest.approx(moment['wxyz'])
        assert len(reader.values['hello']['further_tools']) == 1
        assert [shown['label'] for shown in reader.values['hello']['tissues']] == ['bag', 'bag']
        reader.close()
    finally:
        page.server.stop()


def test_page_plays_at_the_speed_that_was_chosen_and_begins_anew_at_the_end(
    page: ReplayPage, bag: Bag
) -> None:
    end = duration(bag)
    reader = OpenPage(url(page))

    def at(now: float) -> float:
        page.update(now)
        return float(page._playhead.position)

    def shown() -> dict[str, Any]:
        return reader.values.get('playhead', {})

    reader.ask('speed', value=2.0)
    reader.ask('play', on=True)
    reader.wait(lambda: not (at(0.0), page._playhead.paused)[1], 'the play')
    began = at(0.0)
    assert at(0.5) == pytest.approx(began + 1.0)
    at(2 * end)
    reader.wait(lambda: shown().get('playing') is False, 'the end')
    assert shown()['time'] == pytest.approx(end, abs=0.01)
    reader.ask('play', on=True)
    reader.wait(lambda: at(2 * end) < 0.5 * end, 'the beginning again')
    reader.close()


@pytest.mark.long
@pytest.mark.skipif(CHROMIUM is None, reason='chromium is not installed: sudo apt install chromium')
def test_time_line_is_moved_played_and_paused_by_clicks(page: ReplayPage, bag: Bag) -> None:
    end = duration(bag)
    ended: list[bool] = []
    thread = Thread(target=page.run, args=(lambda: bool(ended),))
    thread.start()
    try:
        with chromium((1060, 640), coarseness=2) as browser:
            seen = browser.page(url(page))

            def head() -> Any:
                return seen.state().get('playhead') or {'time': -1.0, 'playing': None}

            seen.wait(lambda: head()['time'] == 0.0, 'the page')
            seen.slide('seek', 0.6)
            seen.wait(lambda: head()['time'] > 0.5 * end, 'the time line')
            seen.wait(lambda: has_both(seen.picture()), 'two tissues, of two colours')
            seen.choose('speed', '0.1 ×')
            began, clock = head()['time'], time.monotonic()
            seen.press('play')
            seen.wait(lambda: head()['time'] > began + 0.05, 'the session to go on')
            assert head()['time'] - began < 0.2 * (time.monotonic() - clock)  # slowly
            seen.press('play')
            seen.wait(lambda: not head()['playing'], 'the pause')
            stands = head()['time']
            time.sleep(0.5)
            assert head()['time'] == stands
            seen.choose('speed', '4 ×')
            seen.press('play')
            seen.wait(lambda: not head()['playing'] and head()['time'] > 0.99 * end, 'the end')
            seen.press('play')
            seen.wait(lambda: head()['time'] < 0.5 * end, 'the beginning again')
    finally:
        ended.append(True)
        thread.join()


def has_both(picture: np.ndarray) -> bool:
    """Whether something of the recorded tissue's colour is seen, and of the computed one's."""
    r, _, b = picture.astype(int).transpose(2, 0, 1)
    middle = np.s_[100:500, 20:700]
    return bool((r > b + 40)[middle].sum() > 500 and (b > r + 25)[middle].sum() > 500)


def test_bag_without_tissue_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BagError):
        RecordedTissue(open_bag(tmp_path))
