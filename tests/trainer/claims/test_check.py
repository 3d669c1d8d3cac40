"""`pans reproduce check`: the pages as they are, and a copy broken in each way."""

import json
import shutil

import pytest
from tree import ROOT

pytest.importorskip("torch", reason="needs the train extra")

from pans.runtime.cli import main
from pans.trainer.claims import check as module
from pans.trainer.claims.check import check_folder
from pans.trainer.claims.commands import command_faults
from pans.trainer.claims.index import BEGIN, END
from pans.trainer.claims.sources import Figures
from pans.trainer.claims.versions import version_notes

RESULTS = ROOT / "docs" / "results"
NAME = "time"


def test_text_json_and_command_of_every_page_agree():
    faults, notes = check_folder(RESULTS)
    assert faults == []
    assert {note.kind for note in notes} <= {"version"}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A copy of two pages and an index that counts them."""
    names = (NAME, "alpha")
    for name in names:
        for path in RESULTS.glob(f"{name}*"):
            shutil.copy(path, tmp_path)
    (tmp_path / "README.md").write_text(f"# Index\n\n{BEGIN}\n{END}\n")
    monkeypatch.setattr(module, "PAGES", names)
    assert main(["reproduce", NAME, "--from-json", "-o", str(tmp_path), "--json"]) == 0
    assert check_folder(tmp_path)[0] == []
    return tmp_path


def replaced(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def broken_row(folder):
    page = json.loads((folder / "alpha.json").read_text())
    page["rows"][0]["final"]["value"] += 3
    (folder / "alpha.json").write_text(json.dumps(page))


BREAKS = {
    "table": lambda f: replaced(f / "time.md", "| 10 | 74.31 | ours | yes |", "| 10 | 74.31 | ours | no |"),
    "number": lambda f: replaced(f / "time.md", "more than 23.2 times", "more than 32.2 times"),
    "title": lambda f: replaced(f / "time.md", "# Time to", "# Time until"),
    "command": lambda f: replaced(f / "time.md", "`pans reproduce time`", "`pans reproduce times`"),
    "picture": lambda f: (f / "alpha-10.png").write_bytes(b"no picture"),
    "link": lambda f: replaced(f / "time.md", "Seconds are", "[Seconds](seconds.md) are"),
    "missing": lambda f: (f / "alpha.json").unlink(),
    "count": lambda f: replaced(f / "README.md", "| 2 | 0 | 2 |", "| 1 | 1 | 2 |"),
}


@pytest.mark.parametrize("kind", BREAKS)
def test_what_is_broken_is_found(kind, folder):
    BREAKS[kind](folder)
    assert kind in {one.kind for one in check_folder(folder)[0]}


def test_a_changed_json_is_found_in_table_counts_and_text(folder):
    broken_row(folder)
    assert {(one.page, one.kind) for one in check_folder(folder)[0]} >= {("alpha", "table"), ("README", "count")}


def test_rows_of_different_versions_are_noted(folder):
    page = json.loads((folder / "time.json").read_text())
    page["rows"][0]["options"] = {"seed": 3, "clicks": 1.0}
    page["rows"][1]["options"] = {"seed": 3}
    (folder / "time.json").write_text(json.dumps(page))
    (note,) = check_folder(folder)[1]
    assert note.words == "rows of 2 versions: some lack the options clicks"


def test_rows_of_other_bundles_and_recipes_are_noted(tmp_path):
    for name in ("fig-3", "mnist", "equal-photons"):
        shutil.copy(RESULTS / f"{name}.json", tmp_path)
    assert [*version_notes(Figures(tmp_path), "mnist")] == []
    (one,) = version_notes(Figures(tmp_path), "fig-3")  # the table of FashionMNIST is not there
    assert one.startswith(
        "measured on other bundles than those of the table: fashion-mnist d_f = 3, fashion-mnist d_f = 4"
    )
    page = json.loads((tmp_path / "mnist.json").read_text())
    page["rows"][1]["options"]["epochs"] += 1
    (tmp_path / "mnist.json").write_text(json.dumps(page))
    (one,) = version_notes(Figures(tmp_path), "mnist")
    assert one == "1 of 6 rows are of another recipe than today's: task mnist features 9"
    page = json.loads((tmp_path / "equal-photons.json").read_text())
    page["rows"] = [row | {"options": row["options"] | {"hidden": 7}} for row in page["rows"] if "options" in row][:1]
    (tmp_path / "equal-photons.json").write_text(json.dumps(page))
    (one,) = version_notes(Figures(tmp_path), "equal-photons")
    assert one == "1 of 1 rows are of another recipe than today's: task transient way PANS asked 1.0"


def test_commands_of_a_page():
    made = "<!-- table: begin --> `pans reproduce {}` <!-- table: end -->"
    assert list(command_faults(made.format("mnist"))) == []
    assert "does not parse" in next(command_faults(made.format("nowhere")))
    assert list(command_faults("see `pans reproduce nowhere`, `pans help run`")) == []  # mentioned, not given
    assert list(command_faults("`pans nothing`")) == ["`pans nothing`: pans nothing is no command"]
    assert list(command_faults("`pans reproduce --nothing`")) == [
        "`pans reproduce --nothing`: pans reproduce has no --nothing"
    ]


def test_the_command_tells_and_refuses(folder, capsys):
    capsys.readouterr()
    assert main(["reproduce", "check", "-o", str(folder), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["ok"] is True
    BREAKS["number"](folder)
    assert main(["reproduce", "check", "-o", str(folder)]) == 2
    said = capsys.readouterr().out
    assert "time: number: time.md:" in said
    assert "1 faults" in said
    assert main(["reproduce", "check", "-o", str(folder), "--collect"]) == 2
    assert "--collect: no effect on check" in capsys.readouterr().err
    assert main(["reproduce", "check", "-o", str(folder / "none")]) == 2
    assert "is no folder" in capsys.readouterr().err
