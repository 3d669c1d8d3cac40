"""The reader written from the documents alone against recordings of the package: same decisions, bit for bit."""

from __future__ import annotations

import secrets
import struct
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bundles import made_bundle
from heads import onnx_chain, random_layers
from lab_bundle import read_bundle
from lab_decisions import decide_again
from lab_recording import NO_NUMBER, read_recording
from tree import ROOT

from pans.app.main import main
from pans.base.errors import EXIT_DEVICE, UsageError
from pans.bundle.heads.layers import quantise_head
from pans.bundle.sensor import Bundle, load_bundle, write_bundle
from pans.record.reading import read_recording as our_reader
from pans.record.reading.exposures import click_list
from pans.record.reading.sent_plan import recorded_plan
from pans.record.tables import to_frame, to_xarray
from pans.record.tables.tables import click_table

D_F, CLASSES, LEVELS = 6, 4, 16
EXPOSURE_US = 100.0
PEAK_HZ = 20_000.0
FASHION = ROOT / "runtime/pans/shipped" / "fashion10.pans"
TROUBLE = "loss:0.02,flip:0.01,duplicate:0.03,reorder:0.03,drip:0.02,stall:300ms/900ms,disconnect:100ms/1500ms,reset:0ms/2500ms"


@dataclass(frozen=True)
class Case:
    """One still run and how it decides."""

    mode: str
    backend: str
    shots: int = 1
    trials: int = 1
    order: str = "auto"
    faults: str = ""
    decisions: int = 60
    outcomes: int = 2  # of an exposure


CASES = [
    Case("sequential", "table", trials=3),
    Case("sequential", "float64", shots=3, trials=2, order="pattern-major"),
    Case("sequential", "int8", shots=5, order="shot-major"),
    Case("parallel", "float64", shots=2, trials=2),
    Case("parallel", "table", trials=5),
    Case("sequential", "table", trials=2, order="shot-major", faults=TROUBLE, decisions=3000),
    Case("parallel", "int8", shots=4, trials=3, faults=TROUBLE, decisions=6000),
]
COUNTED = [  # photon numbers
    Case("sequential", "table", trials=3, outcomes=4),
    Case("sequential", "float64", shots=3, trials=2, order="pattern-major", outcomes=3),
    Case("sequential", "int8", shots=2, order="shot-major", outcomes=16),
    Case("sequential", "float64", trials=2, order="shot-major", faults=TROUBLE, decisions=2000, outcomes=3),
]


def small_bundle(backend: str, outcomes: int = 2) -> Bundle:
    rng = np.random.default_rng(5)
    levels = rng.integers(0, LEVELS, (D_F, 4)).astype(np.uint16)
    levels[0, 0] = LEVELS - 1
    parts: dict[str, object] = {"table": rng.normal(size=(outcomes**D_F, CLASSES)).astype(np.float32)}
    if backend != "table":
        layers = random_layers([D_F, 24, 10, CLASSES], seed=3)
        parts = {"head_onnx": onnx_chain(layers, "transposed"), "int8_head": quantise_head(layers)}
    scale = PEAK_HZ * EXPOSURE_US * 1e-6 / (LEVELS - 1)
    facts = {"image_shape": (2, 2), "levels": LEVELS, "pattern_levels": levels, "photons_per_level": scale}
    return made_bundle(D_F, CLASSES, outcomes=outcomes, **facts, **parts)


def small_profile(mode: str) -> str:
    """The shipped profile `ideal` with other figures, in either mode."""
    text = (ROOT / "hw_profiles" / "ideal.toml").read_text().replace('"sequential"', f'"{mode}"')
    text = text.replace("levels = 65_536", f"levels = {LEVELS}").replace("hz = 10_000.0", f"hz = {PEAK_HZ}")
    text = text.replace("dark_rate_hz = 0.0", "dark_rate_hz = 50.0")
    return text if mode == "sequential" else text.replace("channels = 1\n", f"channels = {D_F}\n")


def record(folder: Path, case: Case, bundle: Path) -> Path:
    """Make a recording with `pans run` in virtual time; its seed is chosen here and printed."""
    (folder / "small.toml").write_text(small_profile(case.mode))
    rng = np.random.default_rng(1)
    np.savez(
        folder / "scene.npz", images=rng.integers(0, 256, (5, 2, 2)).astype(np.uint8), labels=np.arange(5) % CLASSES
    )
    faults = f"&faults={case.faults}" if case.faults else ""
    options = {"shots": case.shots, "trials": case.trials, "decisions": case.decisions, "backend": case.backend}
    words = [word for name, value in options.items() for word in (f"--{name}", str(value))]
    words += ["--order", case.order, "--out", str(folder / "out"), "--reconnect-s", "60", "--json"]
    for _ in range(5):  # a link that breaks before the first ARM ends the run: there is nothing to come back to
        seed = secrets.randbelow(1 << 32)
        print(f"seed {seed}")
        device = f"sim:{folder}/small.toml?scene={folder}/scene.npz&seed={seed}&pace=fast{faults}"
        if main(["run", str(bundle), "--device", device, *words, "--force"]) != EXIT_DEVICE:
            break
    return folder / "out" / "run.pansrec"


def clicks_by_decision(recording: Any, n: int) -> list[float]:
    """Return the clicks, or photons, of each decision, added up from the table of clicks alone."""
    plan = recorded_plan(recording)
    table = click_table(recording, plan, click_list(recording, plan))
    counted = ~np.ma.getmaskarray(table["decision"])
    weights = table["photons"].filled(1)[counted]
    return np.bincount(table["decision"][counted], weights, n).tolist()


