"""HTML pages of runs, bundles, measurements and folders of runs: one file each, for any width, in light and dark, and on paper.

What comes in are files of this project; what goes out is HTML. Structure and words stand in templates/ (Jinja2), charts.py draws
(matplotlib), both of the extra `plot`. No page runs a script or loads anything. Start with run.py and templates/run.html.
"""

from __future__ import annotations

from pathlib import Path

from pans.base.errors import UsageError
from pans.report.files.verify import file_kind


def page_of(path: str | Path) -> bytes:
    """Return the page of a recording, a bundle, a calibration or a registration.

    UsageError for another kind of file, a missing one, and without the extra `plot`.
    """
    from pans.record.reading import open_recording

    from .bundle import bundle_page, measured_page
    from .run import run_page

    kind = file_kind(path)
    if kind == "recording":
        return run_page(open_recording(path, salvage=True))
    if kind == "profile":
        raise UsageError(f"{path} is a {kind}", remedy="`pans info` shows it")
    return bundle_page(Path(path)) if kind == "bundle" else measured_page(Path(path))
