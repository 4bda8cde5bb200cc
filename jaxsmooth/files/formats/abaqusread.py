"""The reader of Abaqus' and CalculiX' .inp files.

meshio's (5.3.5) doesn't know pyramids nor most plane types, takes type names in capitals only, mixes up sets
that span several blocks or name other sets, and hangs on AVS files of the same suffix.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import meshio
import numpy as np

from jaxsmooth.cells.table import element_type
from jaxsmooth.convert.regions import SECTIONS
from jaxsmooth.files.formats.cards import Card, integers_of, nodes_of, read_cards, set_members
from jaxsmooth.files.reduction import UNKEPT

__all__ = [
    "ABAQUS_TYPES",
    "CARDS",
    "HEADING",
    "Model",
    "Part",
    "in_part",
    "is_abaqus",
    "place",
    "read_abaqus",
    "read_model",
]

_SOLID = r"(?:DC|AC|F|EM|Q)?C?3D"
_PLANE = r"(?:CPS|CPE|CPEG|CAX|CGAX|DCAX|DC2D|AC2D|ACAX|DS|M3D|R3D|SFM3D|STRI|F2D|S)"
_FAMILIES = (
    (_SOLID, {4: "tetra", 5: "pyramid", 6: "wedge", 8: "hexahedron", 10: "tetra10", 13: "pyramid13"}),
    (_SOLID, {15: "wedge15", 20: "hexahedron20", 27: "hexahedron27"}),
    (_PLANE, {3: "triangle", 4: "quad", 6: "triangle6", 8: "quad8", 9: "quad9"}),
    (r"(?:T2D|T3D|DC1D)", {2: "line", 3: "line3"}),
    (r"COH2D|COHAX", {4: "quad"}),
    (r"COH3D", {6: "wedge", 8: "hexahedron"}),
    (r"B[23]", {1: "line", 2: "line3", 3: "line"}),
)


_SILENT = ("PREPRINT", "ASSEMBLY", "END ASSEMBLY")
_MAKING = ("NGEN", "NFILL", "NCOPY", "NMAP", "ELGEN", "ELCOPY")

HEADING = "written by jaxsmooth:"
"""With counts, in files of this package, for nothing else in these files tells their end."""

ABAQUS_TYPES = "abaqus:types"
"""In `meshio.Mesh.info`: the element type of every cell block by Abaqus' name."""

CARDS = "abaqus:sections"
"""In `meshio.Mesh.info`: section cards (key, options, lines)."""


def is_abaqus(head: bytes) -> bool:
    """Whether a file begins as Abaqus files do: with a keyword, where AVS files have numbers."""
    lines = [line.strip() for line in head.splitlines()]
    first = next((line for line in lines if line and not line.startswith(b"#")), b"")
    return first.startswith(b"*")


def _meshio_type(name: str) -> str | None:
    """The cell type of an element name; what follows the number of nodes says how it is integrated."""
    name = name.upper().replace("STRI65", "STRI6")
    for prefix, types in _FAMILIES:
        # cohesive ones with a letter more have more nodes
        ending = "" if prefix.startswith("COH") else "[A-Z]*5?"
        matched = re.fullmatch(rf"(?:{prefix})(\d+){ending}", name)
        if matched and int(matched[1]) in types:
            return types[int(matched[1])]
    return None


@dataclass
class Part:
    """What stands between *PART or *INSTANCE and its end, or outside of all of them.

    Sets are lists of numbers and of names of other sets; `outer` are those that the assembly gives it.
    `spans` are the data lines of its node cards, see `Card`."""

    name: str = ""
    points: list[np.ndarray] = field(default_factory=list)
    ids: list[np.ndarray] = field(default_factory=list)
    spans: list[tuple[int, int] | None] = field(default_factory=list)
    blocks: list[tuple[str, str, np.ndarray, np.ndarray]] = field(default_factory=list)
    sets: dict[str, dict[str, list]] = field(default_factory=lambda: {"NSET": {}, "ELSET": {}})
    outer: dict[str, dict[str, list]] = field(default_factory=lambda: {"NSET": {}, "ELSET": {}})
    sections: list[tuple[str, dict[str, str], list[str]]] = field(default_factory=list)
    shift: np.ndarray = field(default_factory=lambda: np.zeros(3))
    turn: np.ndarray | None = None

    def names(self, key: str, outer: bool = False) -> dict[str, list]:
        """All sets by name in capitals; of two of one name its own, or the assembly's."""
        first, last = (self.sets, self.outer) if outer else (self.outer, self.sets)
        return {name.upper(): members for sets in (first, last) for name, members in sets[key].items()}


