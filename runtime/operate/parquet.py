"""Tables as Parquet files (extra `parquet`): the decisions of a recording, and any rows of plain values.

pyarrow is imported when a file is written. A file is written whole or not at all.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pans.runtime.core.decision import NO_LABEL
from pans.runtime.errors import UsageError
from pans.runtime.outputs import whole_file
from pans.runtime.record import Recording

COLUMNS = {  # name: its type, and the field of a decision ("": made of another one)
    "decision": ("int64", "index"),
    "tick": ("int64", "tick"),
    "exposure": ("int64", "exposure_index"),
    "object": ("int64", "object"),
    "first_shot": ("int64", "shot"),
    "clicks": ("int64", "clicks"),
    "label": ("int32", "label"),
    "class": ("string", ""),
    "truth": ("int32", "truth"),
    "probability": ("float32", "probability"),
    "flags": ("int32", "flags"),
    "exposures": ("int64", "exposures"),
}


def need_pyarrow() -> Any:
    """Return pyarrow; UsageError that names the extra."""
    try:
        importlib.import_module("pyarrow.parquet")
        return importlib.import_module("pyarrow")
    except ImportError as error:
        what = "Parquet needs the package pyarrow, which is not installed"
        raise UsageError(what, remedy="pip install 'pans-runtime[parquet]'") from error


def write_decisions(path: Path, recording: Recording, *, force: bool = False) -> None:
    """Write the decisions of `recording` to `path`, block by block; columns as in decisions.csv, unknown values are null.

    The schema's metadata hold `pans`, a JSON object with the recording's facts (`simulated`, `tick_us`, `decisions_sha256`, ...).
    """
    pyarrow = need_pyarrow()
    classes = list(recording.bundle().classes if recording.bundle_place else ())
    facts = {
        "recording": recording.path.name,
        "simulated": recording.simulated,
        "complete": recording.complete,
        "tick_us": 1e6 / int(recording.header["config"]["tick_hz"]),
        "classes": classes,
        "decisions_sha256": recording.decisions_sha256,
        "bundle_sha256": recording.header.get("bundle_sha256"),
    }
    columns = [(name, getattr(pyarrow, kind)()) for name, (kind, _) in COLUMNS.items()]
    schema = pyarrow.schema(columns, metadata={"pans": json.dumps(facts)})
    names = np.array([*classes, None], object)  # the last one is that of an unknown or nameless label
    with whole_file(path, force=force) as beside, pyarrow.parquet.ParquetWriter(beside, schema) as writer:
        for rows in recording.iter_decisions():
            label = rows["label"].astype(np.int64)
            unknown = label == NO_LABEL
            found = {name: rows[field] for name, (_, field) in COLUMNS.items() if field}
            found["class"] = names[np.where(label < len(classes), label, len(classes))]
            masks = {"label": unknown, "probability": unknown, "truth": rows["truth"] < 0}
            arrays = [
                pyarrow.array(np.ascontiguousarray(found[name]), mask=masks.get(name)).cast(kind)
                for name, kind in columns
            ]
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
