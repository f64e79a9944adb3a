import json
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.error import HTTPError, URLError
from urllib.request import Request, urlopen

import numpy as np
import pytest
import torch

from browser import CHROMIUM, Browser
from door_and_drawer import made_of, photographed
from structuregs.export.html import page_of, scene_of
from structuregs.export.sweep import telling_order
from structuregs.fit.events import Preview
from structuregs.fit.reconstruct import fit_run
from structuregs.fit.schedule import FitConfig, Growth
from structuregs.fit.state import FitState
from structuregs.geometry import Screw
from structuregs.model import ArticulatedObject
from structuregs.view import LivePage, serve


def screw(kind: str, axis: list[float], origin: list[float]) -> Screw:
    return Screw(kind, torch.tensor(axis, dtype=torch.float64), torch.tensor(origin, dtype=torch.float64))


DOOR = screw("revolute", [0, 0, 1], [1, 0, 0])
DRAWER = screw("prismatic", [0, -1, 0], [0, 0, 0]).motion(0.4)


@pytest.fixture(scope="module")
def obj() -> ArticulatedObject:
    return made_of(DOOR.motion(0.8), DRAWER)


@pytest.fixture(scope="module")
def later() -> ArticulatedObject:
    """The same object some steps on: black, and its door opens half as far again."""
    made = made_of(DOOR.motion(1.2), DRAWER)
    splats = replace(made.parts.splats, sh=torch.full_like(made.parts.splats.sh, -2.0))
    return replace(made, parts=replace(made.parts, splats=splats))


@pytest.fixture
def page() -> Iterator[LivePage]:
    with LivePage("a <thing>") as page:
        yield page


def get(url: str, host: str | None = None) -> tuple[int, str]:
    with urlopen(Request(url, headers={"Host": host} if host else {}), timeout=10) as answer:
        return answer.status, answer.read().decode()


def plain(record: dict[str, Any]) -> dict[str, Any]:
    """A record as JSON gives it back."""
    return json.loads(json.dumps(record))


def test_the_page_is_the_exported_one_with_a_scene_that_it_asks_for(page, obj):
    status, text = get(page.url)
    assert status == 200
    assert "<title>a &lt;thing&gt;</title>" in text
    assert 'id="scene">null</script>' in text
    assert "connect-src 'self'" in text
    exported = page_of(obj, title="a <thing>")
    assert "connect-src" not in exported
    assert "fetch(" not in exported
    for line in exported.split('id="scene">')[0].splitlines():
        assert line.partition("img-src data:")[0] in text


def test_a_scene_comes_once_there_is_one_and_again_when_it_has_changed(page, obj, later):
    assert get(page.url + "scene?after=0") == (204, "")
    page.show(obj)
    first = json.loads(get(page.url + "scene?after=0")[1])
    assert first == plain(scene_of(obj)) | {"version": 1}
    assert get(page.url + "scene?after=1") == (204, "")
    page.show(later)
    second = json.loads(get(page.url + "scene?after=1")[1])
    assert second == plain(scene_of(later, view=first["view"])) | {"version": 2}
    assert json.loads(get(page.url + "scene")[1]) == second


def test_the_renderer_runs_in_the_thread_that_shows_and_in_no_other(page, obj, later, monkeypatch):
    """Its kernels end the process where two threads run them at once (Numba's workqueue)."""
    threads = []

    def noted(*arguments):
        threads.append(threading.current_thread())
        return telling_order(*arguments)

    monkeypatch.setattr("structuregs.export.html.telling_order", noted)
    for shown in (obj, later):
        page.show(shown)
        assert get(page.url + "scene")[0] == 200
    assert threads == [threading.main_thread()]


@pytest.mark.parametrize(("path", "host", "status"), [("object.json", None, 404), ("scene", "evil.example:80", 403)])
def test_nothing_else_is_served_and_to_no_page_of_another_site(page, obj, path, host, status):
    page.show(obj)
    with pytest.raises(HTTPError) as refused:
        get(page.url + path, host)
    assert refused.value.code == status


def test_a_tunnel_may_come_out_at_another_port(page):
    assert get(page.url, "localhost:1234")[0] == 200


def test_nobody_else_on_the_network_is_answered(page):
    port = int(page.url.rstrip("/").rpartition(":")[2])
    with socket.socket() as other, pytest.raises(OSError, match="refused"):
        other.connect(("127.0.0.2", port))


def test_after_the_end_nothing_is_served_and_nobody_is_waited_for(obj):
    with LivePage("thing") as page, socket.create_connection(("127.0.0.1", int(page.url[:-1].rpartition(":")[2]))) as silent:
        silent.sendall(b"GET / HT")
        page.show(obj)
    with pytest.raises(URLError):
        get(page.url)


@pytest.mark.parametrize("port", [-1, 70000])
def test_a_port_that_there_is_not_gives_one_sentence(port):
    with pytest.raises(
        ValueError, match=rf"^port {port}: no page can be served there \([^.]*\); choose another, or 0 for any\.$"
    ):
        LivePage("thing", port=port)


def test_a_port_that_is_taken_gives_one_sentence(page):
    port = int(page.url.rstrip("/").rpartition(":")[2])
    with pytest.raises(ValueError, match=rf"^port {port}: no page can be served there \(Address [^.]*\); choose another"):
        LivePage("thing", port=port)


