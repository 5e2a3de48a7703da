"""`trainer completion`: scripts that complete commands, options and values in the shell.

The script has the words in it, so that a Tab starts no Python. Typer's own script calls the program
by its bare name and without arguments: there is no `trainer` on the path, and `./trainer` alone is
the launcher, which prints its help.
"""

import shlex
import typing
from collections.abc import Mapping
from typing import Any, Literal

from cutting_trainer.node_common.share_folder import scene_names

Shell = Literal['bash', 'zsh']
LAUNCHERS_OWN = ('setup', 'overlay', 'clean', 'bench', 'chart', 'validate')
"""Commands that the launcher of a checkout has beside those here."""

_SCRIPT = """\
_trainer() {{
  local word=${{COMP_WORDS[COMP_CWORD]}} previous=${{COMP_WORDS[COMP_CWORD-1]}} words=
  if [ "$COMP_CWORD" -eq 1 ]; then
    words={commands}
  else
    case "${{COMP_WORDS[1]}} $previous" in
{values}
    *) case "$word" in -*) case "${{COMP_WORDS[1]}}" in
{options}
      esac ;; esac ;;
    esac
  fi
  COMPREPLY=($(compgen -W "$words" -- "$word"))
}}
complete -o default -F _trainer trainer ./trainer
"""


def script(program: Any, shell: Shell) -> str:
    """Return the script for a shell.

    Args:
        program: click's group of all commands.
        shell: zsh reads bash's script by its own `bashcompinit`.
    """
    commands = program.commands
    options: list[str] = []
    values: list[str] = []
    for name, command in commands.items():
        hints = typing.get_type_hints(command.callback)
        words = ['--help']
        for parameter in command.params:
            spelt = [*parameter.opts, *parameter.secondary_opts]  # --push, --no-push
            words += [option for option in spelt if option.startswith('--')]
            known = _known(parameter.name, hints)
            for before in parameter.opts if known else ():
                # an argument is asked for right after the command
                before = before if before.startswith('-') else name
                values.append(f'    {shlex.quote(f"{name} {before}")}) words={_quoted(known)} ;;')
        options.append(f'      {name}) words={_quoted(words)} ;;')
    text = _SCRIPT.format(
        commands=_quoted([*commands, *LAUNCHERS_OWN]),
        values='\n'.join(values),
        options='\n'.join(options),
    )
    return ('autoload -U +X bashcompinit && bashcompinit\n' if shell == 'zsh' else '') + text


def _known(name: str, hints: Mapping[str, Any]) -> list[str]:
    """Return values that an option or argument may have, as far as they can be listed."""
    if name == 'scene':
        return scene_names()
    if typing.get_origin(hints.get(name)) is Literal:
        return list(typing.get_args(hints[name]))
    return []


def _quoted(words: list[str]) -> str:
    return shlex.quote(' '.join(words))
