"""The house rules: who imports whom, what the lean runtime never loads, and that the wheel holds the tree."""

from __future__ import annotations

import ast
import importlib.util
import os
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from tree import ROOT

PACKAGES = ("runtime", "trainer", "firmware_sim", "hw_profiles")
ALLOWED = {
    "runtime": {"hw_profiles"},
    "trainer": {"runtime", "hw_profiles"},
    "firmware_sim": {"runtime", "hw_profiles"},
    "hw_profiles": set(),
}
HEAVY = ("torch", "matplotlib", "h5py", "optuna", "onnx", "scipy", "pandas")


def modules(package: str) -> list[Path]:
    return sorted(path for path in (ROOT / package).rglob("*.py") if "__pycache__" not in path.parts)


def imported(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return names


@pytest.mark.parametrize("package", PACKAGES)
def test_who_imports_whom(package: str) -> None:
    for path in modules(package):
        ours = {name.split(".")[1] for name in imported(path) if name.startswith("pans.")}
        strangers = ours - ALLOWED[package] - {package}
        assert not strangers, f"{path.relative_to(ROOT)} imports pans.{strangers}"
        bare = {name.split(".")[0] for name in imported(path)} & set(PACKAGES)
        assert not bare, f"{path.relative_to(ROOT)} imports a bare {bare}: a second copy of every class"


@pytest.mark.parametrize("package", ["runtime", "firmware_sim"])
def test_the_lean_half_names_no_heavy_library(package: str) -> None:
    for path in modules(package):
        heavy = {name.split(".")[0] for name in imported(path)} & set(HEAVY)
        assert not heavy, f"{path.relative_to(ROOT)} imports {heavy}"


def test_nothing_pickles() -> None:
    for package in PACKAGES:
        for path in modules(package):
            assert "pickle" not in {name.split(".")[0] for name in imported(path)}, path
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "load":
                    words = {word.arg: word.value for word in node.keywords}
                    target = ast.unparse(node.func.value)
                    if target in ("np", "numpy"):
                        allow = words.get("allow_pickle")
                        assert isinstance(allow, ast.Constant), f"{path}: np.load without allow_pickle=False"
                        assert allow.value is False, path


def test_a_run_loads_no_heavy_library(tmp_path: Path) -> None:
    code = f"""
import sys
from pans.runtime.cli import main
code = main(["demo", "--pace", "fast", "--trials", "1", "--out", sys.argv[1], "--json"])
heavy = [name for name in {HEAVY!r} if name in sys.modules]
assert not heavy, heavy
sys.exit(code)
"""
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, timeout=120)
    assert done.returncode in (0, 1), done.stderr


def test_the_packages_import_only_under_their_names() -> None:
    for package in PACKAGES:
        assert importlib.util.find_spec(package) is None, f"a bare `import {package}` works: the root is on sys.path"
        assert importlib.util.find_spec(f"pans.{package}") is not None


def test_only_tests_have_a_conftest() -> None:
    assert [path.relative_to(ROOT).as_posix() for path in ROOT.glob("**/conftest.py") if ".venv" not in path.parts] == [
        "tests/conftest.py"
    ]


def test_every_module_says_what_it_owns() -> None:
    for package in PACKAGES:
        for path in modules(package):
            assert ast.get_docstring(ast.parse(path.read_text())), path


def test_the_package_list_is_complete() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    folders = {path.parent for package in PACKAGES for path in modules(package)}
    assert set(settings["packages"]) == {"pans." + ".".join(folder.relative_to(ROOT).parts) for folder in folders}
    for folder in folders:
        assert (folder / "__init__.py").is_file(), folder


@pytest.mark.skipif(os.environ.get("PANS_SKIP_WHEEL") == "1", reason="PANS_SKIP_WHEEL=1: no build tools here")
def test_the_wheel_holds_the_tree(tmp_path: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "--no-deps",
        "--no-build-isolation",
        "-q",
        "-w",
        str(tmp_path),
        str(ROOT),
    ]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode and "setuptools" in done.stderr:
        pytest.skip("setuptools is not installed beside pip: the wheel cannot be built without network")
    assert done.returncode == 0, done.stderr
    (wheel,) = tmp_path.glob("*.whl")
    held = set(zipfile.ZipFile(wheel).namelist())
    tracked = subprocess.run(["git", "ls-files", *PACKAGES], cwd=ROOT, capture_output=True, text=True)
    wanted = {f"pans/{name}" for name in tracked.stdout.split()}
    if not wanted:
        pytest.skip("no git here: the tree's files are not known")
    assert wanted <= held, wanted - held
    code = {name for name in held if name.startswith("pans/")}
    assert {name for name in code if name.endswith(".py")} <= wanted | {
        f"pans/{p.relative_to(ROOT)}" for q in PACKAGES for p in modules(q)
    }
