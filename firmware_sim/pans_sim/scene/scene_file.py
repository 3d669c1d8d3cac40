"""Scene files in TOML: `kind = "still"`, `"cells"` or `"tape"`, and `[[change]]` tables; docs/reference/simulator.md explains every key.

`open_scene` returns a `SceneFile`; errors start with file:line:col. Names of other files in it are relative to it. `scene_on_table` puts
the scene behind the optics that the profile or `--optics` states.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.base.errors import ConfigError
from pans.base.files import Key, KeyPath, Position, found, near, position_of, read_toml, toml_text, type_remedy
from pans.instrument.optics import bleaching_of, imaging_of, is_spec
from pans.instrument.profile import Profile

from . import moving
from .detector import uniform_numbers
from .detector_model import TELEGRAPH_STREAM
from .moving import ALL_CHANNELS, CHANGE_KINDS, Cells, Change, SceneFile, Tape
from .still import SCENE_FOLDER, TARGETS, Scene, load_images, load_scene

MAX_FILE_BYTES = 1 << 16
MAX_TAPE_BITS = 1 << 24
MAX_TIME_S = 1e7
_PAGE = "docs/reference/simulator.md"
_SHARED = {"kind": Key("text", choices=("still", "cells", "tape"))}
_RULES: dict[str, dict[str, Key]] = {
    "still": {"images": Key("text")},
    "cells": {
        "images": Key("text"),
        "leave_out": Key("names", required=False),
        "rate_hz": Key("number", moving.MIN_HZ, moving.MAX_RATE_HZ),
        "velocity_fields_per_s": Key("number", moving.MIN_HZ, moving.MAX_SPEED_HZ),
        "velocity_spread": Key("number", 0, moving.MAX_SPREAD, required=False),
        "offset_px": Key("whole", 0, moving.MAX_OFFSET_PX, required=False),
        "background_transmission": Key("number", 0, 1, required=False),
        "gap_every_s": Key("number", 0, MAX_TIME_S, required=False),
        "gap_s": Key("number", 0, MAX_TIME_S, required=False),
    },
    "tape": {
        "bars": Key("whole", 1, moving.MAX_BARS),
        "pixels_per_bar": Key("whole", 1, moving.MAX_PIXELS_PER_BAR),
        "speed_bars_per_s": Key("number", moving.MIN_HZ, moving.MAX_SPEED_HZ),
        "jitter_bars": Key("number", 0, moving.MAX_JITTER_BARS, required=False),
        "jitter_time_s": Key("number", 0, MAX_TIME_S, above=True, required=False),
        "target": Key("text", required=False),
        "file": Key("text", required=False),
    },
}
_TIMES = {"at_s": Key("number", 0, MAX_TIME_S), "for_s": Key("number", 0, MAX_TIME_S, above=True, required=False)}
_CHANNEL = Key("whole", 0, 4095, required=False)
_CHANGE_RULES: dict[str, dict[str, Key]] = {
    "dark": {"factor": Key("number", 0, 1e6), "channel": _CHANNEL},
    "burst": {"rate_hz": Key("number", 0, 1e9), "channel": _CHANNEL},
    "hot": {"rate_hz": Key("number", 0, 1e9), "channel": replace(_CHANNEL, required=True)},
    "dead": {"channel": replace(_CHANNEL, required=True)},
    "drift": {"percent_per_s": Key("number", -100, 100)},
}
_AMOUNTS = {"dark": "factor", "burst": "rate_hz", "hot": "rate_hz", "drift": "percent_per_s"}


def open_scene(name_or_path: str | Path, changes: str = "") -> SceneFile:
    """Open what a device URL names: a scene file in TOML (shipped ones by name), or whatever `load_scene` knows.

    `changes` adds to those of the file: like `dark:at_s=30:factor=2,dead:at_s=40:channel=3`, the keys of [[change]].
    """
    scene = _open(name_or_path)
    if not changes:
        return scene
    tables = [dict(_pair(word) for word in f"kind={one}".split(":")) for one in changes.split(",")]
    added = _Check({"change": tables}, {}, Path(f"changes={changes}")).changes()
    return replace(scene, changes=scene.changes + added)


def _pair(word: str) -> tuple[str, Any]:
    """`key=value` as a key of a TOML file would be read: a number where it is one, else text."""
    key, _, value = word.partition("=")
    for read in (int, float):
        try:
            return key, read(value)
        except ValueError:
            continue
    return key, value


def _open(name_or_path: str | Path) -> SceneFile:
    name = str(name_or_path)
    shipped = SCENE_FOLDER / f"{name}.toml"
    if "/" not in name and "\\" not in name and shipped.is_file():
        return read_scene_file(shipped, name)
    path = Path(name)
    if path.suffix == ".toml" and path.is_file():
        return read_scene_file(path, path.stem)
    scene = load_scene(name_or_path)
    return SceneFile(scene.name, scene)


def read_scene_file(path: Path, name: str) -> SceneFile:
    """Read the scene at `path` and call it `name`; ConfigError with file:line:col for whatever makes no sense."""
    text = toml_text(path, MAX_FILE_BYTES, "a scene")
    tables, positions = read_toml(text, str(path))
    check = _Check(tables, positions, path)
    changes = check.changes()
    kind, values = check.scene()
    if kind == "still":
        return SceneFile(name, check.images(values["images"]), changes)
    return SceneFile(name, check.cells(values) if kind == "cells" else check.tape(values), changes)


@dataclass(frozen=True, slots=True)
class _Check:
    """One file under check; its methods return checked values or raise with the position."""

    tables: dict[str, Any]
    positions: Mapping[KeyPath, Position]
    path: Path

    def fault(self, path: KeyPath, message: str, remedy: str = "") -> ConfigError:
        line, column = position_of(path, self.positions)
        return ConfigError(f"{self.path}:{line}:{column}: {message}", remedy=remedy)

    def scene(self) -> tuple[str, dict[str, Any]]:
        table = {key: value for key, value in self.tables.items() if key != "change"}
        if "kind" not in table:
            raise self.fault((), "kind is missing", f"add kind = {_SHARED['kind'].allowed}")
        kind = self._table({"kind": table["kind"]}, _SHARED, ())["kind"]
        return kind, self._table(table, _SHARED | _RULES[kind], (), f"a scene of kind {kind}")

    def changes(self) -> tuple[Change, ...]:
        listed = self.tables.get("change", [])
        if not isinstance(listed, list) or not all(isinstance(one, dict) for one in listed):
            raise self.fault(("change",), f"change must be a list of tables, found {found(listed)}", "write [[change]]")
        if len(listed) > moving.MAX_CHANGES:
            raise self.fault(("change",), f"{len(listed)} changes, allowed are {moving.MAX_CHANGES}")
        return tuple(self._change(table, ("change", str(number))) for number, table in enumerate(listed))

    def _change(self, table: dict[str, Any], at: KeyPath) -> Change:
        kinds = {"kind": Key("text", choices=CHANGE_KINDS)}
        if "kind" not in table:
            raise self.fault(at, "change.kind is missing", f"add kind = {kinds['kind'].allowed}")
        kind = self._table({"kind": table["kind"]}, kinds, at)["kind"]
        values = self._table(table, kinds | _TIMES | _CHANGE_RULES[kind], at, f"a change of kind {kind}")
        amount = float(values.get(_AMOUNTS.get(kind, ""), 0.0))
        return Change(kind, values["at_s"], values.get("for_s", math.inf), values.get("channel", ALL_CHANNELS), amount)

    def _table(
        self, table: Mapping[str, Any], rules: Mapping[str, Key], at: KeyPath, what: str = "a scene file"
    ) -> dict[str, Any]:
        label = f"{at[0]}." if at else ""
        for key in table:
            if key not in rules:
                remedy = near(key, list(rules), page=_PAGE)
                raise self.fault((*at, key), f"{label}{key} is not a key of {what}: {', '.join(rules)}", remedy)
        for key, rule in rules.items():
            if rule.required and key not in table:
                raise self.fault(at, f"{label}{key} is missing in {what}", f"add {key} = ...: {rule.allowed}")
        return {key: self._value(value, rules[key], (*at, key), label + key) for key, value in table.items()}

    def _value(self, value: Any, rule: Key, at: KeyPath, label: str) -> Any:
        if rule.fits(value) and rule.within(value):
            return float(value) if rule.kind == "number" else value
        remedy = "" if rule.fits(value) else type_remedy(value, rule.kind)
        raise self.fault(at, f"{label} must be {rule.allowed}, found {found(value)}", remedy)

    def images(self, name: str) -> Scene:
        """Pictures by name: a shipped scene, or a file or folder relative to this one."""
        try:
            return load_images(name, self.path.parent)
        except ConfigError as error:
            raise self.fault(("images",), error.message, error.remedy) from error

    def cells(self, values: Mapping[str, Any]) -> Cells:
        """A scene of kind cells, with what needs more than one key."""
        facts = {key: value for key, value in values.items() if key not in ("kind", "images", "leave_out")}
        cells = Cells(self._without(self.images(values["images"]), values.get("leave_out", [])), **facts)
        if cells.gap_s > 0 and cells.gap_s >= cells.gap_every_s:
            message = f"gap_s must be less than gap_every_s = {cells.gap_every_s:g}, found {cells.gap_s:g}"
            raise self.fault(("gap_s",), message)
        height = cells.objects.images.shape[1]
        if cells.objects.any_shape or cells.offset_px >= height:
            message = f"the cells need pictures higher than offset_px = {cells.offset_px}, found {height} rows"
            raise self.fault(("images",), message, f"the targets {', '.join(TARGETS)} are no cells")
        return cells

    def _without(self, objects: Scene, left_out: list[str]) -> Scene:
        for name in left_out:
            if name not in objects.classes:
                known = ", ".join(objects.classes) or "none"
                raise self.fault(("leave_out",), f'leave_out names "{name}", the classes are {known}')
        numbers = [objects.classes.index(name) for name in left_out]
        kept = ~np.isin(objects.labels, numbers)
        if not kept.any():
            raise self.fault(("leave_out",), "leave_out leaves no picture")
        return replace(objects, images=objects.images[kept], labels=objects.labels[kept])

    def tape(self, values: Mapping[str, Any]) -> Tape:
        """A scene of kind tape, with what needs more than one key."""
        facts = {key: value for key, value in values.items() if key not in ("kind", "file")}
        bits = self._bits(values["file"]) if "file" in values else np.zeros(0, np.uint8)
        tape = Tape(**facts, file_bits=bits)
        if set(tape.target) - {"0", "1"} or len(tape.target) > tape.bars:
            message = f"target must be up to {tape.bars} digits 0 and 1, found {found(tape.target)}"
            raise self.fault(("target",), message)
        if tape.jitter_bars > 0 and not tape.jitter_time_s:
            raise self.fault(("jitter_bars",), "jitter_bars needs jitter_time_s, its correlation time")
        return tape

    def _bits(self, name: str) -> NDArray[np.uint8]:
        path = self.path.parent / name
        try:
            with open(path, "rb") as file:
                data = file.read(MAX_TAPE_BITS + 1)
        except OSError as error:
            raise self.fault(("file",), f"{path}: cannot be read: {error.strerror or error}") from error
        digits = np.frombuffer(data.translate(None, b" \t\r\n"), np.uint8)
        if len(data) > MAX_TAPE_BITS or not len(digits) or not np.isin(digits, (48, 49)).all():
            raise self.fault(("file",), f"{path}: must hold 1 to {MAX_TAPE_BITS} digits 0 and 1, and nothing else")
        return digits - np.uint8(48)


def scene_on_table(
    name: str, changes: str, optics: str, profile: Profile, bleach: str = "", seed: int = 0
) -> SceneFile:
    """Open the scene `name` with `changes` where `profile` says, or where `optics` does; ConfigError for one that moves.

    `optics` is as of `--optics`; keys that it does not name are as the profile states them. `bleach` is as of `--bleach`; `seed` chooses
    the pixels that jump.
    """
    scene = _bleaching(open_scene(name, changes), bleach)
    imaging = profile.imaging()
    if is_spec(optics):
        imaging = imaging_of(optics, imaging)
    scene = _drifting(scene, profile)
    scene = replace(scene, changes=(*scene.changes, *reading_changes(profile, seed)))
    if imaging.is_identity:
        return scene
    if not isinstance(scene.what, Scene):
        raise ConfigError(
            f"scene {scene.name!r} moves: optics other than perfect ones are simulated for still objects",
            remedy="leave the optics out, or choose a scene of still objects",
        )
    return replace(scene, what=replace(scene.what, imaging=imaging))


def _bleaching(scene: SceneFile, bleach: str) -> SceneFile:
    if not bleach:
        return scene
    if not isinstance(scene.what, Scene):
        raise ConfigError(
            f"scene {scene.name!r} moves: bleaching is simulated for still objects",
            remedy="leave bleach= out, or choose a scene of still objects",
        )
    return replace(scene, what=replace(scene.what, bleaching=bleaching_of(bleach)))


def _drifting(scene: SceneFile, profile: Profile) -> SceneFile:
    """Let the source drift as the profile states, for as long as a run may last."""
    drift = 0.0 if profile.optics is None else profile.optics.source_drift_percent_per_hour
    if not drift:
        return scene
    return replace(scene, changes=(*scene.changes, Change("drift", 0.0, math.inf, ALL_CHANNELS, drift / 3600)))


def reading_changes(profile: Profile, seed: int) -> tuple[Change, ...]:
    """Return what the profile states of readings that shift: a threshold that drifts, and pixels that jump between two levels."""
    detector, changes = profile.detector, []
    if detector.threshold_drift_e_per_hour:
        changes.append(Change("threshold", 0.0, math.inf, ALL_CHANNELS, detector.threshold_drift_e_per_hour / 3600))
    jumping = round(detector.telegraph_share * detector.channels)
    order = np.argsort(uniform_numbers(seed, 0, detector.channels, 1, TELEGRAPH_STREAM)[:, 0])
    for channel in np.sort(order[:jumping]).tolist():
        changes.append(
            Change("telegraph", float(seed % 2**32), detector.telegraph_time_s, channel, detector.telegraph_offset_e)
        )
    return tuple(changes)
