"""The bag of a session that this machine has just computed, with the sample's hand: no graph."""

from collections.abc import Callable, Iterator, Mapping
from itertools import count
from pathlib import Path
from typing import Any

from cutting_trainer_msgs.msg import FrameInputs
from rclpy.serialization import serialize_message

from cutting_trainer.bags.message_text import schema_text
from cutting_trainer.bags.metadata import FORMAT_VERSION, read_metadata
from cutting_trainer.bags.reader import open_bag
from cutting_trainer.bags.resimulation import Resimulation
from cutting_trainer.bags.topic_names import (
    CONTACT,
    FORCE,
    INPUTS,
    MEMORY,
    MESH,
    POSE,
    STATE,
    UPDATES,
)
from cutting_trainer.bags.writer import BagWriter
from cutting_trainer.cutting.memory import MethodState
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.haptic_bridge.force_path import ForcePath
from cutting_trainer.node_common.cdr_codec import ContactCodec, ForceSampleCodec, PoseStampedCodec
from cutting_trainer.node_common.code_identity import identity_here
from cutting_trainer.node_common.ros import stamp
from cutting_trainer.recordings.recorded_scene import restore_scene
from cutting_trainer.recordings.resimulate_command import recomputation
from cutting_trainer.recordings.what_if import Hand, closed_loop
from cutting_trainer.session.scene_loader import Scene, load_scene
from cutting_trainer.tissue_sim.contact.tool import Frame, ToolMode
from cutting_trainer.tissue_sim.simulation.cut_transaction import ANSWER_FRAMES
from cutting_trainer.tissue_sim.simulation.serialisation import ObjectState
from cutting_trainer.tissue_sim.simulation.state import state_of
from cutting_trainer.tissue_sim.streaming.messages import DeltaEncoder, mesh_message
from cutting_trainer.tissue_sim.streaming.state_publisher import state_messages

PERIOD = 50_000_000
"""[ns] of a frame."""
KEYFRAME = 40
STATE_TYPE = 'cutting_trainer_msgs/msg/State'


class Watched(Resimulation):
    """A session that keeps its state, and that of cutting, at some frames.

    Attributes:
        every: frames from one to the next.
        kept: by the number of the frame that begins from them.
    """

    every = 1
    kept: dict[int, tuple[ObjectState, ObjectState]]

    def frame(self, contact: Any) -> Frame:
        step = self.simulation.step + 1
        if step % self.every == 0 and not self.simulation.awaits_answer:
            memory = MethodState(self._method, self._mesh).state()
            self.kept[step] = (state_of(self.simulation), memory)
        return super().frame(contact)


def watched(scene: Scene, every: int) -> Watched:
    """Simulation and cutting of a scene, before the first frame."""
    computed = Watched(recomputation(scene).simulation, make_method(scene.cutting))
    computed.every, computed.kept = every, {}
    return computed


def conceding(frame: Callable[..., Frame], concessions: Mapping[int, int]) -> Callable[..., Frame]:
    """Frames with concessions, from some of them on."""
    numbers, now = count(1), 0

    def conceded(*contacts: Any, concession: int = 0) -> Frame:
        nonlocal now
        now = concessions.get(next(numbers), now)
        return frame(*contacts, concession=now)

    return conceded


def make_session(
    sample: Path,
    folder: Path,
    temporary: Path,
    every: int = 0,
    modes: Mapping[int, ToolMode] | None = None,
    changes: Mapping[str, str] | None = None,
    concessions: Mapping[int, int] | None = None,
) -> Path:
    """Writes the bag of a session: the hand of a sample, everything else computed now.

    Args:
        sample: bag of which scene and poses are taken.
        folder: of the new bag.
        temporary: for the scene.
        every: frames from one whole state in the bag to the next; 0: it has none.
        modes: that the tool takes at the beginning of some frames.
        changes: of the sample's scene, by dotted key.
        concessions: of the tissue, from some frames on, by their number.
    """
    bag = open_bag(sample)
    file = restore_scene(bag, temporary, changes)
    scene = load_scene(str(file))
    codec = PoseStampedCodec()
    poses = [codec.decode(m.data) for m in bag.messages([POSE])]
    hand = Hand(ForcePath(scene.tool, scene.device, scene.haptics, scene.profile))
    computed = watched(scene, every) if every else recomputation(scene)
    simulation = computed.simulation
    if concessions:
        simulation.frame = conceding(simulation.frame, concessions)  # type: ignore[method-assign]
    about = read_metadata(sample)['custom_data'] | {'format_version': str(FORMAT_VERSION)}
    if changes:
        about['scene'] = file.read_text(encoding='utf-8')
    writer = BagWriter(folder, custom_data=about | identity_here().flat())
    for topic in (MESH, UPDATES, FORCE, INPUTS, CONTACT, POSE):
        kind = bag.topics()[topic]
        text = schema_text(kind) if topic == INPUTS else bag.schemas[kind]
        writer.add_topic(topic, kind, text, '', bag.profiles(topic))
    for topic in (STATE, MEMORY) if every else ():
        writer.add_topic(topic, STATE_TYPE, schema_text(STATE_TYPE), '', bag.profiles(FORCE))
    encoder = DeltaEncoder(simulation.mesh, simulation.displacement)

    def write(topic: str, time: int, data: bytes) -> None:
        writer.write(topic, time, time, data)

    def keyframe(time: int) -> None:
        message = mesh_message(
            simulation.mesh,
            simulation.displacement,
            'made',
            encoder.revision,
            simulation.step,
            time,
        )
        write(MESH, time, serialize_message(message))

    encode = PoseStampedCodec('arm_base').encode
    for pose in poses:
        write(POSE, pose.stamp_ns, encode(pose.stamp_ns, pose.values))
    start, end = poses[0].stamp_ns, poses[-1].stamp_ns
    keyframe(start)
    cut_step = 0
    untils = range(start + PERIOD, end, PERIOD)

    def times() -> Iterator[tuple[int, int]]:
        for number, until in enumerate(untils):
            hand.path.next_mode = (modes or {}).get(number, hand.path.next_mode)
            yield until, until

    for until, (frame, answer) in zip(
        untils, closed_loop(poses, times(), hand, computed), strict=True
    ):
        assert hand.contact is not None
        contact, time = hand.contact, until + 1
        inputs = FrameInputs(
            step=frame.step,
            has_contact=True,
            contact_sequence=int(contact.values[0]),
            contact_stamp=stamp(contact.stamp_ns),
            answer=answer,
            cut_step=cut_step if answer else 0,
            answer_frames=ANSWER_FRAMES,
            concession=frame.concession,
        )
        inputs.header.stamp = stamp(time)
        write(CONTACT, time, ContactCodec('tissue').encode(contact.stamp_ns, contact.values))
        write(INPUTS, time, serialize_message(inputs))
        if isinstance(computed, Watched):
            for topic, state in zip(
                (STATE, MEMORY), computed.kept.pop(frame.step, ()), strict=False
            ):
                for part in state_messages(state, frame.step, time):
                    write(topic, time, serialize_message(part))
        touched = computed.touched if answer == FrameInputs.APPLIED else None
        delta = encoder.encode(simulation.displacement, frame.step, time, touched, cut_step)
        assert hand.sample is not None
        write(FORCE, time, ForceSampleCodec('tissue').encode(time, hand.sample.values))
        if delta is not None:
            write(UPDATES, time, serialize_message(delta))
        if frame.step % KEYFRAME == 0 or (every and frame.step % every == 0):
            keyframe(time)
        if frame.command is not None:
            cut_step = frame.step
    writer.close()
    return folder
