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


def need_pyarrow() -> Any:
    """Return pyarrow; UsageError that names the extra."""
    try:
        importlib.import_module("pyarrow.parquet")
        return importlib.import_module("pyarrow")
    except ImportError as error:
        raise UsageError(
            "Parquet needs the package pyarrow, which is not installed", remedy="pip install 'pans-runtime[parquet]'"
        ) from error


def write_decisions(path: Path, recording: Recording, *, force: bool = False) -> None:
    """Write the decisions of `recording` to `path`, block by block; columns as in decisions.csv, unknown values are null.

    The schema's metadata hold `pans`, a JSON object with the recording's facts (`simulated`, `tick_us`, `decisions_sha256`, ...).
    """
    pyarrow = need_pyarrow()
    classes = recording.bundle().classes if recording.bundle_place else ()
    tick_us = 1e6 / int(recording.header["config"]["tick_hz"])
    facts = {
        "recording": recording.path.name,
        "simulated": recording.simulated,
        "complete": recording.complete,
        "tick_us": tick_us,
        "classes": list(classes),
        "decisions_sha256": recording.decisions_sha256,
        "bundle_sha256": recording.header.get("bundle_sha256"),
    }
    schema = _decision_schema(pyarrow).with_metadata({"pans": json.dumps(facts)})
    names = pyarrow.array(list(classes), pyarrow.string())
    with whole_file(path, force=force) as beside, pyarrow.parquet.ParquetWriter(beside, schema) as writer:
        for rows in recording.iter_decisions():
            writer.write_batch(_decision_batch(pyarrow, schema, rows, names))


def _decision_schema(pyarrow: Any) -> Any:
    types = {
        **{"decision": "int64", "tick": "int64", "exposure": "int64", "object": "int64", "first_shot": "int64"},
        **{"clicks": "int64", "label": "int32", "class": "string", "truth": "int32", "probability": "float32"},
        **{"flags": "int32", "exposures": "int64"},
    }
    return pyarrow.schema([(name, getattr(pyarrow, kind)()) for name, kind in types.items()])


def _decision_batch(pyarrow: Any, schema: Any, rows: Any, names: Any) -> Any:
    label = rows["label"].astype(np.int64)
    unknown = label == NO_LABEL
    nameless = unknown | (label >= len(names))
    of_class = pyarrow.array(np.where(nameless, 0, label), mask=nameless)
    columns = {
        **{"decision": rows["index"], "tick": rows["tick"], "exposure": rows["exposure_index"]},
        **{"object": rows["object"], "first_shot": rows["shot"], "clicks": rows["clicks"]},
        "label": pyarrow.array(label, mask=unknown),
        "class": names.take(of_class) if len(names) else pyarrow.nulls(len(rows), pyarrow.string()),
        "truth": pyarrow.array(rows["truth"].astype(np.int64), mask=rows["truth"] < 0),
        "probability": pyarrow.array(rows["probability"], mask=unknown),
        **{"flags": rows["flags"], "exposures": rows["exposures"]},
    }
    arrays = [
        pyarrow.array(np.ascontiguousarray(one)) if isinstance(one, np.ndarray) else one for one in columns.values()
    ]
    cast = [array.cast(field.type) for array, field in zip(arrays, schema, strict=True)]
    return pyarrow.record_batch(cast, schema=schema)


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
