"""The further tools of a scene, as a page draws them."""

from pathlib import Path

from cutting_trainer_msgs.msg import Contact
from geometry_msgs.msg import PoseStamped

from cutting_trainer.haptic_bridge.scene_schema import DeviceSettings, ToolSettings
from cutting_trainer.node_common import ros
from cutting_trainer.node_common.cdr_codec import ContactCodec, PoseStampedCodec
from cutting_trainer.node_common.lifecycle import ManagedNode
from cutting_trainer.node_common.scene_reader import read_section, tool_names
from cutting_trainer.viewer.tool_state import Moment, Translator
from cutting_trainer.viewer.topic_rate import Stream


class FurtherTool:
    """One of them: its newest contact and pose.

    Args:
        node: to subscribe with.
        scene: path of the scene file.
        name: of the tool, and the namespace of its arm and bridge.

    Attributes:
        tool: its settings.
    """

    def __init__(self, node: ManagedNode, scene: Path, name: str) -> None:
        self.tool = read_section(scene, 'tool', ToolSettings, name)
        self._translator = Translator(read_section(scene, 'device', DeviceSettings, name))
        self._contact = Stream(node, Contact, f'{name}/{ros.CONTACT}', ContactCodec())
        topic = f'{name}/{ros.ARM}/measured_cp'
        self._pose = Stream(node, PoseStamped, topic, PoseStampedCodec())

    def moment(self, now: float) -> Moment | None:
        """Return the newest state at a time [s]; None: it is not known."""
        for stream in (self._contact, self._pose):
            stream.poll(now)
        if self._contact.newest is None:
            return None
        return self._translator.moment(self._contact.newest, self._pose.newest, None)

    def close(self) -> None:
        """End the subscriptions."""
        for stream in (self._contact, self._pose):
            stream.close()


def further_tools(node: ManagedNode, scene: Path) -> list[FurtherTool]:
    """Return the further tools of a scene, in its order."""
    return [FurtherTool(node, scene, name) for name in tool_names(scene)]
