"""Location of config/ and launch/, in a checkout and in an installation."""

from pathlib import Path

import cutting_trainer

ROOMS = Path(cutting_trainer.__file__).absolute().parent
"""Folder of the package `cutting_trainer`. Its links are not followed: `colcon build
--symlink-install` makes each file of an installation a link into the checkout."""
PACKAGES = ROOMS.parent
"""Parent folder of the Python package: the checkout, or site-packages of an installation."""


def share_folder(packages: Path = PACKAGES) -> Path:
    """Return the folder that contains config/.

    This is the checkout, or share/cutting_trainer below the prefix of the installed packages. No
    ament index is asked, so another sourced installation cannot be found by mistake.

    Args:
        packages: parent folder of the Python packages.
    """
    installed = (prefix / 'share' / 'cutting_trainer' for prefix in packages.parents)
    return next((f for f in (packages, *installed) if (f / 'config').is_dir()), packages)


def is_checkout() -> bool:
    """Return whether the packages lie in a checkout."""
    return share_folder() == PACKAGES


SCENES = share_folder() / 'config' / 'scenes'
"""Folder of the scenes that come with the trainer."""


def scene_names() -> list[str]:
    """Return the names of the scenes that come with the trainer."""
    return sorted(path.stem for path in SCENES.glob('*.yaml'))
