"""Claims about the page of a bag: any moment of it, and the session computed again beside it."""

import time
from collections.abc import Iterator
from pathlib import Path
from threading import Thread

import numpy as np
import pytest
from bag_copies import rewritten
from made_session import make_session
from rich.console import Console

from bags.errors import BagError
from bags.player import duration
from bags.reader import Bag, Recorded, open_bag
from bags.tissue import tissue_at
from bags.topics import CONTACT
from bench.browser import CHROMIUM, chromium
from bench.open_page import OpenPage
from haptic_bridge.wire import ContactCodec
from session.recordings.picture import read_story
from session.recordings.recorded_scene import restore_scene
from session.recordings.view_bag import resimulated
from session.scene import Scene, load_scene
from viewer.page import addresses
from viewer.replay_page import ReplayPage
from viewer.tracks import ComputedTissue, RecordedTissue, RecordedTool

pytestmark = pytest.mark.alone

CUT = Path(__file__).parents[1] / 'bags' / 'samples' / 'format_2' / 'straight_cut'
NOTES = Console(quiet=True)


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
    page = ReplayPage(bag, scene.tool, scene.device, again, 'computed again', '127.0.0.1', 0)
    yield page
    page.server.stop()


def test_page_goes_where_the_time_line_is_put(page: ReplayPage, bag: Bag) -> None:
    end = duration(bag)
    reader = OpenPage(addresses(page.server))
    page.show(0.8 * end, 0.0)
    scene = page.server.scene
    moved = scene.get_handle_by_name('/tissue/0').vertices
    late = RecordedTissue(bag).go_to(0.8 * end)
    used = np.unique(late.triangles[late.triangle_kind == 0])
    np.testing.assert_allclose(moved, late.positions()[used], atol=1e-7)
    beside = scene.get_handle_by_name('/computed/0').vertices
    np.testing.assert_allclose(beside, moved, atol=1e-7)
    tip = RecordedTool(bag).contact.at(0.8 * end)
    assert tip is not None
    np.testing.assert_allclose(
        scene.get_handle_by_name('/tool').position, tip.values[ContactCodec.fields['device']]
    )
    page.show(0.0, 1.0)
    first = RecordedTissue(bag).go_to(0.0)
    shown = scene.get_handle_by_name('/tissue/0').vertices
    np.testing.assert_allclose(shown, first.positions()[np.unique(first.triangles)], atol=1e-7)
    reader.close()


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason='chromium is not installed: sudo apt install chromium')
def test_time_line_is_moved_played_and_paused_by_clicks(page: ReplayPage, bag: Bag) -> None:
    end, tool = duration(bag), RecordedTool(bag)
    line = "+document.querySelector('[role=slider]').ariaValueNow"
    ended: list[bool] = []
    thread = Thread(target=page.run, args=(lambda: bool(ended),))
    thread.start()

    def shows(seconds: float) -> bool:
        contact = tool.contact.at(seconds)
        tip = page.server.scene.get_handle_by_name('/tool').position
        return contact is not None and np.array_equal(
            tip, contact.values[ContactCodec.fields['device']]
        )

    try:
        with chromium((1060, 640), coarseness=2) as browser:
            seen = browser.page(addresses(page.server))
            seen.wait(lambda: seen.says('Play'), 'the page')
            seen.slide(0.6)
            seen.wait(lambda: seen.evaluate(line) > 0.5 * end, 'the time line')
            seen.wait(lambda: shows(seen.evaluate(line)), 'the moment')
            seen.wait(lambda: has_both(seen.picture()), 'two tissues, of two colours')
            seen.choose('1 x', '0.1 x')
            began, clock = seen.evaluate(line), time.monotonic()
            seen.click('Play')
            seen.wait(lambda: seen.evaluate(line) > began + 0.05, 'the session to go on')
            assert seen.evaluate(line) - began < 0.2 * (time.monotonic() - clock)  # slowly
            seen.click('Pause')
            seen.wait(lambda: seen.says('Play'), 'the pause')
            stands = page.server.scene.get_handle_by_name('/tool').position
            time.sleep(0.5)
            assert np.array_equal(page.server.scene.get_handle_by_name('/tool').position, stands)
            seen.choose('0.1 x', '4 x')
            seen.click('Play')
            seen.wait(lambda: seen.says('Play') and shows(end), 'the end')
            seen.click('Play')
            seen.wait(lambda: seen.evaluate(line) < 0.5 * end, 'the beginning again')
    finally:
        ended.append(True)
        thread.join()


def has_both(picture: np.ndarray) -> bool:
    """Whether something of the recorded tissue's colour is seen, and of the computed one's."""
    r, _, b = picture.astype(int).transpose(2, 0, 1)
    middle = np.s_[:, 330:720]  # between the panels
    return bool((r > b + 40)[middle].sum() > 500 and (b > r + 25)[middle].sum() > 500)


def test_bag_without_tissue_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BagError):
        RecordedTissue(open_bag(tmp_path))
