"""`trainer film`: a recorded session as a moving picture, drawn by the page."""

import io
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import av
import numpy as np
from PIL import Image

from cutting_trainer.recordings.headless_browser import Page, run_browser
from cutting_trainer.recordings.view_bag_command import open_recording
from cutting_trainer.session.errors import SessionError
from cutting_trainer.session.node_commands import LOCAL
from cutting_trainer.viewer.access_control import link, make_gate
from cutting_trainer.viewer.recording import recorded_beside
from cutting_trainer.viewer.replay_page import ReplayPage

CODECS = {'.mp4': ('libx264', {'crf': '20'}), '.webm': ('libvpx-vp9', {'crf': '32', 'b': '0'})}
ENDINGS = (*CODECS, '.gif')
MAX_PICTURES = 36_000
_PALETTE_PICTURES = 9
"""Pictures of a film that its one palette is made of."""
_ALONE = """(() => {{
    const sheet = new CSSStyleSheet();
    sheet.replaceSync(`.view {{ position: fixed; inset: 0; }}
        body.old .view canvas {{ opacity: 1; }}
        body > :not(.view), .views, .guide, .hint{also} {{ display: none !important; }}`);
    document.adoptedStyleSheets.push(sheet);
}})()"""
"""The tissue fills the page. No picture is old: the page has drawn the moment that is asked."""
_DRAWN = """new Promise(done => {{
    const drawn = () => requestAnimationFrame(() => requestAnimationFrame(() => done(true)));
    const look = () => window.page?.state.playhead?.time === {time} && window.page.state.frames > 0
        ? drawn() : setTimeout(look, 5);
    look();
}})"""


@dataclass(frozen=True)
class FilmOptions:
    """Options of `film`.

    Attributes:
        bag: folder of the bag.
        output: file, .mp4, .webm or .gif.
        beside: folder of another bag to show beside it; None: none.
        start, end: part of the session [s]; `end` None: to its end.
        rate: seconds of the session in one second.
        fps: pictures a second.
        size: of the picture [pixel], even numbers.
        zoom: by which the camera is nearer than that of the page.
    """

    bag: Path
    output: Path
    beside: Path | None = None
    start: float = 0.0
    end: float | None = None
    rate: float = 1.0
    fps: int = 30
    size: tuple[int, int] = (1280, 720)
    zoom: float = 1.0


class Film:
    """Draws a recorded session at any times.

    Args:
        page: of the session.
        shown: in the browser.
        zoom: by which the camera is nearer than that of the page.
        gauges: with force and depth in a corner.

    Attributes:
        end: of the session [s].
    """

    def __init__(self, page: ReplayPage, shown: Page, zoom: float, *, gauges: bool) -> None:
        self._page, self._shown, self.end = page, shown, page.end
        self._draw(0.0)
        shown.evaluate(_ALONE.format(also='' if gauges else ', .hud'))
        shown.evaluate(f'window.page.zoom({zoom})')

    def pictures(self, times: np.ndarray) -> Iterator[Image.Image]:
        """Yield the picture at each time [s], shape (n,), once the page has drawn it."""
        for now in times:
            self._draw(float(now))
            shot = self._shown.screenshot(optimizeForSpeed=True)  # not for size
            yield Image.open(io.BytesIO(shot)).convert('RGB')

    def _draw(self, now: float) -> None:
        self._page.server.tick()
        self._page.show(now)
        self._shown.evaluate(_DRAWN.format(time=round(now, 3)))


