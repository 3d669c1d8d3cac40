"""Tables as Parquet files (extra `parquet`): the decisions of a recording, and any rows of plain values.

pyarrow is imported when a file is written. A file is written whole or not at all.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pans.base.console import needed
from pans.base.files import whole_file
from pans.decide.plan import Plan
from pans.record.reading.recording import Recording

from .tables import DECISIONS, facts_of, iter_decisions


def need_pyarrow() -> Any:
    """Return pyarrow; UsageError that names the extra."""
    needed("pyarrow.parquet", "Parquet", "parquet")
    return needed("pyarrow")


def write_decisions(path: Path, recording: Recording, plan: Plan, *, force: bool = False) -> None:
    """Write the decisions of `recording` to `path`, block by block; columns as in decisions.csv, missing values are null.

    The metadata of each field hold its `unit`, `meaning` and what null means (`missing`), those of the schema `pans`, a JSON object with
    the recording's facts (`simulated`, `tick_us`, `decisions_sha256`, ...).
    """
    pyarrow = need_pyarrow()
    fields = [
        pyarrow.field(
            name,
            getattr(pyarrow, {"str": "string"}.get(column.dtype, column.dtype))(),
            nullable=bool(column.missing),
            metadata={key: said for key in ("unit", "meaning", "missing") if (said := getattr(column, key))},
        )
        for name, column in DECISIONS.items()
    ]
    schema = pyarrow.schema(fields, metadata={"pans": json.dumps(facts_of(recording))})
    with whole_file(path, force=force) as beside, pyarrow.parquet.ParquetWriter(beside, schema) as writer:
        for table in iter_decisions(recording, plan):
            columns = ((table[one.name], one.type) for one in fields)
            arrays = [pyarrow.array(np.ma.getdata(v), kind, mask=np.ma.getmaskarray(v)) for v, kind in columns]
            writer.write_batch(pyarrow.record_batch(arrays, schema=schema))


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]], *, force: bool = False) -> None:
    """Write `rows`, whose values are numbers, texts, booleans or None, to `path`; a column's type is that of its values.

    What stands in few rows is null in the others. A column of mixed types becomes text, as JSON.
    """
    pyarrow = need_pyarrow()
    names = list(dict.fromkeys(name for row in rows for name in row))
    table = pyarrow.table({name: _column(pyarrow, [row.get(name) for row in rows]) for name in names})
    with whole_file(path, force=force) as beside:
        pyarrow.parquet.write_table(table, beside)


def _column(pyarrow: Any, values: list[Any]) -> Any:
    kinds = {type(value) for value in values if value is not None}
    if kinds == {int, float}:
        return pyarrow.array([None if value is None else float(value) for value in values])
    if len(kinds) > 1 or kinds & {dict, list}:
        return pyarrow.array([None if value is None else json.dumps(value, sort_keys=True) for value in values])
    return pyarrow.array(values)
