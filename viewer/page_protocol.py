"""Protocol between pages and server, version 1.

A page sends JSON text of at most `MAX_MESSAGE` bytes: one object with its `op` and exactly the
fields of that op's class below. Everything else is rejected: other ops, other fields, other types,
numbers that are not finite or out of bounds. `cutting_trainer.viewer.allowed_requests` decides whether an
op and its values are allowed now.

The server sends JSON text with a `type`; each message is the newest value of its type and replaces
the one before:

| type | fields |
|---|---|
| hello | version, mode, title, session, scenes, methods, exercises of name and title, duration, speeds, tool, further_tools, camera, floor, bounds, metres_per_newton, tissues, plots_span, exercise: null where the scene is none |
| controls | refused: by role, sentence by op; every other op of the mode is allowed |
| state | state, text, guided: how the pointer moves the tool, e_stopped, held: by the instructor |
| nodes | rows of name, level, message, rate |
| session | scene, method, recording, busy, scenes, tissue: factors stiffness and toughness |
| scale | value, min, max |
| moment | tip, wxyz, proxy, force, depth, can_guide, contact, clutched, further: tip and wxyz of each further tool, null where it is not known |
| plots | span, lines of title, unit, times, values and colours by name, least |
| playhead | time, playing, speed |
| attempt | rows of name, value, over; score: null, or points, passed, reasons once the attempt is over; bridge: null, or the place of the tissue that still holds a nearly freed lesion [m] |
| attempts | rows of bag, subject, exercise, attempt, begun, state, points, passed, newest first |
| replay | number: of the request, link: to open |
| notice | id, text |
| refused | op, why: only to the page that asked |
| pong | id: the same, age: of the newest session update [s] |

A tissue is binary. It begins with the length of a header as little-endian uint32, and the header
as JSON, padded with spaces so that both have a multiple of 4 bytes. Each part follows with its
positions, float32 (vertices, 3) [m], and, where `faces` is not null, its triangles, uint32
(faces, 3). At the end are the edges of the cuts, float32 (cut_edges, 3), and with new triangles x and y
at rest of the outside's vertices, float32 (rest, 2): the page draws there what belongs to a place of
the tissue. Null triangles mean that the page has them already.
"""  # noqa: E501

import math
from typing import Annotated, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from cutting_trainer.exercises.attempt_store import SUBJECT

VERSION = 1
MAX_MESSAGE = 2048
"""[bytes] of a message from a page."""
MAX_NAME = 64
"""Characters of a scene's or method's name."""
_MAX_COORDINATE_M = 10.0
"""[m] of any position: goals are bounded further, see `cutting_trainer.viewer.allowed_requests`."""
_LENGTH_TOLERANCE = 0.01
"""Tolerance of the length of a unit quaternion."""

Mode = Literal['live', 'replay']
Name = Annotated[str, Field(min_length=1, max_length=MAX_NAME)]
Coordinate = Annotated[float, Field(ge=-_MAX_COORDINATE_M, le=_MAX_COORDINATE_M)]
Share = Annotated[float, Field(ge=-1 - _LENGTH_TOLERANCE, le=1 + _LENGTH_TOLERANCE)]
Positive = Annotated[float, Field(gt=0, le=1000)]
Role = Literal['trainee', 'instructor']
"""Of a page: who looks at it, by its link."""
ROLES: tuple[Role, ...] = get_args(Role)


class PageMessage(BaseModel):
    """Base of a page's messages: an `op`, and no field but its own."""

    model_config = ConfigDict(extra='forbid', strict=True, frozen=True, allow_inf_nan=False)


class EStop(PageMessage):
    """Set the force to zero at once."""

    op: Literal['e_stop']


class ResetEStop(PageMessage):
    """Clear the E-STOP; force stays off until `start`."""

    op: Literal['reset_e_stop']


class Start(PageMessage):
    """Enable the force."""

    op: Literal['start']


