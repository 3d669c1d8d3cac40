"""The rooms, as pyproject.toml states them: who may import whom, through which faces, no circle, and what importing a room loads.

Every import counts: at the top of a module, in a function, under TYPE_CHECKING, and by `import_module` with a literal name.
"""

import ast
import importlib.util
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import pytest
from tree import FOLDERS, ROOT, name_of

ROOMS: dict[str, list[str]] = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["pans"]["rooms"]
PUBLIC_MOST = 5  # modules of a room that other rooms may import
IMPORTED_MOST = 60  # modules of pans that are imported from another room
ABOVE = ("pans", "pans.__main__", "pans.ophyd", "pans.runtime")  # the interface itself, above all rooms
STARTED = re.compile(
    r"-m[\"', ]+(pans(?:_trainer|_sim)?(?:\.\w+)*)"
)  # another process: `python -m pans...`, as words of a list too


class Import(NamedTuple):
    """An import of a module of ours; `by_name` where a string names it."""

    line: int
    module: str
    by_name: bool


@cache
def modules() -> dict[str, Path]:
    """Dotted name -> file of every module."""
    return {name_of(path): path for folder in FOLDERS.values() for path in sorted((ROOT / folder).rglob("*.py"))}


@cache
def imports(name: str) -> tuple[Import, ...]:
    """Return the modules of ours that a module imports, each as the module that Python would load last."""
    return tuple(
        Import(line, known, by_name)
        for line, found, by_name in _written(name)
        if (known := _nearest(found)) is not None and known != name
    )


def _written(name: str) -> Iterator[tuple[int, str, bool]]:
    path = modules()[name]
    package = name.split(".") if path.name == "__init__.py" else name.split(".")[:-1]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name, False) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            base = [*base, *([node.module] if node.module else [])]
            yield from ((node.lineno, ".".join([*base, alias.name]), False) for alias in node.names)
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            called, text = ast.unparse(node.func).rpartition(".")[2], node.args[0].value
            if called in ("import_module", "__import__") and isinstance(text, str):
                yield node.lineno, ".".join([*package, text[1:]]) if text.startswith(".") else text, True


def _nearest(name: str) -> str | None:
    """Return the longest part of a dotted name that is a module of ours."""
    while name and name not in modules():
        name = name.rpartition(".")[0]
    return name or None


def room_of(name: str) -> tuple[str, str]:
    """Return distribution and room of a module: ("pans", "live"); "" for the modules at the top."""
    top, _, rest = name.partition(".")
    first = rest.partition(".")[0]
    return top, first if first in ROOMS[top] else ""


def is_allowed(importer: str, imported: str) -> bool:
    """Whether the order lets one module import another."""
    (top, room), (other_top, other) = room_of(importer), room_of(imported)
    if importer in ABOVE or importer.endswith(".__main__"):
        return True
    if top != other_top:
        return other_top == "pans" and top != "pans"
    if imported == "pans":
        return False  # the interface stands above the rooms
    return ROOMS[top].index(other) <= ROOMS[top].index(room)


def public(room: str) -> set[str]:
    """Return the modules that a room's docstring names after "import"; its face itself is public too."""
    text = ast.get_docstring(ast.parse(modules()[f"pans.{room}"].read_text(encoding="utf-8"))) or ""
    found = re.search(r"(?s)(?:Other rooms|Packages that add commands) import (.*?)(?:\.(?:\s|$)|$)", text)
    assert found, f"pans.{room}: its docstring does not say what other rooms import"
    return {f"pans.{room}.{word}" for word in re.findall(r"\w+", found[1]) if f"pans.{room}.{word}" in modules()}


def handed_out(face: str) -> set[str]:
    """Return the modules that a package hands out as a whole: `from . import kernels as kernels`."""
    tree = ast.parse(modules()[face].read_text(encoding="utf-8"))
    whole = [node for node in tree.body if isinstance(node, ast.ImportFrom) and node.level == 1 and node.module is None]
    return {f"{face}.{alias.name}" for node in whole for alias in node.names}


