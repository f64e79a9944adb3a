import base64
import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from browser import CHROMIUM, Browser
from door_and_drawer import made_of
from structuregs.export.html import export_html, page_of, quantised, scene_of, splat_columns
from structuregs.geometry import SE3, Camera, Screw, quat_to_matrix
from structuregs.metrics import psnr
from structuregs.model import ArticulatedObject, Splats
from structuregs.raster import render

CAMERA = Camera(
    SE3.from_rotation(torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), torch.tensor([0.0, -5, 0.1])),
    150.0, 160.0, 85.0, 55.0, 160, 120,
)  # fmt: skip
CENTRES = ((0.0, 0.0, 0.0), (-1.0, -0.6, 0.5), (0.2, -0.6, 0.5), (-0.6, -0.6, -0.4), (0.6, -0.6, -0.4))


def screw(kind: str, axis: list[float], origin: list[float]) -> Screw:
    return Screw(kind, torch.tensor(axis, dtype=torch.float64), torch.tensor(origin, dtype=torch.float64))


@pytest.fixture(scope="module")
def obj() -> ArticulatedObject:
    """A base, two doors and two drawers, of flat and coloured splats with a tint."""
    motions = [
        screw("revolute", [0, 0, 1], [-1.4, -0.6, 0.5]).motion(-0.8),
        screw("revolute", [0, 0, 1], [0.6, -0.6, 0.5]).motion(0.5),
        screw("prismatic", [0, -1, 0], [0, 0, 0]).motion(0.7),
        screw("prismatic", [0, -0.6, -0.8], [0, 0, 0]).motion(0.5),
    ]
    made = made_of(*motions, centres=CENTRES)
    g = torch.Generator().manual_seed(1)
    n = len(made.parts.splats)
    splats = replace(
        made.parts.splats,
        log_scales=made.parts.splats.log_scales + torch.randn(n, 3, generator=g) * 0.6,
        logit_opacities=torch.randn(n, generator=g) * 2,
    )
    return replace(made, parts=replace(made.parts, splats=splats, tint=torch.rand(n, 3, generator=g) * 0.4 - 0.2))


def without_tint(obj: ArticulatedObject) -> ArticulatedObject:
    return replace(obj, parts=replace(obj.parts, tint=torch.zeros_like(obj.parts.tint)))


def rendered(splats: Splats, camera: Camera = CAMERA) -> np.ndarray:
    return render(splats, camera).rgb.clamp(0, 1).numpy()


def closeness(a: np.ndarray, b: np.ndarray) -> float:
    return float(psnr(torch.from_numpy(a), torch.from_numpy(b)))


def test_numbers_stand_for_values_to_half_a_step_and_take_two_bytes_each(obj):
    columns = splat_columns(obj)
    numbers, low, high = quantised(columns)
    assert np.abs(low + numbers * ((high - low) / 65535) - columns).max() <= 0.51 * ((high - low) / 65535).max()
    assert len(base64.b64decode(scene_of(obj)["splats"])) == 32 * len(obj.parts.splats)
    constant = np.full((3, 2), 0.7, np.float32)
    assert quantised(constant)[1].tolist() == pytest.approx([0.7, 0.7])
    assert not quantised(constant)[0].any()


def test_three_numbers_give_back_every_orientation(obj):
    """Half turns and negated quaternions too; by the formula of Schaub and Junkins for the rotation matrix."""
    parts = replace(obj.parts, boxes=replace(obj.parts.boxes, T_world_box=SE3.identity(5)))
    quats = parts.splats.quats.clone()
    quats[0], quats[1] = torch.tensor([0.0, 1, 0, 0]), torch.tensor([-0.1, 0, -1, 0])
    m = splat_columns(replace(obj, parts=replace(parts, splats=replace(parts.splats, quats=quats))))[:, 3:6].astype(float)
    square = (m * m).sum(1)[:, None, None]
    cross = np.cross(m[:, None], np.eye(3)[None]).swapaxes(1, 2)
    R = np.eye(3) + (8 * cross @ cross + 4 * (1 - square) * cross) / (1 + square) ** 2
    assert np.abs(R - quat_to_matrix(quats).numpy()).max() < 1e-5
    assert np.abs(m).max() <= 1


def test_a_page_is_one_file_that_names_no_other(obj, tmp_path):
    file = export_html(obj, tmp_path / "new" / "thing.html")
    again = export_html(obj, tmp_path / "again.html", title="thing")
    assert file.read_bytes() == again.read_bytes()
    assert [p.name for p in file.parent.iterdir()] == ["thing.html"]
    text = file.read_text()
    assert "<title>thing</title>" in text
    assert not re.search(r"https?://|\{\{|import\(|<link(?! rel=\"icon\" href=\"data:,\")|src=", text)


def test_no_text_of_the_object_ends_its_element(obj):
    joint = replace(obj.joints[0], review="</script><b>look</b>")
    text = page_of(replace(obj, joints=(joint, *obj.joints[1:])), title="<i>{{scene}}</i>")
    assert text.count("</script>") == 2
    assert '<h1 id="title">&lt;i&gt;{{scene}}&lt;/i&gt;</h1>' in text
    scene = re.search(r'id="scene">(.*)</script>', text)
    assert scene is not None
    assert json.loads(scene[1])["joints"][0]["review"] == joint.review


def test_the_page_opens_before_the_side_where_parts_come_out(obj):
    """Drawers and doors come out towards -y."""
    view = scene_of(obj)["view"]
    assert math.sin(view["azimuth"]) < -0.6


needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    browser = Browser(tmp_path_factory.mktemp("profile"))
    yield browser
    browser.close()


