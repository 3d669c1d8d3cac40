"""HTML pages of recordings and bundles in one file each, readable on a screen of any width, in light and dark, and on paper.

What comes in are recordings and bundles; what goes out is HTML. Verdicts and figures of a whole run are those of its summary
(report/summary.py); verdict.py adds why a run passed, and the advice on each fault, which it finds by the words of its sentence: change
both together. No page runs a script or loads anything. Start with run.py and page.py.

>>> from pans.runtime.pages import Page
>>> page = Page("A & B", simulated=False)
>>> page.text("one <b>")
>>> b"one &lt;b&gt;" in page.html()
True
"""

from .charts import Axis, Bars, Chart, Curve, Mark
from .page import Page
from .run import page_of

__all__ = ["Axis", "Bars", "Chart", "Curve", "Mark", "Page", "page_of"]
