"""The data set that a bundle was trained on, found again.

Owns where it is looked for: by its name, where it was when the bundle was written (relative to the bundle), beside the bundle and in the
working folder. What is there must be the same data, by SHA-256.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pans.runtime.errors import UsageError

from .registry import task_names


def path_from(bundle: Path, task: str) -> str:
    """Return where the data set `task` is, relative to the folder of the bundle; "" for a name, or where there is no such path."""
    if task in task_names():
        return ""
    try:
        return Path(os.path.relpath(task, bundle.parent)).as_posix()
    except ValueError:  # another drive
        return ""


def remembered_task(provenance: Mapping[str, Any], name: str, bundle: Path) -> str:
    """Return the name or the path of what a bundle was trained on; UsageError says where it was looked for.

    `provenance` is the bundle's, `name` its task, `bundle` its file.
    """
    told = str(provenance.get("task_argument", name))
    if told in task_names():
        return told
    kept = str(provenance.get("data_path", ""))
    places = [Path(told), bundle.parent / told] if told else []
    places = ([bundle.parent / kept] if kept else []) + places
    places += [place.with_name(f"{place.name}.npz") for place in places if not place.suffix]
    for place in dict.fromkeys(Path(os.path.normpath(place)) for place in places):
        if place.exists():
            return str(place)
    looked = ", ".join(dict.fromkeys(os.path.normpath(place) for place in places)) or "nothing: the bundle names none"
    digest = str(provenance.get("data_sha256", ""))[:12]
    raise UsageError(
        f"the data set {told!r}{f' (SHA-256 {digest}…)' if digest else ''} of {bundle} was not found; looked for {looked}",
        remedy="name it: --task FOLDER, FILE.npz or a name of `pans data list`",
    )
