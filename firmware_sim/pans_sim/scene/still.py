"""What stands before the detector: a list of still images with their truth, or a calibration target.

`load_scene` reads an `.npz` with `images`, `labels`, `classes`, a shipped scene or a target (`uniform`, `dark`, `registration`), and
returns a frozen `Scene` or raises ConfigError. A file is measured before anything is allocated, and never unpickled.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.base.errors import ConfigError, PansError, UsageError
from pans.base.files import read_class_folder, scene_arrays
from pans.calibrate.registration import built_in_target
from pans.instrument.optics import IDENTITY, NO_BLEACHING, Bleaching, Imaging

MAX_OBJECTS = 1 << 17
MAX_PIXELS = 1 << 22
MAX_SCENE_BYTES = 1 << 26
MAX_CLASSES = 4096
NAME_MAX = 250  # of a file: longer ones no system has
UNKNOWN_LABEL = -1
SCENE_FOLDER = Path(__file__).parent.parent / "scenes"
TARGETS = ("uniform", "dark", "registration")


@dataclass(frozen=True, slots=True)
class Scene:
    """Objects in the order in which they pass: images uint8 (n, height, width), labels int16 (n,) with -1 for unknown.

    A target has one image of one pixel that stands for any shape; `lit` is False when no light reaches the detector. `imaging` is
    where the images stand on the grid of the patterns, and how sharply; `bleaching` what light does to each object, which is fresh when
    it comes.
    """

    name: str
    images: NDArray[np.uint8]
    labels: NDArray[np.int16]
    classes: tuple[str, ...]
    lit: bool = True
    imaging: Imaging = IDENTITY
    bleaching: Bleaching = NO_BLEACHING

    @property
    def n_objects(self) -> int:
        return int(self.images.shape[0])

    @property
    def n_pixels(self) -> int:
        return int(self.images.shape[1] * self.images.shape[2])

    @property
    def any_shape(self) -> bool:
        """Whether the scene fits patterns of any number of pixels (a calibration target)."""
        return self.n_pixels == 1

    def truth(self, index: int) -> int:
        """The label of the object that passes as number `index`: the scene starts over when it is at its end."""
        return int(self.labels[index % self.n_objects])


def shipped_scenes() -> tuple[str, ...]:
    """Names that `load_scene` knows without a path: the targets and the files that come with the package."""
    return (*TARGETS, *sorted(path.stem for path in SCENE_FOLDER.glob("*.npz")))


def shipped_scene_files() -> tuple[str, ...]:
    """Names of the scene files in TOML that come with the package (scene_file.py reads them)."""
    return tuple(sorted(path.stem for path in SCENE_FOLDER.glob("*.toml")))


def load_scene(name_or_path: str | Path) -> Scene:
    """Load a target, a shipped scene or an `.npz` file; ConfigError says what is wrong with it and where."""
    name = str(name_or_path)
    if name in TARGETS:
        return _target(name)
    shipped = SCENE_FOLDER / f"{name}.npz"
    if "/" not in name and "\\" not in name and _is_file(shipped):
        return _read_scene(shipped, name)
    path = Path(name)
    if not _is_file(path):
        raise ConfigError(
            f"scene {name!r}: neither a shipped scene nor a file",
            remedy=f"shipped are {', '.join(shipped_scenes() + shipped_scene_files())}; or name a .npz or .toml file",
        )
    return _read_scene(path, path.stem)


def load_images(name: str, base: Path) -> Scene:
    """Load pictures for a scene: a target, a shipped scene, or a `.npz` file or a folder of class folders relative to `base`."""
    path = base / name
    if len(path.name) < NAME_MAX and path.is_dir():
        try:
            pictures = read_class_folder(path, MAX_SCENE_BYTES)
        except PansError as error:
            raise ConfigError(error.message, remedy=error.remedy) from error
        return scene_from_arrays(str(path), pictures.images, pictures.labels, pictures.classes)
    return load_scene(path if _is_file(path) else name)


def scene_from_arrays(name: str, images: NDArray[Any], labels: NDArray[Any] | None, classes: tuple[str, ...]) -> Scene:
    """Make a `Scene` of images uint8 (n, height, width), labels integer (n,) or None, and class names; ConfigError."""
    if images.dtype != np.uint8 or images.ndim != 3 or not images.size:
        raise ConfigError(f"{name}: images must be uint8 (objects, height, width) and not empty, found {_kind(images)}")
    if len(images) > MAX_OBJECTS or images.shape[1] * images.shape[2] > MAX_PIXELS:
        raise ConfigError(
            f"{name}: images must be (objects, height, width), at most {MAX_OBJECTS} objects of {MAX_PIXELS} pixels,"
            f" found {images.shape}"
        )
    if labels is None:
        labels = np.full(images.shape[0], UNKNOWN_LABEL, np.int16)
    if labels.dtype.kind not in "iu" or labels.shape != images.shape[:1]:
        raise ConfigError(f"{name}: labels must be integers, one for each image ({len(images)}), found {_kind(labels)}")
    top = len(classes) if classes else MAX_CLASSES
    lowest, highest = int(labels.min()), int(labels.max())
    if lowest < UNKNOWN_LABEL or highest >= top:
        raise ConfigError(f"{name}: labels must lie in -1..{top - 1}, found {lowest}..{highest}")
    return Scene(name, _frozen(images), _frozen(labels.astype(np.int16)), classes)


def _is_file(path: Path) -> bool:
    return len(path.name) < NAME_MAX and path.is_file()


def _target(name: str) -> Scene:
    label = np.full(1, UNKNOWN_LABEL, np.int16)
    if name == "registration":
        return Scene(name, _frozen(built_in_target()[None]), _frozen(label), ())
    return Scene(name, _frozen(np.full((1, 1, 1), 255, np.uint8)), _frozen(label), (), lit=name != "dark")


def _read_scene(path: Path, name: str) -> Scene:
    try:
        arrays = scene_arrays(path, MAX_SCENE_BYTES)
    except UsageError as error:
        raise ConfigError(error.message, remedy=error.remedy) from error
    for array in arrays.values():
        array.flags.writeable = False  # nobody else has them: no copy
    checked = scene_from_arrays(str(path), arrays["images"], arrays.get("labels"), _classes(path, arrays))
    return replace(checked, name=name)


def _classes(path: Path, arrays: Mapping[str, NDArray[Any]]) -> tuple[str, ...]:
    names = arrays.get("classes")
    if names is None:
        return ()
    if names.dtype.kind != "U" or names.ndim != 1 or names.size > MAX_CLASSES:
        raise ConfigError(f"{path}: classes must be a list of at most {MAX_CLASSES} names, found {_kind(names)}")
    return tuple(str(name) for name in names)


def _frozen(array: NDArray[Any]) -> NDArray[Any]:
    kept = np.ascontiguousarray(array)
    if kept is array and array.flags.writeable:
        kept = array.copy()
    kept.flags.writeable = False
    return kept


def _kind(array: NDArray[Any]) -> str:
    return f"{array.dtype} {array.shape}"