@pytest.mark.parametrize(
    "case", [*CASES, *COUNTED], ids=lambda case: f"{case.mode}-{case.backend}-{bool(case.faults)}-{case.outcomes}"
)
def test_decisions_come_out_the_same(tmp_path: Path, case: Case) -> None:
    write_bundle(small_bundle(case.backend, case.outcomes), tmp_path / "small.pans")
    path = record(tmp_path, case, tmp_path / "small.pans")
    recording = read_recording(path.read_bytes())
    assert recording.timings == our_reader(path).timings().tolist()
    assert recording.bundle == (tmp_path / "small.pans").read_bytes()
    assert recording.header["config"]["backend"] == case.backend
    assert struct.unpack_from("<I", path.read_bytes(), 8)[0] == 1
    rows = decide_again(recording, read_bundle(recording.bundle))
    for found, logged in zip(rows, recording.rows):
        assert found == logged
    assert rows.tobytes() == recording.rows.tobytes()
    assert len(rows) >= case.decisions // 2
    if case.outcomes > 2:
        assert rows["clicks"].max() > D_F * case.shots  # more than a click each
    assert clicks_by_decision(our_reader(path), len(rows)) == rows["clicks"].tolist()
    if case.faults:
        assert 0 < np.count_nonzero(rows["flags"]) < len(rows)


def test_frames_hold_what_the_lab_reads(tmp_path: Path) -> None:
    pytest.importorskip("pandas", reason="needs the frames extra")
    pytest.importorskip("xarray", reason="needs the frames extra")
    case = Case("sequential", "table", trials=2, order="shot-major", faults=TROUBLE, decisions=900)
    write_bundle(small_bundle(case.backend), tmp_path / "small.pans")
    path = record(tmp_path, case, tmp_path / "small.pans")
    lab, ours = read_recording(path.read_bytes()), our_reader(path)
    frame, data = to_frame(ours), to_xarray(ours)
    columns = {"decision": "index", "exposure": "exposure_index", "first_shot": "shot"}
    for name in ("decision", "tick", "exposure", "object", "first_shot", "clicks", "flags"):
        assert frame[name].tolist() == data[name].values.tolist() == lab.rows[columns.get(name, name)].tolist()
    for name, none in (("label", NO_NUMBER), ("truth", -1)):
        wanted = [-1 if value == none else value for value in lab.rows[name].tolist()]
        assert frame[name].fillna(-1).tolist() == data[name].values.tolist() == wanted
    decided = lab.rows["label"] != NO_NUMBER
    assert decided.any()
    assert not decided.all()
    assert frame.probability[decided].tolist() == lab.rows["probability"][decided].tolist()
    assert frame.probability.isna().tolist() == (~decided).tolist()
    times = np.array(lab.timings)
    timed = np.isin(lab.rows["index"], times[:, 0])  # one that an outage ended may have no times
    assert ours.virtual_time
    assert frame.latency_us.isna().all()  # there is none in virtual time
    assert np.isnan(data.latency_us.values).all()
    # the same file, as one of a run in real time
    real = to_frame(replace(ours, header={**ours.header, "virtual_time": False}, summary={}))
    assert real.latency_us.isna().tolist() == frame.index.isna().tolist() == (~timed).tolist()
    assert real.latency_us[timed].to_numpy() == pytest.approx((times[:, 3] - times[:, 1]) / 1000, abs=6e-4)
    zero_ns = min(sent for sent, _ in lab.commands)
    begun = np.datetime64(lab.header["created_utc"].removesuffix("+00:00"), "ns")
    shown = frame.index.tz_localize(None).values
    assert (shown[timed] - begun).astype(int).tolist() == (times[:, 1] - zero_ns).tolist()
    np.testing.assert_array_equal(data.time.values, shown)
    assert (frame.attrs["units"]["latency_us"], data.latency_us.attrs["units"]) == ("us", "us")
    with pytest.raises(UsageError, match="decisions or clicks"):
        to_frame(ours, "photons")


def test_a_head_of_hundreds_of_units(tmp_path: Path) -> None:
    device = f"sim:oled-qcmos?seed={secrets.randbelow(1 << 32)}&pace=fast"
    options = ["--decisions", "100", "--shots", "2", "--backend", "float64", "--out", str(tmp_path), "--json"]
    assert main(["run", str(FASHION), "--device", device, *options]) in (0, 1)  # 1: something rare was noticed
    recording = read_recording((tmp_path / "run.pansrec").read_bytes())
    rows = decide_again(recording, read_bundle(recording.bundle))
    assert rows.tobytes() == recording.rows.tobytes()
    assert len(rows) == 100


def test_a_bundle_means_the_same() -> None:
    bundle, (known, sha256) = read_bundle(FASHION.read_bytes()), load_bundle(FASHION)
    assert bundle.sha256 == sha256
    assert bundle.header["classes"] == list(known.classes)
    assert [layer.weights.shape for layer in bundle.layers()] == [(10, 512), (512, 10)]
    for means, scores in zip(bundle.parts["golden_means"], bundle.parts["golden_scores"]):
        x = means.astype(np.float64)
        for weights, bias, relu in bundle.layers():
            x = x @ weights + bias
            x = np.maximum(x, 0) if relu else x
        assert np.abs(x - scores).max() <= 1e-5 * max(1.0, np.abs(scores).max())
