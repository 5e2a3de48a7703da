"""What `trainer repair` says."""

import json
from dataclasses import asdict
from pathlib import Path

from rich.console import Console

from bags.repair import Repair, repair_bag
from session.evidence import read_evidence


def repair(folder: Path, *, as_json: bool = False) -> None:
    """Repairs a bag and says what is gone.

    Raises:
        BagError: it is no bag, or there is no room.
    """
    console = Console(soft_wrap=True)
    result = repair_bag(folder)
    if as_json:
        plain = {'bag': str(folder), **asdict(result), 'lost': read_evidence(folder).lost}
        print(json.dumps(plain, indent=2))
        return
    for line in told(folder, result):
        console.print(line, highlight=False, markup=False)


def told(folder: Path, result: Repair) -> list[str]:
    """The outcome in lines."""
    if result.whole:
        return [f'{folder} is whole: nothing to repair']
    lines = [
        f'{folder} is readable again: {result.messages} messages, {result.topics} topics, '
        f'{result.seconds:.1f} s'
    ]
    if result.cut_off:
        lines.append(
            f'gone: what was in its last {result.cut_off} bytes, which are no complete chunk; the '
            f'file was changed last {result.silence:.2f} s after the last message kept'
        )
    if result.damaged:
        lines.append(f'gone: what was in {result.damaged} chunks whose checksum does not hold')
    if result.strangers:
        lines.append(f'gone: {result.strangers} messages of topics defined in those chunks')
    missing = read_evidence(folder).lost
    lines += [f'missing by sequence numbers: {n} of {topic}' for topic, n in missing.items()]
    return lines
