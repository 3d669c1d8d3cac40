"""The tables of figures on the page of exit codes and JSON keys, made from the one table of figures: `python docs/assets/figures.py`.

Between `<!-- figures: NAME -->` and `<!-- end of figures -->` stand the rows of that name; a test compares them.
"""

import re
from collections.abc import Iterable
from pathlib import Path

from pans.base.numbers import FIGURES, Figure, Part

PAGE = Path(__file__).parents[1] / "reference/exit-codes.md"
MARK = re.compile(r"(?s)<!-- figures: (\w+) -->\n.*?<!-- end of figures -->")


def filled(text: str) -> str:
    """Return the text of a page with the tables of today."""
    return MARK.sub(lambda mark: f"<!-- figures: {mark[1]} -->\n{table(mark[1])}\n<!-- end of figures -->", text)


def table(name: str) -> str:
    """Return the rows of a name in Markdown: a part of the summary, `run`: all that every run has, or `state`: the state file."""
    every = FIGURES.values()
    if name == "state":
        rows = [(one.live, one.metric or "", one) for one in every if one.live]
        return _markdown(
            ("key", "unit", "metric", "meaning"), ((key, one.unit, metric, one) for key, metric, one in rows)
        )
    parts = (Part.DECISIONS, Part.RUN, Part.COMMAND) if name == "run" else (Part[name.upper()],)
    found = (one for one in every if one.part in parts and "." not in one.key)
    return _markdown(("key", "unit", "of", "meaning"), ((one.key, one.unit, one.of, one) for one in found))


def _markdown(head: tuple[str, ...], rows: Iterable[tuple[str, str, str, Figure]]) -> str:
    lines = [f"| {' | '.join(head)} |", "| --- " * len(head) + "|"]
    for key, unit, other, one in rows:
        meaning = f"{one.meaning}: {one.more}" if one.more else one.meaning
        meaning += f" ([more]({one.see}))" if one.see else ""
        lines.append(f"| `{key}` | {unit} | {f'`{other}`' if other else ''} | {meaning} |")
    return "\n".join(lines)


if __name__ == "__main__":
    PAGE.write_text(filled(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
