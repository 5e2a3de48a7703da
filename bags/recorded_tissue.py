"""The recorded tissue at a moment of the session."""

from collections.abc import Iterator

from cutting_trainer.bags.errors import BagError
from cutting_trainer.bags.playback_messages import first_time, require_moment
from cutting_trainer.bags.reader import Bag, Recorded
from cutting_trainer.bags.topic_names import MESH, UPDATES
from cutting_trainer.tissue_sim.mesh.replica import MeshReplica


def tissue_at(bag: Bag, seconds: float | None = None) -> MeshReplica:
    """Return the tissue that keyframes and deltas give.

    Args:
        bag: to read.
        seconds: moment [s] since the first message; None: the end. Before the first keyframe it is
            that one.

    Raises:
        BagError: there is no keyframe, or the moment is not in the bag.
    """
    if seconds is not None:
        require_moment(bag, seconds)
    replica = MeshReplica()
    origin = first_time(bag)
    for recorded in tissue_messages(bag):
        late = seconds is not None and recorded.log_time - origin > seconds * 1e9
        if late and replica.revision >= 0:
            break
        follow(replica, recorded.topic, bag.read(recorded))
    if replica.revision < 0:
        raise BagError(f'{bag.path} has no message of {MESH}: there is no tissue')
    return replica


def first_current_keyframe(bag: Bag) -> Recorded | None:
    """Return the first keyframe that the recorded deltas continue; None where there is no keyframe.

    A recorder that joins a session first receives the keyframe that was published last. Cuts since
    then are not in it, and no recorded delta fits it. Where no keyframe fits, this is the first.
    """
    delta = next(iter(bag.messages([UPDATES])), None)
    base = 0 if delta is None else bag.read(delta).base_revision
    first = None
    for keyframe in bag.messages([MESH]):
        first = first or keyframe
        if bag.read(keyframe).revision >= base:
            return keyframe
    return first


def tissue_messages(bag: Bag) -> Iterator[Recorded]:
    """Yield keyframes and deltas in their order, from the `first_current_keyframe` on."""
    first = first_current_keyframe(bag)
    if first is not None:
        messages = bag.messages([MESH, UPDATES])
        yield from (m for m in messages if m.log_time >= first.log_time)


def first_tissue(bag: Bag) -> float:
    """Return the time of the first keyframe [s since the first message]; 0 where there is none."""
    first = first_current_keyframe(bag)
    return 0.0 if first is None else (first.log_time - first_time(bag)) * 1e-9


def follow(replica: MeshReplica, topic: str, message: object) -> None:
    """Apply a keyframe or a delta; after a gap no delta fits until the next keyframe."""
    if topic == UPDATES:
        replica.apply(message)
    elif getattr(message, 'revision', -1) > replica.revision:
        replica.load(message)
