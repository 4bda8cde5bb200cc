"""The HTML report: what is in it, why nodes are held, and what a browser makes of it."""

import base64
import html
import json
import re
import shutil
import subprocess
import time

import meshes
import meshio
import numpy as np
import pytest
from test_curved import ball

import jaxsmooth as js
from jaxsmooth.mesh.topology import find_facets
from jaxsmooth.report import scene as scenes
from jaxsmooth.report.compared import compare_row
from jaxsmooth.report.holding import REASONS, holding
from jaxsmooth.report.page import html_comparison, html_page
from jaxsmooth.report.scene import scene


def box(kind="tetra", shape=(3, 3, 3), amplitude=0.2, **data):
    points, cells = meshes.grid(kind, shape, amplitude)
    return js.from_meshio(meshio.Mesh(np.asarray(points), cells, **data)).mesh


def page_of(mesh, steps=0, **more):
    return html_page("a <b> & $x$", mesh, js.smooth(mesh, steps=steps), **more)


def scene_of(page):
    return json.loads(re.search(r'type="application/json">(.*?)</script>', page, re.S)[1])


def numbers(text, dtype):
    return np.frombuffer(base64.b64decode(text), dtype)


def reasons(mesh, **options):
    found = holding(mesh, js.detect_constraints(mesh, **options)).reason
    return np.array([REASONS[i] for i in found])


# --- What holds nodes -----------------------------------------------------------------------------------


def test_a_box_has_corners_edges_and_faces():
    mesh = box(amplitude=0)
    sides = np.array([len(n) for n in meshes.box_normals(np.asarray(mesh.points))])
    words = np.array(["free", "slides on a face", "slides along an edge", "held: edge or corner"])
    np.testing.assert_array_equal(reasons(mesh), words[sides])
    fixed = reasons(mesh, boundary="fixed")
    assert set(fixed[sides == 1]) == {"held: flat boundary"}
    assert set(fixed[sides > 1]) == {"held: edge or corner"}
    inner = np.flatnonzero(sides == 0)
    assert set(reasons(mesh, fixed=inner)[inner]) == {"held: by an option"}


def test_curved_boundaries_marks_regions_and_links():
    mesh = ball("tetra", 6)
    rim = np.abs(np.linalg.norm(mesh.points, axis=1) - 1) < 1e-9
    assert (reasons(mesh)[rim] == "held: curved boundary").mean() > 0.5
    assert set(reasons(mesh)[~rim]) == {"free"}
    points, cells = meshes.grid("triangle", (4, 4), 0)
    points = np.asarray(points)
    tags = (points[cells["triangle"]].mean(axis=1)[:, 0] > 0.5).astype(int)
    mark = np.zeros(len(points), int)
    mark[12] = 1
    source = meshio.Mesh(points, cells, point_data={"fixed": mark}, cell_data={"material": [tags]})
    mesh = js.from_meshio(source).mesh
    assert reasons(mesh)[12] == "held: by the file"
    middle = np.isclose(points[:, 0], 0.5) & (points[:, 1] % 1 > 0) & (np.arange(len(points)) != 12)
    assert set(reasons(mesh, interfaces="fixed")[middle]) == {"held: between regions"}
    linked = mesh.with_links(js.find_periodic(mesh, "x"))
    assert (reasons(linked) == "follows other nodes").sum() == 3  # the corners are held
    found = holding(mesh, js.detect_constraints(mesh))
    assert sum(number for _, number in found.counts()) == len(points)
    assert "2 by the file" in found.of(np.array([12, 12, 6]))


# --- What the viewer gets -------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["tetra10", "hexahedron", "quad8", "wedge15"])
def test_the_scene_is_the_mesh(kind):
    mesh = box(kind, (2, 2, 2)[: meshes.dim_of(kind)], 0.05)
    drawn = scene({"before": mesh, "after": mesh}, holding(mesh, js.detect_constraints(mesh)))
    places = numbers(drawn["states"][0]["points"], "<f4").reshape(-1, 3)[:, : mesh.dim]
    np.testing.assert_allclose(places, mesh.points, atol=1e-6)
    (block,) = drawn["blocks"]
    nodes = numbers(block["nodes"], "<u2").reshape(block["count"], block["k"])
    sides = {frozenset(row[ring]) for ring in block["facets"] for row in nodes}
    if mesh.dim == 3:
        kf = {len(ring) for ring in block["facets"]}
        expected = {frozenset(f[part.type.outline]) for part in find_facets(mesh) for f in part.nodes}
        assert sides == expected
        assert kf == {len(part.type.outline) for part in find_facets(mesh)}
    else:
        assert sides == {frozenset(row) for row in np.asarray(mesh.connectivity[0])}
    q = numbers(drawn["states"][0]["quality"], "<i2") / 32000
    np.testing.assert_allclose(q, js.quality(mesh)[0], atol=2e-5)


