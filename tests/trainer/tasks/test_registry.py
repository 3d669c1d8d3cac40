"""Tasks: pinned public files, a user's own data, what is refused before it is unpacked, and the fibre of MMF-MNIST."""

import gzip
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

from pans.base.errors import DamagedFileError, PansError, UsageError
from pans.bundle.sensor.analyser import phase_mask, scatter
from pans_trainer.tasks import registry as tasks
from pans_trainer.tasks.public_sets import PUBLIC_SETS, PinnedFile, check_pinned, fetch, file_sha256, read_idx
from pans_trainer.tasks.registry import FIBRE_TASKS, fold_tasks, load_task, path_from, remembered_task, task_names

RNG = np.random.default_rng(0)


def idx_bytes(array):
    header = bytes([0, 0, 8, array.ndim]) + b"".join(size.to_bytes(4, "big") for size in array.shape)
    return header + array.tobytes()


def own_npz(path, n=20, **more):
    images = RNG.integers(0, 256, (n, 3, 4), dtype=np.uint8)
    np.savez(path, images=images, labels=np.arange(n) % 3, **more)
    return images


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: gzip.compress(data[:-1]),
        lambda data: gzip.compress(data + b"\0"),
        lambda data: gzip.compress(b"\1" + data[1:]),
        lambda data: gzip.compress(data)[:-9],
        lambda data: b"not gzip",
        lambda data: gzip.compress(data + bytes(64 << 20)),
    ],
    ids=["short", "long", "other magic", "cut", "not gzip", "bomb"],
)
def test_a_damaged_idx_file_is_refused(tmp_path, damage):
    path = tmp_path / "a.gz"
    path.write_bytes(damage(idx_bytes(np.zeros((5, 2, 3), np.uint8))))
    with pytest.raises(DamagedFileError, match=r"a\.gz"):
        read_idx(path, (5, 2, 3))


@pytest.mark.parametrize(("n_bytes", "match"), [(4, "0" * 64), (5, "4 bytes, the pinned file has 5")])
def test_an_altered_file_is_named_with_its_size_or_hash(tmp_path, n_bytes, match):
    path = tmp_path / "a.bin"
    path.write_bytes(b"abcd")
    with pytest.raises(DamagedFileError, match=match):
        check_pinned(path, PinnedFile("a.bin", n_bytes, "0" * 64, (4,)))


def test_fetch_keeps_only_what_is_pinned(tmp_path):
    source = tmp_path / "source.bin"
    source.write_bytes(b"right")
    pinned = PinnedFile("got.bin", 5, file_sha256(source), (5,))
    target = tmp_path / "deep" / "got.bin"
    assert fetch(source.as_uri(), target, pinned) is True
    assert target.read_bytes() == b"right"
    assert fetch("file:///nowhere", target, pinned) is False  # it is there already
    target.unlink()
    source.write_bytes(b"wrong")
    with pytest.raises(DamagedFileError):
        fetch(source.as_uri(), target, pinned)
    with pytest.raises(UsageError, match="cannot be fetched"):
        fetch((tmp_path / "absent").as_uri(), target, pinned)
    assert list(target.parent.iterdir()) == []


def test_own_file_holds_out_every_fifth(tmp_path):
    images = own_npz(tmp_path / "own.npz", classes=np.array(["a", "b", "c"]))
    task = load_task(str(tmp_path / "own.npz"))
    assert task.classes == ("a", "b", "c")
    assert same_images(task.test.images, images[4::5])
    assert same_images(task.train.images, np.delete(images, np.s_[4::5], axis=0))
    assert task.split_here
    assert same_images(task.everything().images, images)


def same_images(found, wanted):
    """Whether both hold the same images, in whatever order."""
    return sorted(image.tobytes() for image in found) == sorted(image.tobytes() for image in wanted)


def test_any_stretch_of_an_own_file_holds_all_classes(tmp_path):
    """A folder is read class by class: without mixing, the last objects, by which a training is judged, are of one class."""
    labels = np.repeat([0, 1, 2], [120, 60, 120])
    images = np.arange(300, dtype=np.uint16).view(np.uint8).reshape(300, 1, 2)
    np.savez(tmp_path / "sorted.npz", images=images, labels=labels)
    task = load_task(str(tmp_path / "sorted.npz"))
    assert np.array_equal(labels[task.train.images.view(np.uint16).ravel()], task.train.labels)
    assert np.array_equal(labels[task.test.images.view(np.uint16).ravel()], task.test.labels)
    for part, size in ((task.train, 20), (task.test, 10)):
        stretches = part.labels.reshape(-1, size)
        counts = np.stack([(stretches == label).sum(axis=1) for label in range(3)], axis=1)
        assert (abs(counts - size * np.array([0.4, 0.2, 0.4])) <= 1).all()
    again = load_task(str(tmp_path / "sorted.npz"))
    assert np.array_equal(again.train.images, task.train.images)


