"""Completion scripts: bash itself completes with ours; zsh and fish get every command and option."""

import contextlib
import io
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from pans.app.find_commands import find_commands
from pans.app.main import main

TRY = """
source "$1"; shift
COMP_WORDS=("$@"); COMP_CWORD=$(($#-1)); COMPREPLY=(); _pans
printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.fixture(scope="module")
def scripts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("scripts")
    found = {}
    for shell in ("bash", "zsh", "fish"):
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            assert main(["completion", shell]) == 0
        found[shell] = folder / shell
        found[shell].write_text(printed.getvalue())
    return found


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
@pytest.mark.parametrize(
    ("line", "wanted"),
    [
        ("pans ver", "verify"),
        ("pans help comp", "compare completion"),
        ("pans run --on", "--on-dark"),
        ("pans run --on-dark ", "warn tables mask abstain"),
        ("pans -q bench li", "link"),
        ("pans verify no-such-file", ""),
        ("pans run --record fir", "first.pansrec"),
    ],
)
def test_bash_completes(scripts: dict[str, Path], line: str, wanted: str, tmp_path: Path) -> None:
    (tmp_path / "first.pansrec").touch()
    words = ["bash", "-c", TRY, "-", str(scripts["bash"]), *line.split(" ")]
    done = subprocess.run(words, capture_output=True, text=True, cwd=tmp_path, check=True)
    assert ({*done.stdout.split()}, done.stderr) == ({*wanted.split()}, "")


def test_every_shell_knows_every_command(scripts: dict[str, Path]) -> None:
    for path in scripts.values():
        known = {*re.findall(r"[\w-]+", path.read_text())}
        assert {*find_commands()} <= known
    assert "-l on-dark -x -a 'warn tables mask abstain'" in scripts["fish"].read_text()
    assert "bashcompinit" in scripts["zsh"].read_text()
