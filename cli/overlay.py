"""Copies message packages of others, such as `crtk_msgs`, for the launcher to build.

Standard library only: the launcher uses it before anything is set up.
"""

import graphlib
import re
import shutil
from collections.abc import Collection, Sequence
from pathlib import Path

PACKAGE_NAME = re.compile(r'[a-z][a-z0-9_]{0,63}')
USED_TYPE = re.compile(r'^[ \t]*([a-z][a-z0-9_]*)/[A-Z]', re.MULTILINE)
INTERFACES = ('msg', 'srv', 'action')
OVERLAY_CMAKE = """cmake_minimum_required(VERSION 3.20)
project({name} VERSION {version})
{finds}
list(FILTER AMENT_EXTENSIONS_rosidl_generate_idl_interfaces EXCLUDE REGEX "_cpp:")
file(GLOB interfaces RELATIVE ${{CMAKE_CURRENT_SOURCE_DIR}} msg/*.msg srv/*.srv action/*.action)
rosidl_generate_interfaces(${{PROJECT_NAME}} ${{interfaces}} DEPENDENCIES {needs})
ament_export_dependencies(rosidl_default_runtime)
ament_package()
"""


class OverlayError(Exception):
    """A package that cannot be taken; the message says why, and which could."""


def take_overlay(target: Path, folders: Sequence[Path], known: Collection[str]) -> None:
    """Copy the interface files of every message package below some folders, with a build file.

    The package's own build file is left out: it may ask for what the wheels have not (rclcpp),
    and from its messages follows all that building them needs. Without folders, there is no
    overlay any more.

    Args:
        target: folder that is made anew; its file `order` has the names, those first that others
            use.
        folders: with the packages.
        known: names of packages that are there.

    Raises:
        OverlayError: a folder has no message package, or one uses messages that are not there.
    """
    packages: dict[str, Path] = {}
    for folder in folders:
        found = message_packages(folder.resolve())
        if not found:
            raise OverlayError(
                f'{folder} has no message package: name a folder with a package.xml beside a '
                'folder msg, srv or action'
            )
        packages |= found
    needs = {name: used_packages(path) - {name} for name, path in packages.items()}
    for name, others in needs.items():
        if missing := sorted(others - packages.keys() - set(known)):
            raise OverlayError(
                f'{name} uses messages of {", ".join(missing)}, which are not there: name the '
                'folder of their sources as well'
            )
    try:
        order = [n for n in graphlib.TopologicalSorter(needs).static_order() if n in packages]
    except graphlib.CycleError as error:
        circle = ' and '.join(sorted(set(error.args[1])))
        raise OverlayError(
            f'{circle} use messages of each other, so neither can be built'
        ) from None
    shutil.rmtree(target, ignore_errors=True)
    for name in order:
        copy_package(packages[name], target / name, needs[name])
    if order:
        (target / 'order').write_text('\n'.join(order))


def message_packages(folder: Path) -> dict[str, Path]:
    """Return folders of the packages with messages below a folder, by the packages' names."""
    found = {}
    for path in sorted(folder.rglob('package.xml')):
        name = re.search(r'<name>\s*([^<\s]+)\s*</name>', path.read_text(errors='replace'))
        if any((path.parent / kind).is_dir() for kind in INTERFACES) and name:
            if not PACKAGE_NAME.fullmatch(name[1]):
                raise OverlayError(f'{path}: {name[1][:80]!r} is not a package name')
            found[name[1]] = path.parent
    return found


def interface_files(package: Path) -> list[Path]:
    """Return messages, services and actions of a package."""
    return sorted(file for kind in INTERFACES for file in (package / kind).glob(f'*.{kind}'))


def used_packages(package: Path) -> set[str]:
    """Return the names of the packages whose messages a package uses."""
    return {
        name
        for file in interface_files(package)
        for name in USED_TYPE.findall(file.read_text(errors='replace'))
    }


def copy_package(source: Path, target: Path, needs: set[str]) -> None:
    """Copy the interface files of a package, and write its build file."""
    text = (source / 'package.xml').read_text(errors='replace')
    version = re.search(r'<version>\s*(\d+\.\d+\.\d+)\s*</version>', text)
    for file in interface_files(source):
        (target / file.parent.name).mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, target / file.parent.name / file.name)
    group = '<member_of_group>rosidl_interface_packages</member_of_group>'
    if group not in text:  # rosidl builds no others
        text = text.replace('</package>', f'{group}</package>')
    (target / 'package.xml').write_text(text)
    found = ['ament_cmake', 'rosidl_default_generators', *sorted(needs)]
    content = OVERLAY_CMAKE.format(
        name=target.name,
        version=version[1] if version else '0.0.0',
        finds='\n'.join(f'find_package({name} REQUIRED)' for name in found),
        needs=' '.join(sorted(needs)),
    )
    (target / 'CMakeLists.txt').write_text(content)
