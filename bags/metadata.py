"""metadata.yaml, version 9, as rosbag2 on Jazzy reads it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from bags.errors import BagError
from bags.qos import Profiles, metadata_profiles

FORMAT_VERSION = 2
"""Version of what our bags hold beyond rosbag2's own format; grows when a reader must know."""
METADATA_FILE = 'metadata.yaml'
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
    """What of a bag is on disk.

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
        """Messages of all topics."""
        return sum(self.counts.values())

    def add(self, topic: str, log_time: int) -> None:
        """Counts one message."""
        self.start = min(self.start or log_time, log_time)
        self.end = max(self.end, log_time)
        self.counts[topic] = self.counts.get(topic, 0) + 1

    def merge(self, other: 'Tally') -> None:
        """Counts all that the other has counted."""
        if other.counts:
            self.start = min(self.start or other.start, other.start)
            self.end = max(self.end, other.end)
        for topic, count in other.counts.items():
            self.counts[topic] = self.counts.get(topic, 0) + count


def bag_information(
    file_name: str, topics: Mapping[str, Topic], tally: Tally, custom_data: Mapping[str, str]
) -> dict[str, Any]:
    """What metadata.yaml says of a bag of one file, without the outermost key."""
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
    """The YAML text of `bag_information`."""
    text: str = yaml.safe_dump(dict(information), sort_keys=False, allow_unicode=True)
    return text


def write_metadata(folder: Path, information: Mapping[str, Any]) -> None:
    """Writes metadata.yaml so that at any moment the whole old or the whole new one is there."""
    temporary = folder / f'{METADATA_FILE}.tmp'
    try:
        temporary.write_text(to_yaml({_ROOT: dict(information)}), encoding='utf-8')
        temporary.replace(folder / METADATA_FILE)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise


def read_metadata(folder: Path) -> dict[str, Any]:
    """What `bag_information` made, from the metadata.yaml of a folder.

    Raises:
        BagError: there is none, or it is not that of a bag.
    """
    path = folder / METADATA_FILE
    try:
        content = yaml.safe_load(path.read_text(encoding='utf-8'))
    except FileNotFoundError:
        raise BagError(_no_bag(folder)) from None
    except NotADirectoryError:
        raise BagError(f'{folder} is a file: name the folder of the bag, {folder.parent}') from None
    except (yaml.YAMLError, ValueError) as error:
        raise BagError(f'{path} is not the metadata of a bag: {error}') from None
    if not (isinstance(content, dict) and isinstance(content.get(_ROOT), dict)):
        raise BagError(f'{path} is not the metadata of a bag: it has no {_ROOT}')
    return dict(content[_ROOT])


def _no_bag(folder: Path) -> str:
    """Why a folder is no bag, and what may have been meant."""
    if not folder.exists():
        return f'{folder} is not a bag: there is no such folder'
    bags = sorted(path.parent.name for path in folder.glob(f'*/{METADATA_FILE}'))
    inside = f', but bags in it: {", ".join(bags[-5:])}' if bags else ''
    return f'{folder} is not a bag: it has no {METADATA_FILE}{inside}'
