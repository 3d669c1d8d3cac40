"""The live view in a terminal: one panel, redrawn a few times per second by the drawing process; parts below each other if it is narrow."""

from __future__ import annotations

from itertools import groupby
from typing import TYPE_CHECKING, Any

from .figures import class_rows, latest_rows, rows_of, title_of
from .history import History

if TYPE_CHECKING:
    from rich.console import RenderableType

STYLES = {"good": "green", "note": "dim", "warn": "yellow", "bad": "bold red", "": ""}
MARKS = {"good": "✓ ", "note": "", "warn": "! ", "bad": "✗ ", "": ""}  # not by colour alone
WIDE_COLUMNS = 110
LATEST_SHOWN = 8
CLASSES_SHOWN = 10
BAR_CHARACTERS = 16


class TerminalView:
    """A rich panel on stderr, from the first picture until `close`."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.live import Live

        self._console = Console(stderr=True)
        self._live = Live(console=self._console, auto_refresh=False, transient=True)
        self._open = False

    def draw(self, history: History) -> None:
        """Draw what `history` knows now."""
        if not history.picture:
            return
        if not self._open:
            self._live.start()
            self._open = True
        self._live.update(panel(history, self._console.width), refresh=True)

    def close(self) -> None:
        """Remove the panel; the cursor is shown again."""
        if self._open:
            self._live.stop()


def panel(history: History, width: int) -> RenderableType:
    """Return the whole view for a terminal of `width` columns."""
    from rich.columns import Columns
    from rich.console import Group
    from rich.panel import Panel
    from rich.progress_bar import ProgressBar
    from rich.text import Text

    parts: list[RenderableType] = [_figures(history)]
    expected = history.begin.get("expected", 0)
    if expected:
        parts.append(ProgressBar(total=expected, completed=min(history.picture["decisions"], expected)))
    beside = [one for one in (_classes(history), _latest(history)) if one is not None]
    parts += [Text(""), Columns(beside, padding=(0, 4))] if width >= WIDE_COLUMNS else [Text(""), *beside]
    return Panel(Group(*parts), title=Text(title_of(history)), subtitle=Text("Ctrl-C stops the run"))


def _figures(history: History) -> RenderableType:
    from rich.table import Table
    from rich.text import Text

    table = Table.grid(padding=(0, 2, 0, 0))
    table.add_column(style="dim", no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for group, rows in groupby(rows_of(history), key=lambda row: row.group):
        for number, row in enumerate(rows):
            text = Text(MARKS[row.level] + row.text, style=STYLES[row.level])
            table.add_row("" if number else group, Text(row.name), text)
    return table


def _classes(history: History) -> RenderableType | None:
    from rich.text import Text

    found = class_rows(history)
    if not found or not any(decided for _, decided, _, _ in found):
        return None
    most = max(decided for _, decided, _, _ in found)
    table = _table("class", "decisions", "", "right")
    for name, decided, truth, right in sorted(found, key=lambda row: -row[1])[:CLASSES_SHOWN]:
        bar = "█" * max(round(BAR_CHARACTERS * decided / most), bool(decided))
        table.add_row(Text(name), f"{decided:,}", Text(bar, style="cyan"), f"{right / truth:.0%}" if truth else "")
    return table


def _latest(history: History) -> RenderableType | None:
    from rich.text import Text

    found = latest_rows(history)[:LATEST_SHOWN]
    if not found:
        return None
    table = _table("object", "decision", "sure", "clicks", "truth")
    for row in found:
        decision = Text(MARKS[row["level"]] + row["decision"], style=STYLES[row["level"]])
        clicks = f"{'●' * min(row['clicks'], 20)} {row['clicks']}"
        table.add_row(str(row["object"]), decision, row["probability"], clicks, Text(row["truth"]))
    return table


def _table(*names: str) -> Any:
    from rich.table import Table

    return Table(*names, box=None, padding=(0, 2, 0, 0), header_style="dim")
