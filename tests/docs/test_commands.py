"""Every command and every example in README.md and docs/ is parsed, and run unless the page says why not.

A page's blocks run one after the other in one empty folder. `pans` commands run in this process; a block with anything else in it is
given to bash.
"""

from __future__ import annotations

import argparse
import doctest
import json
import os
import re
import runpy
import shutil
import signal
import subprocess
import sys
import tomllib
from contextlib import suppress
from pathlib import Path

import pytest
from documents import EXAMPLES, SHELL, Block, blocks, indented, pages, pans_commands, sentences, spans
from tree import ROOT

from pans.app.command import parser_of as command_parser
from pans.app.find_commands import find_commands
from pans.app.main import main

COMMANDS = find_commands()
MOST_WORDS = 40  # of a sentence outside measurements and results, which are mostly figures


def parser_of(name: str) -> argparse.ArgumentParser:
    """The parser of one command, as `pans` itself makes it."""
    return command_parser(name, COMMANDS[name].load())


def check(words: list[str], where: str, whole: bool) -> None:
    """Parse one command line; of one that is only mentioned in a line of text, the command and its options must exist."""
    if words[0] in ("--help", "--version", "-V", "help", "COMMAND"):
        return
    assert words[0] in COMMANDS, f"{where}: pans {words[0]} is no command"
    try:
        parser = parser_of(words[0])
    except ModuleNotFoundError as error:
        pytest.skip(f"pans {words[0]} needs {error.name}")
    known = {option for action in parser._actions for option in action.option_strings}
    assert {word.partition("=")[0] for word in words if word.startswith("--")} <= known, f"{where}: {words}"
    if whole and "..." not in words and "--config" not in words:  # a file may hold what is required
        try:
            parser.parse_args(words[1:])
        except (SystemExit, argparse.ArgumentError) as error:
            pytest.fail(f"{where}: pans {' '.join(words)}: {error}")


@pytest.mark.parametrize("page", pages(), ids=lambda page: str(page.relative_to(ROOT)))
def test_every_command_line_is_one(page: Path) -> None:
    for block in blocks(page):
        if block.language in SHELL:
            for words in block.commands:
                check(words, f"{page.name}:{block.line}", whole=True)
    for span in spans(page):
        for words in pans_commands(span):
            check(words, page.name, whole=page == ROOT / "README.md")


def test_every_command_is_on_the_page_of_commands() -> None:
    """Its options are put there when the site is built."""
    text = (ROOT / "docs/reference/commands.md").read_text(encoding="utf-8")
    sections = {part.split("\n", 1)[0].removeprefix("pans ").strip("` "): part for part in text.split("\n## ")[1:]}
    assert {name for name in COMMANDS if f"<!-- options of pans {name} -->" in sections.get(name, "")} == set(COMMANDS)


