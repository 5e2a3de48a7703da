"""The doctor: each finding is one line with what is there and what to do."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import live
import pytest

from cutting_trainer.cli import doctor
from cutting_trainer.cli.doctor import Finding
from cutting_trainer.node_common import realtime
from cutting_trainer.node_common.share_folder import PACKAGES
from cutting_trainer.session.exit_status import Status

pytestmark = pytest.mark.long

NOWHERE = '/no/such/profile.xml'


def only(monkeypatch: pytest.MonkeyPatch, *findings: Finding) -> list[doctor.Check]:
    """Checks that find this, and none of the others."""
    for name in ('dds', 'ports', 'page_port', 'real_time', 'cores', 'clock_source'):
        monkeypatch.setattr(doctor, name, lambda *_: Finding('other', 'ok', 'well'))
    for name in ('time_sync', 'disk'):
        monkeypatch.setattr(doctor, name, lambda *_: Finding('other', 'ok', 'well'))
    return [lambda f=f: f for f in findings]  # type: ignore[misc]


@pytest.mark.parametrize(
    ('level', 'status'), [('ok', Status.OK), ('warning', Status.OK), ('error', Status.FAILED)]
)
def test_only_an_error_makes_the_status_that_of_a_failure(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], level: str, status: Status
) -> None:
    checks = only(monkeypatch, Finding('legs', level, 'one', 'grow another'))  # type: ignore[arg-type]
    assert doctor.run_doctor(checks, None, {}, as_json=False) == status
    first, *others = capsys.readouterr().out.splitlines()
    assert 'legs' in first and first.endswith('one: grow another')
    assert len(others) == 8
    assert doctor.run_doctor(checks, None, {}, as_json=True) == status
    told = json.loads(capsys.readouterr().out)
    assert told['ok'] == (status == Status.OK)
    assert told['checks'][0] == {
        'check': 'legs',
        'level': level,
        'found': 'one',
        'remedy': 'grow another',
    }


def test_priority_that_is_tried_is_that_of_the_fast_loops() -> None:
    assert doctor.PRIORITY == realtime.PRIORITY


def test_ports_in_use_are_counted_in_their_domain() -> None:
    domain = live.free_domain()
    free = doctor.ports(str(domain))
    first = 7400 + 250 * domain + 10
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as used:
        used.bind(('127.0.0.1', first))
        taken = doctor.ports(str(domain))
    assert free.level == 'ok' and str(first) in free.found
    assert taken.level == 'warning' and taken.found.startswith('1 in use')


@pytest.mark.parametrize('domain', ['102', '-1', 'mine'])
def test_domain_that_cannot_be_is_an_error_with_the_range(domain: str) -> None:
    found = doctor.ports(domain)
    assert found.level == 'error'
    assert domain in found.found and '0 to 101' in found.remedy


def test_port_of_the_page_in_use_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as server:
        server.bind(('127.0.0.1', 0))
        server.listen()
        monkeypatch.setattr(doctor, 'PAGE_PORT', server.getsockname()[1])
        assert doctor.page_port().level == 'warning'
    assert doctor.page_port().level == 'ok'


def test_refused_priority_says_what_gives_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, 'no')

    monkeypatch.setattr(os, 'sched_setscheduler', refuse)
    found = doctor.real_time()
    assert found.level == 'warning'
    assert 'rtprio' in found.remedy and 'limits.d' in found.remedy


def test_clock_that_is_slow_to_read_is_named(tmp_path: Path) -> None:
    source = tmp_path / 'current_clocksource'
    source.write_text('hpet\n')
    slow = doctor.clock_source(source)
    assert slow.level == 'warning' and 'hpet' in slow.found
    source.write_text('tsc\n')
    assert doctor.clock_source(source).level == 'ok'


def test_folder_that_cannot_be_written_is_an_error_and_a_full_disk_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert doctor.disk(tmp_path).level == 'ok'
    monkeypatch.setattr(doctor, 'BAG_SPACE', 10**18)
    assert doctor.disk(tmp_path).level == 'warning'
    monkeypatch.setattr(os, 'access', lambda *_: False)
    assert doctor.disk(tmp_path).level == 'error'


def test_kernels_count_only_where_they_fit_the_sources(tmp_path: Path) -> None:
    assert doctor.kernel_cache(tmp_path, current=True).level == 'warning'
    (tmp_path / 'folder').mkdir()
    (tmp_path / 'folder' / 'kernel.1.nbc').write_bytes(b'code')
    assert doctor.kernel_cache(tmp_path, current=True).level == 'ok'
    assert 'setup' in doctor.kernel_cache(tmp_path, current=False).remedy


def test_what_is_not_set_up_is_a_warning_and_no_room_for_it_an_error(tmp_path: Path) -> None:
    folder = tmp_path / 'home' / 'wheels'
    assert doctor.set_up(folder, None, ready=True, needed=1).level == 'ok'
    assert './trainer setup' in doctor.set_up(folder, None, ready=False, needed=1).remedy
    assert doctor.set_up(folder, None, ready=False, needed=10**18).level == 'error'


@pytest.mark.thorough
def test_messages_really_pass_and_without_a_transport_it_is_said_what_to_look_at(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    python = sys.executable
    environ = {**os.environ, 'PYTHONPATH': os.environ.get('PYTHONPATH', str(PACKAGES))}
    well = doctor.dds(python, environ)
    assert well.level == 'ok', well
    assert 'to another process and back' in well.found
    broken = doctor.dds(python, {**environ, 'RMW_IMPLEMENTATION': 'rmw_nothing_cpp'})
    assert broken.level == 'error'
    assert 'RMW_IMPLEMENTATION' in broken.remedy
    missing = doctor.dds('false', {**environ, 'FASTRTPS_DEFAULT_PROFILES_FILE': NOWHERE})
    assert missing.level == 'error' and NOWHERE in missing.remedy
    assert doctor.dds(None, environ).level == 'warning'


def test_dds_that_hangs_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    def hang(*_: object, **__: object) -> None:
        raise subprocess.TimeoutExpired('python', 30)

    monkeypatch.setattr(subprocess, 'run', hang)
    assert doctor.dds('python', {}).level == 'error'
