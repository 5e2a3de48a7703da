"""Recorded sessions as a page shows them, one or two side by side."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from cutting_trainer.bags.playback_messages import duration
from cutting_trainer.bags.reader import Bag
from cutting_trainer.bags.recorded_indexings import indexing_at
from cutting_trainer.exercises.scene_schema import ExerciseSettings
from cutting_trainer.haptic_bridge.scene_schema import DeviceSettings, ToolSettings
from cutting_trainer.tissue_sim.mesh.depth import SurfaceDepth
from cutting_trainer.viewer.bag_timeline import ComputedTissue, RecordedTissue, RecordedTool
from cutting_trainer.viewer.tool_state import Floats, Moment, Translator

_LEAVES_M, _BEFORE_S = 1e-3, 1.0
"""Path of the tip from its first place after which a hand has begun; time that is shown before."""


class TissueInTime(Protocol):
    """A tissue at any moment."""

    def go_to(self, seconds: float) -> Any:
        """Return the tissue at a time [s]."""


@dataclass(eq=False)
class Recording:
    """A recorded session.

    Args:
        bag: to read.
        tool, device, exercise: sections of its scene.

    Raises:
        BagError: the bag has no tissue.
    """

    bag: Bag
    tool: ToolSettings
    device: DeviceSettings
    exercise: ExerciseSettings

    def __post_init__(self) -> None:
        self.tissue: TissueInTime = RecordedTissue(self.bag)
        self.track = RecordedTool(self.bag)
        self.end = duration(self.bag)
        self._translator = Translator(self.device)

    @property
    def name(self) -> str:
        """Return the name of the session: of its folder if split, or of its file."""
        path = self.bag.path
        return path.name if path.is_dir() else path.stem.removesuffix('_0')

    @cached_property
    def depths(self) -> Floats:
        """Return the depth of the blade's end at each contact [m], shape (n,)."""
        blades = [self.track.contact.vectors(end) for end in ('blade_root', 'blade_tip')]
        return SurfaceDepth(self.tissue.go_to(0.0)).depths(np.stack(blades, axis=1))

    @property
    def felt(self) -> tuple[Floats, Floats]:
        """Return times [s] and norms [N] of the tissue's force."""
        return self.track.force.times, np.linalg.norm(self.track.force.vectors('force'), axis=1)

    def moment(self, seconds: float) -> Moment | None:
        """Return the tool at a time [s]; None: it is not known yet."""
        contact = self.track.contact.at(seconds)
        if contact is None:
            return None
        pose, wrench = self.track.pose.at(seconds), self.track.wrench.at(seconds)
        indexing = indexing_at(self.track.indexings, contact.stamp_ns)
        return self._translator.moment(contact, pose, wrench, indexing)

    def depth(self, seconds: float) -> float:
        """Return the depth of the blade's end at a time [m]."""
        at = int(np.searchsorted(self.track.contact.times, seconds, 'right')) - 1
        return float(self.depths[max(at, 0)])

    def begin(self) -> float:
        """Return the time just before the hand begins to move [s]; it may be before the bag's."""
        tips = self.track.contact.vectors('device')
        left = np.linalg.norm(tips - tips[:1], axis=1) > _LEAVES_M
        return float(self.track.contact.times[left.argmax()]) - _BEFORE_S


@dataclass(eq=False)
class Beside:
    """A tissue to show beside the recorded one.

    Attributes:
        name: of it.
        tissue: at any moment.
        felt: times [s] and norms [N] of its force.
        end: of it [s].
        recording: the session that it is from; None: it is computed.
        later: time of it at the beginning of the other [s]; negative: it begins later.
    """

    name: str
    tissue: TissueInTime
    felt: tuple[Floats, Floats]
    end: float = 0.0
    recording: Recording | None = None
    later: float = 0.0


def computed_beside(name: str, computed: ComputedTissue) -> Beside:
    """Return a computed tissue to show beside the recorded one."""
    return Beside(name, computed, (np.array(computed.times), np.array(computed.forces)))


def recorded_beside(other: Recording, first: Recording) -> Beside:
    """Return another session to show beside the first, so that both hands begin together."""
    later = other.begin() - first.begin()
    times, forces = other.felt
    return Beside(
        other.name, other.tissue, (times - later, forces), other.end - later, other, later
    )
