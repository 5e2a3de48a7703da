"""Hosts that the nodes of a session communicate with: by default this one alone."""

import ipaddress
import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from cutting_trainer.session.domain import RANGE
from cutting_trainer.session.errors import SessionError
from cutting_trainer.session.node_commands import PROFILES, discovery, node_environment

PEERS, SERVER = 'ROS_STATIC_PEERS', 'ROS_DISCOVERY_SERVER'
EVERYTHING = 'ROS_SUPER_CLIENT'
SERVER_PORT = 11811
_DDS = '{http://www.eprosima.com}'


@dataclass(frozen=True)
class Network:
    """Reach of the graph.

    Attributes:
        open: find nodes of other hosts by multicast.
        peers: addresses or names of hosts to connect to; needs no multicast.
        server: `HOST` or `HOST:PORT` of a Fast DDS discovery server.
        partition: DDS partition; nodes communicate within one, '' is the default.
    """

    open: bool = False
    peers: tuple[str, ...] = ()
    server: str = ''
    partition: str = ''

    @property
    def leaves(self) -> bool:
        """Whether other hosts can take part."""
        return self.open or bool(self.peers) or bool(self.server)

    def variables(self, environ: Mapping[str, str]) -> dict[str, str]:
        """Return the variables of the environment for this reach.

        Args:
            environ: environment of the shell, which provides the defaults.

        Raises:
            SessionError: an address is not valid.
        """
        given = dict(environ)
        if self.leaves:
            given[RANGE] = 'SUBNET'
        found = discovery(given)
        if self.peers:
            found[PEERS] = ';'.join(_host(peer, '--peer') for peer in self.peers)
        if self.server:
            host, _, port = self.server.partition(':')
            if port and not (port.isdecimal() and 0 < int(port) < 1 << 16):
                raise SessionError(
                    f'--discovery-server is {self.server!r}: the port must be a number up to 65535'
                )
            found[EVERYTHING] = 'TRUE'  # the recorder must discover topics that it does not know
            found[SERVER] = f'{_host(host, "--discovery-server")}:{port or SERVER_PORT}'
        return found


@contextmanager
def network_environment(domain: int, network: Network) -> Iterator[dict[str, str]]:
    """Yield the environment of the nodes, with a temporary DDS profile where there is a partition.

    Args:
        domain: ROS domain.
        network: reach of the graph.

    Raises:
        SessionError: an address, or the name of the partition, is not valid.
    """
    environment = node_environment(domain) | network.variables(os.environ)
    if not network.partition:
        yield environment
        return
    if not network.partition.isidentifier():
        raise SessionError(
            f'--partition is {network.partition!r}: give a name of letters, digits and _'
        )
    with tempfile.TemporaryDirectory(prefix='trainer-dds-') as folder:
        profile = Path(folder) / 'profile.xml'
        profile.write_bytes(_in_partition(Path(environment[PROFILES]), network.partition))
        yield environment | {PROFILES: str(profile)}


def _host(name: str, option: str) -> str:
    try:
        return str(ipaddress.ip_address(name))
    except ValueError:
        pass
    if name and all(part.replace('-', 'a').isalnum() for part in name.split('.')):
        return name
    raise SessionError(f"{option} is {name!r}: give a host's address (192.168.1.20) or its name")


def _in_partition(profile: Path, partition: str) -> bytes:
    """Return a DDS profile, with all publishers and subscribers in a partition."""
    ElementTree.register_namespace('', _DDS.strip('{}'))
    tree = ElementTree.parse(profile)
    profiles = tree.getroot().find(f'{_DDS}profiles')
    if profiles is None:
        raise SessionError(f'{profile} has no <profiles>: --partition cannot be put into it')
    for kind in ('data_writer', 'data_reader'):
        found = profiles.find(f'{_DDS}{kind}[@is_default_profile="true"]')
        if found is None:
            named = {'profile_name': f'trainer_{kind}', 'is_default_profile': 'true'}
            found = ElementTree.SubElement(profiles, f'{_DDS}{kind}', named)
        qos = ElementTree.SubElement(found, f'{_DDS}qos')
        names = ElementTree.SubElement(
            ElementTree.SubElement(qos, f'{_DDS}partition'), f'{_DDS}names'
        )
        ElementTree.SubElement(names, f'{_DDS}name').text = partition
    return ElementTree.tostring(tree.getroot(), encoding='utf-8', xml_declaration=True)
