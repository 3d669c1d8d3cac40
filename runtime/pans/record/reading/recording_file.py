"""One recording file while it is written: whole blocks appended in order, each chained to the one before.

`Recorder` makes one, or one for each part, and hands it the payloads. A file that is cut off anywhere can be read up to its last
whole block; a failed write is taken back for the same reason.
"""

from __future__ import annotations

import hashlib
import itertools
import os
import shutil
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from pans.base.errors import RecordingError, UsageError, refusing
from pans.base.files import (
    MIB,
    beside_name,
    block_ends,
    canonical_json,
    file_prologue,
    place_new,
    refuse_existing,
    sync_folder,
)

from .decision_log import LogEncoder
from .format import FORMAT_VERSION, LIMITS, MAGIC, Kind

Pieces = tuple[bytes, bytes | memoryview, bytes]  # what stands before a payload, the payload, what stands behind it


class RecordingFile:
    """A file with header and bundle under a hidden name next to `path`, until `take_name` gives it its own."""

    def __init__(self, path: Path, header: Mapping[str, Any], bundle: bytes = b"") -> None:
        """Create the file and sync it. UsageError where that fails; nothing is left behind then.

        `header` is JSON-able; `format_version` and `bundle_sha256` are added where they are missing.
        """
        self.path = path
        self.first_decision = self.n_decisions = self.n_blocks = self.size_bytes = 0
        self.log = LogEncoder()
        facts = {"format_version": FORMAT_VERSION} | (
            {"bundle_sha256": hashlib.sha256(bundle).hexdigest()} if bundle else {}
        )
        text = canonical_json({**facts, **header})
        self._hidden: Path | None = beside_name(path)
        self._file = _create(self._hidden, path)
        self._counts_names = os.fstat(self._file.fileno()).st_nlink > 0  # not every file system does
        start, self._chain = file_prologue(MAGIC, FORMAT_VERSION)
        try:
            self.write(start, *self.framed(Kind.HEADER, text))
            if bundle:
                self.write(*self.framed(Kind.BUNDLE, bundle))
            self.sync()
        except BaseException:
            self.discard()
            raise

    @property
    def has_name(self) -> bool:
        """Whether the file has been given its own name."""
        return self._hidden is None

    @property
    def is_closed(self) -> bool:
        """Whether nothing more can be written."""
        return bool(self._file.closed)

    @property
    def is_deleted(self) -> bool:
        """Whether somebody has deleted the open file; for another thread too."""
        try:
            return self._counts_names and os.fstat(self._file.fileno()).st_nlink == 0
        except (OSError, ValueError):  # it is closed
            return False

    def take_name(self, *, overwrite: bool = False) -> None:
        """Give the file its own name; UsageError if that is in use, unless `overwrite`, or cannot be given."""
        if self._hidden is None:
            return
        with refusing(f"{self.path}: cannot be written"):
            try:
                if overwrite:
                    os.replace(self._hidden, self.path)
                else:
                    place_new(self._hidden, self.path)
            except FileExistsError as error:
                raise refuse_existing(self.path) from error
        self._hidden = None
        sync_folder(self.path.parent)

    def framed(self, kind: Kind, payload: bytes | memoryview) -> Pieces:
        """Return the next block in three pieces, nothing copied; they must be written next."""
        if len(payload) > LIMITS[kind]:
            raise UsageError(f"a {kind.name} block of {len(payload)} bytes, allowed at most {LIMITS[kind]}")
        head, tail, self._chain = block_ends(kind, self.n_blocks, self._chain, payload)
        self.n_blocks += 1
        return head, payload, tail

    def write(self, *pieces: bytes | memoryview) -> None:
        """Write whole blocks; RecordingError, with the file cut at its last whole block and closed, where the disk fails."""
        if self._file.closed:
            raise UsageError(f"{self.path}: this recording is closed")
        try:
            for piece in pieces:
                view = memoryview(piece)
                while view:
                    view = view[self._file.write(view) :]
        except OSError as error:
            raise self._broken(error) from error
        self.size_bytes += sum(len(piece) for piece in pieces)

    def sync(self) -> None:
        """Wait until what was written survives a power cut: milliseconds, never on the hot path."""
        try:
            os.fsync(self._file.fileno())
        except OSError as error:
            raise self._broken(error) from error

    def finish(self, summary: Mapping[str, Any]) -> str:
        """Write END with `summary` (JSON-able), sync, close; return the SHA-256 (hex) of the decision log."""
        digest = self.log.hexdigest()
        facts = {"blocks": self.n_blocks, "decisions": self.n_decisions, "decisions_sha256": digest}
        self.write(*self.framed(Kind.END, canonical_json({**facts, "summary": summary})))
        self.sync()
        self.close()
        return digest

    def close(self) -> None:
        """Close the file; RecordingError, which names it, where the disk fails only then."""
        try:
            self._file.close()
        except OSError as error:
            raise RecordingError(
                f"{self.path}: the disk failed when the recording was closed: {error.strerror or error}",
                remedy="check the disk, and the file with `pans verify`",
            ) from error

    def discard(self) -> None:
        """Close the file, and delete it if it has no name of its own yet."""
        with suppress(OSError):
            self._file.close()
        if self._hidden is not None:
            with suppress(OSError):
                self._hidden.unlink(missing_ok=True)

    def keep_deleted(self) -> None:
        """Continue in a copy next to the folder of a file that was deleted, and take its path.

        A file without a name cannot be given one again (link(2) refuses it), but it can be read as long as it is open.
        """
        deleted, path = self._file, self.path.absolute()
        try:
            self.path, self._hidden = _folder_beside(path.parent) / path.name, None
            self._file = _create(self.path, self.path)
            deleted.seek(0)
            shutil.copyfileobj(deleted, self._file, MIB)
        except OSError as error:
            raise self._broken(error) from error
        finally:
            deleted.close()
        self.sync()

    def _broken(self, error: OSError) -> RecordingError:
        """Cut the file at its last whole block: a torn one in the middle would make everything behind it unreadable."""
        with suppress(OSError):  # otherwise the reader stops at the torn block by itself
            self._file.truncate(self.size_bytes)
        with suppress(OSError):  # the first error says what is wrong
            self._file.close()
        return RecordingError(
            f"{self.path}: the recording stops after {self.size_bytes} bytes: {error.strerror or error}",
            remedy="make room on the disk; what was written before is readable",
        )


def _create(name: Path, path: Path) -> Any:
    with refusing(f"{path}: cannot be written"):
        return open(name, "x+b", buffering=0)  # one write per block, nothing is held back


def _folder_beside(folder: Path) -> Path:
    """Make a new folder next to `folder`, which may be gone itself."""
    for number in itertools.count(1):
        kept = folder.with_name(f"{folder.name}-kept" + (f"-{number}" if number > 1 else ""))
        with suppress(FileExistsError):
            kept.mkdir(parents=True)
            return kept
    raise AssertionError
