"""A recording for other tools: CSV files with a data dictionary, and Photon-HDF5 (photon-hdf5.org, version 0.5).

Photon-HDF5 needs h5py (extra `export`), imported when a file is written. What is the same in every file stands in photon_hdf5.toml, with
the titles that the format's definition gives its fields: readers such as phconvert refuse other words. A binary click becomes a photon: its
timestamp is the **begin of its exposure** in device ticks (when in the exposure it fell is not known), its detector the channel that
clicked. Which pattern was displayed, which object stood there and what was decided is in `/user/pans`; the format leaves `/user` to its
users.
"""

from __future__ import annotations

import csv
import io
import json
import time
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from importlib.resources import files
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from pans.base import __version__
from pans.base.console import csv_cell, needed
from pans.base.errors import UsageError
from pans.base.files import make_folder, write_file
from pans.decide.plan import Plan
from pans.record.reading.exposures import ClickList
from pans.record.reading.recording import Recording

from . import tables

TABLES = {"decisions.csv": tables.DECISIONS, "clicks.csv": tables.CLICKS, "timings.csv": tables.TIMINGS}
FILES = (*TABLES, "columns.csv", "about.json")


def write_csv(folder: Path, recording: Recording, plan: Plan, clicks: ClickList, *, force: bool = False) -> list[Path]:
    """Write the tables, their dictionary columns.csv and about.json into `folder`; return their paths. UsageError where it is a file."""
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"{folder} is a file", remedy="name a folder: csv is several files")
    make_folder(folder)
    timed, virtual = tables.timing_table, recording.virtual_time
    written = {
        "decisions.csv": _csv(tables.DECISIONS, tables.iter_decisions(recording, plan)),
        "clicks.csv": _csv(tables.CLICKS, [tables.click_table(recording, plan, clicks)]),
        "timings.csv": _csv(tables.TIMINGS, (timed(rows, virtual=virtual) for rows in recording.iter_timings())),
        "columns.csv": dictionary(),
    }
    about = tables.facts_of(recording) | {
        "exposure_us": plan.exposure_us,
        "exposures": clicks.exposures,
        "time_zero": "the begin of the first recorded exposure",
        "header": {key: value for key, value in recording.header.items() if key != "profile"},
        # without the place of a part, which only a replay needs
        "events": [{key: event[key] for key in event if key != "place"} for event in recording.events()],
    }
    texts = written | {"about.json": json.dumps(about, indent=1, sort_keys=True) + "\n"}
    for name, text in texts.items():
        write_file(folder / name, text.encode(), force=force)
    return [folder / name for name in texts]


def dictionary() -> str:
    """Return columns.csv: every column of every table with its unit, its type, what it means, and what an empty cell means."""
    rows = (
        (file, name, column.unit, column.dtype, column.meaning, column.missing)
        for file, columns in TABLES.items()
        for name, column in columns.items()
    )
    return _text(("file", "column", "unit", "dtype", "meaning", "empty_means"), rows)


def _csv(columns: Mapping[str, object], blocks: Iterable[tables.Table]) -> str:
    """A table with a head; masked values are None, which the writer leaves empty."""
    rows = (zip(*([csv_cell(value) for value in one.tolist()] for one in table.values())) for table in blocks)
    return _text(tuple(columns), chain.from_iterable(rows))