def test_own_file_with_a_test_part(tmp_path):
    images, labels = RNG.integers(0, 256, (9, 2, 2), dtype=np.uint8), np.arange(9) % 2
    train = {"train_images": images[:6], "train_labels": labels[:6]}
    np.savez(tmp_path / "own.npz", **train, test_images=images[6:], test_labels=labels[6:])
    task = load_task(str(tmp_path / "own.npz"))
    assert np.array_equal(task.test.images, images[6:])
    assert task.classes == ("0", "1")
    assert np.array_equal(task.everything().images, images)


@pytest.mark.parametrize(
    "arrays",
    [
        {"images": np.full((20, 3, 4), 1.5), "labels": np.arange(20) % 2},
        {"images": np.full((20, 3, 4), np.nan), "labels": np.arange(20) % 2},
        {"images": np.zeros((20, 3, 4), np.int64), "labels": np.arange(20) % 2},
        {"images": np.zeros((20, 3, 4), np.uint8), "labels": np.zeros(19, int)},
        {"images": np.zeros((20, 3, 4), np.uint8), "labels": np.full(20, -1)},
        {"images": np.zeros((20, 3, 4), np.uint8), "labels": np.zeros(20)},
        {"images": np.zeros((20, 12), np.uint8), "labels": np.zeros(20, int)},
        {"images": np.zeros((3, 3, 4), np.uint8), "labels": np.arange(3)},
        {"pictures": np.zeros(3)},
    ],
    ids=["beyond full scale", "nan", "signed", "lengths", "negative label", "float label", "flat", "too few", "names"],
)
def test_unfit_own_files_are_refused(tmp_path, arrays):
    np.savez(tmp_path / "own.npz", **arrays)
    with pytest.raises(UsageError, match=r"own\.npz"):
        load_task(str(tmp_path / "own.npz"))


def test_images_of_one_class_are_refused_with_its_name(tmp_path):
    np.savez(tmp_path / "own.npz", images=np.zeros((20, 3, 4), np.uint8), labels=np.zeros(20, int), classes=["cat"])
    with pytest.raises(UsageError, match=r"own\.npz: 20 images of one class \('cat'\), needed are 2 classes or more"):
        load_task(str(tmp_path / "own.npz"))


def test_objects_that_would_run_code_are_refused(tmp_path):
    np.savez(tmp_path / "own.npz", images=np.array([{}], dtype=object), labels=np.zeros(1, int))
    with pytest.raises(DamagedFileError):
        load_task(str(tmp_path / "own.npz"))


@pytest.mark.parametrize("kind", ["uint16", "float32", "float64", "bool"])
def test_images_of_other_types_keep_their_full_scale(tmp_path, kind):
    grey = RNG.integers(0, 256, (20, 3, 4), dtype=np.uint8)
    given = {"uint16": grey.astype(np.uint16) * 257, "bool": grey > 99}.get(kind, (grey / 255).astype(kind))
    np.savez(tmp_path / "own.npz", images=given, labels=np.arange(20) % 2)
    task = load_task(str(tmp_path / "own.npz"))
    wanted = np.where(grey > 99, 255, 0).astype(np.uint8) if kind == "bool" else grey
    assert same_images(task.everything().images, wanted)
    assert "full scale" in task.source
    dim = (given // 2) if kind == "uint16" else given  # a dim camera stays dim: nothing is stretched
    np.savez(tmp_path / "dim.npz", images=dim, labels=np.arange(20) % 2)
    assert load_task(str(tmp_path / "dim.npz")).everything().images.max() <= 255 // (2 if kind == "uint16" else 1) + 1


def test_folder_of_class_folders(tmp_path):
    image = pytest.importorskip("PIL.Image", reason="needs the train extra")
    for name, level in (("bright", 200), ("dark", 20)):
        (tmp_path / "set" / name).mkdir(parents=True)
        for i in range(10):
            image.fromarray(np.full((4, 5), level + i, np.uint8)).save(tmp_path / "set" / name / f"{i}.png")
    task = load_task(str(tmp_path / "set"))
    assert (task.name, task.classes, task.image_shape) == ("set", ("bright", "dark"), (4, 5))
    assert len(task.train) == 16
    assert sorted(task.test.images[:, 0, 0].tolist()) == [24, 29, 204, 209]
    folds = fold_tasks(task)  # each image is held out once, and never trained on then
    assert sorted(int(i[0, 0]) for fold in folds for i in fold.test.images) == sorted(
        [*range(20, 30), *range(200, 210)]
    )
    for fold in folds:
        assert not {*fold.test.images[:, 0, 0]} & {*fold.train.images[:, 0, 0]}
        assert sorted(fold.test.labels) == [0, 0, 1, 1]
        assert len(fold.train) == 16
    (tmp_path / "set" / "dark" / "zz.png").write_text("no image")
    with pytest.raises(DamagedFileError, match=r"zz\.png"):
        load_task(str(tmp_path / "set"))


def test_unknown_task_and_missing_folder_have_a_remedy(tmp_path, monkeypatch):
    monkeypatch.delenv("PANS_DATA", raising=False)
    for name, folder in (("no-such-task", None), ("mnist", None), ("mnist", tmp_path)):
        with pytest.raises(PansError) as caught:
            load_task(name, folder)
        assert caught.value.remedy


@pytest.mark.data
@pytest.mark.parametrize("name", PUBLIC_SETS)
def test_public_sets_are_the_pinned_ones(name, data_dir):
    task = load_task(name, data_dir)
    assert task.train.images.shape == (60000, 28, 28)
    assert task.test.images.shape == (10000, 28, 28)
    assert np.bincount(task.train.labels).shape == (10,)
    assert not task.split_here


def test_a_lab_s_own_task_is_found_and_checked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "labtask.py").write_text(
        "import numpy as np\n"
        "from pans_trainer.tasks.registry import Objects, Task\n"
        "def make(seed, top=1):\n"
        "    part = Objects(np.full((4, 3, 5), seed, np.uint8), np.array([0, 1, 0, top]))\n"
        "    return Task('lab', ('a', 'b'), part, part, '0' * 64, 'by hand')\n"
        "def bad(seed):\n"
        "    return make(seed, 2)\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    points = [EntryPoint("lab", "labtask:make", "pans.tasks"), EntryPoint("bad", "labtask:bad", "pans.tasks")]
    monkeypatch.setattr(tasks, "entry_points", lambda group: points)
    assert load_task("lab", data_seed=7).train.images.max() == 7
    assert task_names()[-2:] == ("bad", "lab")
    with pytest.raises(UsageError, match=r"'bad', train: labels must lie in 0\.\.1"):
        load_task("bad")


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "lab/data/parts").mkdir(parents=True)
    (tmp_path / "lab/bundles").mkdir()
    monkeypatch.chdir(tmp_path / "lab")
    return tmp_path / "lab"