def test_serving_ends_with_ctrl_c(obj):
    seen = []

    def ready(url: str) -> None:
        seen.append(get(url)[0])
        raise KeyboardInterrupt

    serve(obj, title="thing", ready=ready)
    assert seen == [200]


def fitted(run: Path, page: LivePage | None = None) -> list[tuple[ArticulatedObject, str]]:
    """Goes on with a fit from rough parts to its end; what it previews, where there is a page, and its scene at that time."""
    capture = photographed(made_of(DOOR.motion(0.8), DRAWER), views=3)
    growth = Growth(interval=30, most=600)
    config = FitConfig(steps=110, structure_until=10, image_from=10, sizes=((0.0, 32),), checkpoint_every=60, growth=growth)
    next(fit_run(capture, run, config, device="cpu"))
    FitState.start(made_of(DOOR.motion(0.5), DRAWER).parts).save(run / "checkpoints" / "last.pt")
    seen = []
    for event in fit_run(capture, run, config, device="cpu"):
        if page is not None and isinstance(event, Preview):
            obj = event.obj()
            page.show(obj)
            seen.append((obj, get(page.url + "scene")[1]))
    return seen


def test_a_fit_that_is_watched_ends_in_the_same_bytes_and_what_was_seen_stays_as_it_was(page, tmp_path):
    seen = fitted(tmp_path / "watched", page)
    fitted(tmp_path / "alone")
    for name in ("object/object.json", "object/splats.safetensors", "metrics.jsonl"):
        assert (tmp_path / "watched" / name).read_bytes() == (tmp_path / "alone" / name).read_bytes()
    scenes = [json.loads(text)["splats"] for _, text in seen]
    assert len(set(scenes)) == 3
    assert [scene_of(obj)["splats"] for obj, _ in seen] == scenes


needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")


@pytest.fixture(scope="module")
def browser(tmp_path_factory) -> Iterator[Browser]:
    browser = Browser(tmp_path_factory.mktemp("profile"))
    yield browser
    browser.close()


def visit(browser: Browser, page: LivePage) -> None:
    browser.send("Page.navigate", url=page.url)
    until(browser, f"location.href === '{page.url}' && document.readyState === 'complete'")


def until(browser: Browser, condition: str) -> None:
    for _ in range(200):
        if browser.run(condition):
            return
        time.sleep(0.05)
    raise AssertionError(f"never came true: {condition}")


def picture(browser: Browser) -> np.ndarray:
    """What is drawn, sharp as it is at rest."""
    return browser.image("viewer.moving = false; viewer.picture()")


def drag_slider(browser: Browser, i: int, q: float) -> None:
    browser.run(f"(s => {{ s.value = {q}; s.dispatchEvent(new Event('input')); }})(document.getElementById('joint_{i}'))")


@needs_browser
def test_the_picture_changes_with_the_object_and_sliders_and_camera_stay(browser, page, obj, later):
    visit(browser, page)
    until(browser, "document.querySelector('.sorry')?.textContent.includes('will appear')")
    page.show(obj)
    until(browser, "window.viewer !== undefined")
    assert browser.run("document.querySelector('.sorry')") is None
    closed = picture(browser)
    drag_slider(browser, 1, 0.4)
    opened = picture(browser)
    assert np.abs(opened - closed).max() > 0.3
    browser.run("viewer.orbit.turn(50, 20); document.querySelectorAll('fieldset input')[2].click()")
    camera = browser.run("viewer.orbit.camera(1)")
    before = picture(browser)

    page.show(later)
    until(browser, "viewer.viewer.scene.version === 2")
    assert np.abs(picture(browser) - before).max() > 0.3
    assert browser.run("viewer.orbit.camera(1)") == camera
    assert browser.run("viewer.viewer.q") == pytest.approx([0.6, 0], abs=1e-5)
    assert float(browser.run("document.getElementById('joint_1').value")) == pytest.approx(0.6, abs=1e-5)
    assert browser.run("[...document.querySelectorAll('.joint .range span:last-child')].map((s) => s.textContent)") == [
        "68.8°",
        "0.400 units",
    ]
    assert browser.run("viewer.viewer.shown.parts") == [True, True, False]
    black = picture(browser)
    drag_slider(browser, 1, 1.2)
    assert np.abs(picture(browser) - black).max() > 0.3
    assert browser.complaints == []


@needs_browser
def test_the_panel_follows_the_number_of_parts(browser, page, obj):
    page.show(obj)
    visit(browser, page)
    until(browser, "window.viewer !== undefined")
    browser.run("document.querySelectorAll('fieldset input')[3].click(); viewer.play(true)")
    page.show(made_of(DRAWER))
    until(browser, "viewer.viewer.scene.version === 2")
    assert browser.run("[...document.querySelectorAll('.joint .kind')].map((k) => k.textContent)") == ["slides"]
    labels = browser.run("[...document.querySelectorAll('fieldset label')].map((l) => [l.textContent, l.control.checked])")
    assert labels == [["base", True], ["part 1", True], ["boxes", True], ["joint axes", False]]
    until(browser, "viewer.viewer.q[0] > 0.01")
    assert browser.complaints == []


@needs_browser
def test_the_page_stays_when_the_program_has_ended(browser, obj):
    with LivePage("thing") as page:
        page.show(obj)
        visit(browser, page)
        until(browser, "window.viewer !== undefined")
    until(browser, "document.getElementById('hint').textContent.includes('has ended')")
    before = picture(browser)
    drag_slider(browser, 1, 0.8)
    assert np.abs(picture(browser) - before).max() > 0.3
