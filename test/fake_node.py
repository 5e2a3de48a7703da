"""A node without ROS for the tests of the supervisor: says its lines and writes down what it gets.

Arguments: NAME, LEDGER (a file that all fake nodes append to), and any of: mute (never ready),
deaf (ignores SIGINT and SIGTERM), done (says `done` soon), slow (ends 0.3 s after it was asked to),
dies (exit status 7 before it is ready), refuses (the same with 2, as a node does whose scene is
bad), asks (the launcher, and repeats its answer), falls (killed by a signal soon after it is
ready), parent (starts a process of its own), garbles (says messages that nobody can read), beats
(gives signs of life), crashes (by a wrong access to memory as it ends).
"""

import faulthandler
import os
import signal
import subprocess
import sys
import time
from pathlib import Path


def main(name: str, ledger: str, *habits: str) -> None:
    stopping = False

    def note(word: str) -> None:
        with Path(ledger).open('a') as file:
            file.write(f'{word} {name} {os.getpid()} {time.monotonic()}\n')

    def stop(number: int, _: object) -> None:
        nonlocal stopping
        note(signal.Signals(number).name)
        stopping = 'deaf' not in habits

    signal.signal(signal.SIGINT, stop)
    signal.signal(signal.SIGTERM, stop)
    note('start')
    if 'parent' in habits:
        child = subprocess.Popen(['sleep', '600'])
        with Path(ledger).open('a') as file:
            file.write(f'start child {child.pid} 0\n')
    if 'dies' in habits or 'refuses' in habits:
        print('error: no such mesh', file=sys.stderr)
        sys.exit(7 if 'dies' in habits else 2)
    print(f'{name} looks around')
    if 'mute' not in habits:
        print(f'ready: {name}')
    if 'asks' in habits:
        print('message: {"ask": "may I?"}')
        print(f'message: {{"answered": "{sys.stdin.readline().strip()}"}}')
    if 'garbles' in habits:
        print('message: {"ask": ')
        print('message: [1]')
        print('message: {"page": "' + 200_000 * 'x' + '"}')
    if 'done' in habits:
        time.sleep(0.5)
        print(f'done: {name}')
    if 'falls' in habits:
        time.sleep(0.1)
        os.kill(os.getpid(), signal.SIGKILL)
    print(f'[WARN] [1.0] [{name}]: careful')
    while not stopping:
        time.sleep(0.01)
        if 'beats' in habits:
            print(f'beat: {name}')
    if 'slow' in habits:
        time.sleep(0.3)
    if 'unborn' in habits:  # what Python says that is interrupted before it has started
        print('Fatal Python error: init_import_site: Failed to import the site module')
        print('Traceback (most recent call last):')
        sys.exit(1)
    if 'crashes' in habits:
        faulthandler.enable()
        os.kill(os.getpid(), signal.SIGSEGV)
    note('end')


if __name__ == '__main__':
    main(*sys.argv[1:])
