"""Where the checkout is, and what its modules are called: tests that read documents, sources or shipped files start here."""

from pathlib import Path

ROOT = Path(__file__).parents[2]
FOLDERS = {"pans": "runtime/pans", "pans_trainer": "trainer/pans_trainer", "pans_sim": "firmware_sim/pans_sim"}


def name_of(path: Path) -> str:
    """Return the dotted name of a module of ours by its file."""
    return ".".join(path.relative_to(ROOT).with_suffix("").parts[1:]).removesuffix(".__init__")
