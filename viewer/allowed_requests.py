"""Allowed requests of pages: one rule for the server that checks and the page that shows it."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from cutting_trainer.viewer.page_protocol import (
    AnyMessage,
    Attempt,
    Choose,
    Guide,
    Record,
    Role,
    Scale,
    Seek,
    SetTissue,
    Speed,
    Watch,
)

TISSUE_FACTORS = (0.5, 2.0)
"""Range of the factors of the scene's own stiffness and toughness."""
_NO_LAUNCHER = 'This needs the launcher: the page shows a graph that was started elsewhere.'
HELD = 'The instructor has paused. Only the instructor goes on.'
_INSTRUCTORS = 'Only the page of the instructor does this.'


@dataclass(frozen=True)
class Bounds:
    """A box in the tissue frame.

    Attributes:
        low, high: its corners [m].
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def contain(self, position: tuple[float, float, float]) -> bool:
        """Return whether a position [m] is in it."""
        return all(
            low <= at <= high for low, at, high in zip(self.low, position, self.high, strict=True)
        )


@dataclass(frozen=True)
class LiveControls:
    """Controls of a live session at one moment; immutable, so that threads may share it.

    Attributes:
        scenes, methods: on offer.
        scale: smallest and largest force scale on offer.
        bounds: allowed positions of the hand; None: none.
        session: whether a launcher is behind the page.
        busy: activity of the launcher, '' when there is none.
        can_guide: whether the hand follows goals.
        e_stopped: whether an E-STOP holds.
        recording: whether a bag is in progress.
        exercises: titles of the exercises on offer, by scene.
        bags: names of the attempts' bags.
        held: whether the instructor has paused.
    """

    scenes: tuple[str, ...] = ()
    methods: tuple[str, ...] = ()
    scale: tuple[float, float] = (1.0, 1.0)
    bounds: Bounds | None = None
    session: bool = False
    busy: str = ''
    can_guide: bool = False
    e_stopped: bool = False
    recording: bool = False
    exercises: Mapping[str, str] = field(default_factory=dict)
    bags: tuple[str, ...] = ()
    held: bool = False

    def refused(self, role: Role = 'trainee') -> dict[str, str]:
        """Return why an op is not allowed whatever its values, by op.

        Args:
            role: of the page.
        """
        found = {}
        asks_launcher = ('record', 'choose', 'attempt', 'tissue', 'watch')
        if not self.session:
            found = dict.fromkeys(asks_launcher, _NO_LAUNCHER)
        elif self.busy:
            found = dict.fromkeys((*asks_launcher, 'reset'), self.busy)
        if self.e_stopped:
            found['start'] = 'An E-STOP holds: reset it first.'
        if not self.can_guide or self.bounds is None:
            found['guide'] = 'The hand follows only an emulated arm with the force on.'
        if self.held:
            found['start'] = HELD
        if role == 'instructor':
            found['guide'] = 'The trainee moves the tool: this page watches.'
            return found
        if self.held:
            found |= dict.fromkeys(('reset', 'record', 'choose', 'attempt', 'scale', 'guide'), HELD)
        return found | dict.fromkeys(('hold', 'tissue'), _INSTRUCTORS)

    def refusal(self, message: AnyMessage, role: Role = 'trainee') -> str:
        """Return why a message from a page of a role is not allowed now; '' where it is."""
        if why := self.refused(role).get(message.op):
            return why
        if isinstance(message, Choose) and not (
            message.scene in self.scenes and message.method in self.methods
        ):
            return 'Choose a scene and a method from the lists.'
        if isinstance(message, Attempt) and message.scene not in self.exercises:
            return 'Choose an exercise from the list.'
        if isinstance(message, Watch) and not set(message.bags) <= set(self.bags):
            return 'Choose attempts from the list.'
        if isinstance(message, Scale) and not self.scale[0] <= message.value <= self.scale[1]:
            return f'The force scale is from {self.scale[0]:g} to {self.scale[1]:g}.'
        if isinstance(message, SetTissue) and not all(
            TISSUE_FACTORS[0] <= factor <= TISSUE_FACTORS[1]
            for factor in (message.stiffness, message.toughness)
        ):
            low, high = TISSUE_FACTORS
            return f'Factors of the tissue are from {low:g} to {high:g}.'
        if isinstance(message, Guide) and self.bounds and not self.bounds.contain(message.position):
            return 'The hand is guided around the tissue only.'
        if isinstance(message, Record) and message.on == self.recording:
            return 'A bag is being made already.' if message.on else 'No bag is being made.'
        return ''


@dataclass(frozen=True)
class ReplayControls:
    """Controls of a recorded session.

    Attributes:
        end: of the session [s].
        speeds: on offer.
    """

    end: float
    speeds: tuple[float, ...]

    def refused(self, _: Role = 'trainee') -> dict[str, str]:
        """Return an empty dictionary: everything is allowed at any time."""
        return {}

    def refusal(self, message: AnyMessage, _: Role = 'trainee') -> str:
        """Return why a message is not allowed; '' where it is."""
        if isinstance(message, Seek) and message.time > self.end:
            return f'The session ends at {self.end:.2f} s.'
        if isinstance(message, Speed) and message.value not in self.speeds:
            return 'Choose a speed from the list.'
        return ''


Controls = LiveControls | ReplayControls
