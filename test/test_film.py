"""Claims about films of recorded sessions: foreign decoders read what the page has drawn."""

from itertools import pairwise
from pathlib import Path
from time import sleep
from typing import Any

import av
import numpy as np
import pytest
from page_user import cut_coloured, reddish
from PIL import Image, ImageSequence

from cutting_trainer.recordings.film_command import (
    FilmOptions,
    make_film,
    open_film,
    picture_times,
)
from cutting_trainer.recordings.headless_browser import CHROMIUM, Page
from cutting_trainer.session.errors import SessionError
from cutting_trainer.viewer.page_server import PageServer

pytestmark = pytest.mark.long

SAMPLE = Path(__file__).parents[1] / 'bags' / 'samples' / 'format_7' / 'straight_cut'
SIZE = 320, 200
needs_browser = pytest.mark.skipif(
    CHROMIUM is None, reason='chromium is not installed: sudo apt install chromium'
)


def film(
    file: Path, start: float, end: float, fps: int = 5, zoom: float = 1.0
) -> tuple[int, list[float]]:
    shares: list[float] = []
    options = FilmOptions(SAMPLE, file, start=start, end=end, fps=fps, size=SIZE, zoom=zoom)
    return make_film(options, shares.append), shares


@needs_browser
def test_a_film_has_the_pictures_of_its_times_and_the_tissue_is_opened_in_it(
    tmp_path: Path,
) -> None:
    count, shares = film(tmp_path / 'cut.mp4', 0.0, 6.0)
    assert count == 31 and shares[-1] == 1.0
    with av.open(str(tmp_path / 'cut.mp4')) as container:
        pictures = [frame.to_ndarray(format='rgb24') for frame in container.decode(video=0)]
        assert float(container.duration / av.time_base) == pytest.approx(count / 5, abs=0.05)
    assert len(pictures) == count and pictures[0].shape == (*SIZE[::-1], 3)
    assert [path.name for path in tmp_path.iterdir()] == ['cut.mp4']
    red = [int(((p[..., 0] > 120) & (p[..., 0] > p[..., 2] + 40)).sum()) for p in pictures]
    assert min(red) > 100, 'tissue is in every picture'
    moving = [np.abs(np.subtract(a, b, dtype=float)).mean() for a, b in pairwise(pictures)]
    assert max(moving) > 0.1, 'something moves'


@needs_browser
def test_a_gif_shows_the_cut_in_its_colour_and_from_nearer_more_tissue(tmp_path: Path) -> None:
    found = []
    for zoom in (1.0, 2.0):
        film(tmp_path / 'cut.gif', 0.0, 6.0, fps=1, zoom=zoom)
        with Image.open(tmp_path / 'cut.gif') as made:
            made.seek(made.n_frames - 1)
            found.append(np.asarray(made.convert('RGB')))
    far, near = (int(reddish(picture).sum()) for picture in found)
    assert near > 2 * far > 0
    assert int(cut_coloured(found[1]).sum()) > 30


@needs_browser
def test_a_film_says_nowhere_that_its_picture_is_old(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(PageServer, 'tick', lambda self: setattr(self, '_ticked', -1e3))
    film(tmp_path / 'cut.mp4', 0.0, 6.0)
    with av.open(str(tmp_path / 'cut.mp4')) as container:
        for frame in container.decode(video=0):
            r, g, b = frame.to_ndarray(format='rgb24').astype(int).transpose(2, 0, 1)
            amber = (r > 200) & (g > 130) & (b < 110)
            assert int(amber.sum()) < 100, 'the goal has this colour too, and the banner thousands'


@needs_browser
def test_a_gif_runs_as_long_as_the_session(tmp_path: Path) -> None:
    count, _ = film(tmp_path / 'cut.gif', 2.0, 3.0)
    with Image.open(tmp_path / 'cut.gif') as made:
        assert made.n_frames > 1 and made.size == SIZE
        lengths = [frame.info['duration'] for frame in ImageSequence.Iterator(made)]
    assert count == 6 and sum(lengths) == 200 * count, 'equal pictures may be one that lasts longer'


def test_what_cannot_be_filmed_is_refused_in_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(SessionError, match=r'end its name in \.mp4, \.webm, \.gif'):
        film(tmp_path / 'cut.avi', 0.0, 1.0)
    options = FilmOptions(SAMPLE, tmp_path / 'cut.mp4', start=9.0)
    with pytest.raises(SessionError, match=r'--start 9 .* of 7\.0 s make 0 pictures'):
        picture_times(options, 7.0)
    slow = FilmOptions(SAMPLE, tmp_path / 'cut.mp4', rate=0.01, fps=120)
    with pytest.raises(SessionError, match='36000 can be'):
        picture_times(slow, 7.0)


@needs_browser
def test_a_slow_browser_draws_the_same_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    at_once = Page.screenshot

    def slowly(page: Page, **options: Any) -> bytes:
        sleep(2.0)  # the page says after a second that its picture is old
        return at_once(page, **options)

    with open_film(SAMPLE, SIZE) as film:
        (soon,) = film.pictures(np.array([3.0]))
        monkeypatch.setattr(Page, 'screenshot', slowly)
        (late,) = film.pictures(np.array([3.0]))
    assert np.abs(np.subtract(soon, late, dtype=int)).max() < 20
