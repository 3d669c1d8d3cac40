"""The live view in a terminal: one panel, redrawn a few times per second by the drawing process."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .figures import latest_rows, rows_of, title_of
from .history import History

if TYPE_CHECKING:
    from rich.console import RenderableType

STYLES = {"good": "green", "note": "dim", "warn": "yellow", "bad": "bold red", "": ""}
MARKS = {"good": "✓ ", "note": "", "warn": "! ", "bad": "✗ ", "": ""}  # not by colour alone
LATEST_SHOWN = 8


class TerminalView:
    """A rich panel on stderr, from the first picture until `close`."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.live import Live

        self._live = Live(console=Console(stderr=True), auto_refresh=False, transient=True)

    def draw(self, history: History) -> None:
        """Draw what `history` knows now."""
        if history.picture:
            self._live.start()
            self._live.update(panel(history), refresh=True)

    def close(self) -> None:
        """Remove the panel; the cursor is shown again."""
        self._live.stop()


def panel(history: History) -> RenderableType:
    """Return the whole view: the figures, how much is done, the latest decisions."""
    from rich.console import Group
    from rich.panel import Panel
    from rich.progress_bar import ProgressBar
    from rich.table import Table
    from rich.text import Text

    figures = Table.grid(padding=(0, 2, 0, 0))
    figures.add_column(style="dim", no_wrap=True)
    figures.add_column(overflow="fold")
    for row in rows_of(history):
        figures.add_row(row.name, Text(MARKS[row.level] + row.text, style=STYLES[row.level]))
    parts: list[RenderableType] = [figures]
    if expected := history.begin.get("expected", 0):
        parts.append(ProgressBar(total=expected, completed=min(history.picture["decisions"], expected)))
    if found := latest_rows(history)[:LATEST_SHOWN]:
        names = ("object", "decision", "sure", "clicks", "truth")
        latest = Table(*names, box=None, padding=(0, 2, 0, 0), header_style="dim")
        for one in found:
            decision = Text(MARKS[one["level"]] + one["decision"], style=STYLES[one["level"]])
            clicks = f"{'●' * min(one['clicks'], 20)} {one['clicks']}"
            latest.add_row(str(one["object"]), decision, one["probability"], clicks, Text(one["truth"]))
        parts += [Text(""), latest]
    return Panel(Group(*parts), title=Text(title_of(history)), subtitle=Text("Ctrl-C stops the run"))
