"""`trainer doctor`: check this machine for the trainer; each finding has a remedy.

Standard library only, and nothing of ours but what is the same: it must run before setting up has.
"""

import contextlib
import ctypes
import errno
import json
import os
import resource
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from cutting_trainer.session.domain import FIRST_PORT, MAX_DOMAIN, PORTS_PER_DOMAIN
from cutting_trainer.session.exit_status import Status

Level = Literal['ok', 'warning', 'error']

PRIORITY = 40
"""Of the 1 kHz loops: the real-time priority that the user must be allowed to ask for."""
PARTICIPANTS = 32
"""Of which each takes two ports from its domain's range."""
PAGE_PORT = 8080
BAG_SPACE = 10**9
"""[bytes] a session of 20 s takes about 10 MB; below this a long one may not find room."""
DDS_TIMEOUT = 30.0
STA_UNSYNC = 0x40
GOOD_CLOCKS = ('tsc', 'kvm-clock', 'arch_sys_counter', 'hyperv_clocksource_tsc_page')


@dataclass(frozen=True)
class Finding:
    """Result of one check.

    Attributes:
        check: its name.
        level: ok; warning: the trainer runs, worse or not everywhere; error: it does not run.
        found: what is there.
        remedy: what to do; '' where all is well.
    """

    check: str
    level: Level
    found: str
    remedy: str = ''


Check = Callable[[], Finding]


def run_doctor(
    setup: Sequence[Check], python: str | None, environ: Mapping[str, str], *, as_json: bool
) -> Status:
    """Run all checks and print a line for each.

    Args:
        setup: checks of what only the launcher knows; they come first.
        python: interpreter of the trainer's environment; None: it is not set up yet.
        environ: what the nodes would get.
        as_json: print an object instead, for machines.

    Returns:
        OK, with warnings too; FAILED where an error was found.
    """
    checks = [
        *setup,
        lambda: dds(python, environ),
        lambda: ports(environ.get('ROS_DOMAIN_ID') or '0'),
        page_port,
        real_time,
        cores,
        clock_source,
        time_sync,
        lambda: disk(Path.cwd()),
    ]
    findings = []
    for check in checks:
        finding = check()
        findings.append(finding)
        if not as_json:
            print(line(finding, colour=sys.stdout.isatty()), flush=True)
    failed = any(finding.level == 'error' for finding in findings)
    if as_json:
        print(json.dumps({'ok': not failed, 'checks': [asdict(f) for f in findings]}, indent=2))
    return Status.FAILED if failed else Status.OK


def examine(launcher: Any, home: Any, *, as_json: bool) -> int:
    """Examine the machine for the launcher, set up or not.

    Args:
        launcher: its module, which knows what setting up needs and has done.
        home: where it sets up, and for which ROS.
        as_json: see `run_doctor`.
    """

    def check(name: str, action: Callable[[], str]) -> Finding:
        try:
            return Finding(name, 'ok', action())
        except launcher.SetupError as error:
            found, _, remedy = str(error).partition(': ')
            return Finding(name, 'error', found, remedy)

    def python() -> str:
        facts = launcher.choose_python(home)
        return f'{".".join(map(str, facts["version"]))} at {facts["executable"]}'

    def compiler() -> str:
        launcher.check_build_tools()
        return 'C, C++, CMake and a make program are there'

    def fits(step: str) -> bool:
        key, _ = launcher.steps()[step]
        return bool(launcher.done(home, step, key(home)))

    checks = [
        lambda: check('python', python),
        lambda: check('compiler', compiler),
        lambda: set_up(
            home.folder,
            home.jazzy,
            ready=launcher.prepared(home),
            needed=launcher.NEEDED_SPACE,
        ),
        lambda: kernel_cache(home.numba_cache, current=fits('kernels')),
    ]
    environment = launcher.node_environment(home, dict(os.environ))
    interpreter = str(home.python) if fits('interfaces') else None
    return int(run_doctor(checks, interpreter, environment, as_json=as_json))


def line(finding: Finding, *, colour: bool) -> str:
    """Return a finding as one line of text."""
    sign = {'ok': 'ok', 'warning': 'warn', 'error': 'ERROR'}[finding.level]
    number = {'ok': 32, 'warning': 33, 'error': 31}[finding.level]
    shown = f'\x1b[{number}m{sign:<6}\x1b[0m' if colour else f'{sign:<6}'
    remedy = f': {finding.remedy}' if finding.remedy else ''
    return f'{shown}{finding.check:<14} {finding.found}{remedy}'


