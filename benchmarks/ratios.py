"""Measurements as JSON, and whether their ratios have become worse."""

from __future__ import annotations

import argparse
import json
import platform
from pathlib import Path
from typing import Any

__all__ = ["parser", "settle"]

_LOSS = 1.15  # a ratio that has grown by more is a loss


def parser(text: str | None) -> argparse.ArgumentParser:
    """With the option that all of these benchmarks have."""
    made = argparse.ArgumentParser(description=text, formatter_class=argparse.RawTextHelpFormatter)
    made.add_argument("--check", action="store_true", help="compare with the stored ratios; 1 for a loss")
    return made


def settle(path: Path, rows: dict[str, dict[str, Any]], check: bool) -> int:
    """Store rows of measurements, or compare their ``"ratio"`` with those that are stored.

    Ratios are taken in one run, to a reference that does not depend on this project, so that a slower or a
    busier machine changes them little.

    Args:
        path: the JSON file.
        rows: measurements by name.
        check: compare, and write nothing.

    Returns:
        An exit code: 1 where a ratio has grown by more than 15 %.
    """
    if not check:
        content = {"machine": platform.machine(), "rows": rows}
        path.write_text(json.dumps(content, indent=1) + "\n")
        return 0
    stored = json.loads(path.read_text())["rows"]
    lost = [
        f"{name}: {row['ratio']:.2f}, was {stored[name]['ratio']:.2f}"
        for name, row in rows.items()
        if name in stored and row.get("ratio", 0) > _LOSS * stored[name].get("ratio", float("inf"))
    ]
    print("\n".join(["slower:", *lost] if lost else ["no ratio has grown by more than 15 %"]))
    return int(bool(lost))
