"""Rules for the whole tree: what the lean runtime never loads, that nothing pickles, and that the wheel holds the tree."""

import ast
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from tree import ROOT

PACKAGES = ("runtime", "trainer", "firmware_sim")
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
asked = []
class Watch:
    def find_spec(self, name, path=None, target=None):
        frame = sys._getframe(1)
        while frame.f_globals["__name__"].startswith("importlib"):
            frame = frame.f_back
        asked.append((name, frame.f_globals["__name__"])) if name in {HEAVY!r} else None
sys.meta_path.insert(0, Watch())
from pans.app.main import main
code = main(["demo", "--pace", "fast", "--trials", "1", "--out", sys.argv[1], "--json"])
assert not [one for one in asked if one[1].startswith("pans")], asked
heavy = {{*{HEAVY!r}}} & {{*sys.modules}} - {{"scipy"}}  # which numba loads where it is installed
assert not heavy, heavy
sys.exit(code)
"""
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, timeout=120)
    assert done.returncode in (0, 1), done.stderr


def test_only_tests_have_a_conftest() -> None:
    found = [path for path in ROOT.glob("**/conftest.py") if ".venv" not in path.parts]
    assert found == [ROOT / "tests/conftest.py"]


def test_every_module_says_what_it_owns() -> None:
    for package in PACKAGES:
        for path in modules(package):
            assert ast.get_docstring(ast.parse(path.read_text())), path


def test_the_wheel_holds_the_tree(tmp_path: Path) -> None:
    pytest.importorskip("hatchling", reason="the build system is not installed")
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True).stdout.split()
    if not tracked:
        pytest.skip("no git here: the tree's files are not known")
    kept = [name for name in tracked if (ROOT / name).is_file() and not name.startswith(("docs/", "tests/"))]
    for name in kept:  # a copy: a build leaves files
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    options = ["--no-deps", "--no-build-isolation", "-q", "-w", str(tmp_path / "wheel")]
    subprocess.run([sys.executable, "-m", "pip", "wheel", *options, str(tmp_path)], check=True)
    (wheel,) = (tmp_path / "wheel").glob("*.whl")
    held = {name for name in zipfile.ZipFile(wheel).namelist() if name.startswith("pans") and ".dist-info/" not in name}
    wanted = {name.partition("/")[2] for name in kept if name.startswith(("runtime/", "trainer/", "firmware_sim/"))}
    assert held == wanted | {f"pans/{name}" for name in kept if name.startswith("hw_profiles/")}
