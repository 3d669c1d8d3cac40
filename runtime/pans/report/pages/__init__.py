"""HTML pages of runs, bundles, measurements and folders of runs: one file each, for any width, in light and dark, and on paper.

In: files of this project. Out: HTML. templates/ has structure and words (Jinja2), charts.py draws (matplotlib); extra `ui` or `plot`.
No page runs a script or loads anything. Start at run.py and templates/run.html.
"""

from .bundle import write_registration_page
from .charts import need_extra
from .file_page import page_of
from .index import index_page

__all__ = [
    "index_page",
    "need_extra",
    "page_of",
    "write_registration_page",
]
