"""Compiled programs that the next process uses."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import meshes
import meshio
import numpy as np


def _run(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "JAXSMOOTH_CACHE": str(folder / "cache"), "COLUMNS": "80"}
    environment["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"  # quick or not, all are kept
    environment.pop("TF_CPP_MIN_LOG_LEVEL", None)
    command = [sys.executable, "-m", "jaxsmooth", *words]
    return subprocess.run(command, capture_output=True, text=True, env=environment, cwd=Path.cwd())


def test_the_second_process_compiles_nothing_and_says_nothing_of_it(tmp_path):
    points, blocks = meshes.grid("triangle")
    points = np.c_[meshes.jiggle(points, 0.1, 0), np.zeros(len(points))]
    meshio.Mesh(points, list(blocks.items())).write(tmp_path / "in.vtu")
    words = ["smooth", str(tmp_path / "in.vtu"), "--steps", "1"]
    first = _run(tmp_path, *words[:2], str(tmp_path / "one.vtu"), *words[2:])
    assert (first.returncode, first.stderr) == (0, "")
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "cache").rglob("*-cache")}
    assert kept
    second = _run(tmp_path, *words[:2], str(tmp_path / "two.vtu"), *words[2:])
    assert (second.returncode, second.stderr) == (0, "")
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "cache").rglob("*-cache")} == kept
    assert (tmp_path / "one.vtu").read_bytes() == (tmp_path / "two.vtu").read_bytes()
    alone = _run(tmp_path, *words[:2], str(tmp_path / "three.vtu"), *words[2:], "--no-cache")
    assert (alone.returncode, len(kept)) == (0, len(list((tmp_path / "cache").rglob("*-cache"))))
