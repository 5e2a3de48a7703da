"""The error that a user of the command line can correct."""


class SessionError(ValueError):
    """A request that cannot be met; the message is a sentence that names the correct input."""
