"""Tables of a study: one row for each bag and setting."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import JsonValue

from cutting_trainer.studies.bag_collection import StudyBag
from cutting_trainer.studies.designs import Setting
from cutting_trainer.studies.evaluation import Result

TABLE_FILE, COSTS_FILE = 'table.parquet', 'costs.parquet'


@dataclass(frozen=True)
class Row:
    """One row of the table."""

    bag: StudyBag
    setting: Setting
    result: Result

    @property
    def is_reference(self) -> bool:
        """Whether it is that of the setting whose force the others are compared with."""
        return self.setting.number > 0 and self.setting.identity == self.result.reference

    @property
    def head(self) -> dict[str, object]:
        """Columns that name the row."""
        return {
            'bag': self.bag.name,
            'bag_hash': self.bag.hash,
            'setting': self.setting.number,
            'setting_hash': self.setting.identity,
        }


def write_table(file: Path, rows: Sequence[Row], outputs: Iterable[str]) -> None:
    """Write settings, outputs, failures and identities as Parquet.

    The bytes depend on the rows alone, so that studies can be compared by their files.

    Args:
        file: to write; it is replaced in one step.
        rows: in their order.
        outputs: columns of results.
    """
    columns: dict[str, list[object]] = (
        {name: [row.head[name] for row in rows] for name in rows[0].head} if rows else {}
    )
    types: dict[str, pa.DataType] = {'setting': pa.int64()}
    for key in dict.fromkeys(key for row in rows for key in row.setting.changes):
        values = [row.setting.changes.get(key) for row in rows]
        given = [v for row, v in zip(rows, values, strict=True) if key in row.setting.changes]
        numbers = all(_is_number(value) for value in given)
        types[key] = pa.float64() if numbers else pa.string()
        columns[key] = [
            None if key not in row.setting.changes else value if numbers else as_text(value)
            for row, value in zip(rows, values, strict=True)
        ]
    for name in outputs:
        types[name] = pa.float64()
        columns[name] = [row.result.outputs.get(name) for row in rows]
    columns['reference'] = [row.result.reference for row in rows]
    columns['failure'] = [row.result.failure for row in rows]
    types['differs_from_frame'] = pa.int64()
    columns['differs_from_frame'] = [
        row.result.differs_from_frame if not row.setting.number else None for row in rows
    ]
    identities = [asdict(row.result.identity) for row in rows]
    for identity in identities:
        del identity['commit'], identity['cpu']  # of one kind of processor, there are many
    for name in identities[0] if identities else ():
        columns[name] = [identity[name] for identity in identities]
    _write(file, columns, types)


def write_costs(file: Path, rows: Sequence[Row]) -> None:
    """Write processor time [s], memory [bytes], processor and commit of each row, which vary."""
    columns: dict[str, list[object]] = {
        **({name: [row.head[name] for row in rows] for name in rows[0].head} if rows else {}),
        'cpu': [row.result.cpu for row in rows],
        'warm_up': [row.result.warm_up for row in rows],
        'memory': [row.result.memory for row in rows],
        'processor': [row.result.identity.cpu for row in rows],
        'commit': [row.result.identity.commit for row in rows],
    }
    _write(file, columns, {'setting': pa.int64(), 'cpu': pa.float64(), 'warm_up': pa.float64()})


def as_text(value: JsonValue) -> str:
    """Return a value of a scene key as it stands in YAML."""
    return value if isinstance(value, str) else json.dumps(value)


def _is_number(value: JsonValue) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _write(file: Path, columns: dict[str, list[object]], types: dict[str, pa.DataType]) -> None:
    arrays = {name: pa.array(values, types.get(name)) for name, values in columns.items()}
    new = file.with_suffix('.new')
    pq.write_table(pa.table(arrays), new, compression='zstd')
    new.replace(file)
