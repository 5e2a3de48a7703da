"""`pip install .`: the core without ROS, and the command line. colcon reads package.xml."""

from pathlib import Path

from setuptools import find_packages, setup

ROOT = Path(__file__).parent


def at_least(name: str) -> list[str]:
    """Lower bounds: the launcher pins exactly, a library must not."""
    lines = (ROOT / name).read_text().splitlines()
    return [line.replace('==', '>=') for line in lines if line and not line.startswith('#')]


def data_files() -> list[tuple[str, list[str]]]:
    """Return files that are no Python, by the folder that `share_folder` looks for below."""
    share = Path('share') / 'cutting_trainer'
    paths = [path for name in ('config', 'launch') for path in (ROOT / name).rglob('*.*')]
    folders = sorted({path.parent for path in paths if path.parent.name != '__pycache__'})
    return [(str(share), ['package.xml'])] + [
        (
            str(share / folder.relative_to(ROOT)),
            sorted(str(p.relative_to(ROOT)) for p in paths if p.parent == folder and p.is_file()),
        )
        for folder in folders
    ]


setup(
    name='cutting_trainer',
    version='0.1.0',
    description='Teleoperated soft-tissue cutting trainer for ROS 2',
    license='Apache-2.0',
    python_requires='>=3.11,<3.14',
    packages=find_packages(str(ROOT), include=['cutting_trainer', 'cutting_trainer.*']),
    package_data={'cutting_trainer.viewer': ['static/*', 'static/*/*']},
    data_files=data_files(),
    install_requires=at_least('requirements.txt'),
    extras_require={
        'mesh': at_least('requirements-mesh.txt'),
        'study': at_least('requirements-study.txt'),
    },
    entry_points={'console_scripts': ['cutting-trainer = cutting_trainer.cli.main:main']},
)
