"""Examples in docstrings as code blocks: the docstrings are Markdown, where a bare `>>>` would be a quotation in a quotation."""

import re
from typing import Any

import griffe

# An example begins with a prompt and ends with a blank line that no further prompt follows, or with the text.
EXAMPLE = re.compile(r"(?:^|\n)\n*((?:[ ]*)>>> .*?)(?=\n\s*\n(?![ ]*>>>)|\Z)", re.DOTALL)


class Doctests(griffe.Extension):
    """Puts every example of a docstring into a fence."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Change the docstring of a module, class or function below the top package."""
        if obj.docstring is not None:
            obj.docstring.value = EXAMPLE.sub(r"\n\n```pycon\n\1\n```\n", obj.docstring.value)

    def on_package(self, *, pkg: griffe.Module, **_: Any) -> None:
        """Change the docstring of the top package, which is no object of another."""
        self.on_object(obj=pkg)