def test_of_large_meshes_the_boundary_and_the_poorest_elements(monkeypatch):
    mesh = box(shape=(4, 4, 4))
    monkeypatch.setattr(scenes, "_BUDGET", 800)
    drawn = scene({"before": mesh, "after": mesh}, holding(mesh, js.detect_constraints(mesh)))
    full, *skins = drawn["blocks"]
    assert full["count"] == 50
    q = np.asarray(js.quality(mesh)[0])
    np.testing.assert_array_equal(np.sort(q[drawn["ids"]]), np.sort(q)[:50])
    outer = sum(int((part.partner < 0).sum()) for part in find_facets(mesh))
    own = np.isin(np.repeat(np.arange(len(q)), 4), drawn["ids"])
    left = sum(int(((part.partner < 0) & ~own).sum()) for part in find_facets(mesh))
    assert sum(block["count"] for block in skins) == left < outer
    assert len(numbers(drawn["states"][1]["quality"], "<i2")) == 50 + left


def test_the_page_says_what_was_done_and_asks_for_nothing():
    names = {"cell_data": {"material": [np.arange(162) % 2]}}
    mesh = box(**names)
    settings = {"method": "elastic", "fix": [], "goal": None}
    page = page_of(mesh, 1, settings=settings, seconds={"smooth": 1.25, "compile": 3.5}, notes=["<odd>"])
    assert "a &lt;b&gt; &amp; $x$" in page
    assert "<li>&lt;odd&gt;</li>" in page
    text = html.unescape(re.sub(r"<[^>]+>", " ", page.split('<script id="scene"')[0]))
    for words in ("elastic", "compile 3.5 s", "tetra, region 1", js.__version__, "held: edge or corner"):
        assert words in text
    assert "goal" not in text
    assert not re.search(r"https?:|src=|@import|url\(", page)
    assert "default-src 'none'" in page
    worst = int(np.argmin(js.smooth(mesh, steps=1).quality[0]))
    assert re.search(r'data-element="(\d+)"', page)[1] == str(worst)


def test_a_page_of_thirty_thousand_elements_is_small_and_quick():
    mesh = box(shape=(19, 19, 15), amplitude=0.1)
    assert len(mesh.connectivity[0]) > 32_000
    result = js.smooth(mesh, steps=0)
    start = time.perf_counter()
    page = html_page("large", mesh, result)
    assert time.perf_counter() - start < 10
    assert len(page) < 2e6


# --- In a browser ---------------------------------------------------------------------------------------

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")

SCRIPT = """<script>
const said = {all: canvas.dataset.shown};
const move = (id, value) => { $(id).value = value; $(id).dispatchEvent(new Event("input")); };
const press = (group, value) =>
  document.querySelector(`[data-group=${group}] button[value="${value}"]`).click();
const picture = () => { paint(); return canvas.toDataURL(); };
const count = () => {  // pixels that are not background
  paint();
  const p = new Uint8Array(4 * canvas.width * canvas.height);
  gl.readPixels(0, 0, canvas.width, canvas.height, gl.RGBA, gl.UNSIGNED_BYTE, p);
  let n = 0;
  for (let i = 0; i < p.length; i += 4) n += Math.abs(p[i] - 241) + Math.abs(p[i + 2] - 248) > 60;
  return n;
};
said.pixels = [count()];
move("below", 0.4);
said.below = canvas.dataset.shown;
said.text = $("shown").textContent;
said.pixels.push(count());
move("below", 1); press("axis", 0); move("cut", 0.5);
said.cut = canvas.dataset.shown;
$("flip").click();
said.other = canvas.dataset.shown;
press("axis", -1);
const pictures = ["quality", "moved", "held"].map((name) => { press("colour", name); return picture(); });
said.colours = new Set(pictures).size;
press("colour", "quality");
const still = picture();
camera.az += 0.5;
said.turned = still !== picture();
document.querySelector("[data-element]").click();
said.picked = $("picked").textContent;
said.requests = performance.getEntriesByType("resource").length;
said.error = gl.getError();
document.body.dataset.said = JSON.stringify(said);
</script>"""


