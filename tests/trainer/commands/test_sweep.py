"""Sweeps: a study goes on where it was, two workers share it, another question is refused."""

import json
import subprocess
import sys

import numpy as np
import pytest
from databases import postgres_server

optuna = pytest.importorskip("optuna", reason="needs the sweep extra")
from pans.app.main import main  # noqa: E402


@pytest.fixture(params=["journal", "postgresql"])
def storage(request, tmp_path):
    """A journal file, or a database of a server that is started for the test."""
    if request.param == "journal":
        yield str(tmp_path / "study.journal")
        return
    pytest.importorskip("psycopg", reason="needs the postgres extra")
    with postgres_server() as url:
        yield url


@pytest.fixture
def words(tmp_path, storage):
    rng = np.random.default_rng(0)
    labels = rng.integers(0, 2, 60)
    images = rng.integers(0, 50, (60, 3, 3), dtype=np.uint8)
    images[labels == 1, :, 1] = 250
    np.savez(tmp_path / "bars.npz", images=images, labels=labels)
    shared = ["sweep", str(tmp_path / "bars.npz"), "--features", "2", "--epochs", "2", "--hidden", "4"]
    return [*shared, "--storage", storage, "--json"]


def test_a_study_goes_on_and_refuses_another_question(words, pans):
    first = pans(*words, "--trials", "2")
    assert (first["trials"], set(first["best"])) == (2, {"front_rate", "head_rate", "warm", "batch", "light", "alpha"})
    again = pans(*words, "--trials", "3")
    assert again["trials"] == 3
    assert again["best_loss"] <= first["best_loss"]
    assert main([*words, "--trials", "3"]) == 0  # nothing left to do
    assert json.loads(pans.said().out)["trials"] == 3
    assert "clicks None (now 1.0)" in pans.refuses(*words, "--trials", "3", "--clicks", "1")


def test_two_workers_share_a_study_and_a_killed_one_costs_its_trial_alone(words, pans):
    command = [
        sys.executable,
        "-P",  # not the working folder: its metadata may be old
        "-c",
        "import sys; from pans.app.main import main; sys.exit(main(sys.argv[1:]))",
        *words,
    ]
    killed = subprocess.Popen(
        [*command, "--trials", "1000"], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    assert any(line.startswith("trial ") for line in killed.stderr)  # one is finished and the next begun
    killed.kill()
    killed.wait()
    killed.stderr.close()
    other = subprocess.Popen([*command, "--trials", "6"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    mine = pans(*words, "--trials", "6")
    theirs = json.loads(other.communicate()[0])
    assert other.returncode == 0
    assert mine["trials"] >= 6
    assert theirs["trials"] >= 6


@pytest.mark.parametrize(
    "url", ["nonsense://x/y", "postgresql://lab:secret@127.0.0.1:1/none", "sqlite:////nowhere/at/all.db"]
)
def test_databases_that_cannot_be_opened_are_told_without_their_password(url):
    from pans.base.errors import UsageError
    from pans_trainer.commands.sweep import open_storage

    with pytest.raises(UsageError, match="--storage") as caught:
        open_storage(url)
    assert "secret" not in str(caught.value)
    assert caught.value.remedy
