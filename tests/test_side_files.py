"""Nothing is lost: outputs are put in place together or not at all, whatever happens on the way."""

import contextlib
import errno
import io
import json
import os
import resource
import signal
import subprocess
import sys
from pathlib import Path

import meshio
import numpy as np
import pytest
from jax.errors import JaxRuntimeError
from meshes import grid

import jaxsmooth as js
from jaxsmooth.cli import main
from jaxsmooth.convert.meshfile import MeshFileError
from jaxsmooth.report import report as reports
from jaxsmooth.runs import driver as smoothing


def run(*arguments):
    return main([str(a) for a in arguments])


def content(folder):
    """All files below a folder, hidden ones too."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.fixture
def part(tmp_path):
    """A small mesh of tetrahedra in a folder of its own; all runs here share its compiled step."""
    points, blocks = grid("tetra", (2, 2, 2), amplitude=0.1)
    path = tmp_path / "in" / "part.vtu"
    path.parent.mkdir()
    meshio.Mesh(points, list(blocks.items()), point_data={"heat": np.arange(len(points)) / 2}).write(path)
    (tmp_path / "out").mkdir()
    return path


@pytest.fixture
def out(tmp_path, part):
    return tmp_path / "out"


@pytest.fixture
def no_work(monkeypatch):
    """Makes reading and smoothing fail, so that a refusal must have come before them."""

    def fail(*args, **kwargs):
        raise AssertionError("the work has begun")

    monkeypatch.setattr("jaxsmooth.files.io.read", fail)
    monkeypatch.setattr(smoothing, "smooth", fail)


def one_sentence(capsys, *parts):
    error = capsys.readouterr().err
    assert error.startswith("jaxsmooth: ")
    assert error.count("\n") == 1
    for text in parts:
        assert text in error
    return error


# --- What is refused before the work ---------------------------------------------------


def link(kind, target, path):
    if kind == "symbolic":
        path.symlink_to(target)
    else:
        os.link(target, path)
    return path


def test_side_files_equal_to_others(part, out, no_work, capsys, monkeypatch):
    monkeypatch.chdir(out)
    (out / "old.vtu").write_text("old")
    soft, hard = (link(k, part, out / f"{k}.vtu") for k in ("symbolic", "hard"))
    soft_old, hard_old = (link(k, out / "old.vtu", out / f"{k}-old.vtu") for k in ("symbolic", "hard"))
    future = out / "future.json"
    future.symlink_to("mesh.vtu")
    same = [
        ("mesh.vtu", "--json", "mesh.vtu"),
        ("mesh.vtu", "--report", out / "mesh.vtu"),
        ("mesh.vtu", "--json", "../out/mesh.vtu"),
        ("mesh.vtu", "--json", "MESH.vtu"),
        ("mesh.vtu", "--report", future),
        ("old.vtu", "--json", soft_old, "--force"),
        ("old.vtu", "--report", hard_old),
        ("mesh.vtu", "--json", part, "--force"),
        ("mesh.vtu", "--report", soft),
        ("mesh.vtu", "--json", hard),
        ("mesh.vtu", "--json", "side", "--report", "./side"),
        (part, "--force", "--report", hard),
        (soft,),
        (hard,),
    ]
    before = content(out.parent)
    for target, *rest in same:
        assert run("smooth", part, target, *rest) == 2, rest
        one_sentence(capsys, "one file" if rest else "--force")
        assert content(out.parent) == before
    for command in ("quality", "compare"):
        assert run(command, part, "--json", hard) == 2
        one_sentence(capsys, "--json and IN are one file")


def test_files_that_are_no_files(part, out, no_work, capsys):
    os.mkfifo(out / "pipe.vtu")
    (out / "loop.vtu").symlink_to("loop.vtu")
    reader, writer = os.pipe()
    for arguments, text in [
        ((out / "pipe.vtu",), "a device or a pipe"),
        ((out / "loop.vtu",), "leads back to itself"),
        ((out / "a.vtu", "--json", "/dev/null"), "a device or a pipe"),
        ((out / "a.vtu", "--json", f"/dev/fd/{reader}"), "a device or a pipe"),
        ((out / "a.vtu", "--json", out), "this is a folder"),
        ((out / "a.vtu", "--json", ""), "this is a folder"),
        ((out / "a.vtu", "--report", "-"), "name a file"),
        ((out / "a.vtu", "--report", out / "none" / "a.html"), "there is no folder"),
        ((out / "a.what",), ".what"),
    ]:
        assert run("smooth", part, *arguments) == 2, arguments
        one_sentence(capsys, text)
    assert sorted(os.listdir(out)) == ["loop.vtu", "pipe.vtu"]
    os.close(reader)
    os.close(writer)


def test_a_platform_that_is_not_there(part, out, capsys, monkeypatch):
    monkeypatch.setattr("jax.default_backend", raising(AssertionError()))  # what JAX 0.10 does
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    assert run("smooth", part, out / "a.vtu") == 2
    one_sentence(capsys, "JAX_PLATFORMS='cuda'")


def test_a_file_that_standard_output_goes_to(part, out, no_work, capfd):
    with open(out / "log.vtu", "w") as log:
        kept = os.dup(1)
        os.dup2(log.fileno(), 1)
        try:
            assert run("smooth", part, out / "log.vtu") == 2
        finally:
            os.dup2(kept, 1)
            os.close(kept)
    assert "standard output goes to this file" in capfd.readouterr().err


def test_a_read_only_file_is_not_replaced(part, out, no_work, capsys, monkeypatch):
    (out / "a.vtu").write_text("precious")
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # root may write everything
    assert run("smooth", part, out / "a.vtu") == 2
    one_sentence(capsys, "read-only")


def test_a_read_only_file_system(part, out, no_work, capsys, monkeypatch):
    def refuse(*args, **kwargs):
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr("tempfile.TemporaryFile", refuse)
    assert run("smooth", part, out / "a.vtu") == 2
    one_sentence(capsys, "Read-only file system")


@pytest.fixture
def no_matplotlib(monkeypatch):
    monkeypatch.delitem(sys.modules, "jaxsmooth.report.pictures", raising=False)
    monkeypatch.setitem(sys.modules, "matplotlib.axes", None)


def test_reports_need_no_matplotlib(part, out, no_matplotlib, capsys):
    assert run("smooth", part, out / "a.vtu", "--steps", 0, "--report", out / "a.html") == 0
    assert sorted(content(out)) == ["a.html", "a.vtu"]


def test_what_a_format_needs_is_asked_before_the_work(part, out, capsys, monkeypatch):
    def lacking(names, path, format):
        raise MeshFileError(f"{path}: writing {format} files needs h5py")

    def fail(*args, **kwargs):
        raise AssertionError("the work has begun")

    monkeypatch.setattr("jaxsmooth.files.io.check_types", lacking)
    monkeypatch.setattr(smoothing, "smooth", fail)
    assert run("smooth", part, out / "a.med") == 2
    one_sentence(capsys, "needs h5py")


def test_what_a_writer_refuses_is_known_before_the_work(part, out, capsys, monkeypatch):
    monkeypatch.setattr(smoothing, "smooth", raising(AssertionError("the work has begun")))
    monkeypatch.setattr(meshio, "write", raising(ValueError("no place for this")))
    assert run("smooth", part, out / "a.vtk") == 2
    one_sentence(capsys, "no place for this")
    assert content(out) == {}


def test_formats_of_two_files(part, out):
    """Tetgen's nodes and elements go together, and never over a file that is not theirs."""
    file = js.read(part)
    js.write(out / "a.node", file)
    assert sorted(os.listdir(out)) == ["a.ele", "a.node"]
    assert len(meshio.read(out / "a.ele").points) == len(file.mesh.points)
    js.write(out / "a.node", js.read(out / "a.node"), force=True)
    (out / "b.ele").write_text("precious")
    with pytest.raises(MeshFileError, match=r"b\.ele: .*replaced together with .*b\.node"):
        js.write(out / "b.node", file)
    with pytest.raises(MeshFileError, match="replaced together"):
        js.write(out / "a.ele", js.read(out / "a.node"))
    assert (out / "b.ele").read_text() == "precious"
    assert sorted(os.listdir(out)) == ["a.ele", "a.node", "b.ele"]


