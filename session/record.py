"""The recorder alone, for a graph that somebody else has started."""

import os
import sys
from pathlib import Path

from session.demo import new_bag
from session.domain import parse_domain
from session.errors import SessionError
from session.graph import RECORDER_NODE, node_environment, recorder_command
from session.scene import load_scene


def run_recorder(output: Path | None, scene: str, seed: int, domain: str) -> None:
    """Becomes the recorder, which ends by Ctrl-C and says what it has; does not return.

    Args:
        output: folder of the new bag; None: one named after scene and time.
        scene: name or path of the scene that the nodes run; empty: not known.
        seed: of the session.
        domain: ROS domain; empty: of the environment.

    Raises:
        SessionError, SceneError: it cannot be recorded like this.
    """
    number = parse_domain(domain)
    if number == 'free':
        raise SessionError('--domain free has no graph in it: give the domain of the nodes')
    if output == Path():
        raise SessionError('--output names no folder: give the path of a new one')
    path = load_scene(scene).path if scene else None
    bag = new_bag(output, path.stem if path else RECORDER_NODE)
    command = recorder_command(path, bag, seed)
    sys.stdout.flush()
    os.execvpe(command.argv[0], command.argv, node_environment(number))
