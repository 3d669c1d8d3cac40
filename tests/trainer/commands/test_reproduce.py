"""`pans reproduce`: what it lists, collects and refuses."""

import shutil
import subprocess
import sys

import pytest
from tree import ROOT

from pans_trainer.commands.reproduce import NAMES


def test_the_command_lists_collects_and_refuses(tmp_path, pans):
    pytest.importorskip("matplotlib", reason="needs the plot extra")
    assert pans("reproduce", "list")["rows"] == list(NAMES)
    words = ["reproduce", "mnist", "--collect", "--cache", str(tmp_path / "cache"), "--json"]
    assert pans(*words, "-o", tmp_path / "out")["rows"] == []
    assert (tmp_path / "out" / "mnist.md").read_text().startswith("# MNIST")
    assert "mnist has 4, 9, 16" in pans.refuses(*words, "--rows", "5")


def test_pages_are_listed_without_torch():
    words = "import sys; from pans_trainer.commands import reproduce; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", words], check=False).returncode == 0


@pytest.mark.parametrize("name", ["barcode", "mmf-mnist"])
def test_what_is_not_drawn_has_no_other_draws(name, pans):
    assert f"{name} is not drawn" in pans.refuses("reproduce", name, "--data-seed", "7")


def test_tables_are_written_again_from_their_json(tmp_path, pans):
    words = ["reproduce", "sequence", "--from-json", "--json"]
    assert "name it by -o DIR" in pans.refuses(*words)
    assert "measure it: pans reproduce sequence" in pans.refuses(*words, "-o", tmp_path)
    out = tmp_path / "results"
    shutil.copytree(ROOT / "docs" / "results", out)
    whole = (out / "cells.md").read_text()
    (out / "cells.md").write_text(whole.replace("63.91", "99.99"))
    rows = pans("reproduce", "all", "--from-json", "-o", out)["rows"]
    assert {row["table"] for row in rows} > {"shots", "budgets"}
    assert "one frame, cell in the middle" in {row.get("way") for row in rows}
    assert (out / "cells.md").read_text() == whole
