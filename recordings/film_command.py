"""`trainer film`: a recorded session as a moving picture, drawn by the page."""

import io
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
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
_VIEW = """(() => {
    document.body.classList.add('film');
    const r = document.getElementById('view').getBoundingClientRect();
    return [r.x, r.y, r.width, r.height, innerWidth, innerHeight];
})()"""
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


def make_film(options: FilmOptions, progress: Callable[[float], None]) -> int:
    """Write a film; return the number of its pictures.

    Args:
        options: of the command.
        progress: is given the share that is done.

    Raises:
        BagError, SessionError: an option or a bag is not valid, or there is no browser.
    """
    if options.output.suffix not in ENDINGS:
        raise SessionError(f'{options.output}: end its name in {", ".join(ENDINGS)}')
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix='trainer-')))
        recording, beside = open_recording(options.bag, folder / 'first'), None
        if options.beside is not None:
            beside = recorded_beside(open_recording(options.beside, folder / 'other'), recording)
        gate = make_gate(LOCAL, ())
        page = ReplayPage(recording, beside, LOCAL, 0, gate)
        stack.callback(page.server.stop)
        times = picture_times(options, page.end)
        browser = stack.enter_context(run_browser(Page, options.size))
        shown = browser.page(link(LOCAL, page.server.port, (), gate.token) + '&quality=high')
        _show(page, shown, float(times[0]))
        clip = _clip(shown, options)

        def pictures(times: np.ndarray) -> Iterator[Image.Image]:
            for now in times:
                page.server.tick()
                _show(page, shown, float(now))
                yield Image.open(io.BytesIO(shown.screenshot(clip=clip))).convert('RGB')

        part = options.output.with_name(f'{options.output.stem}.part{options.output.suffix}')
        stack.callback(part.unlink, missing_ok=True)
        told = _told(pictures(times), len(times), progress)
        if part.suffix == '.gif':
            few = np.linspace(0, len(times) - 1, min(len(times), _PALETTE_PICTURES)).astype(int)
            _write_gif(part, options.fps, told, _palette(pictures(times[few])))
        else:
            _write_video(part, options, told)
        part.replace(options.output)
    return len(times)


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


def _clip(shown: Page, options: FilmOptions) -> dict[str, float]:
    """Make room for a picture of the size, and return the part of the page that has it."""
    width, height = options.size
    for _ in range(2):  # the picture fills what the rest of the page leaves
        *_, wide, high, inner_width, inner_height = shown.evaluate(_VIEW)
        shown.resize(int(inner_width + width - wide), int(inner_height + height - high))
    shown.evaluate(f'window.page.zoom({options.zoom})')
    x, y, *_ = shown.evaluate(_VIEW)
    return {'x': x, 'y': y, 'width': width, 'height': height, 'scale': 1}


def _show(page: ReplayPage, shown: Page, now: float) -> None:
    """Go to a time [s], and return once the page has drawn it."""
    page.show(now)
    shown.evaluate(_DRAWN.format(time=round(now, 3)))


def _told(
    pictures: Iterable[Image.Image], count: int, progress: Callable[[float], None]
) -> Iterator[Image.Image]:
    """Yield pictures, and tell the share of them that is done."""
    for number, picture in enumerate(pictures):
        yield picture
        progress((number + 1) / count)


def _write_video(file: Path, options: FilmOptions, pictures: Iterator[Image.Image]) -> None:
    codec, settings = CODECS[file.suffix]
    with av.open(str(file), 'w') as container:
        stream = cast(av.VideoStream, container.add_stream(codec, options.fps, settings))
        stream.width, stream.height = options.size
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
