"""The command line.  Thin: parse, call the library, print.  ``--help`` never loads JAX."""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
from importlib import import_module

from jaxsmooth.files.outputs import Outputs, ending
from jaxsmooth.options import check, parse
from jaxsmooth.report.terminal import close_standard_output, complain, prepare_streams, sentence

__all__ = ["main"]

BAD_INPUT, INTERRUPTED = 2, 130


def main(arguments: list[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: its words; None for those of this process, which an interrupt then ends.

    Returns:
        The exit code: 0 done; 2 bad input or usage, nothing written; 3 done, but inverted elements
        remain; 4 some of several meshes failed, the others are written; 130 interrupted.
    """
    prepare_streams()
    outputs = Outputs()
    program = contextlib.nullcontext()
    if arguments is None:
        program = ending(lambda: _interrupted(outputs), INTERRUPTED)
    try:
        with program, outputs:
            return _run_command(parse(arguments), outputs)
    except KeyboardInterrupt:
        _interrupted(outputs)
        return INTERRUPTED
    finally:
        close_standard_output()


def _interrupted(outputs: Outputs) -> None:
    outputs.discard()
    written = f" after {', '.join(outputs.written)} had been written" if outputs.written else ""
    complain(f"interrupted{written or '; nothing was written'}")


def _run_command(options: argparse.Namespace, outputs: Outputs) -> int:
    try:
        check(options)
        _set_up_jax(options)
        return getattr(import_module("jaxsmooth.commands"), options.command)(options, outputs)
    except Exception as error:
        text = sentence(error)
        if text is None:
            raise
        complain(text)
        return BAD_INPUT


def _set_up_jax(options: argparse.Namespace) -> None:
    # XLA reports processor features of kept programs as errors; it reads this when it is loaded
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    import jax

    from jaxsmooth.cache import keep_compiled

    jax.config.update("jax_enable_x64", options.precision == "float64")
    if not options.no_cache:
        keep_compiled()
    try:
        jax.default_backend()
    except (RuntimeError, AssertionError) as error:
        asked = os.environ.get("JAX_PLATFORMS", "")
        raise ValueError(f"JAX finds no device for JAX_PLATFORMS={asked!r}; unset it, or say cpu") from error


if __name__ == "__main__":
    sys.exit(main())
