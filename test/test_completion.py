"""The shell completes what the command line has."""

import shutil
import subprocess
from pathlib import Path

import pytest
from typer.main import get_command

from cutting_trainer.cli.completion import LAUNCHERS_OWN, script
from cutting_trainer.cli.main import app

pytestmark = pytest.mark.long


def completed(folder: Path, *words: str) -> list[str]:
    """What a Tab after these words offers."""
    file = folder / 'completion'
    file.write_text(script(get_command(app), 'bash'))
    line = ' '.join(f"'{word}'" for word in ('./trainer', *words))
    asked = f'. {file}; COMP_WORDS=({line}); COMP_CWORD={len(words)}; _trainer'
    program = ['bash', '-c', f'{asked}; echo "${{COMPREPLY[@]}}"']
    return subprocess.run(program, capture_output=True, text=True, check=True).stdout.split()


def test_commands_are_those_of_the_help(tmp_path: Path) -> None:
    assert set(completed(tmp_path, '')) == {*get_command(app).commands, *LAUNCHERS_OWN}


@pytest.mark.parametrize(
    ('words', 'offered'),
    [
        (('im',), ['import-mesh']),
        (('demo', '--js'), ['--json']),
        (('probe-device', '--no'), ['--no-moves']),
        (('demo', '--scene', 'li'), ['liver', 'liver_suspended']),
        (('plan', 'fl'), ['flap']),
        (('import-mesh', '--unit', ''), ['m', 'cm', 'mm']),
        (('completion', 'z'), ['zsh']),
        (('picture', ''), []),  # the shell's own: files
    ],
)
def test_options_and_known_values_are_offered(
    tmp_path: Path, words: tuple[str, ...], offered: list[str]
) -> None:
    assert completed(tmp_path, *words) == offered


@pytest.mark.skipif(shutil.which('zsh') is None, reason='zsh is not installed')
def test_zsh_reads_the_script(tmp_path: Path) -> None:
    file = tmp_path / 'completion'
    file.write_text(script(get_command(app), 'zsh'))
    command = ['zsh', '-fc', f'autoload -U compinit; compinit -D; . {file}; echo $_comps[trainer]']
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert '_bash_complete' in done.stdout, done.stderr
