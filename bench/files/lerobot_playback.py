"""Read a data set with LeRobot's own loader, in LeRobot's own environment: imports no trainer.

Prints JSON: for each episode its number of frames, the largest force, the length of the tool's
path, frames whose neighbours in time are others than the loader says, and coarse pictures.
"""

import json
import math
import sys
from typing import Any

from lerobot.datasets.lerobot_dataset import LeRobotDataset

EACH, PART = 25, 10
"""Frames from one kept picture to the next; width and height of its parts [pixel]."""
DECODER = 'pyav'
"""The default, torchcodec, needs FFmpeg's libraries on the machine."""
FORCE, STATE, ACTION = 'observation.force', 'observation.state', 'action'


def play(root: str) -> dict[str, Any]:
    """Return figures of each episode, recomputed frame by frame.

    Args:
        root: folder of the data set.
    """
    rate = LeRobotDataset('local/tissue', root=root).fps
    shifts = {FORCE: [-1 / rate, 0.0]}
    data = LeRobotDataset('local/tissue', root=root, delta_timestamps=shifts, video_backend=DECODER)
    episodes: dict[int, dict[str, Any]] = {}
    before: dict[str, Any] | None = None
    for index in range(len(data)):
        frame = data[index]
        number = int(frame['episode_index'])
        own = episodes.setdefault(
            number, {'frames': 0, 'largest_force': 0.0, 'path': 0.0, 'wrong': 0, 'pictures': []}
        )
        earlier, force = frame[FORCE]
        same = before is not None and int(before['episode_index']) == number
        own['frames'] += 1
        largest = float(force.reshape(-1, 3).norm(dim=1).max())
        own['largest_force'] = max(own['largest_force'], largest)
        own['path'] += math.dist(frame[STATE].tolist()[:3], frame[ACTION].tolist()[:3])
        if before is not None and same:
            own['wrong'] += earlier.tolist() != before[FORCE][1].tolist()
            own['wrong'] += frame[STATE].tolist() != before[ACTION].tolist()
            own['wrong'] += not math.isclose(
                float(frame['timestamp'] - before['timestamp']), 1 / rate, rel_tol=0.01
            )
        for camera in data.meta.camera_keys if (own['frames'] - 1) % EACH == 0 else ():
            picture = 255.0 * frame[camera].permute(1, 2, 0)
            height, width, _ = picture.shape
            parts = picture.reshape(height // PART, PART, width // PART, PART, 3).mean((1, 3))
            own['pictures'].append(parts.round().int().tolist())
        before = frame
    return {'fps': rate, 'frames': len(data), 'episodes': episodes}


if __name__ == '__main__':
    print(json.dumps(play(sys.argv[1])))
