"""Data sets with pictures: each goes with all forces since the one before, and with its moment."""

import json
from pathlib import Path

import av
import numpy as np
import pyarrow.parquet as pq
import pytest
from PIL import Image

from bench.files.lerobot_loader import differences, figures_of, same_pictures
from cutting_trainer.bags.topic_names import POSE
from cutting_trainer.recordings.film_command import open_film, write_video
from cutting_trainer.recordings.headless_browser import CHROMIUM
from cutting_trainer.session.bag_measurements import read_evidence
from cutting_trainer.session.errors import SessionError
from cutting_trainer.studies import dataset_episode, dataset_video
from cutting_trainer.studies.bag_collection import StudyBag, find_bags
from cutting_trainer.studies.dataset import INFO_FILE, write_dataset
from cutting_trainer.studies.dataset_episode import ACTION, FORCES, STATE, Episode, read_episode
from cutting_trainer.studies.dataset_video import CAMERA, alike, check_video, statistics, thumbnail
from cutting_trainer.studies.session_metadata import SessionMetadata

SAMPLES = Path(__file__).resolve().parents[1] / 'bags' / 'samples' / 'format_7'
FPS, SIZE = dataset_video.FPS, dataset_video.SIZE


def sample() -> tuple[StudyBag, Episode]:
    (bag,) = find_bags(['straight_cut'], SAMPLES)
    return bag, read_episode(bag, SessionMetadata())


def moving_square(count: int) -> list[Image.Image]:
    pictures = []
    for number in range(count):
        pixels = np.full((*SIZE[::-1], 3), 60, np.uint8)
        pixels[200:280, 40 * number : 40 * number + 80] = (220, 60, 40)
        pictures.append(Image.fromarray(pixels))
    return pictures


def test_a_picture_has_all_forces_since_the_one_before_and_the_next_pose_as_action() -> None:
    bag, ticks = sample()
    frames = ticks.by_picture(FPS)
    assert ticks.rate == 100 and frames.values[FORCES].shape == (frames.length, 4, 3)
    assert np.array_equal(
        frames.values[FORCES].reshape(-1, 3), ticks.values[FORCES][: 4 * frames.length]
    )
    assert 4 * frames.length <= ticks.length < 4 * frames.length + 4
    largest = np.linalg.norm(frames.values[FORCES], axis=2).max()
    assert largest == pytest.approx(read_evidence(bag.path).forces[:, 1].max(), rel=1e-9)
    for number in range(frames.length):
        assert np.array_equal(frames.values[STATE][number], ticks.values[STATE][4 * number + 3])
    assert np.array_equal(frames.values[ACTION][:-1], frames.values[STATE][1:])
    assert np.diff(frames.times) == pytest.approx(1 / FPS, abs=1e-6)
    with pytest.raises(SessionError, match=r'at 100 Hz make no pictures at 30 Hz.*without --video'):
        ticks.by_picture(30)


def test_forces_keep_their_rate_where_poses_come_less_often(monkeypatch) -> None:
    bag, whole = sample()
    stream = dataset_episode._stream

    def thinned(opened, topic: str, *about):
        stamps, values, delay = stream(opened, topic, *about)
        step = 10 if topic == POSE else 1
        return stamps[::step], values[::step], delay

    monkeypatch.setattr(dataset_episode, '_stream', thinned)
    thin = read_episode(bag, SessionMetadata())
    assert thin.rate == whole.rate and thin.length == whole.length
    assert np.array_equal(thin.values[FORCES], whole.values[FORCES])
    assert not np.array_equal(thin.values[STATE], whole.values[STATE])
    goes = np.any(thin.values[ACTION] != thin.values[STATE], axis=1)
    assert np.mean(goes) > 0.9  # the next pose, not the one of the next tick


