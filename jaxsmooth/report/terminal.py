"""What the command line says: to standard output and standard error, in whatever state these are."""

from __future__ import annotations

import contextlib
import io
import os
import signal
import sys
import threading

__all__ = ["close_standard_output", "complain", "prepare_streams", "sentence", "write_to_standard_output"]


def prepare_streams() -> None:
    """Let σ, … and any file's name go to terminals that don't know them, and a reader go away (``| head``).

    Writing to nobody is an error then, as Python has it, and not the end of the process: some libraries
    undo that.
    """
    if hasattr(signal, "SIGPIPE") and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGPIPE, signal.SIG_IGN)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def sentence(error: BaseException) -> str | None:
    """What to tell the user about an error; None for errors of the program itself."""
    if _out_of_memory(error):
        return "out of memory; use a machine with more of it, --precision float32 or a smaller mesh"
    if isinstance(error, OSError) and error.errno is not None:
        return f"{error.filename or 'standard output'}: {error.strerror}"
    if isinstance(error, (ValueError, OSError, ImportError)):
        return " ".join(str(error).splitlines())
    return None


def _out_of_memory(error: BaseException | None) -> bool:
    """NumPy's, JAX's and C++'s ways to say it; those who read and write meshes wrap it."""
    while error is not None:
        words = ("RESOURCE_EXHAUSTED", "bad_alloc") if isinstance(error, RuntimeError) else ()
        if isinstance(error, MemoryError) or any(word in str(error) for word in words):
            return True
        error = error.__cause__
    return False


def complain(text: str) -> None:
    """A line on standard error; also from within a signal handler, where a stream may be in use."""
    line = f"jaxsmooth: {text}\n"
    # nobody to tell; or RuntimeError: an interrupt came while the stream was written
    with contextlib.suppress(OSError, RuntimeError):
        if sys.stderr is not None:
            sys.stderr.write(line)
            sys.stderr.flush()


def write_to_standard_output(text: str) -> None:
    """Write at once, so that a failure is seen before files are put in place.

    Raises:
        ValueError: standard output is closed.
        OSError: it is full.
    """
    if sys.stdout is None:
        raise ValueError("standard output is closed; name a file instead of -")
    with contextlib.suppress(BrokenPipeError):  # the reader has read enough (``| head``)
        sys.stdout.write(text)
        sys.stdout.flush()


def close_standard_output() -> None:
    """Python flushes once more at its end: what failed before would fail again, with a traceback."""
    if sys.stdout is None:
        return
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
