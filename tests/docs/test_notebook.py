"""The notebook of the tutorial: a valid file whose cells run in order."""

import json

import numpy as np
import pytest
from tree import ROOT

NOTEBOOK = ROOT / "docs/tutorial/recording.ipynb"


def test_the_cells_of_the_notebook_run_in_order(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    notebook = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    assert notebook["nbformat"] == 4
    names: dict[str, object] = {"__name__": "notebook"}
    for cell in notebook["cells"]:
        assert cell["id"]
        if cell["cell_type"] == "code":
            assert cell["outputs"] == []  # figures of one machine would be taken for those of another
            exec(compile("".join(cell["source"]), f"{NOTEBOOK.name}:{cell['id']}", "exec"), names)
    said = capsys.readouterr().out
    assert "clicks per decision" in said
    assert "is taken for" in said
    decisions = names["decisions"]
    assert isinstance(decisions, np.ndarray)
    assert len(decisions) == 200
    assert names["accuracy"] == pytest.approx((decisions["label"] == decisions["truth"]).mean())
    assert np.asarray(names["confusion"]).sum() == 200
    assert (tmp_path / "notebook-run").is_dir()
