"""Names of the topics of a session, as bags have them."""

from collections.abc import Collection

MESH, UPDATES = '/tissue/mesh', '/tissue/mesh_updates'
FORCE, INPUTS = '/tissue/force', '/tissue/frame_inputs'
CONTACT = '/tool/contact'
POSE, SERVO_CF = '/arm/measured_cp', '/arm/servo_cf'
OF_DEVICE = (POSE, '/arm/measured_cv', '/arm/measured_cf')
BUTTON = '/arm/button'
OF_TISSUE = (MESH, UPDATES, FORCE, CONTACT)
CUTS = '/cutting/cut/_service_event'
DIAGNOSTICS = '/diagnostics'
REPLAYED = '/replay'
"""Namespace of what a replay and its nodes say to each other in a device's stead."""


def of_session(topic: str, topics: Collection[str]) -> str:
    """A topic of the device, or what stands in its stead in the bag of a replay.

    Args:
        topic: name in a live session.
        topics: those of the bag.
    """
    replayed = f'{REPLAYED}{topic}'
    return replayed if topic not in topics and replayed in topics else topic
