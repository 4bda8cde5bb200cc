"""The line that says what is going on."""

import io

import meshio
import numpy as np
import pytest
from rich.console import Console

import jaxsmooth as js
from jaxsmooth.cli import main

N = 4
POINTS = np.stack(np.meshgrid(*[np.linspace(0, 1, N + 1)] * 2, indexing="ij"), -1).reshape(-1, 2)
POINTS[(N + 1) * 2 + 2] += 0.08
NUMBER = np.arange(len(POINTS)).reshape(N + 1, N + 1)
CORNERS = NUMBER[:-1, :-1], NUMBER[1:, :-1], NUMBER[1:, 1:], NUMBER[:-1, 1:]
QUADS = np.stack([corner.ravel() for corner in CORNERS], axis=1)


def drawn(terminal: bool) -> str:
    text = io.StringIO()
    out = Console(file=text, force_terminal=terminal, width=150)
    with js.progress(2, out) as show:
        js.smooth((POINTS, {"quad": QUADS}), steps=2, tolerance_avg=0, callback=show)
    return text.getvalue()


def test_a_bar_shows_the_steps():
    text = drawn(terminal=True)
    assert "done (q_min" in text
    assert "solver iterations" in text


def test_it_is_silent_when_piped():
    assert not drawn(terminal=False).strip()


@pytest.mark.parametrize("terminal", [True, False])
def test_the_command_says_what_it_does_on_terminals(tmp_path, monkeypatch, capsys, terminal):
    if terminal:
        monkeypatch.setenv("FORCE_COLOR", "1")
    meshio.write(tmp_path / "in.vtk", meshio.Mesh(np.pad(POINTS, ((0, 0), (0, 1))), [("quad", QUADS)]))
    assert main(["smooth", str(tmp_path / "in.vtk"), str(tmp_path / "out.vtk"), "--steps", "1"]) == 0
    assert ("reading in.vtk" in capsys.readouterr().out) is terminal
