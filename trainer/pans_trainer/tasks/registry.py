"""Tasks by name, file or folder: labelled 8-bit images, split into training and held-out objects; and the task of a bundle, found again.

`load_task` returns a `Task` whose images are uint8 (n, height, width): 0 is black. A user's file or folder without a test part is split by
position: every fifth object is held out. Both parts are then mixed, so that any stretch of them holds all classes in their shares: folders
are read class by class, and trainings keep the last objects back. No picture of a folder is in both parts: duplicates are taken once.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.base.console import load_offered
from pans.base.errors import DamagedFileError, UsageError
from pans.base.files import Account, Reading, read_arrays, read_class_folder, to_8_bits
from pans.bundle.sensor import Light, Optics

from .generators import GENERATORS
from .public_sets import PUBLIC_SETS, check_pinned, data_folder, file_sha256, read_idx

FILE_MAX_BYTES = 1 << 30
IMAGES_MAX_BYTES = 1 << 30
HOLD_OUT_EVERY = 5
ORDER_SEED = 0x0D3E  # of the mixing
GROUP = "pans.tasks"  # a lab's own: name -> maker(data_seed) -> Task


@dataclass(frozen=True, slots=True, eq=False)
class Objects:
    """Labelled images: uint8 (n, height, width) and int64 (n,); `behind`: what gave rise to them, where it is asked for."""

    images: NDArray[np.uint8]
    labels: NDArray[np.int64]
    behind: NDArray[np.uint8] | None = None

    def __len__(self) -> int:
        return len(self.labels)

    def take(self, which: slice | NDArray[Any]) -> Objects:
        """Return the objects of a slice, or of those places."""
        return Objects(self.images[which], self.labels[which], None if self.behind is None else self.behind[which])

    def first(self, count: int | None) -> Objects:
        """Return the first `count` objects, or all of them."""
        return self.take(slice(count))

    @property
    def pictures(self) -> NDArray[np.uint8]:
        """What a task of pictures wants back: the images, or what lies behind them."""
        return self.images if self.behind is None else self.behind


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """Objects to train on and objects held out; `sha256` names the data, `split` says how the held-out ones were chosen."""

    name: str
    classes: tuple[str, ...]
    train: Objects
    test: Objects
    sha256: str
    split: str
    light: Light = "transmission"  # what grey is: of an object that we light, or a field amplitude that reaches us
    optics: Optics = "none"  # between the scene and a passive encoder
    target: str = "class"  # what is asked for: the class, or the `image`
    source: str = ""  # of drawn images: whose generator, which seed
    imaged: Callable[[NDArray[np.uint8]], NDArray[np.uint8]] | None = None  # makes images of what is behind them
    account: Account | None = None  # of a folder, what was read
    kept: int = 0  # the last training objects have no varied copies before them, and so can choose; 0: a part that a training chooses

    @property
    def image_shape(self) -> tuple[int, int]:
        """Height and width in pixels."""
        height, width = self.train.images.shape[1:]
        return int(height), int(width)

    @property
    def split_here(self) -> bool:
        """Whether the data had no test part of its own, and every fifth object was held out here."""
        return self.split == _SPLIT_BY_POSITION

    def everything(self) -> Objects:
        """All objects: those to train on, then those held out."""
        images = np.concatenate([self.train.images, self.test.images])
        return Objects(images, np.concatenate([self.train.labels, self.test.labels]))


# what white is, by type of the array: nothing is stretched, so that the same grey means the same light in every file
_FULL_SCALES = {"uint8": 255.0, "uint16": 65535.0, "float16": 1.0, "float32": 1.0, "float64": 1.0, "bool": 1.0}
_SPLIT_BY_POSITION = f"every {HOLD_OUT_EVERY}th object held out"
_SPLIT_OF_FILE = "the test part of the data"
_SPLIT_OF_SEED = "drawn from other random streams"
PLAIN_READING = Reading()  # of a folder's photos, where nothing is said
FIBRE_TASKS = {"mmf-mnist": "class", "mmf-mnist-image": "image"}  # MNIST behind a multimode fibre: what is asked for
TASKS = (*PUBLIC_SETS, *FIBRE_TASKS, *GENERATORS)  # the names of our own


def load_task(
    name_or_path: str, data_dir: str | Path | None = None, *, data_seed: int = 0, reading: Reading = PLAIN_READING
) -> Task:
    """Return the public set or drawn task of that name, or the .npz file or folder of class folders at that path.

    `data_dir` (default: the environment variable PANS_DATA) holds the folders of the public sets; `data_seed` is that of drawn
    tasks, `reading` of a folder's photos, and both say nothing to others. UsageError says what is missing or unfit, DamagedFileError
    which file is not the pinned one.
    """
    if name_or_path in PUBLIC_SETS:
        return _load_public(name_or_path, data_folder(data_dir))
    if name_or_path in FIBRE_TASKS:
        digits = _load_public("mnist", data_folder(data_dir))
        return replace(digits, name=name_or_path, light="field", optics="mmf", target=FIBRE_TASKS[name_or_path])
    if name_or_path in GENERATORS:
        return draw_task(name_or_path, data_seed)
    if name_or_path in (offered := _offered_tasks()):
        return _checked_task(load_offered(offered[name_or_path])(data_seed), name_or_path)
    path = Path(name_or_path)
    if path.is_dir():
        return _load_folder(path, reading)
    if path.is_file() and path.suffix == ".npz":
        return _load_npz(path)
    raise UsageError(
        f"task {name_or_path!r} is neither one of {', '.join(task_names())}, nor a .npz file, nor a folder",
        remedy="a .npz file holds `images` uint8 (n, height, width) and `labels`; a folder holds one folder per class",
    )


def physical_encoder(task: Task) -> str:
    """Return the encoder that the physics of `task` asks for: what `pans train` takes by default."""
    if task.name in GENERATORS and task.source:
        return GENERATORS[task.name].encoder
    return "active" if task.light == "transmission" else "coherent"


def task_names() -> tuple[str, ...]:
    """Return the names that `load_task` knows."""
    return (*TASKS, *sorted(_offered_tasks()))


def _offered_tasks() -> dict[str, EntryPoint]:
    """Tasks of other packages by name; a name of ours cannot be taken."""
    return {point.name: point for point in entry_points(group=GROUP) if point.name not in TASKS}


def _checked_task(task: Task, name: str) -> Task:
    """Return a task of another package; UsageError where its arrays are not what `Task` says."""
    for part, objects in (("train", task.train), ("test", task.test)):
        images, labels = np.asarray(objects.images), np.asarray(objects.labels)
        if images.dtype != np.uint8 or images.ndim != 3 or images.shape[1:] != task.image_shape:
            what = f"task {name!r}, {part}: images are {images.dtype} {images.shape}, must be uint8 (n, h, w)"
            raise UsageError(what)
        if labels.shape != images.shape[:1] or not len(labels):
            raise UsageError(f"task {name!r}, {part}: {labels.shape} labels for {len(images)} images")
        if not ((labels >= 0) & (labels < len(task.classes))).all():
            raise UsageError(f"task {name!r}, {part}: labels must lie in 0..{len(task.classes) - 1}")
    return task


def draw_task(name: str, seed: int = 0, n_train: int | None = None, n_test: int | None = None) -> Task:
    """Return a drawn task (see generators.py) with its recipe's or other numbers of objects.

    The same seed gives the same objects, object by object, whatever the numbers asked for. UsageError for an unknown name or a
    negative seed.
    """
    if name not in GENERATORS:
        raise UsageError(f"no generator for the task {name!r}", remedy=f"there are {', '.join(GENERATORS)}")
    if seed < 0:
        raise UsageError(f"--data-seed is {seed}, allowed: 0 or more")
    recipe = GENERATORS[name]
    train = Objects(*recipe.draw(seed, "train", recipe.n_train if n_train is None else n_train))
    test = Objects(*recipe.draw(seed, "test", recipe.n_test if n_test is None else n_test))
    digest = hashlib.sha256()  # of all images and labels, little-endian
    for part in (train, test):
        digest.update(np.ascontiguousarray(part.images).data)
        digest.update(part.labels.astype("<i8").data)
    source = f"{recipe.source}, seed {seed}"
    return Task(name, recipe.classes, train, test, digest.hexdigest(), _SPLIT_OF_SEED, recipe.light, source=source)


def _load_public(name: str, folder: Path) -> Task:
    public = PUBLIC_SETS[name]
    arrays = []
    for pinned in public.files:
        path = folder / public.folder / pinned.name
        check_pinned(path, pinned)
        arrays.append(read_idx(path, pinned.shape))
    digest = hashlib.sha256("".join(pinned.sha256 for pinned in public.files).encode()).hexdigest()
    train = Objects(arrays[0], arrays[1].astype(np.int64))
    test = Objects(arrays[2], arrays[3].astype(np.int64))
    return Task(name, public.classes, train, test, digest, _SPLIT_OF_FILE)


def _load_npz(path: Path) -> Task:
    """`images` and `labels`, or `train_images`, `train_labels`, `test_images`, `test_labels`; `classes` if there are names."""
    arrays = _read_npz(path)
    parts = [f"{part}_{kind}" for part in ("train", "test") for kind in ("images", "labels")]
    if all(part in arrays for part in parts):
        train = _objects(path, arrays["train_images"], arrays["train_labels"])
        test = _objects(path, arrays["test_images"], arrays["test_labels"])
        split = _SPLIT_OF_FILE
    elif "images" in arrays and "labels" in arrays:
        train, test = _split(path, _objects(path, arrays["images"], arrays["labels"]))
        split = _SPLIT_BY_POSITION
    else:
        what = f"{path}: holds {', '.join(sorted(arrays)) or 'nothing'}"
        raise UsageError(what, remedy=f"name the arrays `images` and `labels`, or {', '.join(parts)}")
    n_classes = int(max(train.labels.max(), test.labels.max())) + 1
    classes = tuple(str(name) for name in arrays.get("classes", np.arange(n_classes)).ravel())
    given = arrays["images" if "images" in arrays else "train_images"].dtype
    source = f"{given.name} images, full scale {_FULL_SCALES[given.name]:g}, rounded to 256 grey levels"
    source = "" if given == np.uint8 else source
    return _checked(Task(path.stem, classes, train, test, file_sha256(path), split, source=source), path)


def _read_npz(path: Path) -> dict[str, NDArray[Any]]:
    if path.stat().st_size > FILE_MAX_BYTES:
        raise UsageError(f"{path}: {path.stat().st_size} bytes, allowed at most {FILE_MAX_BYTES}")
    try:
        return read_arrays(path, None, IMAGES_MAX_BYTES)
    except ValueError as error:
        raise DamagedFileError(f"{path}: cannot be read: {error}") from error


def _load_folder(folder: Path, reading: Reading) -> Task:
    """One folder per class, photos inside (see `pans.base.files.images`)."""
    pictures = read_class_folder(folder, IMAGES_MAX_BYTES, reading)
    objects, name = Objects(pictures.images, pictures.labels), folder.resolve().name
    return replace(own_task(name, pictures.classes, objects, pictures.sha256), account=pictures.account)


def own_task(name: str, classes: tuple[str, ...], objects: Objects, sha256: str = "") -> Task:
    """Return the task of a user's images, the classes one after the other: every fifth is held out, at least one of each class.

    UsageError for fewer than five images of a class. `sha256` is by default that of the pixels.
    """
    counts = np.bincount(objects.labels, minlength=len(classes))
    if len(classes) == counts.size and counts.min() < HOLD_OUT_EVERY:
        few = int(counts.argmin())
        what = f"{name}: class {classes[few]!r} has {counts[few]} images, needed are {HOLD_OUT_EVERY} or more"
        raise UsageError(what, remedy="add images of it, or leave the class out")
    train, test = _split(Path(name), objects.take(np.argsort(objects.labels, kind="stable")))
    sha256 = sha256 or hashlib.sha256(np.ascontiguousarray(objects.images).data).hexdigest()
    return _checked(Task(name, classes, train, test, sha256, _SPLIT_BY_POSITION), Path(name))


def fold_tasks(task: Task) -> list[Task]:
    """Return tasks of the same images, each of which one holds out: `task`, then those that hold out parts of its training images."""
    order = mixed_order(task.train.labels)
    place = np.empty(len(order), np.int64)  # within the class: every part has its share of each
    for label in range(len(task.classes)):
        members = order[task.train.labels[order] == label]
        place[members] = np.arange(len(members))
    folds = [task]
    for number in range(HOLD_OUT_EVERY - 1):
        out = place % (HOLD_OUT_EVERY - 1) == number
        rest, test = task.train.take(~out), task.train.take(out)
        images, labels = (
            np.concatenate([rest.images, task.test.images]),
            np.concatenate([rest.labels, task.test.labels]),
        )
        train = Objects(images, labels).take(mixed_order(labels))
        folds.append(replace(task, train=train, test=test, sha256=f"{task.sha256} {number}"))
    return folds


def _objects(where: Path, images: NDArray[Any], labels: NDArray[Any]) -> Objects:
    full_scale = _FULL_SCALES.get(images.dtype.name)
    if full_scale is None or images.ndim != 3 or 0 in images.shape:
        raise UsageError(
            f"{where}: images are {images.dtype} {images.shape}, allowed: (n, height, width) of uint8, uint16 (full scale 65535), "
            "float16, float32, float64 (full scale 1) or bool",
            remedy="convert them; several colours or frames per image are not taken apart here",
        )
    if images.dtype != np.uint8:
        images = to_8_bits(where, images, full_scale)
    if labels.shape != (len(images),) or not np.issubdtype(labels.dtype, np.integer):
        raise UsageError(f"{where}: labels are {labels.dtype} {labels.shape}, allowed: integers ({len(images)},)")
    return Objects(images, labels.astype(np.int64))


def _split(where: Path, objects: Objects) -> tuple[Objects, Objects]:
    if len(objects) < 2 * HOLD_OUT_EVERY:
        raise UsageError(f"{where}: {len(objects)} objects, needed are {2 * HOLD_OUT_EVERY} or more")
    held_out = np.arange(len(objects)) % HOLD_OUT_EVERY == HOLD_OUT_EVERY - 1
    places = np.arange(len(objects))
    parts = [places[part][mixed_order(objects.labels[part])] for part in (~held_out, held_out)]
    return objects.take(parts[0]), objects.take(parts[1])


def mixed_order(labels: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return an order of objects, int64 (n,), that deals out every class evenly from first to last, at random within it.

    The same for the same labels. Any part of the order holds the classes in the shares that all objects have, but for one object.
    """
    order = np.random.default_rng(ORDER_SEED).permutation(len(labels))
    shuffled = labels[order]
    place = np.empty(len(labels))
    for label in np.unique(labels):
        members = np.flatnonzero(shuffled == label)
        place[members] = (np.arange(len(members)) + 0.5) / len(members)
    return order[np.argsort(place, kind="stable")]


