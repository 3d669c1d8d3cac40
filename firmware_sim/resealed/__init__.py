"""Files with changed contents and right checksums: what a stranger, a faulty exporter or a bad disk controller may hand over.

Owns the changes, the sealing and the judgement: `pans verify` must answer within its limits and without a traceback, and what it
accepts can be run or replayed. Never changes a file that exists.
"""

from typing import TYPE_CHECKING

from pans.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from .judging import FileCounts, fuzz_files

__all__ = ["FileCounts", "fuzz_files"]

__getattr__ = lazy_names(__name__, {"FileCounts": ".judging", "fuzz_files": ".judging"})
