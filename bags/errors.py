"""The exception of this package."""


class BagError(ValueError):
    """A bag cannot be written or read; the message says which, why, and the remedy."""