def test_a_video_with_other_pictures_than_were_drawn_is_refused(tmp_path: Path) -> None:
    pictures = moving_square(8)
    write_video(tmp_path / 'one.mp4', FPS, SIZE, pictures, g='2')
    drawn = [thumbnail(picture) for picture in pictures]
    shades = check_video(tmp_path / 'one.mp4', drawn)
    assert (shades.sum(axis=1) == 8 * SIZE[0] * SIZE[1]).all()
    swapped = [*drawn[:3], drawn[4], drawn[3], *drawn[5:]]
    for other, number in ((swapped, 4), (drawn[:7], 8), ([*drawn, drawn[7]], 8)):
        with pytest.raises(SessionError, match=f'another picture {number} than was drawn'):
            check_video(tmp_path / 'one.mp4', other)
    write_video(tmp_path / 'slow.mp4', FPS - 1, SIZE, pictures)
    with pytest.raises(SessionError, match='another picture 2 than'):
        check_video(tmp_path / 'slow.mp4', drawn)


def test_statistics_of_pictures_are_those_of_their_pixels() -> None:
    pixels = np.random.default_rng(1).integers(20, 200, (3, 5000))
    pixels[1] = 7
    counts = np.array([np.bincount(channel, minlength=256) for channel in pixels])
    found = statistics(counts, {'q10': 0.1, 'q50': 0.5}, 4)
    levels = pixels / 255
    assert found['count'] == [4] and np.shape(found['mean']) == (3, 1, 1)
    for name, wanted in (('mean', levels.mean(axis=1)), ('std', levels.std(axis=1)),
                         ('min', levels.min(axis=1)), ('max', levels.max(axis=1))):  # fmt: skip
        assert np.ravel(found[name]) == pytest.approx(wanted, abs=1e-9)
    for name, share in (('q10', 0.1), ('q50', 0.5)):
        wanted = np.quantile(levels, share, axis=1)
        assert np.ravel(found[name]) == pytest.approx(wanted, abs=1.1 / 255)


def test_pictures_of_a_loader_that_are_others_than_those_of_a_bag_are_named() -> None:
    bag, _ = sample()
    drawn = [thumbnail(picture) for picture in moving_square(4)]
    right = {**figures_of(bag), 'wrong': 0, 'path': 0.0}
    found = {**right, 'pictures': [picture.tolist() for picture in drawn]}
    assert differences([bag], {'0': found}, {bag.hash: drawn}) == []
    turned = {**right, 'pictures': found['pictures'][::-1]}
    (said,) = differences([bag], {'0': turned}, {bag.hash: drawn})
    assert said == 'episode 0: its pictures are others than those of its bag'
    assert not same_pictures(found['pictures'][1:], drawn)


@pytest.mark.long
@pytest.mark.skipif(CHROMIUM is None, reason='chromium is not installed: sudo apt install chromium')
def test_a_data_set_has_the_picture_of_each_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dataset_video, 'FPS', 5)
    bag, ticks = sample()
    write_dataset([bag], tmp_path / 'set', '', pictures=True)
    info = json.loads((tmp_path / 'set' / INFO_FILE).read_text())
    assert info['fps'] == 5 and info['features'][FORCES]['shape'] == [20, 3]
    camera = info['features'][CAMERA]
    assert (camera['dtype'], camera['shape']) == ('video', [480, 640, 3])
    assert camera['info']['video.codec'] == 'h264' and camera['info']['video.fps'] == 5
    place = {'chunk_index': 0, 'file_index': 0}
    table = pq.read_table(tmp_path / 'set' / info['data_path'].format(**place))
    file = tmp_path / 'set' / info['video_path'].format(video_key=CAMERA, **place)
    with av.open(str(file)) as container:
        decoded = [(float(f.time), thumbnail(f.to_image())) for f in container.decode(video=0)]
    stamps = table.column('timestamp').to_numpy()
    assert [time for time, _ in decoded] == pytest.approx(stamps, abs=1e-4)
    (episode,) = pq.read_table(tmp_path / 'set' / 'meta/episodes').to_pylist()
    assert episode[f'videos/{CAMERA}/from_timestamp'] == 0.0
    assert episode[f'videos/{CAMERA}/to_timestamp'] == len(decoded) / 5
    assert np.shape(episode[f'stats/{CAMERA}/mean']) == (3, 1, 1)
    # The picture is that of its frame, and no other one: the blade moves.
    with open_film(bag.path, SIZE, gauges=False) as film:
        first, then = film.pictures(ticks.by_picture(5).times[[14, 22]])
    assert alike(thumbnail(first), decoded[14][1]) and alike(thumbnail(then), decoded[22][1])
    assert not alike(thumbnail(first), decoded[22][1])