def running_python() -> Finding:
    """Check the interpreter that runs this, where no launcher has chosen one."""
    return Finding('python', 'ok', f'{sys.version.split()[0]} at {sys.executable}')


def set_up(folder: Path, jazzy: str | None, *, ready: bool, needed: int) -> Finding:
    """Check the environment of the launcher, or the space for it.

    Args:
        folder: of everything that it makes.
        jazzy: prefix of the sourced ROS that is used; None: the wheels.
        ready: whether all of it is there and fits the sources.
        needed: room that setting up takes [bytes].
    """
    ros = f'with the Jazzy in {jazzy}' if jazzy else 'with ROS 2 Jazzy as wheels'
    if ready:
        return Finding('set-up', 'ok', f'{folder}, {ros}')
    there = next(p for p in (folder, *folder.parents) if p.exists())
    free = shutil.disk_usage(there).free
    if free < needed and not (folder / 'env').exists():
        remedy = f'make room: setting up takes {needed / 1e9:g} GB'
        return Finding('set-up', 'error', f'{free / 1e9:.1f} GB free in {there}', remedy)
    remedy = 'run `./trainer setup`, or any command, which sets up first'
    what = f'missing, unfinished, or made from other sources, {ros}'
    return Finding('set-up', 'warning', what, remedy)


