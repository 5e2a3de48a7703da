"""Answers of the trainer's commands as JSON."""

import json
import os
import subprocess
import sys
from typing import Any

_LIMIT_S = 240.0


def json_answer(*words: str) -> dict[str, Any]:
    """Return what a command of the trainer prints as JSON, whatever its exit status.

    Args:
        words: command and its options, with `--json`.

    Raises:
        RuntimeError: it printed no JSON.
    """
    done = subprocess.run(
        [sys.executable, '-m', 'cutting_trainer.cli', *words],
        env=os.environ | {'COLUMNS': '200'},
        capture_output=True,
        text=True,
        timeout=_LIMIT_S,
        check=False,
    )
    if not done.stdout.startswith('{'):
        raise RuntimeError(f'{words[0]} gave nothing: {done.stderr[-400:]}')
    answer: dict[str, Any] = json.loads(done.stdout)
    return answer
