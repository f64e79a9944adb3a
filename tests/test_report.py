import json
import math
import re
from base64 import b64decode
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from browser import CHROMIUM, Browser
from door_and_drawer import DOOR, DRAWER, made_of, photographed
from structuregs.export.chart import line_chart, ticks
from structuregs.export.report import write_report
from structuregs.model import ArticulatedObject

RECORDS = [
    {"step": s, "loss": 10.0 ** (-s / 100), "psnr": None if s < 50 else 20 + s / 10, "splats": 9} for s in range(10, 201, 10)
]


@pytest.fixture(scope="module")
def obj() -> ArticulatedObject:
    made = made_of(DOOR.motion(), DRAWER.motion())
    doubtful = replace(made.joints[0], confidence=0.34, review="a slide fits <almost> as well")
    return replace(made, joints=(doubtful, made.joints[1]))


@pytest.fixture(scope="module")
def run(obj, tmp_path_factory) -> Path:
    run = tmp_path_factory.mktemp("run")
    (run / "metrics.jsonl").write_text("".join(json.dumps(record) + "\n" for record in RECORDS))
    (run / "timing.json").write_text('{"total": 3725.4}')
    (run / "config.json").write_text(json.dumps({"seed": 3, "fit": {"start": {"voxels": 96}, "sizes": [[0.0, 160]]}}))
    (run / "notes.txt").write_text("5% of what state 1 shows is in no part\n")
    write_report(run, photographed(obj), obj)
    return run


@pytest.fixture(scope="module")
def text(run) -> str:
    return (run / "report.html").read_text()


def pictures(text: str, kind: str) -> list[Image.Image]:
    return [Image.open(BytesIO(b64decode(data))) for data in re.findall(rf"data:image/{kind};base64,([^\"]+)", text)]


def test_it_says_of_every_joint_what_it_is_and_how_sure(text):
    assert "A base and 2 moving parts: 1 that turns and 1 that slides." in text
    rows = re.findall(r"<tr>(.*?)</tr>", text)[1:]
    cells = [[re.sub("<[^>]*>", "", cell) for cell in re.findall(r"<td.*?>(.*?)</td>", row)] for row in rows]
    assert [row[0] for row in cells] == ["part 1", "part 2"]
    assert cells[0][1] == "revolute"
    assert cells[0][4:] == ["60.0°", "0.34", "a slide fits &lt;almost&gt; as well"]
    assert cells[1][1] == "prismatic"
    assert cells[1][2].split()[1] == "−1.000"
    assert cells[1][4] == "0.400 units"


def test_warnings_are_the_joints_doubts_and_the_fits_notes(text, obj, tmp_path):
    Image.new("RGB", (7, 5)).save(tmp_path / "overview.png")
    items = re.findall(r"<li>(.*?)</li>", text)
    assert items == ["Part 1: a slide fits &lt;almost&gt; as well", "5% of what state 1 shows is in no part"]
    clear = replace(obj, joints=tuple(replace(joint, review="", confidence=0.9) for joint in obj.joints))
    capture = photographed(obj)
    assert "<li>" not in write_report(tmp_path, capture, clear).read_text()
    seen = write_report(tmp_path, replace(capture, test=((), ())), clear).read_text()
    assert "No photos were held out" in seen
    assert "seen by the fit" in seen
    unclear = replace(clear, joints=(replace(clear.joints[0], confidence=0.2), clear.joints[1]))
    assert "type and axis are not clear (confidence 0.20)." in write_report(tmp_path, capture, unclear).read_text()


