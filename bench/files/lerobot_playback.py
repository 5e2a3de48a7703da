"""Read a data set with LeRobot's own loader, in LeRobot's own environment: imports no trainer.

Prints JSON: for each episode its number of frames, the largest force, the length of the tool's
path, and frames whose neighbours in time are others than the loader says.
"""

import json
import math
import sys
from typing import Any

from lerobot.datasets.lerobot_dataset import LeRobotDataset

FORCE, STATE, ACTION = 'observation.force', 'observation.state', 'action'


def play(root: str) -> dict[str, Any]:
    """Return figures of each episode, recomputed frame by frame.

    Args:
        root: folder of the data set.
    """
    rate = LeRobotDataset('local/tissue', root=root).fps
    data = LeRobotDataset('local/tissue', root=root, delta_timestamps={FORCE: [-1 / rate, 0.0]})
    episodes: dict[int, dict[str, float]] = {}
    before: dict[str, Any] | None = None
    for index in range(len(data)):
        frame = data[index]
        number = int(frame['episode_index'])
        own = episodes.setdefault(number, dict.fromkeys(('frames', 'largest_force', 'path',
                                                         'wrong'), 0.0))  # fmt: skip
        earlier, force = frame[FORCE].tolist()
        same = before is not None and int(before['episode_index']) == number
        own['frames'] += 1
        own['largest_force'] = max(own['largest_force'], math.hypot(*force))
        own['path'] += math.dist(frame[STATE].tolist()[:3], frame[ACTION].tolist()[:3])
        if before is not None and same:
            own['wrong'] += earlier != before[FORCE].tolist()[1]
            own['wrong'] += frame[STATE].tolist() != before[ACTION].tolist()
            own['wrong'] += not math.isclose(
                float(frame['timestamp'] - before['timestamp']), 1 / rate, rel_tol=0.01
            )
        before = frame
    return {'fps': rate, 'frames': len(data), 'episodes': episodes}


if __name__ == '__main__':
    print(json.dumps(play(sys.argv[1])))
