"""Video of a data set of LeRobot: the tissue as the operator sees it, drawn by the page."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from cutting_trainer.recordings.film_command import open_film, write_video
from cutting_trainer.session.errors import SessionError

Floats = NDArray[np.float64]
Counts = NDArray[np.int64]
Thumbnail = NDArray[np.uint8]

CAMERA = 'observation.images.operator'
FPS, SIZE = 25, (640, 480)
"""Pictures a second: a whole number of ticks at 1000, 500 and 100 Hz. Width and height [pixel]."""
PATH = 'videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4'
_LEVELS = 256
NO_PIXELS: Counts = np.zeros((3, _LEVELS), np.int64)
_KEYFRAMES = {'g': '2'}
"""As LeRobot writes them: a picture in the middle is found by decoding two."""
_THUMBNAIL = (64, 48)
_DIFFERENT = 12
"""Largest difference of a thumbnail, of 256 levels, by the encoder: 7 were seen, and 33 or more
between pictures of a moving blade that are a second apart."""


def write_episode_video(bag: Path, times: Floats, file: Path) -> Counts:
    """Write the video of an episode, and read it back.

    Args:
        bag: folder of the bag.
        times: of the pictures [s since the first message], shape (n,).
        file: .mp4 to write.

    Returns:
        Number of pixels by channel and level, shape (3, 256).

    Raises:
        BagError, SessionError: the bag cannot be drawn, or the video differs from the drawings.
    """
    drawn: list[Thumbnail] = []

    def noted(pictures: Iterator[Image.Image]) -> Iterator[Image.Image]:
        for picture in pictures:
            drawn.append(thumbnail(picture))
            yield picture

    file.parent.mkdir(parents=True, exist_ok=True)
    with open_film(bag, SIZE, gauges=False) as film:
        write_video(file, FPS, SIZE, noted(film.pictures(times)), **_KEYFRAMES)
    return check_video(file, drawn)


def check_video(file: Path, drawn: Sequence[Thumbnail]) -> Counts:
    """Read a video and compare it with the drawings.

    Args:
        file: .mp4.
        drawn: thumbnail of each picture.

    Returns:
        Number of pixels by channel and level, shape (3, 256).

    Raises:
        SessionError: number, times or content of the pictures differ.
    """
    counts, number = NO_PIXELS.copy(), 0
    with av.open(str(file)) as container:
        for number, frame in enumerate(container.decode(video=0), 1):
            pixels = frame.to_ndarray(format='rgb24')
            for channel in range(3):
                counts[channel] += np.bincount(pixels[..., channel].ravel(), minlength=_LEVELS)
            late = abs(float(frame.time or 0.0) - (number - 1) / FPS) > 1e-6
            if number > len(drawn) or late or frame.width != SIZE[0]:
                break
            if not alike(thumbnail(frame.to_image()), drawn[number - 1]):
                break
        else:
            if number == len(drawn):
                return counts
    raise SessionError(f'{file} has another picture {number} than was drawn: the disk is at fault')


def thumbnail(picture: Image.Image) -> Thumbnail:
    """Return the mean levels of parts of a picture, shape (48, 64, 3)."""
    return np.asarray(picture.resize(_THUMBNAIL, Image.Resampling.BOX), np.uint8)


def alike(one: Any, other: Any) -> bool:
    """Return whether two thumbnails are of one picture, but for the encoder's loss."""
    return int(np.abs(np.subtract(one, other, dtype=int)).max()) <= _DIFFERENT


def place_of_episode(chunk: int, file: int, length: int) -> dict[str, Any]:
    """Return the columns of an episode that has a file of its own.

    Args:
        chunk, file: numbers of the file.
        length: number of pictures.
    """
    values = {
        'chunk_index': chunk,
        'file_index': file,
        'from_timestamp': 0.0,
        'to_timestamp': length / FPS,
    }
    return {f'videos/{CAMERA}/{name}': value for name, value in values.items()}


def feature(file: Path) -> dict[str, Any]:
    """Return the feature of the videos, from the first of them."""
    with av.open(str(file)) as container:
        stream = container.streams.video[0]
        info = {
            'video.height': stream.height,
            'video.width': stream.width,
            'video.codec': stream.codec.canonical_name,
            'video.pix_fmt': stream.pix_fmt,
            'video.is_depth_map': False,
            'video.fps': FPS,
            'video.channels': 3,
            'has_audio': False,
        }
    names = ['height', 'width', 'channels']
    return {'dtype': 'video', 'shape': [*SIZE[::-1], 3], 'names': names, 'info': info}


def statistics(counts: Counts, quantiles: dict[str, float], pictures: int) -> dict[str, Any]:
    """Return statistics of each channel from 0 to 1, as LeRobot has them, each shape (3, 1, 1).

    Args:
        counts: number of pixels by channel and level, shape (3, 256).
        quantiles: share by name.
        pictures: their number.
    """
    levels = np.arange(_LEVELS) / (_LEVELS - 1)
    shares = counts / counts.sum(axis=1, keepdims=True)
    below = shares.cumsum(axis=1)
    mean = shares @ levels
    values = {name: levels[(below < share).sum(axis=1)] for name, share in quantiles.items()}
    values |= {
        'min': levels[(counts > 0).argmax(axis=1)],
        'max': levels[_LEVELS - 1 - (counts[:, ::-1] > 0).argmax(axis=1)],
        'mean': mean,
        'std': np.sqrt(np.maximum(shares @ levels**2 - mean**2, 0.0)),
    }
    shaped = {name: of.reshape(3, 1, 1).tolist() for name, of in values.items()}
    return {**shaped, 'count': [pictures]}
