"""Commands warn where the laws of a profile's detector do not hold as stated, and say nothing of a shipped profile."""

from pathlib import Path

import pytest
from commands import Pans

from pans.app.main import main
from pans.base import SHIPPED
from pans.instrument.profile import load_profile

REACHES = "dead_time_ns reaches"
ADAPTIVE = SHIPPED / "fashion-adaptive.pans"


def microled(tmp_path: Path, *, blinded: bool) -> str:
    """The shipped microLED profile with a finer dwell; `blinded`: its detector stays on, dead from one shortest exposure to the next."""
    profile = load_profile("microled-spad")
    dead = 1000 * (profile.exposure.min_us + profile.exposure.readout_us)
    changes = {"dwell_steps = 100\n": "dwell_steps = 1000\n"}
    if blinded:
        changes["dead_time_ns = 35.0"] = f'dead_time_ns = {dead}\nbetween_exposures = "free-running"'
    text = profile.text
    for old, new in changes.items():
        assert text.count(old) == 1
        text = text.replace(old, new)
    (tmp_path / "led.toml").write_text(text)
    return str(tmp_path / "led.toml")


def test_a_check_of_a_profile_warns(tmp_path: Path, pans: Pans) -> None:
    (row,) = pans("profile check", microled(tmp_path, blinded=True))["rows"]
    assert len(row["warnings"]) == 1
    assert REACHES in row["warnings"][0]
    assert pans("profile check microled-spad")["rows"][0]["warnings"] == []


@pytest.mark.parametrize("blinded", [False, True])
def test_a_run_warns(blinded: bool, tmp_path: Path, pans: Pans) -> None:
    profile = microled(tmp_path, blinded=blinded)
    device = f"sim:{profile}?scene=fashion200&pace=fast&seed=1"
    words = ("--profile", profile, "--decisions", "2", "--no-realtime", "--out", str(tmp_path / "run"))
    assert main(["run", str(ADAPTIVE), "--device", device, *words]) in (0, 1)
    assert (REACHES in pans.said().err) is blinded


@pytest.mark.parametrize(
    "size",
    [("active", "--features", "3"), ("automaton", "--exposures", "3", "--states", "4")],
    ids=lambda size: size[0],
)
def test_a_training_warns(size: tuple[str, ...], tmp_path: Path, pans: Pans) -> None:
    pytest.importorskip("torch", reason="needs the train extra")
    words = ("train", "barcode", "--photons", "4", "--epochs", "1", "-o", str(tmp_path / "out.pans"))
    assert REACHES in pans.refuses(*words, "--profile", microled(tmp_path, blinded=True), "--encoder", *size, code=0)