# --- What goes wrong during the work ---------------------------------------------------


def smooth_three(part, out):
    return run(
        *("smooth", part, out / "a.vtu", "--steps", 1),
        *("--json", out / "a.json", "--report", out / "a.html"),
    )


def raising(error):
    def fail(*args, **kwargs):
        raise error

    return fail


@contextlib.contextmanager
def files_of_at_most(size):
    """The system refuses larger files, as a full disk would, with another number."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_no_room_for_any_of_the_files(part, out, capsys):
    assert smooth_three(part, out) == 0
    sizes = {name: len(data) for name, data in content(out).items()}
    before = content(out)
    capsys.readouterr()
    for name in ("a.vtu", "a.html"):
        with files_of_at_most(sizes[name] // 2):
            assert smooth_three(part, out) == 2
        one_sentence(capsys, "File too large", "a.vtu" if sizes["a.vtu"] > sizes[name] // 2 else name)
        assert content(out) == before
    for path in out.iterdir():
        path.unlink()
    with files_of_at_most(1000):
        assert smooth_three(part, out) == 2
    assert list(out.iterdir()) == []


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can mount a small disk")
def test_a_full_disk(part, out, capsys):
    mount = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=24k", "none", str(out)], capture_output=True)
    if mount.returncode != 0:
        pytest.skip("no disk could be mounted")
    try:
        (out / "a.vtu").write_text("old")
        assert smooth_three(part, out) == 2
        one_sentence(capsys, "No space left on device")
        assert content(out) == {"a.vtu": b"old"}
        assert os.listdir(out) == ["a.vtu"]
    finally:
        subprocess.run(["umount", str(out)], check=True)


STAGES = {
    "reading": ("jaxsmooth.files.io.read", False),
    "smoothing": ("jaxsmooth.report.report.print_step", False),
    "writing the mesh": ("jaxsmooth.files.io.patch_file", False),
    "making the report": ("jaxsmooth.report.page.html_page", False),
    "printing the table": ("jaxsmooth.report.report.print_comparison", False),
    "saying so": ("jaxsmooth.commands._finish", True),
}


@pytest.mark.parametrize("stage", STAGES)
def test_interrupts(stage, part, out, capsys, monkeypatch):
    (out / "a.vtu").write_text("old")
    name, done = STAGES[stage]

    def interrupt(*args, **kwargs):
        if done:
            args[1].commit()
        signal.raise_signal(signal.SIGINT)
        raise AssertionError("the signal was lost")

    monkeypatch.setattr(name, interrupt)
    assert smooth_three(part, out) == 130
    error = one_sentence(capsys, "interrupted")
    if done:
        assert sorted(content(out)) == ["a.html", "a.json", "a.vtu"]
        assert "had been written" in error
        assert "a.html" in error
    else:
        assert content(out) == {"a.vtu": b"old"}
        assert os.listdir(out) == ["a.vtu"]
        assert "nothing was written" in error


PROGRAM = """
import gc, signal, sys
import jaxsmooth.report.page, jaxsmooth.files.io
from jaxsmooth.cli import main

