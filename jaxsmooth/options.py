"""The options of the command line; they are known without loading JAX."""

from __future__ import annotations

import argparse
import difflib
import os
from collections.abc import Sequence

from jaxsmooth import __version__

__all__ = ["GOALS", "METHODS", "check", "parse", "parser"]

METHODS = (
    "elastic, elastic-extended, laplacian, smart-laplacian, weighted-laplacian, smart-weighted-laplacian, "
    "optimize, untangle"
)
GOALS = ("average", "worst", "balanced")


def parse(words: Sequence[str] | None) -> argparse.Namespace:
    """The options of a command line; the process ends with a sentence where they are none."""
    root = parser()
    options, rest = root.parse_known_args(words)
    unknown = [word for word in rest if word.startswith("-")]
    if unknown or (rest and not hasattr(options, "files")):
        word = (unknown or rest)[0]
        near = difflib.get_close_matches(
            word.partition("=")[0], _known(root, options.command), n=2, cutoff=0.6
        )
        hint = f"did you mean {' or '.join(near)}?" if near else "see --help"
        root.error(f"unknown option {word}; {hint}" if unknown else f"one word too many, {word}; {hint}")
    if rest:  # files that stand behind an option
        options.files += rest
    return options


def check(options: argparse.Namespace) -> None:
    """What can be seen without loading JAX: missing inputs, methods that there are not.

    Raises:
        ValueError: for a method.
        FileNotFoundError: for an input.
    """
    asked = getattr(options, "methods", None)
    names = asked.split(",") if asked is not None else [getattr(options, "method", "elastic")]
    for name in map(str.strip, names):
        if name not in (known := METHODS.split(", ")):
            near = difflib.get_close_matches(name, known, n=2, cutoff=0.4)
            hint = f"did you mean {' or '.join(near)}?" if near else f"known are {METHODS}"
            raise ValueError(f"unknown method {name!r}; {hint}")
    words = getattr(options, "metric", [])  # its last one may be the file
    path = getattr(options, "input", None) or (words[-1] if len(words) > 1 else None)
    paths = [] if path is None else [path]
    files = getattr(options, "files", [])
    if files and options.out_dir is None:
        if len(files) != 2:
            raise ValueError(
                f"smooth needs IN and OUT, got {len(files)} names; for several meshes add --out-dir DIR"
            )
        if os.path.isdir(files[0]):
            raise ValueError(f"{files[0]}: this is a folder; to smooth all meshes in it add --out-dir DIR")
        paths = files[:1]
    elif files and not any(map(os.path.exists, files)):
        paths = files[:1]
    for path in paths:
        if not os.path.exists(path):
            raise FileNotFoundError(f"{path}: there is no such file; check the name")


def _known(root: argparse.ArgumentParser, name: str) -> list[str]:
    """The options of a command."""
    choices = next(action.choices for action in root._actions if action.choices)
    command = choices["quality" if name == "measure" else name]  # pyright: ignore[reportIndexIssue]
    return list(command._option_string_actions)


def parser() -> argparse.ArgumentParser:
    """The parser; the options of a command name its function in `jaxsmooth.commands`."""
    root = argparse.ArgumentParser(
        prog="jaxsmooth",
        description="Improve finite-element meshes by moving their nodes.",
        epilog="exit codes: 0 done; 2 bad input or usage, nothing written; 3 done, but inverted elements "
        "remain; 4 some of several meshes failed, the others are written; 130 interrupted",
    )
    root.add_argument("--version", action="version", version=f"jaxsmooth {__version__}")
    commands = root.add_subparsers(required=True, metavar="COMMAND")

    _add_smooth(commands)
    command = commands.add_parser("info", help="print what a file holds, and what would hold its nodes")
    command.add_argument("input", metavar="IN", help="mesh file; it is only read")
    _add_motion_options(command)
    _add_json(command, "the facts")
    _add_precision(command)
    command.set_defaults(command="info", steps=None)

    command = commands.add_parser("quality", help="print quality statistics of a mesh")
    help = "mesh file (default: the last word behind --metric)"
    command.add_argument("input", nargs="?", metavar="IN", help=help)
    help = "quality metrics, or all: those that the mesh can have (default: the usual six)"
    command.add_argument("--metric", action="extend", nargs="+", default=[], metavar="NAME", help=help)
    _add_json(command, "the numbers")
    help = "write a row for every element: type, number, region, centroid, metrics (default: none)"
    command.add_argument("--csv", metavar="FILE", help=help)
    help = "write the mesh with the metrics as data of its cells (default: none)"
    command.add_argument("--quality-data", metavar="OUT", help=help)
    _add_precision(command)
    command.set_defaults(command="measure")

    command = commands.add_parser("compare", help="run several methods on a mesh, side by side")
    command.add_argument("input", metavar="IN", help="mesh file; it is only read")
    help = f"some of {METHODS} (default: all)"
    command.add_argument("--methods", default=None, metavar="A,B,…", help=help)
    help = "write a page for any browser with the meshes of all methods, two at a time (default: none)"
    command.add_argument("--report", metavar="FILE.html", help=help)
    _add_run_options(command)
    command.set_defaults(command="compare")

    command = commands.add_parser("demo", help="smooth the mesh that ships with the package")
    help = "folder for its files (default: jaxsmooth-demo)"
    command.add_argument("directory", nargs="?", default="jaxsmooth-demo", metavar="DIR", help=help)
    _add_precision(command)
    command.set_defaults(command="demo")
    return root


