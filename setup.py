"""`pip install -e .`: the core without ROS, and the command line. colcon reads package.xml."""

from pathlib import Path

from setuptools import find_packages, setup

ROOT = Path(__file__).parent
PACKAGES = ('tissue_sim', 'haptic_bridge', 'cutting', 'bags', 'viewer', 'session')


def at_least(name: str) -> list[str]:
    """Lower bounds: the launcher pins exactly, a library must not."""
    lines = (ROOT / name).read_text().splitlines()
    return [line.replace('==', '>=') for line in lines if line and not line.startswith('#')]


setup(
    name='cutting_trainer',
    version='0.1.0',
    description='Teleoperated soft-tissue cutting trainer for ROS 2',
    license='Apache-2.0',
    python_requires='>=3.11,<3.14',
    packages=find_packages(str(ROOT), include=[f'{name}*' for name in PACKAGES]),
    install_requires=at_least('requirements.txt'),
    extras_require={'mesh': at_least('requirements-mesh.txt')},
    entry_points={'console_scripts': ['cutting-trainer = session.cli:main']},
)
