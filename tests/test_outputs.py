"""Files that appear together: at any interrupt, failing rename, mode, link or umask."""

import contextlib
import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from jaxsmooth.files.outputs import Outputs, ending

SPACING = int(os.environ.get("JAXSMOOTH_LINES", "13"))  # 1: at every line, one minute


def write_three(outputs, folder, *contexts):
    """What `main` does, with three small files."""
    try:
        with contextlib.ExitStack() as stack:
            for context in (*contexts, outputs):
                stack.enter_context(context)
            outputs.folder(folder / "new" / "deep")
            for name in ("a.txt", "b.txt", "new/deep/c.txt"):
                outputs.text(folder / name, "new")
            outputs.commit()
    except KeyboardInterrupt:
        outputs.discard()


def interrupt_at(line, number, action, unless=None):
    """Call a function, with a signal before a line that Python executes in it; whether it was sent.

    It is not sent while `unless` is its handler."""
    seen, sent = 0, False
    modules = ("jaxsmooth/outputs.py", "contextlib.py", "tempfile.py")

    def trace(frame, event, argument):
        nonlocal seen, sent
        if event == "line" and frame.f_code.co_filename.endswith(modules):
            seen += 1
            if seen >= line and not sent and signal.getsignal(number) != unless:
                sent = True
                signal.raise_signal(number)
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        action()
    finally:
        sys.settrace(before)
    return sent


def fresh(folder):
    folder.mkdir()
    (folder / "a.txt").write_text("old")
    return folder


def is_new(folder):
    """Whether all files are new; fails if some are, or if there is anything else."""
    files = {str(p.relative_to(folder)): p.read_text() for p in folder.rglob("*") if p.is_file()}
    assert sorted(p.name for p in folder.iterdir()) == sorted({f.split("/")[0] for f in files})
    if files == {"a.txt": "old"}:
        return False
    assert files == {"a.txt": "new", "b.txt": "new", "new/deep/c.txt": "new"}
    return True


def test_an_exception_at_any_line(tmp_path):
    line, sent, outcomes = 1, True, []
    while sent:
        folder, outputs = fresh(tmp_path / str(line)), Outputs()
        sent = interrupt_at(line, signal.SIGINT, lambda: write_three(outputs, folder))  # noqa: B023
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
        assert is_new(folder) == bool(outputs.written), line
        outcomes.append(is_new(folder))
        line += SPACING
    assert outcomes.count(False) > 20
    assert outcomes.count(True) > 2  # the last of them without any signal


def program(folder, number):
    """Ends a process at every line, each in a child of this one; prints how many came to which end."""
    line, sent, outcomes = 1, True, []
    while sent:
        place, outputs = fresh(folder / str(line)), Outputs()
        child = os.fork()
        if child == 0:
            context = ending(outputs.discard, 130)
            unless = signal.getsignal(number)
            interrupt_at(line, number, lambda: write_three(outputs, place, context), unless)  # noqa: B023
            os._exit(0)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        assert code in (0, 130), (line, code)
        sent = code == 130
        outcomes.append(is_new(place))
        line += SPACING
    print(outcomes.count(False), outcomes.count(True))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs child processes")
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_the_end_of_the_process_at_any_line(name, tmp_path):
    call = f"t.program(pathlib.Path({str(tmp_path)!r}), signal.{name})"
    code = f"import signal, pathlib, test_outputs as t; {call}"
    paths = os.pathsep.join([str(Path(__file__).parent), str(Path(__file__).parents[1])])
    environment = {**os.environ, "PYTHONPATH": paths}
    ended = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert (ended.returncode, ended.stderr) == (0, "")
    old, new = map(int, ended.stdout.split())
    assert old > 20
    assert new > 2


def test_what_is_ignored_stays_ignored(tmp_path):
    old = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as under nohup
    try:
        with ending(lambda: None, 130):
            signal.raise_signal(signal.SIGHUP)
            write_three(Outputs(), tmp_path)
            signal.raise_signal(signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, old)
    assert is_new(tmp_path)


def test_a_rename_that_fails_undoes_the_others(tmp_path, monkeypatch):
    (tmp_path / "a").write_text("old a")
    (tmp_path / "c").write_text("old c")
    rename, count = os.replace, 0

    def fail_third(source, target):
        nonlocal count
        count += 1
        if count == 3:
            raise PermissionError(errno.EPERM, "Operation not permitted", source)
        rename(source, target)

    monkeypatch.setattr(os, "replace", fail_third)
    with Outputs() as outputs:
        for name in "abc":
            outputs.text(tmp_path / name, "new")
        with pytest.raises(PermissionError) as caught:
            outputs.commit()
    assert caught.value.filename == str(tmp_path / "c")
    assert outputs.written == ()
    assert [(tmp_path / name).read_text() for name in "ac"] == ["old a", "old c"]
    assert sorted(os.listdir(tmp_path)) == ["a", "c"]


def test_modes_links_and_the_umask(tmp_path):
    (tmp_path / "real").mkdir()
    target, link, fresh = tmp_path / "real" / "a.txt", tmp_path / "link.txt", tmp_path / "fresh.txt"
    target.write_text("old")
    target.chmod(0o640)
    link.symlink_to(Path("real") / "a.txt")
    dangling = tmp_path / "dangling.txt"
    dangling.symlink_to(Path("real") / "b.txt")
    twin = tmp_path / "twin.txt"
    os.link(target, twin)
    umask = os.umask(0o027)
    try:
        with Outputs() as outputs:
            for path in (link, fresh, dangling):
                outputs.text(path, "new")
            outputs.commit()
    finally:
        os.umask(umask)
    assert link.is_symlink()
    assert dangling.is_symlink()
    assert (target.read_text(), (tmp_path / "real" / "b.txt").read_text()) == ("new", "new")
    assert target.stat().st_mode & 0o777 == 0o640
    assert fresh.stat().st_mode & 0o777 == 0o640  # 0666 less the umask
    assert twin.read_text() == "old"
    assert outputs.written == (str(link), str(fresh), str(dangling))
    assert sorted(os.listdir(tmp_path / "real")) == ["a.txt", "b.txt"]