def _add_smooth(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    command = commands.add_parser(
        "smooth",
        help="read a mesh, smooth it, write it; or several",
        usage="jaxsmooth smooth [options] IN OUT\n       jaxsmooth smooth [options] IN [IN …] --out-dir DIR",
    )
    help = "IN and OUT, mesh files; with --out-dir any number of files, and folders of them"
    command.add_argument("files", nargs="+", metavar="IN OUT", help=help)
    help = "write all of IN to DIR under their own names; what fails does not stop the others (default: none)"
    command.add_argument("--out-dir", metavar="DIR", help=help)
    help = f"one of {METHODS} (default: elastic)"
    command.add_argument("--method", default="elastic", metavar="NAME", help=help)
    help = "of OUT: gmsh, gmsh22:ascii, vtu, abaqus, … (default: as its name says, the input's if that fits)"
    command.add_argument("--format", metavar="NAME", help=help)
    help = "write the quality of the elements into OUT, as data of its cells (default: no)"
    command.add_argument("--quality-data", action="store_true", help=help)
    command.add_argument("--force", action="store_true", help="allow OUT to be IN (default: refuse)")
    help = "write a report with the mesh to turn, as a page for any browser (default: none)"
    command.add_argument("--report", metavar="FILE.html", help=help)
    _add_run_options(command)
    command.set_defaults(command="smooth")


def _add_precision(command: argparse.ArgumentParser) -> None:
    help = "of the computation (default: float64)"
    command.add_argument("--precision", choices=("float64", "float32"), default="float64", help=help)
    help = "compile anew, and keep nothing (default: compiled programs are kept in the user's cache folder)"
    command.add_argument("--no-cache", action="store_true", help=help)


def _add_run_options(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    help = (
        "make exactly N steps: the run ends earlier only where no node can move or nothing would get better "
        "(default: at most 10, and the end when a step changes little)"
    )
    add("--steps", type=int, default=None, metavar="N", help=help)
    help = f"of the method optimize: one of {', '.join(GOALS)} (default: balanced)"
    add("--goal", choices=GOALS, default=None, metavar="NAME", help=help)
    _add_motion_options(command)
    _add_json(command, "history and timings")
    help = "print only errors, what OUT can't hold, and what stays inverted (default: progress and a table)"
    add("-q", "--quiet", action="store_true", help=help)
    _add_precision(command)


def _add_json(command: argparse.ArgumentParser, what: str) -> None:
    command.add_argument(
        "--json", metavar="FILE", help=f"write {what}, - for standard output (default: none)"
    )


def _add_motion_options(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    choices = ("slide", "planar", "fixed")
    help = "boundary nodes slide on faces and edges, planar: on flat and straight ones only, or are fixed"
    add("--boundary", choices=choices, help=f"{help} (default: planar; of surfaces slide)")
    help = "the same for the nodes between materials (default: planar)"
    add("--interfaces", choices=choices, default="planar", help=help)
    help = "the nodes of boundary layers: hold them, or free (default: hold)"
    add("--layers", choices=("hold", "free"), default="hold", help=help)
    help = "folds sharper than this are edges (default: 50; with planar 0: all straight ones)"
    add("--feature-angle", type=float, default=None, metavar="DEG", help=help)
    help = "distance that nodes keep to the facets of the input, over the length of edges (default: 0.01)"
    add("--surface-tolerance", type=float, default=0.01, metavar="PART", help=help)
    help = "hold the nodes of elements stretched beyond A, a number above 1 (default: none)"
    add("--freeze-aspect", type=float, default=None, metavar="A", help=help)
    help = (
        "hold nodes: the name of a set, DATA=TAG or DIMENSION:TAG for those of cells with this tag, or "
        "numbers from 0 such as 0-9,20; repeatable (default: none but those that the file marks)"
    )
    add("--fix", action="append", default=[], metavar="WHICH", help=help)
    help = (
        "move the nodes of opposite faces together, along axes such as xy (default: as the file links them)"
    )
    add("--periodic", default=None, metavar="AXES", help=help)
