"""Where config/ and launch/ lie, in a checkout as in an installation."""

from pathlib import Path

PACKAGES = Path(__file__).resolve().parents[1]
"""What holds the Python packages: the checkout, or the site-packages of an installation."""


def share_folder(packages: Path = PACKAGES) -> Path:
    """The folder with config/ in it.

    That is the checkout, or share/cutting_trainer below the prefix that the packages are installed
    in. No index is asked, so that another installation which is sourced too cannot be meant.

    Args:
        packages: what holds the Python packages.
    """
    installed = (prefix / 'share' / 'cutting_trainer' for prefix in packages.parents)
    return next((f for f in (packages, *installed) if (f / 'config').is_dir()), packages)


def is_checkout() -> bool:
    """Whether the packages lie in a checkout."""
    return share_folder() == PACKAGES
