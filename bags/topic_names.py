"""Names of the recorded topics of a session."""

from collections.abc import Collection

MESH, UPDATES = '/tissue/mesh', '/tissue/mesh_updates'
FORCE, INPUTS = '/tissue/force', '/tissue/frame_inputs'
CONTACT, INDEXING = '/tool/contact', '/haptic_bridge/indexing'
OF_ARM = '/arm'
POSE, SERVO_CF = '/arm/measured_cp', '/arm/servo_cf'
FORCES = (SERVO_CF, '/arm/body/servo_cf', '/arm/spatial/servo_cf')
"""Possible topics of the force on the hand: `device.force_topic` selects one."""
OF_DEVICE = (POSE, '/arm/measured_cv', '/arm/measured_cf')
BUTTONS = ('/arm/button', '/arm/clutch')
OF_TISSUE = (MESH, UPDATES, FORCE, CONTACT)
STATE, MEMORY = '/tissue/state', '/cutting/state'
CUTS = '/cutting/cut/_service_event'
DIAGNOSTICS = '/diagnostics'
REPLAYED = '/replay'
"""Namespace of the topics that replace the device's in a replay."""


def further_tools(topics: Collection[str]) -> list[str]:
    """Return the namespaces of the further tools of a session, `''` not among them."""
    ends = [topic.removesuffix(INPUTS) for topic in topics if topic.endswith(INPUTS)]
    return sorted(end for end in ends if end) if INPUTS in topics else []


def of_session(topic: str, topics: Collection[str]) -> str:
    """Return a topic of the device, or its replacement in the bag of a replay.

    A device in a namespace of its own is known where no other in the bag has such a topic.

    Args:
        topic: name in a live session.
        topics: those of the bag.
    """
    names = FORCES if topic == SERVO_CF else (topic,)
    stand_ins = (*names, *(f'{REPLAYED}{name}' for name in names))
    if found := next((name for name in stand_ins if name in topics), ''):
        return found
    ends = tuple(name.removeprefix(OF_ARM) for name in names if name.startswith(f'{OF_ARM}/'))
    elsewhere = [name for name in topics if ends and name.endswith(ends)]
    return elsewhere[0] if len(elsewhere) == 1 else topic
