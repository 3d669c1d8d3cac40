"""The order of the packages, as pyproject.toml states it: who may import whom, no circle, and what importing a package loads."""

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

import pytest
from tree import ROOT

LAYERS: dict[str, list[str]] = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["pans"]["layers"]
BELOW = {"runtime": {"hw_profiles"}, "trainer": {"runtime", "hw_profiles"}, "firmware_sim": {"runtime", "hw_profiles"}}
STARTED = re.compile(r"-m[\"', ]+(pans(?:\.\w+)+)")  # another process: `python -m pans...`, as words of a list too


@cache
def modules() -> dict[str, Path]:
    """Dotted name -> file of every module."""
    files = [path for top in LAYERS for path in (ROOT / top).rglob("*.py") if "__pycache__" not in path.parts]
    names = {"pans." + ".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in files}
    return {name.removesuffix(".__init__"): path for name, path in names.items()}


def imports(name: str) -> Iterator[str]:
    """Yield the modules of ours that a module imports, late imports and those for types included."""
    path = modules()[name]
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in modules())
        elif isinstance(node, ast.ImportFrom):
            parent = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*parent, *([node.module] if node.module else [])])
            for alias in node.names:
                full = f"{base}.{alias.name}"
                if full in modules() or base in modules():
                    yield full if full in modules() else base


def place(name: str) -> tuple[str, str]:
    """Return the top folder and the package that a module belongs to ("" for one beside the packages)."""
    _, top, *rest = name.split(".")
    return top, rest[0] if rest and rest[0] in LAYERS[top] else ""


def is_allowed(importer: str, imported: str) -> bool:
    (top, package), (other_top, other) = place(importer), place(imported)
    if top != other_top:
        return other_top in BELOW.get(top, ())
    return LAYERS[top].index(other) <= LAYERS[top].index(package)


def test_every_folder_has_its_place_in_the_order() -> None:
    for top, packages in LAYERS.items():
        found = {path.parent.name for path in (ROOT / top).glob("*/__init__.py")}
        assert found - {"api"} == set(packages) - {""}, top  # api is `import pans` itself, above all


@pytest.mark.parametrize("top", LAYERS)
def test_each_package_imports_only_those_before_it(top: str) -> None:
    ours = [name for name in modules() if name.split(".")[1] == top and not is_the_door(name)]
    wrong = {f"{name} imports {one}" for name in ours for one in imports(name) if not is_allowed(name, one)}
    assert not wrong, "\n".join(sorted(wrong))


def is_the_door(name: str) -> bool:
    """`python -m pans.firmware_sim` and `import pans` stand above everything in their folder."""
    return name.endswith(".__main__") or name.split(".")[:3] == ["pans", "runtime", "api"]


@pytest.mark.parametrize("top", LAYERS)
def test_what_is_started_as_a_process_exists_and_stands_below(top: str) -> None:
    for name, path in modules().items():
        if name.split(".")[1] != top:
            continue
        for started in STARTED.findall(path.read_text()):
            assert started in modules(), f"{path}: starts {started}, which does not exist"
            own_kind = started.split(".")[1] == top
            assert not own_kind or is_the_door(f"{started}.__main__") or is_allowed(name, started), f"{path}: {started}"


def test_no_module_imports_itself_in_a_circle() -> None:
    graph = {name: set(imports(name)) - {name} for name in modules()}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


FACES = sorted(
    f"pans.{path.parent.relative_to(ROOT).as_posix().replace('/', '.')}".replace("pans.runtime.api", "pans")
    for top in ("runtime", "firmware_sim")
    for path in ROOT.glob(f"{top}/*/__init__.py")
)
SLOW_TO_LOAD = ("numba", "onnxruntime", "torch", "matplotlib", "h5py", "scipy", "serial", "usb", "rich")


@pytest.mark.parametrize("package", ["pans", "pans.runtime", "pans.runtime.cli", "pans.firmware_sim"])
def test_what_every_command_loads_is_light(package: str) -> None:
    code = f"import sys, {package}; print(*(name for name in {SLOW_TO_LOAD!r} if name in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


@pytest.mark.parametrize("package", FACES)
def test_a_public_name_is_never_hidden_by_a_module_of_that_name(package: str) -> None:
    face = importlib.import_module(package)
    for name in getattr(face, "__all__", ()):
        if importlib.util.find_spec(f"{face.__name__}.{name}") is not None:
            importlib.import_module(f"{face.__name__}.{name}")
            assert not isinstance(getattr(face, name), ModuleType), name
