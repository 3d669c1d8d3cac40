"""What a person reads and types: output, progress, logs, options, and text made safe.

printing.py writes the answer and the notes, options.py makes command-line options from a dataclass, extras.py loads what another package
adds.
"""

from . import text as text
from .extras import install, load_offered, missing_extra, needed, package_of
from .logs import LOGGER, add_log_options, log_event, logging_of
from .options import (
    add_options,
    changed_options,
    check_options,
    option,
    option_fields,
    options_from,
    refuse_without,
    words_of,
)
from .printing import begin, emit, fail, note, say, state, warn
from .progress import progress_bar, reading_bar, work_bar
from .text import csv_cell, file_name, html, html_card, markdown, one_line

__all__ = [
    "LOGGER",
    "add_log_options",
    "add_options",
    "begin",
    "changed_options",
    "check_options",
    "csv_cell",
    "emit",
    "fail",
    "file_name",
    "html",
    "html_card",
    "install",
    "load_offered",
    "log_event",
    "logging_of",
    "markdown",
    "missing_extra",
    "needed",
    "note",
    "one_line",
    "option",
    "option_fields",
    "options_from",
    "package_of",
    "progress_bar",
    "reading_bar",
    "refuse_without",
    "say",
    "state",
    "text",
    "warn",
    "words_of",
    "work_bar",
]