def interrupt(*args):
    gc.callbacks.remove(interrupt)
    signal.raise_signal(signal.SIGTERM)  # an exception would be swallowed here

def page(*args, **more):
    gc.callbacks.append(interrupt)
    gc.collect()
    return ""

jaxsmooth.report.page.html_page = page
sys.exit(main())
"""


def test_interrupts_that_callbacks_would_swallow(part, out):
    (out / "a.vtu").write_text("old")
    arguments = ("smooth", part, out / "a.vtu", "--steps", "0", "--report", out / "a.html")
    program = [sys.executable, "-c", PROGRAM, *map(str, arguments)]
    ended = subprocess.run(program, capture_output=True, text=True, cwd=Path(__file__).parents[1])
    assert (ended.returncode, ended.stderr) == (130, "jaxsmooth: interrupted; nothing was written\n")
    assert content(out) == {"a.vtu": b"old"}
    assert os.listdir(out) == ["a.vtu"]


@pytest.mark.parametrize(
    ("name", "error"),
    [
        ("jaxsmooth.runs.driver.smooth", MemoryError()),
        (
            "jaxsmooth.runs.driver.smooth",
            JaxRuntimeError("RESOURCE_EXHAUSTED: allocating 9 bytes."),
        ),
        ("jaxsmooth.runs.driver.smooth", JaxRuntimeError("INTERNAL: std::bad_alloc")),
        ("jaxsmooth.files.io.patch_file", np._core._exceptions._ArrayMemoryError((9,), np.dtype(float))),
        ("meshio.vtu.read", MemoryError()),
    ],
    ids=["python", "jax", "c++", "writing", "reading"],
)
def test_out_of_memory(name, error, part, out, capsys, monkeypatch):
    monkeypatch.setattr(name, raising(error))
    if name == "meshio.vtu.read":
        monkeypatch.setattr(meshio, "read", raising(error))
    assert smooth_three(part, out) == 2
    one_sentence(capsys, "out of memory")
    assert list(out.iterdir()) == []


def test_errors_of_the_program_keep_their_traceback(part, out, monkeypatch):
    monkeypatch.setattr("jaxsmooth.files.io.patch_file", raising(TypeError("a bug")))
    with pytest.raises(TypeError, match="a bug"):
        smooth_three(part, out)
    assert list(out.iterdir()) == []


# --- Standard output -------------------------------------------------------------------


def abandoned():
    """A standard output whose reader has gone, as after ``| head -0``."""
    reader, writer = os.pipe()
    os.close(reader)
    return os.fdopen(writer, "w")


def test_a_reader_that_goes_away(part, out, capsys, monkeypatch):
    for arguments in (
        ("smooth", part, out / "a.vtu", "--steps", 1, "--json", out / "a.json"),
        ("smooth", part, out / "b.vtu", "--steps", 1, "--json", "-"),
        ("quality", part, "--metric", "shape"),
        ("quality", part, "--metric", "shape", "--json", "-"),
    ):
        with abandoned() as stream, monkeypatch.context() as patch:
            patch.setattr(sys, "stdout", stream)
            assert run(*arguments) == 0
    assert sorted(os.listdir(out)) == ["a.json", "a.vtu", "b.vtu"]
    assert capsys.readouterr().err == ""
    with abandoned() as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        with pytest.raises(SystemExit) as end:
            run("smooth", "--help")
    assert end.value.code == 0


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
@pytest.mark.parametrize("extra", [(), ("-q", "--json", "-")])
def test_a_full_standard_output(extra, part, out, capsys, monkeypatch):
    with open("/dev/full", "w") as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        assert run("smooth", part, out / "a.vtu", "--steps", 1, *extra) == 2
    one_sentence(capsys, "standard output: No space left")
    assert list(out.iterdir()) == []


def test_standard_output_that_fails_at_the_end(part, out, capsys, monkeypatch):
    """The last line comes after the files; they stay, and the exit code says so."""
    console = reports.console

    def last_line_fails(quiet=False):
        made = console(quiet)
        show = made.print

        def show_or_fail(*args, **kwargs):
            if args and "wrote" in str(args[0]):
                raise OSError(errno.ENOSPC, "No space left on device")
            show(*args, **kwargs)

        made.print = show_or_fail
        return made

    monkeypatch.setattr(reports, "console", last_line_fails)
    assert smooth_three(part, out) == 0
    assert sorted(os.listdir(out)) == ["a.html", "a.json", "a.vtu"]
    one_sentence(capsys, "a.vtu", "written, but not standard output (No space left on device)")


def test_closed_and_plain_streams(part, out, capsys, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", None)
        assert run("smooth", part, out / "a.vtu", "--steps", 1) == 0
        assert run("smooth", part, out / "b.vtu", "--steps", 1, "--json", "-") == 2
    one_sentence(capsys, "standard output is closed")
    assert os.listdir(out) == ["a.vtu"]
    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", stream)
    assert run("smooth", part, out / "a.vtu", "--steps", 1) == 0
    assert b"\\u03c3" in stream.buffer.getvalue()  # the σ of the table


# --- Names and notes -------------------------------------------------------------------


def test_names_with_anything_in_them(part, out, capsys):
    source = out / "[b]a :smile: $x^$ <i>\udcff.vtu"
    source.write_bytes(part.read_bytes())
    target = out / "[b] [red] {}.vtu"
    assert (
        run("smooth", source, target, "--steps", 1, "--json", out / "a.json", "--report", out / "a.html") == 0
    )
    said = capsys.readouterr().out
    assert "[b]a :smile: $x^$ <i>" in said
    assert f"wrote {target}" in said
    assert "&lt;i&gt;" in (out / "a.html").read_text()
    assert json.loads((out / "a.json").read_text())["input"] == str(source)


def test_losses_are_said_to_those_who_want_silence(part, out, capsys):
    assert run("smooth", part, out / "a.inp", "--steps", 1, "-q") == 0
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("jaxsmooth: ")
    assert "heat" in said.err
    assert run("smooth", part, out / "b.inp", "--steps", 1) == 0
    said = capsys.readouterr()
    assert "heat" in said.out
    assert said.err == ""


def test_notes_are_in_the_json(out, capsys):
    points, blocks = grid("tetra", (2, 2, 2), amplitude=0.1)
    np.savez(
        out / "in.npz", points=np.r_[points, [[9.0, 9, 9]]], tetra=blocks["tetra"], heat=np.arange(28) / 2
    )
    for command in (
        ("smooth", out / "in.npz", out / "a.inp", "--steps", 0),
        ("quality", out / "in.npz", "--metric", "shape"),
        ("compare", out / "in.npz", "--methods", "laplacian", "--steps", 0),
    ):
        assert run(*command, "--json", out / "a.json") == 0
        notes = json.loads((out / "a.json").read_text())["notes"]
        assert "1 of the 28 nodes belong to no cell" in notes[0]
        if command[0] == "smooth":
            assert "heat" in notes[1]


# --- The demo --------------------------------------------------------------------------


def test_the_demo_without_matplotlib(part, tmp_path, no_matplotlib, capsys, monkeypatch):
    monkeypatch.setattr("jaxsmooth.demo.MESH", part)  # quicker
    assert run("demo", tmp_path / "a" / "demo") == 0
    assert sorted(os.listdir(tmp_path / "a" / "demo")) == ["bracket-smooth.vtu", "report.html"]
    said = capsys.readouterr().out
    assert "jaxsmooth[viz]" in said
    assert "scaled Jacobian" in said


def test_a_demo_that_ends_early_leaves_nothing(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("jaxsmooth.report.report.print_step", raising(KeyboardInterrupt()))
    assert run("demo", tmp_path / "a" / "demo") == 130
    assert "nothing was written" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").write_text("precious")
    assert run("demo", tmp_path / "file") == 2
    one_sentence(capsys, "file")
    assert content(tmp_path) == {"file": b"precious"}