def test_every_key_of_a_summary_is_explained(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = (ROOT / "docs/reference/exit-codes.md").read_text(encoding="utf-8")
    assert main(["demo", "--pace", "fast", "--seconds", "1", "--out", str(tmp_path / "demo"), "--json"]) == 0
    assert [key for key in json.loads(capsys.readouterr().out) if f"`{key}`" not in text] == []


def test_the_tables_of_figures_are_those_of_today() -> None:
    """`python docs/assets/figures.py` writes them."""
    made = runpy.run_path(str(ROOT / "docs/assets/figures.py"))
    text = made["PAGE"].read_text(encoding="utf-8")
    assert text.count("<!-- figures: ") == 4
    assert made["filled"](text) == text


def test_every_face_has_a_place_in_the_interface() -> None:
    rooms = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["pans"]["rooms"]
    names = {f"{top}.{room}".rstrip(".") for top, some in rooms.items() for room in some if room != "commands"}
    files = (ROOT / "docs/reference/api").glob("*.md")
    shown = {line for page in files for line in page.read_text(encoding="utf-8").splitlines()}
    assert {f"::: {name}" for name in names} <= shown


def test_what_the_architecture_names_is_there() -> None:
    text = "".join(
        (ROOT / name).read_text(encoding="utf-8") for name in ("docs/explanation/architecture.md", "CONTRIBUTING.md")
    )
    named = re.findall(r"`((?:runtime|trainer|firmware_sim|tests|docs|hw_profiles)/[\w./-]+)(?::([\w.]+))?`", text)
    assert len(named) > 40
    for path, name in named:
        assert (ROOT / path).exists(), path
        source = (ROOT / path).read_text(encoding="utf-8") if name else ""
        for part in name.split(".") if name else ():
            assert re.search(rf"(?m)^\s*(?:def|class) {part}\b|^{part}\b.* = ", source), f"{path}: no {part}"


@pytest.mark.parametrize("name", ["README.md", "CHANGELOG.md", "CONTRIBUTING.md"])
def test_links_into_the_documents_lead_somewhere(name: str) -> None:
    found = re.findall(r"""(?:\]\(|(?:src|srcset)=")(?!http)([^)#"]+)""", (ROOT / name).read_text(encoding="utf-8"))
    assert [link for link in found if not (ROOT / link).exists()] == []


def runnable(page: Path) -> list[Block]:
    """The blocks that the test of a page runs: all but those that say why not, and those of the results, which take hours."""
    found = [] if page.parent.name == "results" else blocks(page)
    return [block for block in found if block.language in (*SHELL, *EXAMPLES) and "not run" not in block.notes]


@pytest.mark.parametrize("page", pages(), ids=lambda page: str(page.relative_to(ROOT)))
def test_no_block_escapes(page: Path) -> None:
    for block in blocks(page):
        known = block.language in (*SHELL, *EXAMPLES, "text", "toml", "json")
        assert known, f"line {block.line}: a block of kind {block.language!r}"
        assert block.notes.get("not run", "why").strip(), f"line {block.line}: no reason"
    assert not indented(page), "a command in an indented block: no test sees it"


def marked(page: Path) -> object:
    slow = any("slow" in block.notes for block in blocks(page))
    return pytest.param(page, id=str(page.relative_to(ROOT)), marks=[pytest.mark.slow] if slow else [])


@pytest.mark.parametrize("page", [marked(page) for page in pages() if runnable(page)])
def test_the_page_does_what_it_says(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]))
    names: dict[str, object] = {"__name__": "page"}
    for block in runnable(page):
        for module in block.notes.get("needs", "").split():
            if module != "data":
                pytest.importorskip(module)
            elif "PANS_DATA" not in os.environ:
                pytest.skip("needs PANS_DATA")
        where = f"{page.relative_to(ROOT)}:{block.line}"
        if "file" in block.notes:
            shutil.copy(ROOT / block.notes["file"], tmp_path)
        if block.language == "python":
            exec(compile(block.text, where, "exec"), names)
        elif block.language == "pycon":
            example = doctest.DocTestParser().get_doctest(block.text, names, where, str(page), block.line)
            found = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(example, clear_globs=False)
            assert found.failed == 0, where
            names.update(example.globs)
        else:
            assert str(run_block(block)) in block.notes.get("exit", "0").split(" or "), where


def run_block(block: Block) -> int:
    """Run a block and return the exit code of its last command; an earlier one must have gone well."""
    script = block.script.replace("\\\n", " ")
    lines = [line for line in script.split("\n") if line.strip() and not line.startswith("#")]
    ours = (line.startswith("pans ") and len(pans_commands(line)) == 1 and not {*line} & {*"|&;<>"} for line in lines)
    if not all(ours):
        shell = subprocess.Popen(["bash", "-ec", block.script], start_new_session=True)
        try:
            return shell.wait(timeout=300)
        finally:
            with suppress(ProcessLookupError):  # what a line that failed left behind
                os.killpg(shell.pid, signal.SIGTERM)
    for line in lines[:-1]:
        assert status(pans_commands(line)[0]) == 0, line
    return status(pans_commands(lines[-1])[0])


def status(words: list[str]) -> int:
    try:
        return main(words)
    except SystemExit as end:
        return int(end.code or 0)


@pytest.mark.parametrize(
    "page", pages("tutorial", "how-to", "reference", "explanation"), ids=lambda page: f"{page.parent.name}/{page.stem}"
)
def test_no_sentence_of_a_page_is_too_long(page: Path) -> None:
    long = [sentence for sentence in sentences(page) if len(sentence.split()) > MOST_WORDS]
    assert not long, "\n".join(long)