def _text(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows(chain([head], rows))
    return text.getvalue()


def write_photon_hdf5(path: Path, recording: Recording, plan: Plan, clicks: ClickList, *, force: bool = False) -> None:
    """Write `clicks` of `recording` to `path`, whole or not at all.

    UsageError without h5py, when the device's clock went back, and if `path` exists, unless `force`.
    """
    h5py = needed("h5py", "Photon-HDF5", "export")
    if (np.diff(clicks.start_tick) < 0).any():
        raise UsageError(
            f"{recording.path}: the device's clock went back (it was switched off in between): the format has one clock",
            remedy="export it as csv, which numbers the streams",
        )
    image = io.BytesIO()  # h5py tells of a full disk by a traceback of its own, or not at all
    with h5py.File(image, "w") as file:
        for key, said in {**_fixed("root"), "TITLE": _fixed("titles")["/"]}.items():
            file.attrs[key] = np.bytes_(said)
        _write(file, _tree(path, recording, plan, clicks))
    write_file(path, image.getbuffer(), force=force)


@cache
def _fixed(table: str) -> dict[str, Any]:
    """What is the same in every file: a table of photon_hdf5.toml; flags are bytes, as readers expect."""
    text = files(__package__).joinpath("photon_hdf5.toml").read_text(encoding="utf-8")
    dtypes = {int: np.uint8, float: np.float64}
    rows = tomllib.loads(text)[table].items()
    return {key: np.array(one, dtypes[type(one[0])]) if isinstance(one, list) else one for key, one in rows}


def _write(group: Any, tree: dict[str, Any], path: str = "") -> None:
    """Text as bytes, and a title on every node: what readers of the format expect."""
    for name, value in tree.items():
        where = f"{path}/{name}"
        if isinstance(value, dict):
            node = group.create_group(name)
            _write(node, value, where)
        else:
            data = np.bytes_(value.encode()) if isinstance(value, str) else value
            node = group.create_dataset(name, data=data)
            if isinstance(value, str):  # so that PyTables, with which readers are written, reads bytes and not an array
                for key, said in (("CLASS", "ARRAY"), ("VERSION", "2.4"), ("FLAVOR", "python")):
                    node.attrs[key] = np.bytes_(said)
        node.attrs["TITLE"] = np.bytes_(_fixed("titles").get(where, name.replace("_", " ")).encode())


def _tree(path: Path, recording: Recording, plan: Plan, clicks: ClickList) -> dict[str, Any]:
    unit_s = plan.exposure_us * 1e-6 / plan.exposure_ticks
    channels = plan.n_channels
    profile: Mapping[str, Any] = recording.header["profile"] if recording.profile_toml else {}
    classes = recording.bundle().classes if recording.bundle_place else ()
    described = (
        f"{'SIMULATED. ' if recording.simulated else ''}Binary clicks of {plan.n_patterns} patterns, {plan.mode}, exposures of "
        f"{plan.exposure_us:g} us; timestamps are the begin of the exposure. Profile {profile.get('name')}."
    )
    return {
        **_fixed("root"),
        "acquisition_duration": (clicks.last_tick - clicks.first_tick) * unit_s,
        "description": described,
        "photon_data": {
            "timestamps": clicks.start_tick,
            "timestamps_specs": {"timestamps_unit": unit_s},
            "detectors": clicks.channel.astype(np.uint8 if channels <= 256 else np.uint16),
            "measurement_specs": {"measurement_type": "generic", "detectors_specs": {}},
        },
        "setup": {"num_pixels": channels, **_fixed("setup")},
        "identity": {
            **_fixed("identity"),
            "filename": path.name,
            "filename_full": str(path.resolve()),
            "creation_time": time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime()),
            "software_version": __version__,
        },
        "provenance": {
            "filename": recording.path.name,
            "filename_full": str(recording.path.resolve()),
            "creation_time": str(recording.header.get("created_utc", ""))[:19].replace("T", " "),
            "software": "pans-runtime",
            "software_version": str(recording.header.get("versions", {}).get("pans", "unknown")),
        },
        "user": {
            "pans": {
                "simulated": int(recording.simulated),
                "exposure_us": plan.exposure_us,
                "exposures": clicks.exposures,
                "exposure": clicks.exposure,
                "object": clicks.object,
                "pattern": clicks.pattern,
                **({"photons": clicks.photons} if plan.largest > 1 and plan.channels_at_once == 1 else {}),
                "decisions": recording.decisions(),
                "classes": np.array([name.encode() for name in classes], dtype=np.bytes_),
                "decisions_sha256": recording.decisions_sha256,
                "device": str(recording.summary.get("device", {}).get("firmware", "unknown")),
                "profile": str(profile.get("toml", "")),
            }
        },
    }