def dds(python: str | None, environ: Mapping[str, str]) -> Finding:
    """Check that a message arrives through DDS, in the transport of the nodes."""
    if python is None:
        return Finding('dds', 'warning', 'not tried', 'run `./trainer setup`, then this again')
    command = [python, '-m', 'cutting_trainer.cli.dds_loopback']
    try:
        done = subprocess.run(
            command,
            env=dict(environ),
            capture_output=True,
            text=True,
            timeout=DDS_TIMEOUT,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return Finding('dds', 'error', f'no answer in {DDS_TIMEOUT:g} s', _dds_remedy(environ))
    if done.returncode:
        said = (done.stderr.strip().splitlines() or ['no output'])[-1]
        return Finding('dds', 'error', said, _dds_remedy(environ))
    return Finding('dds', 'ok', done.stdout.strip())


def _dds_remedy(environ: Mapping[str, str]) -> str:
    profile = environ.get('FASTRTPS_DEFAULT_PROFILES_FILE', '')
    if profile and not Path(profile).is_file():
        return f'FASTRTPS_DEFAULT_PROFILES_FILE names {profile}, which is not there: unset it'
    return (
        'let UDP through on 127.0.0.1 (firewall, container), unset RMW_IMPLEMENTATION and '
        'FASTRTPS_DEFAULT_PROFILES_FILE if they are set, or run `./trainer clean` and start again'
    )


def ports(domain: str) -> Finding:
    """Check the UDP ports of the ROS domain: free, or in use."""
    if not domain.isdecimal() or int(domain) > MAX_DOMAIN:
        return Finding(
            'ports',
            'error',
            f'ROS_DOMAIN_ID is {domain!r}',
            f'set it to a number from 0 to {MAX_DOMAIN}, or unset it',
        )
    first = FIRST_PORT + PORTS_PER_DOMAIN * int(domain)
    wanted = range(first + 10, first + 10 + 2 * PARTICIPANTS)
    taken = [port for port in wanted if not _free(socket.SOCK_DGRAM, port)]
    span = f'UDP {wanted[0]} to {wanted[-1]}, ROS domain {domain}'
    if len(taken) == len(wanted):
        remedy = 'end what runs there, or set ROS_DOMAIN_ID to another domain'
        return Finding('ports', 'error', f'none free of {span}', remedy)
    if taken:
        remedy = 'a ROS graph runs there; give a session of its own `--domain free`'
        return Finding('ports', 'warning', f'{len(taken)} in use of {span}', remedy)
    return Finding('ports', 'ok', f'free: {span}')


def page_port() -> Finding:
    """Check the TCP port of the page in the browser."""
    if _free(socket.SOCK_STREAM, PAGE_PORT):
        return Finding('page port', 'ok', f'free: TCP {PAGE_PORT}')
    remedy = 'give `./trainer view` another port: `--port 0`'
    return Finding('page port', 'warning', f'TCP {PAGE_PORT} is in use', remedy)


def _free(kind: socket.SocketKind, port: int) -> bool:
    with socket.socket(socket.AF_INET, kind) as probe:
        if kind == socket.SOCK_STREAM:
            # a server that has just ended leaves the port usable, as servers use it
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(('127.0.0.1', port))
        except OSError:
            return False
    return True


def real_time() -> Finding:
    """Check whether a process of this user may have the priority of the 1 kHz loops."""
    child = os.fork()
    if child == 0:
        status = 0
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
        except OSError as error:
            status = error.errno or errno.EPERM
        os._exit(status)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if status == 0:
        return Finding('real time', 'ok', f'SCHED_FIFO {PRIORITY} is granted')
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[1]
    return Finding(
        'real time',
        'warning',
        f'SCHED_FIFO {PRIORITY} is refused (limit {limit}): 1 kHz will have gaps under load',
        "write '@realtime - rtprio 90' to /etc/security/limits.d/realtime.conf, "
        'run `sudo groupadd -f realtime && sudo usermod -aG realtime $USER`, log in again; '
        'in a container add --ulimit rtprio=90',
    )


def cores() -> Finding:
    """Check the number of cores for this process, and their load."""
    count = len(os.sched_getaffinity(0))
    load = os.getloadavg()[0]
    found = f'{count}, load {load:.1f}'
    if count < 2:
        return Finding('cores', 'warning', found, 'a session needs two for 1 kHz beside 30 Hz')
    if load > count:
        remedy = 'end other programs: rates will be missed while the machine is this busy'
        return Finding('cores', 'warning', found, remedy)
    return Finding('cores', 'ok', found)


def clock_source(
    path: Path = Path('/sys/devices/system/clocksource/clocksource0/current_clocksource'),
) -> Finding:
    """Check the clock source of the kernel: some take microseconds to read."""
    try:
        name = path.read_text().strip()
    except OSError:
        return Finding('clock', 'ok', 'source not known here')
    start = time.perf_counter_ns()
    for _ in range(1000):
        time.monotonic_ns()
    cost = (time.perf_counter_ns() - start) / 1000
    found = f'{name}, {cost:.0f} ns a reading'
    if name in GOOD_CLOCKS:
        return Finding('clock', 'ok', found)
    return Finding('clock', 'warning', found, 'slow to read: choose tsc in the BIOS or hypervisor')


class _Timex(ctypes.Structure):
    # the head of the kernel's struct timex, and room for its rest
    _fields_ = (
        ('modes', ctypes.c_uint),
        ('offset', ctypes.c_long),
        ('freq', ctypes.c_long),
        ('maxerror', ctypes.c_long),
        ('esterror', ctypes.c_long),
        ('status', ctypes.c_int),
        ('rest', ctypes.c_byte * 256),
    )


def time_sync() -> Finding:
    """Check whether something keeps the system clock to the time of others, as the kernel knows
    it.
    """
    timex = _Timex()
    if ctypes.CDLL(None, use_errno=True).adjtimex(ctypes.byref(timex)) < 0:
        text = os.strerror(ctypes.get_errno())
        return Finding('time sync', 'warning', f'not known: {text}', 'ask `timedatectl`')
    if timex.status & STA_UNSYNC:
        return Finding(
            'time sync',
            'warning',
            'the clock is not synchronised',
            'matters only where arm and simulation run on two computers: `sudo apt install chrony` '
            'on both, for one of them the other as server',
        )
    return Finding('time sync', 'ok', f'synchronised, error at most {timex.maxerror / 1e3:.1f} ms')


def disk(folder: Path) -> Finding:
    """Check the room for bags, and whether they can be written here."""
    sessions = folder / 'bags' / 'sessions'
    there = next(p for p in (sessions, *sessions.parents) if p.exists())
    if not os.access(there, os.W_OK):
        remedy = 'start in a folder of your own, or give `--bag`'
        return Finding('disk', 'error', f'{there} cannot be written', remedy)
    free = shutil.disk_usage(there).free
    found = f'{free / 1e9:.1f} GB free for bags in {there}'
    if free < BAG_SPACE:
        remedy = 'make room: on a full disk the recorder loses messages'
        return Finding('disk', 'warning', found, remedy)
    return Finding('disk', 'ok', found)


def kernel_cache(folder: Path, *, current: bool) -> Finding:
    """Check the compiled kernels: without them, or with those of other sources, a start takes
    minutes.

    Args:
        folder: Numba's cache.
        current: whether it was made from the sources as they are.
    """
    sizes = []
    for file in folder.rglob('*.nbc'):
        with contextlib.suppress(OSError):
            sizes.append(file.stat().st_size)
    if sizes and current:
        found = f'{len(sizes)} kernels, {sum(sizes) / 1e6:.0f} MB in {folder}'
        return Finding('kernel cache', 'ok', found)
    what = 'made from other sources' if sizes else 'none compiled'
    remedy = 'run `./trainer setup`, which compiles them (a minute or two)'
    return Finding('kernel cache', 'warning', f'{what} in {folder}', remedy)
