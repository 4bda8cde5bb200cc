"""Compiled programs that the next process can use."""

from __future__ import annotations

import hashlib
import os
import platform
import sys
from pathlib import Path

__all__ = ["cache_folder", "keep_compiled"]

_LARGEST = 512 * 2**20  # bytes; the programs that were not used for longest go first
_SECONDS = 0.02  # to compile; what takes less is not worth a file, unless JAX's own variable says otherwise
_OFF = ("off", "0", "")


def cache_folder() -> Path | None:
    """Where compiled programs are kept: below ``JAXSMOOTH_CACHE``, else the user's cache folder.

    One folder for every kind of processor, for programs are compiled for the one they run on; None where
    ``JAXSMOOTH_CACHE`` is ``off``.
    """
    chosen = os.environ.get("JAXSMOOTH_CACHE")
    if chosen is not None and chosen.lower() in _OFF:
        return None
    if chosen is None:
        home = Path.home() / ("Library/Caches" if sys.platform == "darwin" else ".cache")
        chosen = str(Path(os.environ.get("XDG_CACHE_HOME") or home) / "jaxsmooth")
    return Path(chosen) / _processor()


def _processor() -> str:
    """What programs that are compiled for this machine depend on."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        features = next(line for line in lines if line.startswith(("flags", "Features")))
    except (OSError, StopIteration):
        features = platform.processor()
    return f"{platform.machine()}-{hashlib.sha256(features.encode()).hexdigest()[:12]}"


def keep_compiled(folder: str | os.PathLike | None = None) -> Path | None:
    """Keep what JAX compiles from now on, and use what was kept.

    The command line does so by default.  Several processes may share a folder.  Programs that compile faster
    than 0.02 s, or ``JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS``, are not kept.  Where XLA complains about
    features of the processor as it loads a program, nothing is wrong; ``TF_CPP_MIN_LOG_LEVEL=3`` in the
    environment, set before JAX is imported, silences it.

    Args:
        folder: by default `cache_folder`.

    Returns:
        The folder, or None where there is none or it can't be written.
    """
    import jax

    path = cache_folder() if folder is None else Path(folder)
    if path is None:
        return None
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    if not os.access(path, os.W_OK):
        return None
    jax.config.update("jax_compilation_cache_dir", str(path))
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", _SECONDS)
    jax.config.update("jax_compilation_cache_max_size", _LARGEST)
    return path
