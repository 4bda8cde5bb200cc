"""Pages of the site that are made when it is built: notebooks, their gallery, benchmarks, changes.

MkDocs runs this as a hook; it needs no network and executes nothing.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
_TABLES = {
    "PEERS": "Beside other smoothers",
    "CURVED": "Curved boundaries",
    "SURFACES": "Surfaces",
    "UNTANGLING": "Tangled meshes",
    "DERIVATIVES": "Derivatives",
    "FILES": "Files in, files out",
    "PAIRS": "From format to format",
}
_NUMBERS = {
    "startup": "Whole processes, from the first import to the last file",
    "scaling": "Growth of a step with the mesh, microseconds an element",
}


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that are made."""
    for name, content in made().items():
        files.append(File.generated(config, name, content=content))
    return files


def made() -> dict[str, str | bytes]:
    """Every such page and picture, by its path in the site."""
    pages: dict[str, str | bytes] = {"changes.md": _linked((ROOT / "CHANGELOG.md").read_text())}
    gallery = ["# Gallery\n\nThe pictures of the notebooks, with the code that draws them behind each.\n"]
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        text, pictures = _notebook(path)
        pages[f"notebooks/{path.stem}.md"] = text
        pages |= {f"notebooks/{name}": content for name, content in pictures.items()}
        title = re.search(r"^# (.+)$", text, re.M)
        gallery.append(f"## [{title[1] if title else path.stem}](notebooks/{path.stem}.md)\n")
        gallery += [f"[![](notebooks/{name}){{width=320}}](notebooks/{path.stem}.md)" for name in pictures]
        gallery.append("")
    pages["gallery.md"] = "\n".join(gallery)
    pages["benchmarks.md"] = _benchmarks(pages)
    return pages


def _notebook(path: Path) -> tuple[str, dict[str, bytes]]:
    """A notebook as a page, and its pictures."""
    from nbconvert import MarkdownExporter

    text, resources = MarkdownExporter().from_filename(str(path))
    pictures = {f"{path.stem}-{name}": content for name, content in resources["outputs"].items()}
    for name in resources["outputs"]:
        text = text.replace(f"]({name})", f"]({path.stem}-{name})")
    text = re.sub(r"<style[^>]*>.*?</style>", "", text, flags=re.S)
    text = re.sub(r"\]\((\w+)\.ipynb\)", r"](\1.md)", text)
    return re.sub(r"\]\((?:\.\./)?docs/", "](../", text), pictures


def _benchmarks(pages: dict[str, str | bytes]) -> str:
    """The list of tables, each a page of its own, and the numbers that are kept as JSON."""
    out = ["# Benchmarks\n\nWhat was measured, each table by one command that its page names.\n"]
    for name, title in _TABLES.items():
        if (path := ROOT / "benchmarks" / f"{name}.md").exists():
            pages[f"benchmarks/{name.lower()}.md"] = _without_code(path.read_text())
            out.append(f"- [{title}](benchmarks/{name.lower()}.md)")
    for name, title in _NUMBERS.items():
        rows = json.loads((ROOT / "benchmarks" / f"{name}.json").read_text())["rows"]
        heads = list(dict.fromkeys(key for row in rows.values() for key in row))
        out += [f"\n## {title}\n", f"`python -m benchmarks.{name}`\n"]
        out += [f"| | {' | '.join(heads)} |", f"|---|{'---:|' * len(heads)}"]
        for label, row in rows.items():
            out.append(f"| {label} | {' | '.join(_number(row.get(head)) for head in heads)} |")
    return "\n".join(out) + "\n"


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:,}" if isinstance(value, int) else f"{value:.3g}"


def _linked(text: str) -> str:
    """Links from the root of the project as links from the root of the site."""
    text = re.sub(r"\]\(docs/", "](", text)
    text = re.sub(r"\]\(benchmarks/(\w+)\.md\)", lambda found: found[0].lower(), text)
    return _without_code(text)


def _without_code(text: str) -> str:
    """Text in place of links to what is not a page of the site."""
    return re.sub(r"\[([^\]]+)\]\((?!https?:|[\w/]+\.md)[^)]*\)", r"\1", text)
