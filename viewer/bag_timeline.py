"""Random access by time to a recorded session: tissue and tool at any moment."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.bags.errors import BagError
from cutting_trainer.bags.playback_messages import first_time
from cutting_trainer.bags.reader import Bag, Recorded
from cutting_trainer.bags.recorded_indexings import recorded_indexings
from cutting_trainer.bags.recorded_tissue import follow, tissue_messages
from cutting_trainer.bags.topic_names import CONTACT, FORCE, MESH, POSE, SERVO_CF, of_session
from cutting_trainer.node_common.cdr_codec import (
    ContactCodec,
    ForceSampleCodec,
    PoseStampedCodec,
    StampedCodec,
    StampedMessage,
    WrenchStampedCodec,
)
from cutting_trainer.tissue_sim.mesh.replica import MeshReplica

Floats = NDArray[np.float64]
_SAMPLE_SPACING_S = 0.005
"""[s] Shortest time between two kept samples of a fast topic."""


class RecordedTissue:
    """The tissue as recorded.

    Args:
        bag: to read.

    Raises:
        BagError: it has no tissue.
    """

    def __init__(self, bag: Bag) -> None:
        origin = first_time(bag)
        self._bag = bag
        self._messages: list[Recorded] = list(tissue_messages(bag))
        self._times = np.array([(m.log_time - origin) * 1e-9 for m in self._messages])
        self._keyframes = np.array(
            [i for i, m in enumerate(self._messages) if m.topic == MESH], np.int64
        )
        if not len(self._keyframes):
            raise BagError(f'{bag.path} has no message of {MESH}: there is no tissue to show')
        self._replica = MeshReplica()
        self._next = 0

    def go_to(self, seconds: float) -> MeshReplica:
        """Return the tissue at a time [s]; before the first keyframe, that one."""
        first = int(self._keyframes[0])
        until = max(int(np.searchsorted(self._times, seconds, 'right')), first + 1)
        keyframe = int(self._keyframes[np.searchsorted(self._keyframes, until) - 1])
        if until < self._next or keyframe > self._next:
            self._replica, self._next = MeshReplica(), keyframe
        for message in self._messages[self._next : until]:
            follow(self._replica, message.topic, self._bag.read(message))
        self._next = until
        return self._replica


@dataclass(eq=False)
class TissueSnapshot:
    """One moment of a computed tissue, with the fields of a replica that are drawn.

    Attributes:
        rest: [m], shape (n, 3).
        displacement: [m], shape (n, 3), float32.
        triangles, triangle_kind: as in `MeshReplica`.
        topology, revision: the same.
    """

    rest: Floats
    displacement: NDArray[np.float32]
    triangles: NDArray[np.int32]
    triangle_kind: NDArray[np.uint8]
    topology: int
    revision: int


@dataclass
class ComputedTissue:
    """A tissue that was computed frame by frame.

    Attributes:
        times: of the frames [s].
        stills: by frame; those of one topology share their arrays.
        forces: norm of the force on the tool by frame [N].
    """

    times: list[float] = field(default_factory=list)
    stills: list[TissueSnapshot] = field(default_factory=list)
    forces: list[float] = field(default_factory=list)

    def add(self, seconds: float, simulation: Any, force: float) -> None:
        """Store the state of a simulation at a time [s], and its force [N]."""
        mesh, last = simulation.mesh, self.stills[-1] if self.stills else None
        if last is not None and last.topology == mesh.topology:
            shared = last.rest, last.triangles, last.triangle_kind
        else:
            shared = mesh.rest.copy(), mesh.triangles.copy(), mesh.triangle_kind.copy()
        rest, triangles, kinds = shared
        moved = simulation.displacement.astype(np.float32)
        number = len(self.stills)
        self.stills.append(TissueSnapshot(rest, moved, triangles, kinds, mesh.topology, number))
        self.times.append(seconds)
        self.forces.append(force)

    def go_to(self, seconds: float) -> TissueSnapshot:
        """Return the tissue at a time [s]; before the first frame, that one."""
        return self.stills[max(int(np.searchsorted(self.times, seconds, 'right')) - 1, 0)]


class Samples:
    """The valid messages of one fast topic, thinned out.

    Args:
        bag: to read.
        topic: name; without messages everything is empty.
        codec: decodes them.
    """

    def __init__(self, bag: Bag, topic: str, codec: StampedCodec) -> None:
        origin, due = first_time(bag), 0.0
        self._codec = codec
        self._data: list[bytes] = []
        times = []
        for message in bag.messages([topic]):
            seconds = (message.log_time - origin) * 1e-9
            if seconds >= due and codec.decode(message.data).stamp_ns:  # 0: there is no device yet
                due = seconds + _SAMPLE_SPACING_S
                self._data.append(message.data)
                times.append(seconds)
        self.times = np.array(times)

    def at(self, seconds: float) -> StampedMessage | None:
        """Return the newest message at a time [s]; None before the first."""
        at = int(np.searchsorted(self.times, seconds, 'right')) - 1
        return self._codec.decode(self._data[at]) if at >= 0 else None

    def vectors(self, name: str) -> Floats:
        """Return a vector of each message, shape (n, 3)."""
        place = self._codec.fields[name]
        return np.reshape([self._codec.decode(d).values[place] for d in self._data], (-1, 3))


class RecordedTool:
    """Contact, pose and force as recorded.

    Args:
        bag: to read.
    """

    def __init__(self, bag: Bag) -> None:
        topics = bag.topics()
        self.contact = Samples(bag, CONTACT, ContactCodec())
        self.pose = Samples(bag, of_session(POSE, topics), PoseStampedCodec())
        self.wrench = Samples(bag, of_session(SERVO_CF, topics), WrenchStampedCodec())
        self.force = Samples(bag, FORCE, ForceSampleCodec())
        self.indexings = recorded_indexings(bag)
