"""Let emulated people play the exercises: `./trainer run python -m bench.training -o FILE`.

Each attempt is one line of JSON in the file; attempts that are there already are not made again,
so that a run that was stopped goes on. The table has the area under the ROC curve by exercise.
"""

import argparse
import json
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

from bench.training.runner import EXERCISES, attempt, table, wanted


def main() -> None:
    """Make the attempts that the file lacks, and print the table."""
    parser = argparse.ArgumentParser(prog='bench.training', description=__doc__)
    parser.add_argument('-o', '--output', type=Path, required=True, help='file of rows, .jsonl')
    parser.add_argument('-n', type=int, default=40, help='attempts of each kind (default: 40)')
    parser.add_argument('--exercises', nargs='+', default=list(EXERCISES), choices=EXERCISES)
    parser.add_argument('--processes', type=int, default=2)
    options = parser.parse_args()
    rows = []
    if options.output.exists():
        rows = [json.loads(line) for line in options.output.read_text().splitlines()]
    made = {(row['exercise'], row['kind'], row['seed']) for row in rows}
    missing = [each for each in wanted(options.exercises, options.n) if each not in made]
    with ProcessPoolExecutor(options.processes, get_context('spawn')) as pool:
        futures = [pool.submit(attempt, *each) for each in missing]
        for future in as_completed(futures):
            row = future.result()
            rows.append(row)
            with options.output.open('a', encoding='utf-8') as file:
                file.write(json.dumps(row) + '\n')
            print(f'{row["exercise"]} {row["kind"]} {row["seed"]}: {row["points"]:.1f}', flush=True)
    print('\n'.join(table(sorted(rows, key=lambda row: EXERCISES.index(row['exercise'])))))


if __name__ == '__main__':
    main()
