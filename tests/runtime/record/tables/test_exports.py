"""Exports: every click and decision of a run from CSV, Photon-HDF5 and Parquet; a bundle comes back from ONNX, arrays and PNG."""

import contextlib
import csv
import json
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bundles import made_bundle
from commands import Pans, fixed_run, json_of
from heads import onnx_chain, random_layers

from pans.app.main import main
from pans.base import SHIPPED
from pans.base.errors import DamagedFileError, UsageError
from pans.base.files.images import grey_png, read_grey_png
from pans.bundle.backends import NO_LABEL
from pans.bundle.heads.onnx_check import check_head
from pans.bundle.sensor.bundle import load_bundle, write_bundle
from pans.instrument.profile import load_profile
from pans.record.reading import read_recording
from pans.record.reading.exposures import click_list
from pans.record.reading.sent_plan import recorded_plan
from pans.record.tables import to_frame, to_xarray
from pans.record.tables.parquet import write_rows

FASHION = SHIPPED / "fashion10.pans"


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    assert main([*fixed_run(60), "--out", str(folder)]) in (0, 1)
    return folder / "run.pansrec"


@pytest.mark.filterwarnings("error")
def test_phconvert_opens_the_file_without_a_word(
    run_of: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("h5py", reason="needs the export extra")
    with warnings.catch_warnings(action="ignore"):  # of other packages that it imports
        hdf5 = pytest.importorskip("phconvert.hdf5", reason="needs the dev extra")
    path = tmp_path / "run.h5"
    found = json_of(capsys, "export", run_of, "--format", "photon-hdf5", "-o", path)
    source = read_recording(run_of)
    with contextlib.closing(hdf5.load_photon_hdf5(str(path))) as loaded:
        hdf5.assert_valid_photon_hdf5(loaded, strict_description=True, require_rootformat=True)
        assert capsys.readouterr().out == ""
        times = loaded.root.photon_data.timestamps.read()
        clicks = click_list(source, recorded_plan(source))
        assert len(times) == found["clicks"]
        assert times.tolist() == clicks.start_tick.tolist()
        names = [name.decode() for name in loaded.root.user.pans.classes.read()]
        assert tuple(names) == source.bundle().classes
        assert loaded.root.identity.format_name.read() == b"Photon-HDF5"
        assert loaded.root.description.read().startswith(b"SIMULATED")


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
    assert table.schema.field("time_us").metadata[b"unit"] == b"us"
    assert table.schema.field("truth").metadata[b"missing"] == b"unknown"
    facts = json.loads(table.schema.metadata[b"pans"])
    assert (facts["simulated"], facts["decisions_sha256"]) == (True, source.decisions_sha256)


def test_rows_of_mixed_kinds_become_columns(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs the parquet extra")
    write_rows(tmp_path / "t.parquet", [{"a": 1, "b": "x", "c": [1]}, {"a": 2.5, "d": True}, {"b": 3}])
    table = parquet.read_table(tmp_path / "t.parquet").to_pydict()
    assert table == {"a": [1.0, 2.5, None], "b": ['"x"', None, "3"], "c": ["[1]", None, None], "d": [None, True, None]}


@pytest.mark.parametrize("way", ["npy", "png"])
def test_a_bundle_comes_back_from_its_exports(way: str, tmp_path: Path, pans: Pans) -> None:
    if way == "png":
        pytest.importorskip("PIL", reason="needs the train extra")
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
    onnx.checker.check_model(model, full_check=True)
    said = {entry.key: entry.value for entry in model.metadata_props}
    bundle = load_bundle(FASHION)[0]
    assert (said["name"], json.loads(said["classes"])) == (bundle.name, list(bundle.classes))
    assert json.loads(said["pans.about"])["photons_per_level"] == bundle.photons_per_level
    assert "mean clicks per exposure, 0 to 1" in model.doc_string
    assert model.producer_name == "pans-runtime"
    check_head(path.read_bytes(), 10, 10)  # a bundle of the exported head loads
    session = onnxruntime.InferenceSession(path)
    scores = session.run(None, {session.get_inputs()[0].name: bundle.golden_means})[0]
    assert np.allclose(scores, bundle.golden_scores, atol=1e-5)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_png_pictures_are_those_of_other_readers(dtype: Any, tmp_path: Path) -> None:
    image = pytest.importorskip("PIL.Image", reason="needs the train extra")
    top = np.iinfo(dtype).max
    grey = np.random.default_rng(1).integers(0, top + 1, (7, 5)).astype(dtype)
    (tmp_path / "ours.png").write_bytes(grey_png(grey))
    assert (np.asarray(image.open(tmp_path / "ours.png")) == grey).all()
    smooth = np.linspace(0, top, 640).reshape(20, 32).astype(dtype)
    image.fromarray(smooth).save(tmp_path / "theirs.png", optimize=True)  # with filters
    found = read_grey_png((tmp_path / "theirs.png").read_bytes(), "theirs.png")
    assert (np.rint(found * top) == smooth).all()


def test_damaged_pictures_are_refused(tmp_path: Path) -> None:
    pytest.importorskip("PIL", reason="needs the train extra")
    data = grey_png(np.zeros((4, 4), np.uint8))
    wrong = [b"", b"GIF89a", data[:-1], data[:20], data[:40] + b"x" + data[41:], data.replace(b"IHDR", b"JHDR")]
    wrong += [data[:cut] for cut in range(8, len(data), 3)]
    for one in wrong:
        with pytest.raises(DamagedFileError, match="not a readable grey PNG"):
            read_grey_png(one, "p.png")


@pytest.fixture(scope="module", params=["oled-qcmos", "wdm-snspd"])
def run_of(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of one detector after another, and of all at once with dark slots."""
    folder = tmp_path_factory.mktemp("run")
    words = [*fixed_run(200)]
    if request.param == "wdm-snspd":
        make_parallel(folder / "small.pans")
        words = ["run", str(folder / "small.pans"), "--device", "sim:wdm-snspd?pace=fast&scene=fashion200"]
        words += ["--decisions", "150", "--shots", "4"]
    assert main([*words, "--out", str(folder)]) in (0, 1)
    return folder / "run.pansrec"


def make_parallel(path: Path) -> None:
    profile, rng = load_profile("wdm-snspd"), np.random.default_rng(0)
    top, levels = profile.projector.peak_photoelectrons_hz * profile.exposure.max_us * 1e-6, profile.projector.levels
    patterns = rng.integers(0, levels, (5, 784)) * (rng.random((5, 784)) < 0.05)
    patterns[0, 0] = levels - 1
    shown = {"levels": levels, "pattern_levels": patterns, "photons_per_level": top / (levels - 1)}
    head = onnx_chain(random_layers([5, 8, 10]))
    made = made_bundle(classes=tuple("0123456789"), image_shape=(28, 28), head_onnx=head, **shown)
    write_bundle(made, path)


def test_csv_holds_every_click_and_decision(run_of: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = json_of(capsys, "export", run_of, "--format", "csv", "-o", tmp_path / "csv")
    recording = read_recording(run_of)
    decisions = recording.decisions()
    with open(tmp_path / "csv" / "decisions.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == found["decisions"] == recording.n_decisions
    classes = recording.bundle().classes
    for row, wanted in zip(rows, decisions):
        assert (int(row["tick"]), int(row["object"]), int(row["clicks"])) == tuple(wanted[["tick", "object", "clicks"]])
        assert row["class"] == classes[wanted["label"]]
        assert np.float32(row["probability"]) == wanted["probability"]
    with open(tmp_path / "csv" / "clicks.csv", newline="") as file:
        clicks = list(csv.DictReader(file))
    assert len(clicks) == found["clicks"]
    # the clicks behind each decision, counted from the exported file alone
    assert all((row["decision"] == "") == (row["dark_slot"] == "1") for row in clicks)
    counted = np.bincount([int(row["decision"]) for row in clicks if row["decision"]], minlength=len(rows))
    assert counted.tolist() == decisions["clicks"].tolist()
    assert found["simulated"] is True
    about = json.loads((tmp_path / "csv" / "about.json").read_text())
    assert about["exposures"] == found["exposures"]


def test_other_readers_find_the_same_tables(run_of: Path, tmp_path: Path, pans: Pans) -> None:
    pandas = pytest.importorskip("pandas", reason="needs the frames extra")
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs the parquet extra")
    for form, name in (("csv", "csv"), ("parquet", "d.parquet")):
        pans("export", run_of, "--format", form, "-o", tmp_path / name)
    dictionary = pandas.read_csv(tmp_path / "csv" / "columns.csv", keep_default_na=False)
    recording = read_recording(run_of)
    for file, columns in dictionary.groupby("file"):
        # by the dictionary alone: nullable types where it says what an empty cell means
        nullable = dict(zip(columns.column, columns.empty_means.ne("") & columns.dtype.str.startswith("int")))
        kinds = {c: d.capitalize() if nullable[c] else d for c, d in zip(columns.column, columns.dtype)}
        found = pandas.read_csv(tmp_path / "csv" / file, dtype=kinds, na_values=[""], keep_default_na=False)
        assert found.columns.tolist() == columns.column.tolist()
        for column, unit in zip(columns.column, columns.unit):
            assert unit in ("", "1") or column.endswith(unit), column  # the unit stands in the name
        wanted = to_frame(recording, "clicks" if file == "clicks.csv" else "decisions").reset_index()
        texts = dict.fromkeys(columns.column[columns.dtype == "str"], "")
        pandas.testing.assert_frame_equal(found.fillna(texts), wanted[found.columns].fillna(texts), check_dtype=False)
    table = parquet.read_table(tmp_path / "d.parquet").to_pandas()
    wanted = to_frame(recording).reset_index()[table.columns]
    for column in table:
        assert table[column].fillna(-1).tolist() == wanted[column].fillna(-1).tolist()


def test_without_the_frames_extra_the_remedy_is_named(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = read_recording(recording)
    for name, call in (("pandas", to_frame), ("xarray", to_xarray)):
        monkeypatch.setitem(sys.modules, name, None)
        with pytest.raises(UsageError, match=name) as error:
            call(source)
        assert error.value.remedy == "pip install pandas xarray"


def test_the_clicks_are_in_order_and_within_the_plan(run_of: Path) -> None:
    recording = read_recording(run_of)
    plan = recorded_plan(recording)
    clicks = click_list(recording, plan)
    assert (np.diff(clicks.start_tick) >= 0).all()
    assert clicks.exposures == recording.n_decisions * plan.slots_per_cycle * plan.cycles_per_object
    assert clicks.channel.max() < (plan.n_patterns if plan.mode == "parallel" else 1)
    slot = clicks.exposure % plan.slots_per_cycle
    assert (plan.slot_pattern[slot] == clicks.pattern).all()
