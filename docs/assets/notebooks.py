"""The notebooks of the tutorial: executed, with what they print and draw kept in the file, and shown as pages of the site.

python docs/assets/notebooks.py        executes all of them (extras `train`, `sklearn`, `plot`, `notebook`)
"""

import json
import re
import tempfile
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parents[1] / "tutorial"
TEXT_MAX = 4000  # characters of one output
LINK = re.compile(r"\(([\w-]+)\.ipynb\)")  # from notebook to notebook; on the site from page to page


def notebooks() -> list[Path]:
    """Return the notebooks of the tutorial."""
    return sorted(FOLDER.glob("*.ipynb"))


def executed(path: Path, folder: Path) -> dict[str, Any]:
    """Return the notebook at `path`, executed in `folder`, with its outputs and nothing of the machine."""
    import nbclient
    import nbformat

    notebook = nbformat.read(path, as_version=4)
    nbclient.NotebookClient(notebook, timeout=120, resources={"metadata": {"path": str(folder)}}).execute()
    for cell in notebook.cells:
        cell.metadata = {}
        for output in cell.get("outputs", ()):
            output.pop("metadata", None)
        if cell.cell_type == "code":
            cell.outputs = [output for output in cell.outputs if _text(output)]
    notebook.metadata = {"language_info": {"name": "python"}}
    return json.loads(nbformat.writes(notebook))


def _text(output: dict[str, Any]) -> str:
    """What is shown of an output, in Markdown; "" of one that shows nothing."""
    if output["output_type"] == "stream":
        return _fenced(output["text"]) if output["name"] == "stdout" else ""
    data = output.get("data", {})
    if "image/png" in data:
        return f'<img alt="what the cell above draws" src="data:image/png;base64,{"".join(data["image/png"]).strip()}">'
    if "text/html" in data:
        return re.sub(r"\s*\n\s*", " ", "".join(data["text/html"])).strip()
    return _fenced(data.get("text/plain", ""))


def _fenced(text: str | list[str]) -> str:
    whole = "".join(text)[:TEXT_MAX].rstrip()
    return f"```text\n{whole}\n```" if whole else ""


def page_of(path: Path) -> str:
    """Return the notebook at `path` as Markdown."""
    parts = []
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        source = LINK.sub(r"(\1.md)", "".join(cell["source"]))
        parts += (
            [f"```python\n{source}\n```", *map(_text, cell["outputs"])] if cell["cell_type"] == "code" else [source]
        )
    parts.insert(1, f"[Download this notebook]({path.name}).")
    return "\n\n".join(part for part in parts if part)


def on_files(files: Any, config: Any) -> Any:
    """Add a page for every notebook (called by mkdocs)."""
    from mkdocs.structure.files import File

    for path in notebooks():
        files.append(File.generated(config, f"tutorial/{path.stem}.md", content=page_of(path)))
    return files


def main() -> None:
    """Execute every notebook, each in a folder of its own, and keep what it shows."""
    for path in notebooks():
        with tempfile.TemporaryDirectory() as folder:
            whole = executed(path, Path(folder))
        path.write_text(json.dumps(whole, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