class Pause(PageMessage):
    """Disable the force, and hold the hand still."""

    op: Literal['pause']


class Reset(PageMessage):
    """Make the tissue whole, with the force off."""

    op: Literal['reset']


class Record(PageMessage):
    """Begin a bag, or end it."""

    op: Literal['record']
    on: bool


class Choose(PageMessage):
    """Restart the nodes with another scene or method of cutting."""

    op: Literal['choose']
    scene: Name
    method: Name


class Attempt(PageMessage):
    """Restart the nodes with an exercise, and record the attempt of a subject from its start."""

    op: Literal['attempt']
    scene: Name
    subject: Annotated[str, Field(max_length=MAX_NAME, pattern=SUBJECT)]


class Hold(PageMessage):
    """Pause for everybody until the same with `on` false, which enables the force again."""

    op: Literal['hold']
    on: bool


class SetTissue(PageMessage):
    """Restart the nodes with another tissue: factors of the scene's own values."""

    op: Literal['tissue']
    stiffness: Positive
    toughness: Positive


class Watch(PageMessage):
    """Serve the replay of an attempt, or of two side by side; the answer has the same number."""

    op: Literal['watch']
    bags: Annotated[list[Name], Field(min_length=1, max_length=2)]
    number: Annotated[int, Field(ge=0, le=2**53)]


class Scale(PageMessage):
    """Set the ratio of the hand's force to the tissue's."""

    op: Literal['scale']
    value: Positive


class Guide(PageMessage):
    """Set the emulated hand's goal in the tissue frame: position [m], unit quaternion w x y z."""

    op: Literal['guide']
    position: tuple[Coordinate, Coordinate, Coordinate]
    wxyz: tuple[Share, Share, Share, Share]

    @property
    def is_unit(self) -> bool:
        """Return whether the quaternion is of unit length."""
        return abs(math.hypot(*self.wxyz) - 1) <= _LENGTH_TOLERANCE


class Ping(PageMessage):
    """Request a `pong` with the same number."""

    op: Literal['ping']
    id: Annotated[int, Field(ge=0, le=2**53)]


class Play(PageMessage):
    """Resume or pause a recorded session."""

    op: Literal['play']
    on: bool


class Seek(PageMessage):
    """Go to a time [s] of a recorded session."""

    op: Literal['seek']
    time: Annotated[float, Field(ge=0, le=1e9)]


class Speed(PageMessage):
    """Set the playback speed: seconds of the session in one second."""

    op: Literal['speed']
    value: Positive


LiveMessage = (
    EStop | ResetEStop | Start | Pause | Reset | Record | Choose | Attempt | Hold | SetTissue
    | Watch | Scale | Guide | Ping
)  # fmt: skip
ReplayMessage = Play | Seek | Speed | Ping
AnyMessage = LiveMessage | ReplayMessage
_ADAPTERS: dict[Mode, TypeAdapter[AnyMessage]] = {
    'live': TypeAdapter(Annotated[LiveMessage, Field(discriminator='op')]),
    'replay': TypeAdapter(Annotated[ReplayMessage, Field(discriminator='op')]),
}
NOT_PROTOCOL = 'this is not a message of the page: see the docstring of viewer/page_protocol.py'


class ProtocolError(ValueError):
    """A message that our pages do not send; the sentence quotes nothing of it."""


def parse(text: str, mode: Mode) -> AnyMessage:
    """Parse the text of a message.

    Args:
        text: of one message.
        mode: of the page.

    Raises:
        ProtocolError: it is invalid, or has a value that no page sends.
    """
    try:
        message = _ADAPTERS[mode].validate_json(text)
    except (ValidationError, ValueError, RecursionError):
        raise ProtocolError(NOT_PROTOCOL) from None
    if isinstance(message, Guide) and not message.is_unit:
        raise ProtocolError('the quaternion of a goal must have the length 1')
    return message
