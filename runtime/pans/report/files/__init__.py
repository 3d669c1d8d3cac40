"""What a file holds and whether it is whole: `verify_file`, `file_facts`.

>>> from pans.report.files import verify_file
>>> verify_file("oled-qcmos").ok
True
"""

from .facts import file_facts
from .verify import FileVerdict, file_kind, verify_file, verify_parts

__all__ = [
    "FileVerdict",
    "file_facts",
    "file_kind",
    "verify_file",
    "verify_parts",
]
