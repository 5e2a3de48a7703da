"""Errors about tissue and scene: one sentence that names file, place, value and remedy."""


class SceneError(ValueError):
    """A scene file that is not valid."""


class MeshError(ValueError):
    """A tetrahedral mesh that is unreadable or cannot be simulated."""
