"""HTML pages of recordings and bundles in one file each, readable on a screen of any width, in light and dark, and on paper.

Owns layout, drawings and which sections stand on a page. It reads recordings and bundles and judges nothing: verdicts and figures of a
whole run are those of its summary. No page runs a script or loads anything.

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
