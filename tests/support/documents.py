"""The pages of README.md and docs/: their code blocks, the commands in them, and their sentences."""

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

from tree import ROOT

# A comment above a block says what a test is to do with it: `not run: why`, `slow: how long`, `exit: codes`, `file: one to copy here`.
_BLOCK = re.compile(r"((?:<!--[^\n]*-->\n)*)```(\w*)[^\n]*\n(.*?)\n```", re.DOTALL)
_NOTE = re.compile(r"<!-- (not run|slow|exit|needs|file): (.*?) -->")
_SPAN = re.compile(r"(?<!`)`(pans [^`]+)`(?!`)")
SHELL = ("console", "sh")
EXAMPLES = ("python", "pycon")


@dataclass(frozen=True)
class Block:
    """One fenced block: its language, its text, and what the comments above it say."""

    page: Path
    line: int
    language: str
    text: str
    notes: dict[str, str]

    @property
    def script(self) -> str:
        """The block as a shell script: of a console block the lines that follow a prompt, and their continuations."""
        if self.language == "sh":
            return self.text
        lines: list[str] = []
        for line in self.text.split("\n"):
            if line.startswith("$ "):
                lines.append(line[2:])
            elif lines and lines[-1].endswith("\\"):
                lines.append(line)
        return "\n".join(lines)

    @property
    def commands(self) -> list[list[str]]:
        """The words of every `pans` command of the block, without redirections, comments and what follows a pipe."""
        joined = re.sub(r"<<(\w+)\n.*?\n\1", "", self.script.replace("\\\n", " "), flags=re.DOTALL)
        return [words for line in joined.split("\n") for words in pans_commands(line)]


def pans_commands(line: str) -> list[list[str]]:
    """The words behind `pans` of every such command of one line of shell; a pipe, `;`, `&` or a redirection ends a command."""
    lexer = shlex.shlex(line, posix=True, punctuation_chars="|&;<>")
    lexer.whitespace_split = True
    commands: list[list[str]] = [[]]
    for word in lexer:
        if set(word) <= set("|&;<>"):
            commands.append([])
        else:
            commands[-1].append(word)
    return [words[1:] for words in commands if words[:1] == ["pans"]]


def pages(*folders: str) -> list[Path]:
    """README.md and every page below docs/, or only the pages of some of its folders."""
    if folders:
        return sorted(page for folder in folders for page in (ROOT / "docs" / folder).glob("*.md"))
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def blocks(page: Path) -> list[Block]:
    """The fenced blocks of a page, in order."""
    text = page.read_text(encoding="utf-8")
    return [
        Block(page, text.count("\n", 0, m.start()) + 1, m[2], m[3], dict(_NOTE.findall(m[1])))
        for m in _BLOCK.finditer(text)
    ]


def spans(page: Path) -> list[str]:
    """The commands that stand within a line of text, in single backticks."""
    text = _BLOCK.sub("", page.read_text(encoding="utf-8"))
    return [" ".join(span.split()) for span in _SPAN.findall(text)]


def sentences(page: Path) -> list[str]:
    """The sentences of a page's prose: without blocks, tables, comments and headings; a list item ends a sentence."""
    text = _BLOCK.sub("\n\n", page.read_text(encoding="utf-8"))
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    text = re.sub(r"\]\([^)]*\)", "]", text)
    text = re.sub(r"(?m)^\s*(#.*|\|.*|!\[.*)$", "\n", text)
    text = re.sub(r"(?m)^\s*([-*]|\d+\.)\s", "\n\n", text)
    return [
        s for part in re.split(r"\n\s*\n", text) for s in re.split(r"(?<=[.?!])[*_)`]*\s+", " ".join(part.split())) if s
    ]


def indented(page: Path) -> list[str]:
    """Lines of indented blocks that look like commands."""
    text = _BLOCK.sub("", page.read_text(encoding="utf-8"))
    return re.findall(r"(?m)^ {4,}(?:\$ )?(?:pans|python|pip) .*$", text)
