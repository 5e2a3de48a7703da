"""Errors of the tissue: each message is one sentence that names file, place, value and remedy."""


class SceneError(ValueError):
    """A scene file that cannot be used as it is."""


class MeshError(ValueError):
    """A tetrahedral mesh that cannot be read, or is not a solid that can be simulated."""