@dataclass(frozen=True)
class Model:
    """What an input file says.

    Attributes:
        parts: its parts where their instances are, then what is outside of them.
        heading: its first heading.
        others: keywords that are not mesh, with their asterisk.
        files: other files that it includes, relative to its folder.
    """

    parts: list[Part]
    heading: str
    others: list[str]
    files: list[str]


def read_model(content: bytes, folder: Path, wanted: frozenset[str] | None = None) -> Model:
    """The model of an input file; includes are followed, instances placed; see `read_cards` for `wanted`.

    Raises `ValueError` in one sentence."""
    model, parts, instances, others, files = Part(), {}, {}, set(), {}
    current, heading = model, ""
    for card in read_cards(content, folder, wanted):
        key, options, lines = card.key, card.options, card.lines
        if card.file is not None:
            files[card.file] = True
        if key == "HEADING":
            heading = heading or " ".join(lines)
        elif key == "PART":
            current = parts[options.get("NAME", "").upper()] = Part()
        elif key == "INSTANCE":
            name, part = options.get("NAME", ""), options.get("PART", "")
            if part.upper() not in parts:
                raise ValueError(f"its *INSTANCE {name!r} is of the *PART {part!r}, which isn't there")
            current = instances[name.upper()] = copy.deepcopy(parts[part.upper()])
            current.name = name
            current.shift, current.turn = _placement(lines)
        elif key in ("END PART", "END INSTANCE"):
            current = model
        elif not _read_card(current, instances, card) and key not in _SILENT:
            others.add(f"*{key}")
    placed = [*instances.values()] if instances else [*parts.values()]
    if len(placed) > 1 and not instances:
        raise ValueError("it has more than one *PART but no *INSTANCE; write each part to a file of its own")
    placed += [model] if model.ids or not placed else []
    return Model(placed, heading, sorted(others), list(files))


def read_abaqus(path: Path) -> tuple[meshio.Mesh, list[str]]:
    """Nodes, elements, sets and sections of an input file.

    Returns the mesh and notes.  Raises `ValueError` in one sentence."""
    model = read_model(path.read_bytes(), path.parent)
    mesh, notes = _assemble(model.parts)
    found = f"{len(mesh.points)} nodes, {sum(map(len, mesh.cells))} elements"
    said = model.heading
    if said.startswith(HEADING) and said.removeprefix(HEADING).strip() != found:
        raise ValueError(
            f"it has {found} and says{said.removeprefix(HEADING)}; the file is damaged or cut short"
        )
    if model.others:
        named = ", ".join(model.others[:4]) + (", …" if len(model.others) > 4 else "")
        mesh.info[UNKEPT] = [("", f"the other cards of the Abaqus file ({named})")]
        notes.append(f"cards of the Abaqus file that are not mesh are kept in Abaqus files only ({named})")
    return mesh, notes


def _read_card(part: Part, instances: dict[str, Part], card: Card) -> bool:
    """Add what a card says to a part; False for cards that are not mesh."""
    key, options, lines = card.key, card.options, card.lines
    if key in _MAKING or (key == "SYSTEM" and lines) or options.get("SYSTEM", "R").upper() != "R":
        raise ValueError(
            f"it has a card *{key} that Abaqus alone works out; give nodes and elements themselves"
        )
    if key == "NODE":
        number, coordinates = nodes_of(lines)
        part.points.append(coordinates)
        part.ids.append(number)
        part.spans.append(card.span)
        if "NSET" in options:
            _add(part.sets["NSET"], options["NSET"], [number])
    elif key == "ELEMENT":
        if "TYPE" not in options:
            raise ValueError("an *ELEMENT line has no TYPE")
        name = _meshio_type(options["TYPE"])
        if name is None:
            raise ValueError(
                f"element type {options['TYPE']} ({len(lines)} lines of it) is not supported; remove it"
            )
        numbers, width = integers_of(lines), 1 + element_type(name).k
        if len(numbers) % width:
            raise ValueError(f"elements of type {options['TYPE']} don't have {width - 1} nodes each")
        table = numbers.reshape(-1, width)
        part.blocks.append((name, options["TYPE"].upper(), table[:, 0], table[:, 1:]))
        if "ELSET" in options:
            _add(part.sets["ELSET"], options["ELSET"], [table[:, 0]])
    elif key in ("NSET", "ELSET") and options.get(key):
        target = instances.get(options.get("INSTANCE", "").upper())
        members = set_members(lines, options)
        if target is not None:
            _add(target.outer[key], options[key], members)
        elif members := _share(instances if not part.name else {}, key, options[key], members):
            _add(part.sets[key], options[key], members)
    elif key.endswith(" SECTION") and "ELSET" in options:
        part.sections.append((key, options, lines))
    else:
        return False
    return True


