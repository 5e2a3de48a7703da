"""Exit statuses of the command line."""

import enum


class Status(enum.IntEnum):
    """What an exit status means; the sentences are those of the help."""

    OK = 0
    FAILED = 1
    BAD_INPUT = 2
    NODE_DIED = 3
    INTERRUPTED = 130

    @property
    def meaning(self) -> str:
        """In a few words."""
        return {
            Status.OK: 'it did what it should',
            Status.FAILED: 'it did not (the reasons are printed)',
            Status.BAD_INPUT: 'it cannot be done as asked',
            Status.NODE_DIED: 'a node died',
            Status.INTERRUPTED: 'it was interrupted',
        }[self]
