"""Checkpoint of the tissue on disk, for a session in which no follower survives."""

import threading
from contextlib import suppress
from pathlib import Path

from cutting_trainer_msgs.msg import Mesh
from rclpy.serialization import deserialize_message, serialize_message


class Checkpoint:
    """Writes the newest mesh to a file, in a thread and by atomic replacement.

    Args:
        path: of the file, in an existing folder.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._newest: Mesh | None = None
        self._closed = False
        self._there = threading.Event()
        threading.Thread(target=self._write, daemon=True).start()

    def offer(self, mesh: Mesh) -> None:
        """Queue a mesh for writing; it replaces an unwritten one."""
        self._newest = mesh
        self._there.set()

    def close(self) -> None:
        """Stop the thread."""
        self._closed = True
        self._there.set()

    def _write(self) -> None:
        beside = self._path.with_suffix('.part')
        while self._there.wait() and not self._closed:
            self._there.clear()
            with suppress(OSError):  # a full disk: the followers still know the tissue
                beside.write_bytes(serialize_message(self._newest))
                beside.replace(self._path)


def read_checkpoint(path: Path) -> list[Mesh]:
    """Return the mesh of a file in a list, empty without a readable file."""
    try:
        return [deserialize_message(path.read_bytes(), Mesh)]
    except Exception:  # no readable file: followers may know the tissue
        return []