def in_a_browser(page, folder, width=900, script=SCRIPT):
    path = folder / "report.html"
    path.write_text(page.replace("</body>", script + "</body>"), encoding="utf-8")
    flags = (
        "--headless --no-sandbox --disable-gpu-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader"
    )
    command = [CHROMIUM, *flags.split(), f"--user-data-dir={folder}/profile", f"--window-size={width},700"]
    command += ["--virtual-time-budget=4000", "--dump-dom", path.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    found = re.search(r'data-said="([^"]*)"', done.stdout)
    if found is None and "sorry" in done.stdout.split("<section>")[1]:
        pytest.skip("this Chromium has no WebGL 2")
    assert found, done.stderr[-2000:]
    return json.loads(html.unescape(found[1]))


@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium")
@pytest.mark.parametrize(("kind", "width"), [("tetra", 900), ("hexahedron20", 400), ("triangle6", 900)])
def test_sliders_and_clicks_change_what_is_shown(kind, width, tmp_path):
    dim = meshes.dim_of(kind)
    mesh = box(kind, (3,) * dim, 0.25 if dim == 3 and kind == "tetra" else 0.1)
    result = js.smooth(mesh, steps=1)
    said = in_a_browser(html_page("part", mesh, result), tmp_path, width)
    total = len(mesh.connectivity[0])
    assert said["all"] == f"{total} {total}"
    q = [np.asarray(part[0]) for part in (js.quality(mesh), result.quality)]
    assert said["below"] == " ".join(str(int((part <= 0.4).sum())) for part in q)
    if (q[0] <= 0.4).any():
        assert 0 < said["pixels"][1] < said["pixels"][0]
        assert f"of {total} elements before" in said["text"]
    halves = [[int(n) for n in said[name].split()] for name in ("cut", "other")]
    np.testing.assert_array_equal(np.sum(halves, axis=0), total)
    assert 0 < halves[0][0] < total
    assert said["colours"] == 3
    assert said["turned"]
    worst = int(np.argmin(q[1]))
    assert said["picked"] == f"{kind} {worst}: q {q[0][worst]:.3f} → {q[1][worst]:.3f}"
    assert said["requests"] == 0
    assert said["error"] == 0


SIDES_SCRIPT = """<script>
const said = {sides: [nameOf("before"), nameOf("after")], names: mesh.states.map((s) => s.name)};
const picture = () => { paint(); return canvas.toDataURL(); };
document.querySelector('[data-group=view] button[value="after"]').click();
const still = picture();
const select = $("tag-after").querySelector("select");
select.value = 0;
select.dispatchEvent(new Event("change"));
said.changed = still !== picture();
said.now = $("only-after").textContent;
said.q = Array.from(mesh.quality.after.slice(0, 3));
said.requests = performance.getEntriesByType("resource").length;
said.error = gl.getError();
document.body.dataset.said = JSON.stringify(said);
</script>"""


def compared(mesh):
    methods = {"elastic": js.Elastic(), "smart": js.Laplacian(smart=True)}
    steps = {"elastic": 1, "smart": 3}  # the first step of both untangles: the second of them ends better
    results = {name: js.smooth(mesh, method, steps=steps[name]) for name, method in methods.items()}
    constraints = js.detect_constraints(mesh)
    rows = [compare_row("input", mesh, None, constraints, {})]
    rows += [compare_row(name, mesh, r, constraints, {"smooth": 1.0}) for name, r in results.items()]
    return results, html_comparison("two <methods>", mesh, results, rows, notes=["odd"])


def test_a_comparison_has_all_methods_and_what_each_made():
    mesh = box()
    results, page = compared(mesh)
    drawn = scene_of(page)
    assert [state["name"] for state in drawn["states"]] == ["input", "elastic", "smart"]
    for state, result in zip(drawn["states"][1:], results.values(), strict=True):
        places = numbers(state["points"], "<f4").reshape(-1, 3)
        np.testing.assert_allclose(places, result.mesh.points, atol=1e-6)
    assert drawn["states"][drawn["right"]]["name"] == "smart"
    text = html.unescape(re.sub(r"<[^>]+>", " ", page.split('<script id="scene"')[0]))
    for words in ("two <methods>", "Take smart", "q_avg", "odd", "held: edge or corner"):
        assert words in text
    assert f"{results['smart'].history[-1].statistics.q_avg:.4g}" in text


@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium")
def test_any_two_methods_stand_side_by_side(tmp_path):
    mesh = box()
    said = in_a_browser(compared(mesh)[1], tmp_path, script=SIDES_SCRIPT)
    assert said["sides"] == ["input", "smart"]
    assert said["names"] == ["input", "elastic", "smart"]
    assert said["changed"]
    assert said["now"] == "input"
    np.testing.assert_allclose(np.array(said["q"]) / 32000, js.quality(mesh)[0][:3], atol=2e-5)
    assert said["requests"] == said["error"] == 0