@pytest.fixture
def page(browser, obj, tmp_path):
    """The page of the object without a tint, seen by the camera."""
    browser.open(export_html(without_tint(obj), tmp_path / "page.html"))
    look_through_camera(browser)
    return browser


def look_through_camera(browser: Browser, camera: Camera = CAMERA) -> None:
    T = camera.T_world_camera
    record = {"R": T.rotation.T.flatten().tolist(), "centre": T.xyz.tolist()}
    record |= {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
    browser.run(f"viewer.setCamera({json.dumps(record)})")


def drag_slider(browser: Browser, i: int, q: float) -> None:
    browser.run(f"const s = document.getElementById('joint_{i}'); s.value = {q}; s.dispatchEvent(new Event('input')); 0")


@needs_browser
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_the_picture_is_the_renderers(browser, obj, tmp_path, share):
    browser.open(export_html(obj, tmp_path / "page.html"))
    look_through_camera(browser)
    q = [share * joint.q[1] for joint in obj.joints]
    browser.run(f"viewer.setJoints({q})")
    assert closeness(browser.image("viewer.picture()"), rendered(obj.at(q))) > 40


@needs_browser
def test_splats_thinner_than_a_pixel_are_the_renderers_too(browser, obj, tmp_path):
    camera = CAMERA.resized(40, 30)
    browser.open(export_html(obj, tmp_path / "page.html"))
    look_through_camera(browser, camera)
    assert closeness(browser.image("viewer.picture()"), rendered(obj.at([0.0] * 4), camera)) > 40


@needs_browser
@pytest.mark.parametrize("part", [1, 4])
def test_a_slider_changes_the_picture_where_its_part_is_and_nowhere_else(page, obj, part):
    before = page.image("viewer.picture()")
    q = [0.0] * 4
    q[part - 1] = obj.joints[part - 1].q[1]
    drag_slider(page, part, q[part - 1])
    change = np.abs(page.image("viewer.picture()") - before).max(2)
    start = sum(obj.parts.counts[:part])
    there = np.zeros_like(change, dtype=bool)
    for splats in (obj.at([0.0] * 4), obj.at(q)):
        there |= render(splats[start : start + obj.parts.counts[part]], CAMERA).alpha.numpy() > 0
    assert there.mean() < 0.4
    assert change[there].max() > 0.3
    assert change[~there].max() < 0.01


@needs_browser
def test_the_page_makes_no_request_and_no_complaint(page):
    page.run("viewer.play(true); new Promise((done) => setTimeout(done, 300))")
    assert [url.partition(":")[0] for url in page.requests] == ["file"] * len(page.requests)
    assert page.complaints == []


@needs_browser
def test_buttons_go_to_the_states_and_boxes_switch_parts_off(page, obj):
    page.run("document.querySelectorAll('.states button')[1].click()")
    labels = page.run("[...document.querySelectorAll('.joint output')].map((o) => o.textContent)")
    assert labels == ["45.8°", "28.6°", "0.700 units", "0.500 units"]
    page.run("document.querySelectorAll('fieldset input')[2].click()")
    splats, start = without_tint(obj).parts.at_state(1), sum(obj.parts.counts[:2])
    kept = torch.ones(len(splats), dtype=torch.bool)
    kept[start : start + obj.parts.counts[2]] = False
    assert closeness(page.image("viewer.picture()"), rendered(splats[kept])) > 40
    page.run("document.querySelectorAll('.states button')[0].click()")
    assert page.run("viewer.viewer.q") == [0, 0, 0, 0]


@needs_browser
def test_boxes_are_drawn_where_they_are_in_their_parts_colours(page, obj):
    q = [joint.q[1] for joint in obj.joints]
    page.run(f"viewer.setJoints({q}); document.querySelectorAll('fieldset input')[5].click()")
    picture = page.image("viewer.picture()")
    for box, part in zip(obj.boxes_at(q).edges[1:], scene_of(obj)["parts"][1:], strict=True):
        pixels, _ = CAMERA.project(box.mean(-2))
        colours = picture[pixels[:, 1].long(), pixels[:, 0].long()]
        assert np.median(np.abs(colours - np.array(part["colour"]) / 255).max(1)) < 0.15


@needs_browser
def test_mouse_and_fingers_move_the_camera(page):
    def camera():
        return page.run("(({azimuth, elevation, distance, target}) => ({azimuth, elevation, distance, target}))(viewer.orbit)")

    def mouse(kind, x, y, **more):
        page.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def drag(button, buttons):
        mouse("mousePressed", 200, 200, button=button, buttons=buttons, clickCount=1)
        mouse("mouseMoved", 260, 230, button=button, buttons=buttons)
        mouse("mouseReleased", 260, 230, button=button)

    start = camera()
    drag("left", 1)
    turned = camera()
    assert turned["azimuth"] < start["azimuth"]
    assert turned["elevation"] > start["elevation"]
    assert turned["target"] == start["target"]
    drag("right", 2)
    moved = camera()
    assert moved["target"] != turned["target"]
    assert moved["azimuth"] == turned["azimuth"]
    mouse("mouseWheel", 200, 200, deltaX=0, deltaY=-100)
    nearer = camera()
    assert nearer["distance"] < moved["distance"]
    for kind, gap in (("touchStart", 40), ("touchMove", 80)):
        points = [{"x": 200 - gap, "y": 200, "id": 0}, {"x": 200 + gap, "y": 200, "id": 1}]
        page.send("Input.dispatchTouchEvent", type=kind, touchPoints=points)
    page.send("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
    assert camera()["distance"] == pytest.approx(nearer["distance"] / 2, rel=0.01)
