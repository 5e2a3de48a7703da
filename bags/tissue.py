"""The recorded tissue at a moment of the session."""

from cutting_trainer.bags.errors import BagError
from cutting_trainer.bags.player import first_time
from cutting_trainer.bags.reader import Bag
from cutting_trainer.bags.topics import MESH, UPDATES
from cutting_trainer.tissue_sim.mesh.replica import MeshReplica


def tissue_at(bag: Bag, seconds: float | None = None) -> MeshReplica:
    """Return the tissue that keyframes and deltas give.

    Args:
        bag: to read.
        seconds: moment [s] since the first message; None: the end.

    Raises:
        BagError: there is no keyframe until then.
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


def first_tissue(bag: Bag) -> float:
    """Return the time of the first keyframe [s since the first message]; 0 where there is none."""
    first = next(iter(bag.messages([MESH])), None)
    return 0.0 if first is None else (first.log_time - first_time(bag)) * 1e-9


def follow(replica: MeshReplica, topic: str, message: object) -> None:
    """Apply a keyframe or a delta; after a gap no delta fits until the next keyframe."""
    if topic == UPDATES:
        replica.apply(message)
    elif getattr(message, 'revision', -1) > replica.revision:
        replica.load(message)
