"""The recorded tissue at a moment of the session."""

from bags.errors import BagError
from bags.player import first_time
from bags.reader import Bag
from bags.topics import MESH, UPDATES
from tissue_sim.replica import MeshReplica


def tissue_at(bag: Bag, seconds: float | None = None) -> MeshReplica:
    """The tissue as keyframes and deltas lead to it.

    Args:
        bag: to read.
        seconds: moment [s] since the first message; None: the end.

    Raises:
        BagError: no keyframe had come until then.
    """
    replica = MeshReplica()
    origin = first_time(bag)
    for recorded in bag.messages([MESH, UPDATES]):
        if seconds is not None and recorded.log_time - origin > seconds * 1e9:
            break
        follow(replica, recorded.topic, bag.read(recorded))
    if replica.revision < 0:
        until = '' if seconds is None else f' in its first {seconds:g} s'
        raise BagError(f'{bag.path} has no message of {MESH}{until}: there is no tissue')
    return replica


def follow(replica: MeshReplica, topic: str, message: object) -> None:
    """Takes a keyframe or a delta; after a gap nothing fits until the next keyframe."""
    if topic == UPDATES:
        replica.apply(message)
    elif getattr(message, 'revision', -1) > replica.revision:
        replica.load(message)
