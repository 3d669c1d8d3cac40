"""Examples in docstrings as code blocks: the docstrings are Markdown, where a bare `>>>` would be a quotation in a quotation."""

import re
from typing import Any

import griffe

# A blank line, an example of any length, and what ends it: a blank line or the end of the text.
EXAMPLE = re.compile(r"(?:^|\n)\n*((?:[ ]*)>>> .*?)(?=\n\s*\n(?![ ]*>>>)|\Z)", re.DOTALL)


class Doctests(griffe.Extension):
    """Puts each run of lines from `>>>` to the next blank line into a fence."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        if obj.docstring is not None:
            obj.docstring.value = EXAMPLE.sub(r"\n\n```pycon\n\1\n```\n", obj.docstring.value)
