"""The report page of any file that has one.

Owns the choice by kind alone.
"""

from __future__ import annotations

from pathlib import Path

from pans.runtime.bundle.model import load_bundle
from pans.runtime.errors import UsageError
from pans.runtime.record import read_recording

from .page_bundle import bundle_page
from .page_run import recording_page
from .verify import file_kind


def page_of(path: str | Path) -> bytes:
    """Return one self-contained HTML page of a recording or a bundle; UsageError for another kind of file or a missing one."""
    kind = file_kind(path)
    if kind == "recording":
        return recording_page(read_recording(path, salvage=True))
    if kind == "bundle":
        bundle, sha256 = load_bundle(path)
        return bundle_page(bundle, sha256, Path(path))
    raise UsageError(f"{path} is a {kind}", remedy="reports are made of recordings and bundles; `pans info` shows this")