def _share(instances: dict[str, Part], key: str, name: str, members: list) -> list:
    """Give instances what a set of the assembly names of theirs; returns the other members."""
    rest = []
    for member in members:
        head, dot, tail = member.rpartition(".") if isinstance(member, str) else ("", "", "")
        owners = [
            part
            for instance, part in instances.items()
            if isinstance(member, str)
            and (instance == head.upper() if dot else member.upper() in part.names(key, True))
        ]
        for part in owners:
            number = tail.isdigit()
            _add(
                part.outer[key],
                name,
                [np.array([int(tail)]) if number else _resolve(part.names(key, not dot), tail)],
            )
        rest += [] if owners else [member]
    return rest


def _add(sets: dict[str, list], name: str, members: list) -> None:
    """Capitals don't count in Abaqus' names."""
    same = next((other for other in sets if other.upper() == name.upper()), name)
    sets.setdefault(same, []).extend(members)


def _placement(lines: list[str]) -> tuple[np.ndarray, np.ndarray | None]:
    """Shift and turn of an instance: shifted first, then turned about an axis by degrees."""
    rows = [
        [float(word) for word in line.upper().replace("D", "E").split(",") if word.strip()] for line in lines
    ]
    shift = np.zeros(3)
    shift[: len(rows[0]) if rows else 0] = rows[0] if rows else []
    if len(rows) < 2:
        return shift, None
    if len(rows[1]) != 7:
        raise ValueError("the turn of an *INSTANCE does not have two points and an angle")
    return shift, np.array(rows[1])


def place(part: Part) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates where the instance is, and the numbers of its nodes."""
    points = np.concatenate([np.zeros((0, 3)), *part.points])
    ids = np.concatenate([np.zeros(0, np.int64), *part.ids])
    _, first, number = np.unique(ids, return_index=True, return_inverse=True)
    other = (points[first[number.reshape(-1)]] != points).any(axis=1)
    if other.any():
        raise ValueError(f"node {ids[other][0]} is given twice, at different places")
    points = points + part.shift
    if part.turn is not None:
        points = _turned(points, part.turn)
    return points, ids


def in_part(part: Part, points: np.ndarray) -> np.ndarray:
    """Coordinates in a part of points ``[nodes, 3]`` where its instance is: `place` the other way round."""
    if part.turn is not None:
        points = _turned(points, np.concatenate([part.turn[:6], -part.turn[6:]]))
    return points - part.shift


def _turned(points: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Points turned about the axis through two points by degrees (Rodrigues' formula)."""
    origin, axis, angle = turn[:3], turn[3:6] - turn[:3], np.radians(turn[6])
    axis = axis / np.linalg.norm(axis)
    arm = points - origin
    along = (arm @ axis)[:, None] * axis
    return origin + np.cos(angle) * (arm - along) + np.sin(angle) * np.cross(axis, arm) + along


