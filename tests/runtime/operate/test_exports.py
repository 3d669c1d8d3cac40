"""Exports for other tools: phconvert reads the Photon-HDF5, Parquet holds every decision, a bundle comes back from ONNX, arrays and PNG."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import Pans, fixed_run

from pans.runtime import SHIPPED
from pans.runtime.bundle.model import load_bundle
from pans.runtime.cli import main
from pans.runtime.core.decision import NO_LABEL
from pans.runtime.errors import DamagedFileError
from pans.runtime.grey_png import png_bytes, read_grey_png
from pans.runtime.operate.parquet import write_rows
from pans.runtime.record import read_recording
from pans.runtime.record.exposures import click_list
from pans.runtime.record.sent_plan import recorded_plan

FASHION = SHIPPED / "fashion10.pans"


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    assert main([*fixed_run(60), "--out", str(folder)]) in (0, 1)
    return folder / "run.pansrec"


def test_phconvert_accepts_and_loads_the_file(recording: Path, tmp_path: Path, pans: Pans) -> None:
    pytest.importorskip("h5py", reason="needs the export extra")
    hdf5 = pytest.importorskip("phconvert.hdf5", reason="needs the dev extra")
    path = tmp_path / "run.h5"
    found = pans("export", recording, "--format", "photon-hdf5", "-o", path)
    source = read_recording(recording)
    hdf5.assert_valid_photon_hdf5(str(path), warnings=False, strict_description=True, require_rootformat=True)
    loaded = hdf5.load_photon_hdf5(str(path))
    try:
        times = loaded.root.photon_data.timestamps.read()
        clicks = click_list(source, recorded_plan(source))
        assert len(times) == found["clicks"]
        assert times.tolist() == clicks.start_tick.tolist()
        names = [name.decode() for name in loaded.root.user.pans.classes.read()]
        assert tuple(names) == source.bundle().classes
        assert loaded.root.identity.format_name.read() == b"Photon-HDF5"
        assert loaded.root.description.read().startswith(b"SIMULATED")
    finally:
        loaded.close()


def test_parquet_holds_every_decision(recording: Path, tmp_path: Path, pans: Pans) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs the parquet extra")
    path = tmp_path / "decisions.parquet"
    pans("export", recording, "--format", "parquet", "-o", path)
    table = parquet.read_table(path)
    source = read_recording(recording)
    rows, classes = source.decisions(), source.bundle().classes
    columns = {name: table[name].to_pylist() for name in table.column_names}
    assert columns["decision"] == rows["index"].tolist()
    for name, field in (("tick", "tick"), ("clicks", "clicks"), ("object", "object"), ("flags", "flags")):
        assert columns[name] == rows[field].tolist()
    known = (rows["label"] != NO_LABEL).tolist()
    labels, probabilities, truths = (rows[name].tolist() for name in ("label", "probability", "truth"))
    assert columns["class"] == [classes[label] if one else None for label, one in zip(labels, known)]
    assert columns["truth"] == [None if truth < 0 else truth for truth in truths]
    assert columns["probability"] == [p if one else None for p, one in zip(probabilities, known)]
    facts = json.loads(table.schema.metadata[b"pans"])
    assert (facts["simulated"], facts["decisions_sha256"]) == (True, source.decisions_sha256)


def test_rows_of_mixed_kinds_become_columns(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs the parquet extra")
    write_rows(tmp_path / "t.parquet", [{"a": 1, "b": "x", "c": [1]}, {"a": 2.5, "d": True}, {"b": 3}])
    table = parquet.read_table(tmp_path / "t.parquet").to_pydict()
    assert table == {"a": [1.0, 2.5, None], "b": ['"x"', None, "3"], "c": ["[1]", None, None], "d": [None, True, None]}


@pytest.mark.parametrize("way", ["npy", "png"])
def test_a_bundle_comes_back_from_its_exports(way: str, tmp_path: Path, pans: Pans) -> None:
    out, head = tmp_path / "parts", tmp_path / "head.onnx"
    facts = pans("export", FASHION, "--format", way, "-o", out)
    pans("export", FASHION, "--format", "onnx", "-o", head)
    classes = ",".join(facts["classes"])
    words = ["--head", head, "--classes", classes, "--levels", facts["levels"], "-o", tmp_path / "b.pans"]
    white = [] if way == "npy" else ["--photons-at-white", facts["photons_at_white"]]
    words += ["--patterns", out / "patterns.npy" if way == "npy" else out, *white]
    pans("bundle", *words)
    (before, _), (after, _) = load_bundle(FASHION), load_bundle(tmp_path / "b.pans")
    assert (after.pattern_levels == before.pattern_levels).all()
    assert after.photons_per_level == pytest.approx(before.photons_per_level, rel=1e-12)
    assert (after.image_shape, after.classes) == (before.image_shape, before.classes)
    assert before.table is not None
    assert after.table is not None
    assert (after.table == before.table).all()


def test_the_exported_head_is_an_onnx_model_that_says_what_it_is(tmp_path: Path, pans: Pans) -> None:
    onnx = pytest.importorskip("onnx", reason="needs the test extra")
    import onnxruntime

    path = tmp_path / "head.onnx"
    pans("export", FASHION, "--format", "onnx", "-o", path)
    model = onnx.load(path)
    onnx.checker.check_model(model)
    facts = json.loads({entry.key: entry.value for entry in model.metadata_props}["pans.about"])
    bundle = load_bundle(FASHION)[0]
    assert facts["classes"] == list(bundle.classes)
    session = onnxruntime.InferenceSession(path)
    scores = session.run(None, {session.get_inputs()[0].name: bundle.golden_means})[0]
    assert np.allclose(scores, bundle.golden_scores, atol=1e-5)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_png_pictures_are_those_of_other_readers(dtype: Any, tmp_path: Path) -> None:
    image = pytest.importorskip("PIL.Image", reason="needs the train extra")
    top = np.iinfo(dtype).max
    grey = np.random.default_rng(1).integers(0, top + 1, (7, 5)).astype(dtype)
    (tmp_path / "ours.png").write_bytes(png_bytes(grey))
    assert (np.asarray(image.open(tmp_path / "ours.png")) == grey).all()
    smooth = np.linspace(0, top, 640).reshape(20, 32).astype(dtype)
    image.fromarray(smooth).save(tmp_path / "theirs.png", optimize=True)  # with filters
    found = read_grey_png((tmp_path / "theirs.png").read_bytes(), "theirs.png")
    assert (np.rint(found * top) == smooth).all()


def test_damaged_pictures_are_refused(tmp_path: Path) -> None:
    data = png_bytes(np.zeros((4, 4), np.uint8))
    wrong = [b"", b"GIF89a", data[:-1], data[:20], data[:40] + b"x" + data[41:], data.replace(b"IHDR", b"JHDR")]
    wrong += [data[:cut] for cut in range(8, len(data), 3)]
    for one in wrong:
        with pytest.raises(DamagedFileError, match="not a readable grey PNG"):
            read_grey_png(one, "p.png")