def test_every_folder_has_its_place_in_the_order() -> None:
    for top, folder in FOLDERS.items():
        found = {path.parent.name for path in (ROOT / folder).glob("*/__init__.py")}
        assert found == set(ROOMS[top]) - {""}, top


@pytest.mark.parametrize("top", ROOMS)
def test_each_room_imports_only_those_before_it(top: str) -> None:
    ours = [name for name in modules() if room_of(name)[0] == top]
    wrong = [
        f"{name}:{one.line} imports {one.module}"
        for name in ours
        for one in imports(name)
        if not is_allowed(name, one.module)
    ]
    assert not wrong, "\n".join(wrong)


def test_no_module_of_ours_is_imported_by_a_string() -> None:
    wrong = [f"{name}:{one.line} {one.module}" for name in modules() for one in imports(name) if one.by_name]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("room", ROOMS["pans"])
def test_a_room_has_a_face_of_few_modules(room: str) -> None:
    assert 1 <= len(public(room)) <= PUBLIC_MOST, sorted(public(room))
    text = ast.get_docstring(ast.parse(modules()[f"pans.{room}"].read_text(encoding="utf-8"))) or ""
    assert text.count("\n") <= 9
    for word in ("In:", "Out:", "Start at"):
        assert word in text, f"pans.{room}: its docstring lacks {word!r}"
    for path in re.findall(r"\b(?:\w+/)*\w+\.py\b", text):
        assert (modules()[f"pans.{room}"].parent / path).is_file(), f"pans.{room}: {path} is not there"


def test_other_rooms_and_packages_import_faces_alone() -> None:
    faces = {one for room in ROOMS["pans"] for one in {f"pans.{room}", *public(room)}}
    faces |= {one for face in faces for one in handed_out(face)}
    imported = {
        (name, one.line, one.module)
        for name in modules()
        for one in imports(name)
        if name not in ABOVE
        and room_of(one.module)[0] == "pans"
        and room_of(one.module)[1]
        and room_of(name) != room_of(one.module)
    }
    wrong = [f"{name}:{line} {module}" for name, line, module in sorted(imported) if module not in faces]
    assert not wrong, "\n".join(wrong)
    assert len({module for name, _, module in imported if name.startswith("pans.")}) <= IMPORTED_MOST


@pytest.mark.parametrize("top", ROOMS)
def test_what_is_started_as_a_process_exists(top: str) -> None:
    for name, path in modules().items():
        if room_of(name)[0] == top:
            for started in STARTED.findall(path.read_text(encoding="utf-8")):
                assert started in modules() or f"{started}.__main__" in modules(), f"{path}: starts {started}"


def test_no_module_imports_itself_in_a_circle() -> None:
    graph = {name: {one.module for one in imports(name) if not name.startswith(f"{one.module}.")} for name in modules()}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


SLOW_TO_LOAD = ("numba", "onnxruntime", "torch", "matplotlib", "h5py", "scipy", "serial", "usb", "rich")


@pytest.mark.parametrize("package", ["pans", "pans.app.main", "pans_sim"])
def test_what_every_command_loads_is_light(package: str) -> None:
    code = f"import sys, {package}; print(*(name for name in {SLOW_TO_LOAD!r} if name in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


@pytest.mark.parametrize("package", sorted(name for name, path in modules().items() if path.name == "__init__.py"))
def test_a_public_name_is_never_hidden_by_a_module_of_that_name(package: str) -> None:
    if package.startswith("pans_trainer"):
        pytest.importorskip("torch", reason="needs the train extra")
    face = importlib.import_module(package)
    for name in getattr(face, "__all__", ()):
        if (
            package != "pans"
            and f"{package}.{name}" not in handed_out(package)
            and importlib.util.find_spec(f"{package}.{name}") is not None
        ):
            importlib.import_module(f"{package}.{name}")
            assert not isinstance(getattr(face, name), ModuleType), name


def test_an_import_of_the_old_package_says_where_it_is_now() -> None:
    with pytest.raises(ImportError, match=r"pans\.runtime is pans itself now"):
        importlib.import_module("pans.runtime")
