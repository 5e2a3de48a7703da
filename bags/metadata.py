"""Reader and writer of metadata.yaml, version 9, as rosbag2 on Jazzy has it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from cutting_trainer.bags.errors import BagError
from cutting_trainer.bags.recorded_qos import Profiles, metadata_profiles
from cutting_trainer.bags.untrusted_yaml import MAX_BYTES, load_yaml
from cutting_trainer.node_common.code_identity import CodeIdentity, identity_of
from cutting_trainer.node_common.yaml_bounds import YamlBoundError, read_bounded

FORMAT_VERSION = 7
"""Version of our additions to rosbag2's format; grows with each change that a reader must know."""
METADATA_FILE = 'metadata.yaml'
_SIMULATION = '/tissue_sim'
_ROOT = 'rosbag2_bagfile_information'


@dataclass(frozen=True)
class Topic:
    """One recorded topic.

    Attributes:
        name: topic, with its leading slash.
        type_name: `package/msg/Type`.
        type_hash: `RIHS01_...` as its publishers offer it.
        profiles: QoS that its publishers offer.
    """

    name: str
    type_name: str
    type_hash: str
    profiles: Profiles


@dataclass
class Tally:
    """Messages of a bag that are on disk.

    Attributes:
        counts: messages by topic.
        start: smallest log time [ns since the epoch], 0 while there is no message.
        end: largest log time [ns since the epoch].
    """

    counts: dict[str, int] = field(default_factory=dict)
    start: int = 0
    end: int = 0

    @property
    def messages(self) -> int:
        """Return the number of messages of all topics."""
        return sum(self.counts.values())

    def add(self, topic: str, log_time: int) -> None:
        """Count one message."""
        self.start = min(self.start or log_time, log_time)
        self.end = max(self.end, log_time)
        self.counts[topic] = self.counts.get(topic, 0) + 1

    def merge(self, other: 'Tally') -> None:
        """Add the counts of another tally."""
        if other.counts:
            self.start = min(self.start or other.start, other.start)
            self.end = max(self.end, other.end)
        for topic, count in other.counts.items():
            self.counts[topic] = self.counts.get(topic, 0) + count


def bag_information(
    file_name: str, topics: Mapping[str, Topic], tally: Tally, custom_data: Mapping[str, str]
) -> dict[str, Any]:
    """Return the content of metadata.yaml for a bag of one file, without the outermost key."""
    duration = {'nanoseconds': tally.end - tally.start}
    start = {'nanoseconds_since_epoch': tally.start}
    return {
        'version': 9,
        'storage_identifier': 'mcap',
        'duration': dict(duration),
        'starting_time': dict(start),
        'message_count': tally.messages,
        'topics_with_message_count': [
            {
                'topic_metadata': {
                    'name': topic.name,
                    'type': topic.type_name,
                    'serialization_format': 'cdr',
                    'offered_qos_profiles': metadata_profiles(topic.profiles),
                    'type_description_hash': topic.type_hash,
                },
                'message_count': tally.counts.get(topic.name, 0),
            }
            for topic in topics.values()
        ],
        'compression_format': '',
        'compression_mode': '',
        'relative_file_paths': [file_name],
        'files': [
            {
                'path': file_name,
                'starting_time': start,
                'duration': duration,
                'message_count': tally.messages,
            }
        ],
        'custom_data': dict(custom_data),
        'ros_distro': 'jazzy',
    }


def to_yaml(information: Mapping[str, Any]) -> str:
    """Return the YAML text of `bag_information`."""
    text: str = yaml.safe_dump(dict(information), sort_keys=False, allow_unicode=True)
    return text


def write_metadata(folder: Path, information: Mapping[str, Any]) -> None:
    """Write metadata.yaml atomically: the old or the new one is complete at any moment."""
    temporary = folder / f'{METADATA_FILE}.tmp'
    try:
        temporary.write_text(to_yaml({_ROOT: dict(information)}), encoding='utf-8')
        temporary.replace(folder / METADATA_FILE)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise


def read_metadata(folder: Path) -> dict[str, Any]:
    """Return the content of a folder's metadata.yaml, as `bag_information` has it.

    Raises:
        BagError: there is none, or it is not that of a bag.
    """
    path = folder / METADATA_FILE
    try:
        content = load_yaml(read_bounded(path, MAX_BYTES), str(path))
    except FileNotFoundError:
        raise BagError(_no_bag(folder)) from None
    except NotADirectoryError:
        raise BagError(f'{folder} is a file: name the folder of the bag, {folder.parent}') from None
    except YamlBoundError as error:
        raise BagError(error.of(path)) from None
    except UnicodeDecodeError as error:
        raise BagError(
            f'{path} is not the metadata of a bag: byte {error.start} is no text'
        ) from None
    except OSError as error:
        raise BagError(f'{path} cannot be read: {error.strerror}') from None
    if not (isinstance(content, dict) and isinstance(content.get(_ROOT), dict)):
        raise BagError(f'{path} is not the metadata of a bag: it has no {_ROOT}')
    return dict(content[_ROOT])


def _no_bag(folder: Path) -> str:
    """Return why a folder is no bag, and which folder may have been meant."""
    if not folder.exists():
        return f'{folder} is not a bag: there is no such folder'
    bags = sorted(path.parent.name for path in folder.glob(f'*/{METADATA_FILE}'))
    inside = f', but bags in it: {", ".join(bags[-5:])}' if bags else ''
    return f'{folder} is not a bag: it has no {METADATA_FILE}{inside}'


def recorded_parameters(
    data: Mapping[str, str], where: str = 'parameters in the metadata'
) -> dict[str, Any]:
    """Return the recorded parameters of a session's nodes: values by name by node.

    Args:
        data: `custom_data` of the bag.
        where: field that contains them, for the error.

    Raises:
        BagError: they are not the YAML of a bag.
    """
    nodes = load_yaml(data.get('parameters', ''), where)
    return nodes if isinstance(nodes, dict) else {}


def recorded_code(data: Mapping[str, str]) -> CodeIdentity | None:
    """Return the identity of the code that computed a session; None: the bag does not name it.

    It is that of `tissue_sim`, which may have run on another host than the recorder. Where the bag
    lacks that node's statement, it is the recorder's.

    Args:
        data: `custom_data` of the bag.
    """
    node = recorded_parameters(data).get(_SIMULATION)
    return identity_of(node if isinstance(node, dict) else {}) or identity_of(data)