def test_photos_stand_beside_renderings_of_their_cameras(text):
    """The photos are the object's own renderings, so pairs are alike, and their PSNR is that of rounding to bytes."""
    shown = [np.asarray(picture.convert("RGB")).astype(float) for picture in pictures(text, "jpeg")]
    assert len(shown) == 8  # two views of each state and their renderings
    for photo, rendering in zip(shown[::2], shown[1::2], strict=True):
        assert photo.shape == rendering.shape
        assert np.abs(photo - rendering).mean() < 3
    other = np.asarray(Image.fromarray(shown[4].astype(np.uint8)).resize(shown[0].shape[1::-1])).astype(float)
    assert np.abs(shown[0] - other).mean() > 10  # the states differ
    assert min(float(p) for p in re.findall(r"([\d.]+) dB</span>", text)) > 40


def test_the_joints_are_seen_to_move(text):
    (sweep,) = pictures(text, "webp")
    assert sweep.n_frames == 30
    first = np.asarray(sweep.convert("RGB")).astype(float)
    sweep.seek(15)
    assert np.abs(np.asarray(sweep.convert("RGB")) - first).max() > 50


def test_figures_and_settings_are_those_of_the_runs_files(text):
    assert "<dd>1 h 2 min</dd>" in text
    assert "200 steps in 1 h 2 min" in text
    assert f"<dd>{20 + (110 + 200) / 2 / 10:.1f} dB</dd>" in text  # the mean of the last ten
    settings = dict(re.findall(r"<dt>([^<]*)</dt><dd>([^<]*)</dd>", text))
    assert settings["fit.start.voxels"] == "96"
    assert settings["fit.sizes"] == "[[0.0, 160]]"


def test_the_report_is_one_file_and_the_same_each_time(run, text, obj):
    again = write_report(run, photographed(obj), obj)
    assert again.read_text() == text
    assert {file.name for file in run.iterdir()} == {"metrics.jsonl", "timing.json", "notes.txt", "config.json", "report.html"}
    assert not re.search(r"https?://|src=\"(?!data:)|<script", text)


def test_the_runs_own_picture_of_boxes_is_shown_where_it_is(obj, tmp_path):
    Image.new("RGB", (7, 5)).save(tmp_path / "overview.png")
    (picture,) = pictures(write_report(tmp_path, photographed(obj), obj).read_text(), "png")
    assert picture.size == (7, 5)


def test_an_object_that_does_not_move_is_reported_too(tmp_path):
    still = made_of()
    text = write_report(tmp_path, photographed(still), still).read_text()
    assert "A base; nothing moves." in text


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0.0, 1400.0, [0, 500, 1000]),
        (23.4, 38.1, [25, 30, 35]),
        (0.1, 0.34, [0.1, 0.15, 0.2, 0.25, 0.3]),
        (-1.0, 1.0, [-1, -0.5, 0, 0.5, 1]),
    ],
)
def test_ticks_are_round_and_few(low, high, expected):
    assert ticks(low, high) == pytest.approx(expected)


def test_a_curve_goes_where_its_points_are():
    """Of an exponential by logarithm: a straight line, which no running mean changes, from corner to corner."""
    svg = line_chart([(float(s), math.exp(-s)) for s in range(30)], x_label="step", y_label="Loss", log=True)
    raw, smooth = ([tuple(map(float, p.split(","))) for p in line.split()] for line in re.findall(r'points="([^"]+)"', svg))
    assert np.allclose(raw, smooth, atol=0.11)
    x, y = np.array(raw).T
    assert np.allclose(np.diff(x), np.diff(x).mean(), atol=0.11)
    assert np.allclose(np.diff(y), np.diff(y).mean(), atol=0.11)
    assert y[0] < y[-1]  # down the page is down the curve


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")
def test_a_browser_shows_it_without_a_request_or_a_complaint(run, tmp_path):
    browser = Browser(tmp_path / "profile")
    try:
        browser.open(run / "report.html")
        sizes = browser.run("[...document.images].map((image) => image.naturalWidth)")
        assert min(sizes) > 0
        assert browser.run("document.documentElement.scrollWidth <= window.innerWidth")
        assert {url.partition(":")[0] for url in browser.requests} <= {"file", "data"}
        assert browser.complaints == []
    finally:
        browser.close()
