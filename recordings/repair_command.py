"""`trainer repair`: repair a bag and print an account."""

import json
from dataclasses import asdict
from pathlib import Path

from rich.console import Console

from cutting_trainer.bags.repair import Repair, repair_bag
from cutting_trainer.session.bag_measurements import read_evidence


def repair(folder: Path, *, as_json: bool = False) -> None:
    """Repair a bag and print the losses.

    Raises:
        BagError: it is no bag, or there is no room.
    """
    console = Console(soft_wrap=True)
    result = repair_bag(folder)
    if as_json:
        missing = {'lost_by_sequence': read_evidence(folder).lost}
        plain = {'bag': str(folder), **asdict(result), **missing}
        print(json.dumps(plain, indent=2))
        return
    for line in account_lines(folder, result):
        console.print(line, highlight=False, markup=False)


def account_lines(folder: Path, result: Repair) -> list[str]:
    """Return the result in lines."""
    if result.whole:
        before = [result.repaired] if result.repaired else []
        return [f'{folder} is whole: nothing to repair', *before]
    lines = [
        f'{folder} is readable again: {result.messages} messages, {result.topics} topics, '
        f'{result.seconds:.1f} s'
    ]
    lines.append(f'flaw: {result.flaw}')
    if result.lost != 0 or result.lost_bytes:
        lines.append(f'gone: {result.gone}')
    if result.cut_off:
        lines.append(
            f'of these, {result.cut_off} bytes were its last; the file was changed last '
            f'{result.silence:.2f} s after the last message kept'
        )
    if result.strangers:
        lines.append(f'gone too: {result.strangers} messages of topics that nothing defines')
    if result.doubtful:
        lines.append(
            f'kept, but to be doubted: {result.doubtful} messages of chunks whose checksum does '
            'not hold; at least one of each chunk is damaged'
        )
    if result.repeated:
        lines.append(f'kept as they are: {result.repeated} chunks that the file has twice')
    missing = read_evidence(folder).lost
    lines += [f'missing by sequence numbers: {n} of {topic}' for topic, n in missing.items()]
    return lines
