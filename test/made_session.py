"""The bag of a session that this machine has just computed, with the sample's hand: no graph."""

from pathlib import Path

from cutting_trainer_msgs.msg import FrameInputs
from rclpy.serialization import serialize_message

from bags.metadata import read_metadata
from bags.reader import open_bag
from bags.topics import CONTACT, FORCE, INPUTS, MESH, POSE, UPDATES
from bags.writer import BagWriter
from haptic_bridge.force_path import ForcePath
from haptic_bridge.wire import ContactCodec, ForceSampleCodec, PoseStampedCodec
from session.recordings.experiment import Hand, closed_loop
from session.recordings.recorded_scene import restore_scene
from session.recordings.resimulate import recomputation
from session.scene import load_scene
from tissue_sim.messages import DeltaEncoder, mesh_message
from tissue_sim.ros import stamp

PERIOD = 50_000_000
"""[ns] of a frame."""
KEYFRAME = 40


def make_session(sample: Path, folder: Path, temporary: Path) -> Path:
    """Writes the bag of a session: the hand of a sample, everything else computed now.

    Args:
        sample: bag of which scene and poses are taken.
        folder: of the new bag.
        temporary: for the scene.
    """
    bag = open_bag(sample)
    scene = load_scene(str(restore_scene(bag, temporary)))
    codec = PoseStampedCodec()
    poses = [codec.decode(m.data) for m in bag.messages([POSE])]
    hand = Hand(ForcePath(scene.tool, scene.device, scene.haptics, scene.profile))
    computed = recomputation(scene)
    simulation = computed.simulation
    writer = BagWriter(folder, custom_data=read_metadata(sample)['custom_data'])
    for topic in (MESH, UPDATES, FORCE, INPUTS, CONTACT, POSE):
        kind = bag.topics()[topic]
        writer.add_topic(topic, kind, bag.schemas[kind], '', bag.profiles(topic))
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
    for until, (frame, answer) in zip(
        untils, closed_loop(poses, untils, hand, computed), strict=True
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
        )
        inputs.header.stamp = stamp(time)
        write(CONTACT, time, ContactCodec('tissue').encode(contact.stamp_ns, contact.values))
        write(INPUTS, time, serialize_message(inputs))
        touched = computed.touched if answer == FrameInputs.APPLIED else None
        delta = encoder.encode(simulation.displacement, frame.step, time, touched, cut_step)
        assert hand.sample is not None
        write(FORCE, time, ForceSampleCodec('tissue').encode(time, hand.sample.values))
        if delta is not None:
            write(UPDATES, time, serialize_message(delta))
        if frame.step % KEYFRAME == 0:
            keyframe(time)
        if frame.command is not None:
            cut_step = frame.step
    writer.close()
    return folder