def _assemble(parts: list[Part]) -> tuple[meshio.Mesh, list[str]]:
    """One mesh of all parts; sets of several instances carry the instance's name."""
    points, cells, types, regions, notes = [], [], [], [], []
    point_sets: dict[str, list[np.ndarray]] = {}
    cell_sets: dict[str, dict[int, np.ndarray]] = {}
    sections, said = [], {}
    several = sum(bool(part.name) for part in parts) > 1
    start = 0
    for part in parts:
        coordinates, ids = place(part)
        order = np.argsort(ids, kind="stable")
        first = len(cells)
        for name, kind, _, nodes in part.blocks:
            at = _lookup(ids[order], order, nodes)
            cells.append((name, np.where(at < 0, at, at + start)))
            types.append(kind)
            regions.append(np.zeros(len(nodes), np.int64))
        for name, wanted in _sets(part, "NSET", several):
            at = _lookup(ids[order], order, wanted)
            point_sets.setdefault(name, []).append(start + at[at >= 0])
            _count_missing(notes, name, int((at < 0).sum()))
        for name, wanted in _sets(part, "ELSET", several):
            rows = _rows(part, wanted)
            cell_sets.setdefault(name, {}).update({first + k: r for k, r in enumerate(rows)})
            _count_missing(notes, name, len(wanted) - sum(map(len, rows)))
        for key, options, lines in part.sections:
            name = options["ELSET"]
            if name.upper() not in part.names("ELSET"):
                raise ValueError(f"its *{key} is for the set {name!r}, which isn't there")
            number = said.setdefault(_meaning(key, options, lines), len(said) + 1)
            for k, rows in enumerate(_rows(part, _resolve(part.names("ELSET"), name))):
                regions[first + k][rows] = number
            sections.append((key, {**options, "ELSET": _shown(part, "ELSET", name, several)}, lines))
        points.append(coordinates)
        start += len(ids)
    none = np.zeros(0, np.int64)
    mesh = meshio.Mesh(
        np.concatenate(points),
        cells,
        point_sets={name: np.unique(np.concatenate(members)) for name, members in point_sets.items()},
        cell_sets={name: [rows.get(k, none) for k in range(len(cells))] for name, rows in cell_sets.items()},
    )
    mesh.info = {ABAQUS_TYPES: types, CARDS: sections, **({SECTIONS: regions} if sections else {})}
    return mesh, notes


def _meaning(key: str, options: dict[str, str], lines: list[str]) -> tuple[str, ...]:
    """What a section says, whatever set it is for and however it is integrated."""
    said = [f"{k}={v}".upper() for k, v in sorted(options.items()) if k not in ("ELSET", "CONTROLS")]
    return (
        key,
        *said,
        "",
        *(word.strip().upper() for line in lines for word in line.split(",") if word.strip()),
    )


def _rows(part: Part, wanted: np.ndarray) -> list[np.ndarray]:
    """For every block of a part its elements with these numbers."""
    return [np.flatnonzero(np.isin(numbers, wanted)) for _, _, numbers, _ in part.blocks]


def _sets(part: Part, key: str, several: bool) -> Iterator[tuple[str, np.ndarray]]:
    """Names and numbers of the sets of a part, then of those that the assembly gave it."""
    for name in part.sets[key]:
        yield _shown(part, key, name, several), _resolve(part.names(key), name)
    for name in part.outer[key]:
        yield name, _resolve(part.names(key, outer=True), name)


def _shown(part: Part, key: str, name: str, several: bool) -> str:
    """The name that a set of a part has in the mesh: sets of an assembly may have the same."""
    own = next((other for other in part.sets[key] if other.upper() == name.upper()), None)
    outer = next((other for other in part.outer[key] if other.upper() == name.upper()), None)
    if own is None:
        return outer or name
    return f"{part.name}_{own}" if part.name and (several or outer) else own


def _count_missing(notes: list[str], name: str, count: int) -> None:
    if count > 0:
        notes.append(f"{count} members of the Abaqus set {name} are not in the file")


def _resolve(sets: dict[str, list], name: str, seen: tuple[str, ...] = ()) -> np.ndarray:
    """Numbers in a set (its name in any case), also those of the sets that it names."""
    found = [np.zeros(0, np.int64)]
    for member in sets[name.upper()]:
        if isinstance(member, str):
            if member.upper() not in sets:
                raise ValueError(f"set {name!r} names the set {member!r}, which isn't there")
            if member.upper() not in (*seen, name.upper()):
                found.append(_resolve(sets, member, (*seen, name.upper())))
        else:
            found.append(member)
    return np.unique(np.concatenate(found))


def _lookup(sorted_ids: np.ndarray, order: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Index of the nodes with these numbers; −1 where there is none."""
    if not len(sorted_ids):
        return np.full(wanted.shape, -1)
    at = np.minimum(np.searchsorted(sorted_ids, wanted), len(sorted_ids) - 1)
    return np.where(sorted_ids[at] == wanted, order[at], -1)
