"""Products are chosen by what a child process computes: a machine that announces an instruction and refuses it trains all the same."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from trainings import practice_folder

from pans.bundle.sensor.bundle import load_bundle
from pans_trainer import processor
from pans_trainer.device import product_dtype
from pans_trainer.processor import FASTER, LIMITS, Trial, choose

REFUSING = Path(__file__).parents[1] / "support" / "refusing_torch"
AMX = {"ONEDNN_MAX_CPU_ISA": "AVX512_CORE_BF16"}
QUICK = ("--encoder", "automaton", "--exposures", "3", "--states", "4", "--epochs", "2", "--photons", "5")
TRIED = 2  # of the environments: of those behind them, which is the fastest is a matter of the hour
SETTLE = (
    f"from pans_trainer import processor as p; p.LIMITS = p.LIMITS[:{TRIED}]; c = p.settle(); "
    "print(c.products, sorted(c.limits.values()))"
)


def refusing(tmp_path: Path, how: str) -> dict[str, str]:
    """Return the environment of a process whose torch refuses what its processor announces."""
    path = os.pathsep.join(filter(None, (str(REFUSING), os.environ.get("PYTHONPATH"))))
    kept = {name: value for name, value in os.environ.items() if name not in LIMITS[-1]}
    return {**kept, "PANS_REFUSES": how, "PYTHONPATH": path, "XDG_CACHE_HOME": str(tmp_path / "cache")}


def ran(env: dict[str, str], *words: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    done = subprocess.run([sys.executable, *words], env=env, cwd=cwd, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stdout + done.stderr
    return done


def trial(float32: float | None, bfloat16: float | None, limits: dict[str, str] | None = None) -> Trial:
    rates = {"float32": float32, "bfloat16": bfloat16}
    works = {name: rate for name, rate in rates.items() if rate is not None}
    return Trial(limits or {}, works, {name: "refused" for name in rates if name not in works})


@pytest.mark.parametrize(
    ("trials", "products", "limits"),
    [
        ([trial(108, 487)], "bfloat16", {}),
        ([trial(117, 24)], "float32", {}),  # emulated
        ([trial(100, 100 * FASTER * 0.99)], "float32", {}),  # coarser, and hardly faster
        ([trial(None, None), trial(117, 71, AMX)], "float32", AMX),
        ([trial(110, None), trial(112, 480, AMX)], "bfloat16", AMX),
        ([trial(110, None), trial(112, None, AMX)], "float32", {}),
        ([trial(None, 500), trial(90, None, AMX)], "float32", AMX),  # convolutions are of float32 in any case
        ([trial(None, None), trial(None, None, AMX)], "float32", {}),
    ],
)
def test_the_fastest_that_works_is_taken(trials, products, limits):
    chosen = choose(trials)
    assert (chosen.products, chosen.limits) == (products, limits)


def test_the_type_of_products_works_in_this_process():
    dtype = product_dtype()
    drawn = np.random.default_rng(1)
    a, b = drawn.random((70, 300), np.float32), drawn.random((300, 90), np.float32)
    found = (torch.from_numpy(a).to(dtype) @ torch.from_numpy(b).to(dtype)).float().numpy()
    np.testing.assert_allclose(found, a.astype(float) @ b, rtol=2e-2)


@pytest.mark.parametrize("how", ["die", pytest.param("raise", marks=pytest.mark.slow)])
def test_refused_products_and_convolutions_are_found_out_once(tmp_path, how, monkeypatch):
    answer = "float32 ['AVX512_CORE_BF16']"
    env = refusing(tmp_path, how)
    first = ran(env, "-c", SETTLE)
    assert first.stdout.strip() == answer
    assert "once per machine" in first.stderr
    # by the environment before and after the choice
    kept, inherited = (tmp_path / "cache" / "pans").glob("products-*")
    told = json.loads(kept.read_text())
    reasons = {reason for tried in told["trials"] for reason in tried["failed"].values()}
    assert reasons == {"SIGILL" if how == "die" else "RuntimeError: could not create a primitive"}
    again = ran(env, "-c", SETTLE)
    assert again.stdout.strip() == answer
    assert "once per machine" not in again.stderr
    monkeypatch.setattr(processor, "LIMITS", LIMITS[:TRIED])
    for name in ("XDG_CACHE_HOME", *LIMITS[TRIED - 1]):
        monkeypatch.setenv(name, env[name]) if name in env else monkeypatch.delenv(name, raising=False)
    found = processor._kept()
    assert (found.products, found.limits) == ("float32", LIMITS[1])
    for file in (kept, inherited):
        file.write_text('{"products": "float64"}')  # of another version, or damaged
    assert processor._kept() is None


@pytest.mark.skipif(sys.platform != "linux", reason="a kept answer is tried by fork")
@pytest.mark.parametrize("how", ["die", "raise"])
def test_an_answer_that_no_longer_holds_is_found_anew(tmp_path, how):
    """As on a virtual machine that moved: what was kept where everything worked fails now."""
    before = ran(refusing(tmp_path, ""), "-c", SETTLE)
    assert before.stdout.strip().endswith("[]")
    moved = refusing(tmp_path, how)
    found = ran(moved, "-c", SETTLE)
    assert found.stdout.strip() == "float32 ['AVX512_CORE_BF16']"
    assert "the products found here before fail now" in found.stderr
    again = ran(moved, "-c", SETTLE)
    assert again.stdout == found.stdout
    assert "fail now" not in again.stderr


def test_the_answer_is_kept_by_processor(monkeypatch):
    monkeypatch.setattr(processor, "_cpu", lambda: "model name: one, microcode: 0x1")
    here = processor._file()
    monkeypatch.setattr(processor, "_cpu", lambda: "model name: one, microcode: 0x2")
    assert processor._file() != here


def test_training_and_convolutions_run_where_torch_refuses(tmp_path):
    env = refusing(tmp_path, "raise-unlimited")
    out = tmp_path / "strings.pans"
    said = ran(env, "-m", "pans", "train", "barcode", *QUICK, "-v", "-o", str(out)).stderr
    assert "products" in said
    assert "ONEDNN_MAX_CPU_ISA=AVX512_CORE_BF16" in said
    assert "ONEDNN_MAX_CPU_ISA=AVX512_CORE_BF16" in load_bundle(out)[0].provenance["trained_with"]
    convolve = "from pans_trainer.baselines.networks import FrameNet; import torch; "
    convolve += "FrameNet((28, 28), 10)(torch.rand(3, 784)).sum().backward()"
    ran(env, "-c", convolve)


@pytest.mark.slow  # kernels of another target are compiled anew
@pytest.mark.parametrize(
    "limits", [{"NUMBA_CPU_NAME": "generic"}, {"ONEDNN_MAX_CPU_ISA": "SSE41"}, {"PANS_REFUSES": "die"}], ids=str
)
def test_training_own_images_and_the_demo_on_a_plain_processor(tmp_path, limits):
    env = {**refusing(tmp_path, ""), **limits, "NUMBA_CACHE_DIR": str(tmp_path / "kernels")}
    practice_folder(tmp_path / "letters", "letters", 150)
    ran(env, "-m", "pans", "train", "barcode", *QUICK, "-o", "strings.pans", cwd=tmp_path)
    ran(env, "-m", "pans", "train", "letters", "--exposures", "4", "--states", "8", "-o", "letters.pans", cwd=tmp_path)
    shown = json.loads(ran(env, "-m", "pans", "demo", "--pace", "fast", "--json", cwd=tmp_path).stdout)
    assert shown["verdict"] == "PASS"