@contextmanager
def open_film(
    bag: Path,
    size: tuple[int, int],
    beside: Path | None = None,
    *,
    zoom: float = 1.0,
    gauges: bool = True,
) -> Iterator[Film]:
    """Open a recorded session to be drawn.

    Args:
        bag: folder of the bag.
        size: of the pictures [pixel].
        beside: folder of another bag to show beside it; None: none.
        zoom: by which the camera is nearer than that of the page.
        gauges: with force and depth in a corner.

    Raises:
        BagError, SessionError: a bag is not valid, or there is no browser.
    """
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix='trainer-')))
        recording, other = open_recording(bag, folder / 'first'), None
        if beside is not None:
            other = recorded_beside(open_recording(beside, folder / 'other'), recording)
        gate = make_gate(LOCAL, ())
        page = ReplayPage(recording, other, LOCAL, 0, gate)
        stack.callback(page.server.stop)
        browser = stack.enter_context(run_browser(Page, size))
        shown = browser.page(link(LOCAL, page.server.port, (), gate.token) + '&quality=high')
        yield Film(page, shown, zoom, gauges=gauges)


def make_film(options: FilmOptions, progress: Callable[[float], None]) -> int:
    """Write a film; return the number of its pictures.

    Args:
        options: of the command.
        progress: is given the share that is done.

    Raises:
        BagError, SessionError: an option or a bag is not valid, or there is no browser.
    """
    output = options.output
    if output.suffix not in ENDINGS:
        raise SessionError(f'{output}: end its name in {", ".join(ENDINGS)}')
    with open_film(options.bag, options.size, options.beside, zoom=options.zoom) as film:
        times = picture_times(options, film.end)
        pictures = _counted(film.pictures(times), len(times), progress)
        part = output.with_name(f'{output.stem}.part{output.suffix}')
        try:
            if part.suffix == '.gif':
                few = np.linspace(0, len(times) - 1, min(len(times), _PALETTE_PICTURES)).astype(int)
                palette = _palette(film.pictures(times[few]))
                _write_gif(part, options.fps, pictures, palette)
            else:
                write_video(part, options.fps, options.size, pictures)
            part.replace(output)
        finally:
            part.unlink(missing_ok=True)
    return len(times)


def _counted(
    pictures: Iterator[Image.Image], count: int, progress: Callable[[float], None]
) -> Iterator[Image.Image]:
    for number, picture in enumerate(pictures, 1):
        yield picture
        progress(number / count)


def picture_times(options: FilmOptions, end: float) -> np.ndarray:
    """Return the time of each picture [s], shape (n,).

    Args:
        options: of the film.
        end: of the session [s].

    Raises:
        SessionError: there is no picture, or there are too many.
    """
    until = end if options.end is None else min(options.end, end)
    step = options.rate / options.fps
    count = int((until - options.start) / step) + 1 if until > options.start else 0
    if not 0 < count <= MAX_PICTURES:
        raise SessionError(
            f'--start {options.start:g} and --end {until:g} of a session of {end:.1f} s make '
            f'{count} pictures: 1 to {MAX_PICTURES} can be'
        )
    return options.start + step * np.arange(count)


def write_video(
    file: Path, fps: int, size: tuple[int, int], pictures: Iterable[Image.Image], **more: str
) -> None:
    """Write pictures as a video.

    Args:
        file: .mp4 or .webm.
        fps: pictures a second.
        size: of the pictures [pixel], even numbers.
        pictures: in their order.
        more: options of the encoder.
    """
    codec, settings = CODECS[file.suffix]
    with av.open(str(file), 'w') as container:
        stream = cast(av.VideoStream, container.add_stream(codec, fps, settings | more))
        stream.width, stream.height = size
        stream.pix_fmt = 'yuv420p'
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_image(picture)))
        container.mux(stream.encode())


def _palette(pictures: Iterable[Image.Image]) -> Image.Image:
    """Return the common palette of pictures; small parts of a colour of their own keep it."""
    together = np.concatenate([np.asarray(picture) for picture in pictures])
    return Image.fromarray(together).quantize(method=Image.Quantize.FASTOCTREE)


def _write_gif(file: Path, fps: int, pictures: Iterator[Image.Image], palette: Image.Image) -> None:
    # One palette without dither: what stands still takes no bytes.
    made = (picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures)
    next(made).save(file, save_all=True, append_images=made, duration=round(1000 / fps), loop=0)
