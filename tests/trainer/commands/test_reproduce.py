"""`pans reproduce`: what it lists, collects and refuses."""

import json
import shutil
import subprocess
import sys

import pytest
from tree import ROOT

from pans.runtime.cli import main
from pans.trainer.commands.reproduce import NAMES


def test_the_command_lists_collects_and_refuses(tmp_path, capsys):
    pytest.importorskip("matplotlib", reason="needs the plot extra")
    assert main(["reproduce", "list", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rows"] == list(NAMES)
    words = ["reproduce", "mnist", "--collect", "--cache", str(tmp_path / "cache"), "--json"]
    assert main([*words, "-o", str(tmp_path / "out")]) == 0
    assert json.loads(capsys.readouterr().out)["rows"] == []
    assert (tmp_path / "out" / "mnist.md").read_text().startswith("# MNIST")
    assert main([*words, "--rows", "5"]) == 2
    assert "mnist has 4, 9, 16" in capsys.readouterr().err


def test_pages_are_listed_without_torch():
    words = "import sys; from pans.trainer.commands import reproduce; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", words], check=False).returncode == 0


@pytest.mark.parametrize("name", ["barcode", "mmf-mnist"])
def test_what_is_not_drawn_has_no_other_draws(name, capsys):
    assert main(["reproduce", name, "--data-seed", "7"]) == 2
    assert f"{name} is not drawn" in capsys.readouterr().err


def test_tables_are_written_again_from_their_json(tmp_path, capsys):
    words = ["reproduce", "sequence", "--from-json", "--json"]
    assert main(words) == 2
    assert "name it by -o DIR" in capsys.readouterr().err
    assert main([*words, "-o", str(tmp_path)]) == 2
    assert "measure it: pans reproduce sequence" in capsys.readouterr().err
    out = tmp_path / "results"
    shutil.copytree(ROOT / "docs" / "results", out)
    whole = (out / "cells.md").read_text()
    (out / "cells.md").write_text(whole.replace("63.91", "99.99"))
    assert main(["reproduce", "all", "--from-json", "-o", str(out), "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert {row["table"] for row in rows} > {"shots", "budgets"}
    assert "one frame, cell in the middle" in {row.get("way") for row in rows}
    assert (out / "cells.md").read_text() == whole
