"""Output files that appear together, complete, or not at all.

    with Outputs() as outputs:
        with outputs.file("part.vtu") as part:
            ...  # write the file `part`
        outputs.text("part.json", "{}")
        outputs.commit()

Each file is written under its own name in a temporary folder beside its target; `commit` renames all of them.
Before that no target is touched, whatever happens; after it, or after an error, no temporary folder is left.
Interrupts wait while files are renamed or removed.
"""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import signal
import stat
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import NamedTuple

__all__ = ["Outputs", "ending", "uninterrupted"]

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")
_INTERRUPTS = [getattr(signal, name) for name in _NAMES if hasattr(signal, name)]


class _Output(NamedTuple):
    """The name that was asked for, the file it stands for (links followed), and where it is made."""

    name: str
    target: Path
    folder: Path


class _Move(NamedTuple):
    """A complete file, its target, and a second name for what the target held (None: nothing)."""

    part: Path
    target: Path
    old: Path | None


class Outputs:
    """Files to put in place together; see the module.

    Attributes:
        written: the names of the files that `commit` has put in place.
    """

    def __init__(self) -> None:
        self.written: tuple[str, ...] = ()
        self._outputs: list[_Output] = []
        self._protected: list[Path] = []
        self._made: list[Path] = []

    def __enter__(self) -> Outputs:
        return self

    def __exit__(self, *_: object) -> None:
        self.discard()

    def protect(self, path: str | Path) -> None:
        """A file that no companion of an output (``x.node`` beside ``x.ele``) may replace."""
        self._protected.append(Path(path))

    def folder(self, path: str | Path) -> None:
        """Make a folder, and those above it; they go again if nothing comes to be written."""
        path = Path(path)
        missing = [p for p in (path, *path.parents) if not p.exists()]
        with uninterrupted():
            self._made += missing  # deepest first
            path.mkdir(parents=True, exist_ok=True)

    @contextlib.contextmanager
    def file(self, path: str | Path) -> Iterator[Path]:
        """Where to write a file, under its own name; writers may put companions beside it.

        Raises:
            OSError: with the name of the target, not of the temporary file.
        """
        target = Path(os.path.realpath(path))
        with _named(path):
            with uninterrupted():
                folder = Path(tempfile.mkdtemp(prefix=".jaxsmooth-", dir=target.parent))
                self._outputs.append(_Output(str(path), target, folder))
            for name in ("new", "old"):
                (folder / name).mkdir()
            yield folder / "new" / target.name

    def text(self, path: str | Path, content: str) -> None:
        """Write a text file."""
        with self.file(path) as part:
            part.write_text(content, encoding="utf-8")

    def commit(self) -> None:
        """Put all files in place, with the modes of those that they replace.

        Raises:
            OSError: one can't be put in place; then all targets are as they were.
        """
        moves = [move for output in self._outputs for move in self._moves(output)]
        with uninterrupted():
            done: list[_Move] = []
            for move in moves:
                try:
                    os.replace(move.part, move.target)
                except OSError as error:
                    self._put_back(done)
                    raise OSError(error.errno, error.strerror, str(move.target)) from error
                done.append(move)
            self.written = tuple(output.name for output in self._outputs)
            self.discard()

    def _put_back(self, done: list[_Move]) -> None:
        outputs, self._outputs = self._outputs, []  # what can't be put back is not to be removed either
        for move in reversed(done):
            if move.old is None:
                move.target.unlink()
            else:
                os.replace(move.old, move.target)
        self._outputs = outputs

    def discard(self) -> None:
        """Remove what is not in place (after `commit`: nothing)."""
        with uninterrupted():
            while self._outputs:
                # best effort: an error here must not hide the one that led here
                shutil.rmtree(self._outputs.pop().folder, ignore_errors=True)
            while self._made and not self.written:
                with contextlib.suppress(OSError):  # others have put something there
                    self._made[0].rmdir()
                self._made.pop(0)

    def _moves(self, output: _Output) -> Iterator[_Move]:
        """What to rename for an output, all of it on the disk."""
        for part in sorted((output.folder / "new").iterdir()):
            companion = part.name != output.target.name
            target = output.target
            if companion:
                target = Path(os.path.realpath(target.with_name(part.name)))
                self._check_companion(target, output)
            with _named(target if companion else output.name):
                _flush(part)
                yield _Move(part, target, _keep(part, target, output.folder / "old" / part.name))

    def _check_companion(self, target: Path, output: _Output) -> None:
        others = [*self._protected, *(other.target for other in self._outputs)]
        taken = target.exists() and (
            not output.target.exists() or any(p.exists() and p.samefile(target) for p in others)
        )
        if taken or target in others:
            reason = f"it would be replaced together with {output.name}; choose another name"
            raise FileExistsError(errno.EEXIST, reason, str(target))


@contextlib.contextmanager
def _named(name: str | Path) -> Iterator[None]:
    """Errors of the system name this file."""
    try:
        yield
    except OSError as error:
        if error.errno is None:  # not one of the system
            raise
        raise OSError(error.errno, error.strerror, str(name)) from error


def _flush(part: Path) -> None:
    """Some file systems say only now that they are full."""
    handle = os.open(part, os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _keep(part: Path, target: Path, old: Path) -> Path | None:
    """Give a new file the mode and owner of the one it replaces, and that one a second name."""
    try:
        state = target.stat()
    except FileNotFoundError:
        return None
    if hasattr(os, "chown"):
        with contextlib.suppress(PermissionError):  # only root may give files away
            os.chown(part, state.st_uid, state.st_gid)
    os.chmod(part, stat.S_IMODE(state.st_mode))
    try:
        os.link(target, old)
    except OSError:  # no links there, or not to other users' files
        shutil.copy2(target, old)
    return old


# --- Interrupts ------------------------------------------------------------------------


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """Let Ctrl-C, and what `ending` takes for it, wait until the block is done."""
    main = threading.current_thread() is threading.main_thread()  # no other thread gets signals
    if not main or signal.getsignal(signal.SIGINT) is None:
        yield
        return
    late: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, frame: late.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        if late:
            signal.raise_signal(late[0])


@contextlib.contextmanager
def ending(clean_up: Callable[[], None], code: int) -> Iterator[None]:
    """Let an interrupt end the process: for programs, not for what they call.

    An exception would have to pass through code that does not expect it: imports that are cut short
    end in a crash, callbacks of JAX swallow it.

    Args:
        clean_up: called first.
        code: the exit code.
    """

    def end(number: int, frame: FrameType | None) -> None:
        waiting = signal.getsignal(signal.SIGINT)
        if callable(waiting) and waiting is not end:  # `uninterrupted`
            waiting(number, frame)
            return
        for other in taken:
            signal.signal(other, signal.SIG_IGN)
        clean_up()
        os._exit(code)

    # what is ignored stays so (nohup, background jobs)
    usual = (signal.SIG_DFL, signal.default_int_handler)
    before = {number: signal.getsignal(number) for number in _INTERRUPTS}
    taken = {number: handler for number, handler in before.items() if handler in usual}
    try:
        for number in taken:
            signal.signal(number, end)
        yield
    finally:
        for number, handler in taken.items():
            signal.signal(number, handler)