def _checked(task: Task, where: Path) -> Task:
    labels = np.concatenate([task.train.labels, task.test.labels])
    n_classes = len(task.classes)
    if task.test.images.shape[1:] != task.train.images.shape[1:]:
        raise UsageError(f"{where}: training and test images differ in size")
    if labels.min() < 0 or labels.max() >= n_classes:
        raise UsageError(f"{where}: labels from {labels.min()} to {labels.max()} for {n_classes} classes")
    if n_classes < 2:
        what = f"{where}: {len(labels)} images of one class ({task.classes[0]!r}), needed are 2 classes or more"
        raise UsageError(what, remedy="add another class, for example images without what the first one shows")
    return task


def path_from(bundle: Path, task: str) -> str:
    """Return where the data set `task` is, relative to the folder of the bundle; "" for a name, or where there is no such path."""
    if task in task_names():
        return ""
    try:
        return Path(os.path.relpath(task, bundle.parent)).as_posix()
    except ValueError:  # another drive
        return ""


def remembered_reading(provenance: Mapping[str, Any]) -> Reading:
    """Return how the photos of the folder were read that a bundle of that provenance was trained on."""
    found = provenance.get("reading")
    if not isinstance(found, Mapping):
        return Reading(side=0)
    side = found.get("side")
    side = side if isinstance(side, int) and not isinstance(side, bool) else None
    return Reading(side, found.get("pad") is True, found.get("skip_bad") is True)


def remembered_task(provenance: Mapping[str, Any], name: str, bundle: Path) -> str:
    """Return the name or the path of what a bundle was trained on; UsageError says where it was looked for.

    `provenance` is the bundle's, `name` its task, `bundle` its file.
    """
    task = str(provenance.get("task_argument", name))
    if task in task_names():
        return task
    kept = str(provenance.get("data_path", ""))
    places = [Path(task), bundle.parent / task] if task else []
    places = ([bundle.parent / kept] if kept else []) + places
    places += [place.with_name(f"{place.name}.npz") for place in places if not place.suffix]
    for place in dict.fromkeys(Path(os.path.normpath(place)) for place in places):
        if place.exists():
            return str(place)
    looked = ", ".join(dict.fromkeys(os.path.normpath(place) for place in places)) or "nothing: the bundle names none"
    digest = str(provenance.get("data_sha256", ""))[:12]
    what = f"the data set {task!r}{f' (SHA-256 {digest}…)' if digest else ''} of {bundle} was not found; looked for {looked}"
    raise UsageError(what, remedy="name it: --task FOLDER, FILE.npz or a name of `pans data list`")
