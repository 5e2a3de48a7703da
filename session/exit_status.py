"""Exit statuses of the command line."""

import enum


class Status(enum.IntEnum):
    """Exit status; the help prints the meanings."""

    OK = 0
    FAILED = 1
    BAD_INPUT = 2
    NODE_DIED = 3
    INTERRUPTED = 130

    @property
    def meaning(self) -> str:
        """Meaning in a few words."""
        return {
            Status.OK: 'success',
            Status.FAILED: 'a check failed (the reasons are printed)',
            Status.BAD_INPUT: 'it cannot be done as asked',
            Status.NODE_DIED: 'a node died',
            Status.INTERRUPTED: 'it was interrupted',
        }[self]