def told(bundle: str, task: str) -> dict[str, str]:
    return {"task_argument": Path(task).name, "data_path": path_from(Path(bundle), task), "data_sha256": "ab" * 32}


def test_it_is_found_from_anywhere_and_after_a_move(lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    provenance = told("bundles/parts.pans", "data/parts")
    assert provenance["data_path"] == "../data/parts"
    assert Path(remembered_task(provenance, "parts", Path("bundles/parts.pans"))).samefile("data/parts")
    moved = lab.rename(lab.with_name("moved"))
    monkeypatch.chdir("/")
    found = remembered_task(provenance, "parts", moved / "bundles/parts.pans")
    assert Path(found).samefile(moved / "data/parts")


def test_what_is_not_there_is_told_with_the_places(lab: Path) -> None:
    with pytest.raises(UsageError) as caught:
        remembered_task(told("bundles/parts.pans", "gone/parts"), "parts", Path("bundles/parts.pans"))
    assert "looked for gone/parts, parts, bundles/parts" in caught.value.message
    assert "SHA-256 abababababab…" in caught.value.message
    assert caught.value.remedy.startswith("name it: --task")


IMAGES = np.random.default_rng(1).integers(0, 256, (5, 28, 28), dtype=np.uint8)


def test_the_mask_is_pinned():
    mask = phase_mask()
    assert mask.shape == (28, 28)  # RandomState(42): .3745 .9507 .7320
    assert mask.ravel()[:3] == pytest.approx([2.353312, 5.973520, 4.599257], abs=1e-5)
    assert 0 <= mask.min() < mask.max() < 2 * np.pi


def test_the_fibre_loses_no_light():
    assert (np.abs(scatter(IMAGES)) ** 2).sum(axis=(1, 2)) == pytest.approx(
        ((IMAGES / 255) ** 2).sum(axis=(1, 2)), rel=1e-5
    )


def test_the_speckle_by_the_definition_of_the_fourier_transform():
    n = np.arange(28)
    fourier = np.exp(-2j * np.pi * np.outer(n, n) / 28)
    spectrum = fourier @ (IMAGES[0] / 255) @ fourier * np.exp(1j * phase_mask())
    wanted = fourier.conj() @ spectrum @ fourier.conj() / 784
    assert np.abs(scatter(IMAGES[:1])[0] - wanted).max() < 1e-5


def test_the_release_normalises_every_batch_by_itself():
    pytest.importorskip("torch", reason="needs the train extra")
    from pans_trainer.reproduce.passive import release_intensity

    batched = release_intensity(IMAGES, batch=2)
    for start in (0, 2, 4):
        assert np.allclose(batched[start : start + 2], release_intensity(IMAGES[start : start + 2]))


@pytest.mark.data
@pytest.mark.parametrize("name", FIBRE_TASKS)
def test_mmf_mnist_is_mnist_behind_the_fibre(name, data_dir):
    task, digits = load_task(name, data_dir), load_task("mnist", data_dir)
    assert (task.name, task.light, task.optics, task.target) == (name, "field", "mmf", FIBRE_TASKS[name])
    assert np.array_equal(task.test.images, digits.test.images)
