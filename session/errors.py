"""The one kind of error that a user of the command line can mend."""


class SessionError(ValueError):
    """A request that cannot be met; the message is a sentence that says what would be right."""
