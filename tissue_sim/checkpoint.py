"""The tissue on disk, for the case that everybody who knew it has died."""

import threading
from contextlib import suppress
from pathlib import Path

from cutting_trainer_msgs.msg import Mesh
from rclpy.serialization import deserialize_message, serialize_message


class Checkpoint:
    """Keeps the newest mesh in a file, written in a thread of its own and replaced whole.

    Args:
        path: of the file, in a folder that exists.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._newest: Mesh | None = None
        self._closed = False
        self._there = threading.Event()
        threading.Thread(target=self._write, daemon=True).start()

    def offer(self, mesh: Mesh) -> None:
        """Has this written next; what was offered before and is not written yet is passed over."""
        self._newest = mesh
        self._there.set()

    def close(self) -> None:
        """Ends the thread."""
        self._closed = True
        self._there.set()

    def _write(self) -> None:
        beside = self._path.with_suffix('.part')
        while self._there.wait() and not self._closed:
            self._there.clear()
            with suppress(OSError):  # a full disk: the followers of the tissue know it still
                beside.write_bytes(serialize_message(self._newest))
                beside.replace(self._path)


def read_checkpoint(path: Path) -> list[Mesh]:
    """The mesh of a file, in a list that is empty where there is none."""
    try:
        return [deserialize_message(path.read_bytes(), Mesh)]
    except Exception:  # none yet, or none that can be read: others may know the tissue
        return []
