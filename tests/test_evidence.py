"""A closed box of splats, and a ball that slides out of it: which photos show the ball, and what follows."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from structuregs.capture import Capture, View, stack_views
from structuregs.fit.evidence import alike_in_both, covered_in_both, outlined_in_both, seen_in_both, shown, supported
from structuregs.geometry import SE3, Box, Camera, Screw
from structuregs.joints import REVIEW_BELOW, articulate
from structuregs.model import ArticulatedObject, PosedParts, Splats
from structuregs.raster import coverage_of, painted, render
from structuregs.synthetic import RenderOptions, make_capture, make_object


@pytest.fixture(scope="module")
def capture() -> Capture:
    return make_capture(make_object("laptop"), RenderOptions(size=64, views=6, test_views=1, samples=1))


def blobs(means: torch.Tensor, size: float) -> Splats:
    n = len(means)
    log_scales = torch.full((n, 3), size).log()
    return Splats(means, torch.tensor([1.0, 0, 0, 0]).repeat(n, 1), log_scales, torch.full((n,), 6.0), torch.zeros(n, 1, 3))


def walls() -> torch.Tensor:
    """Points on the faces of [-1, 1]^3."""
    faces = []
    side = torch.linspace(-1, 1, 13)
    u, v = (t.flatten() for t in torch.meshgrid(side, side, indexing="ij"))
    for axis in range(3):
        for level in (-1.0, 1.0):
            face = torch.stack([u, v, torch.full_like(u, level)], 1)
            faces.append(face.roll(axis, 1))
    return torch.cat(faces)


def hidden_ball(out: float) -> ArticulatedObject:
    """A ball in the middle of a closed box in state 0, `out` further along x in state 1."""
    boxes = Box(SE3.identity(2), torch.tensor([[0.3, 0.3, 0.3], [0.1, 0.1, 0.1]]))
    slide = SE3.exp(torch.tensor([out, 0.0, 0.0, 0.0, 0.0, 0.0]))
    motions = SE3(torch.stack([SE3.identity().wxyz_xyz, slide.wxyz_xyz]))
    generator = torch.Generator().manual_seed(0)
    ball = torch.nn.functional.normalize(torch.randn(200, 3, generator=generator), dim=-1)
    shell, inner = blobs(walls(), 0.03), blobs(ball, 0.02)
    counts = (len(shell), len(inner))
    return articulate(PosedParts(boxes, motions, Splats.concatenate([shell, inner]), counts, torch.zeros(sum(counts), 3)))


def test_what_one_state_hides_is_flagged(capture: Capture):
    before = hidden_ball(out=0.7)
    assert before.joints[0].confidence == 1
    (joint,) = seen_in_both(before, capture).joints
    assert joint.confidence < 0.2
    assert joint.review == "Hardly a photo of state 0 shows the part: where it is there is a guess."


def test_what_both_states_show_keeps_its_confidence(capture: Capture):
    obj = hidden_ball(out=0.7)
    away = SE3.exp(torch.tensor([0.0, 0.7, 0.0, 0.0, 0.0, 0.0]))
    moved = Box(SE3(torch.stack([SE3.identity().wxyz_xyz, away.wxyz_xyz])), obj.parts.boxes.half_extents)
    seen = articulate(replace(obj.parts, boxes=moved))
    (joint,) = seen_in_both(seen, capture).joints
    assert joint.confidence == 1
    assert joint.review == ""


@pytest.mark.parametrize(("turned", "doubtful"), [pytest.param(90.0, True, id="turns"), pytest.param(0.0, False, id="slides")])
def test_a_part_that_turns_has_to_be_seen_more_than_one_that_slides(capture: Capture, turned: float, doubtful: bool):
    """In state 0 a quarter of a rod stands out of a closed box; in state 1 it lies before the box, across or as it was."""
    shell, x = blobs(walls(), 0.03), torch.linspace(-0.6, 0.6, 400)
    rod = blobs(torch.stack([x, torch.zeros_like(x), torch.zeros_like(x)], 1), 0.03)
    half = torch.tensor([[1.1, 1.1, 1.1], [0.65, 0.05, 0.05]])
    within = SE3.exp(torch.tensor([0.7, 0.0, 0.0, 0.0, 0.0, 0.0]))
    angle = torch.tensor(turned).deg2rad()
    place = [1.3, 0.0, 0.0] if turned else [0.3, -1.3, 0.0]
    out = SE3.exp(torch.tensor([*place, 0, 0, 0])) @ SE3.exp(torch.stack([*torch.zeros(5), angle]))
    boxes = Box(SE3(torch.stack([SE3.identity().wxyz_xyz, within.wxyz_xyz])), half)
    motions = SE3(torch.stack([SE3.identity().wxyz_xyz, (out @ within.inverse()).wxyz_xyz]))
    counts = (len(shell), len(rod))
    parts = PosedParts(boxes, motions, Splats.concatenate([shell, rod]), counts, torch.zeros(sum(counts), 3))
    before = articulate(parts)
    (joint,) = seen_in_both(before, capture).joints
    assert before.joints[0].kind == ("revolute" if turned else "prismatic")
    assert not before.joints[0].review
    assert (joint.confidence < REVIEW_BELOW) == bool(joint.review) == doubtful


def test_an_older_doubt_is_kept(capture: Capture):
    obj = hidden_ball(out=0.7)
    doubtful = replace(obj, joints=(replace(obj.joints[0], confidence=0.5, review="Older."),))
    (joint,) = seen_in_both(doubtful, capture).joints
    assert joint.confidence < 0.1
    assert joint.review == "Older."


def two_balls(*out: float) -> ArticulatedObject:
    """Balls above and below a box, which go so far along x from state 0 to state 1."""
    places = torch.tensor([[0.0, 0, 0], [0, 0.8, 0], [0, -0.8, 0]])
    upright = torch.tensor([1.0, 0, 0, 0]).repeat(3, 1)
    boxes = Box(SE3.from_quat(upright, places), torch.tensor([[0.3, 0.3, 0.3], [0.15, 0.15, 0.15], [0.15, 0.15, 0.15]]))
    motions = SE3.from_quat(upright, torch.tensor([[0.0, 0, 0], [out[0], 0, 0], [out[1], 0, 0]]))
    shell = blobs(walls(), 0.03)
    splats = Splats.concatenate([shell] * 3)
    return articulate(PosedParts(boxes, motions, splats, (len(shell),) * 3, torch.zeros(len(splats), 3)))


def photographed(obj: ArticulatedObject) -> Capture:
    """Six photos of either state from around, and above and below."""
    states = []
    for state in (0, 1):
        views = []
        for k in range(6):
            turn = SE3.exp(torch.tensor([0.0, 0, 0, 0.4 * (-1) ** k, math.pi * k / 3, 0]))
            camera = Camera(turn @ SE3.exp(torch.tensor([0.0, 0, -4, 0, 0, 0])), 100.0, 100.0, 48.0, 48.0, 96, 96)
            image = render(obj.parts.at_state(state), camera)
            rgba = (255 * torch.cat([image.rgb.clamp(0, 1), image.alpha[..., None]], -1)).round().byte().numpy()
            views.append(View(f"{k:04d}", camera, rgba))
        states.append(tuple(views))
    return Capture("made", Path("made"), (states[0], states[1]), ((), ()), "memory")


@pytest.mark.parametrize(
    ("evidence", "out", "sentence"),
    [
        pytest.param(covered_in_both, 0.2, "Beside the part, photos of state 1 show what nothing covers (", id="bare"),
        pytest.param(
            outlined_in_both,
            0.58,
            "Where the part lies in state 1, its outline is not the masks' (by ",
            id="half a pixel short",
        ),
    ],
)
def test_a_part_is_doubted_that_goes_less_far_than_photos_say(
    evidence: Callable[[ArticulatedObject, Capture], ArticulatedObject], out: float, sentence: str
):
    photos = photographed(two_balls(0.7, 0.6))
    right, short = evidence(two_balls(0.7, 0.6), photos).joints, evidence(two_balls(0.7, out), photos).joints
    assert [joint.confidence for joint in right] == [1, 1]
    assert [joint.review for joint in right] == ["", ""]
    assert short[0].confidence == 1
    assert short[1].confidence < 0.5
    assert short[1].review.startswith(sentence)


def test_half_a_pixel_short_leaves_nothing_bare():
    photos = photographed(two_balls(0.7, 0.6))
    assert covered_in_both(two_balls(0.7, 0.58), photos).joints[1].confidence == 1


def test_what_has_no_joint_is_not_doubted():
    """Photos show two balls, the object has none."""
    photos, obj = photographed(two_balls(0.7, 0.6)), two_balls(0.7, 0.6)
    still = articulate(obj.parts.joined(0, 1).joined(0, 1))
    assert still.joints == ()
    for evidence in (seen_in_both, covered_in_both, outlined_in_both, alike_in_both):
        assert evidence(still, photos).joints == ()


def test_what_some_splats_cover_and_what_the_others_do_adds_up_to_the_picture_s_coverage(capture: Capture):
    splats = hidden_ball(out=0.7).parts.at_state(1)
    camera = capture.train[0][0].camera
    some = torch.arange(len(splats)) % 3 == 0
    total = coverage_of(splats, some, camera) + coverage_of(splats, ~some, camera)
    torch.testing.assert_close(total, render(splats, camera).alpha, rtol=0, atol=1e-5)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_what_each_splat_paints_is_what_it_takes_part_in(capture: Capture, backend: str):
    """Held against pictures in which some splats are white and all others black."""
    splats = hidden_ball(out=0.7).parts.at_state(1)
    if backend == "reference":
        splats = Splats(**{name: value.double() for name, value in splats.tensors().items()})
    camera = capture.train[0][0].camera
    each = painted(splats, camera)
    assert not each.requires_grad
    for some in (torch.arange(len(splats)) % 3 == 0, torch.arange(len(splats)) > len(splats) - 200):
        assert float(each[some].sum()) == pytest.approx(float(coverage_of(splats, some, camera).mean()), abs=2e-5)
        left = torch.arange(camera.width) < camera.width / 2
        here = painted(splats, camera, left.expand(camera.height, -1))
        assert float(here[some].sum()) == pytest.approx(float((coverage_of(splats, some, camera) * left).mean()), abs=2e-5)


def test_what_no_photo_shows_is_told_from_what_some_do(capture: Capture):
    photos = [stack_views(views, 64) for views in capture.train]
    seen = []
    for way in (0.0, 0.7):
        parts = hidden_ball(out=way).parts
        parts.splats.log_scales[: parts.counts[0]] = math.log(0.06)  # no light between the blobs of the box
        seen.append(shown(parts, photos).split(parts.counts))
    (shell, shut), (_, out) = seen
    assert shell.float().mean() > 0.9
    assert not shut.any()
    assert out.float().mean() > 0.4


TURN = Screw("revolute", torch.tensor([0.0, 1.0, 0.0]), torch.tensor([0.0, 0.0, -2.5])).motion(0.1)
SLIDE = SE3.exp(torch.tensor([0.25, 0.0, 0.0, 0.0, 0.0, 0.0]))


def carried(ball: float, motion: SE3) -> tuple[PosedParts, dict[str, slice]]:
    """A closed box, and a part that goes a quarter of a unit along x: a ball of some radius beside the box, and more.

    In state 0 the box hides all but the ball of it; in state 1 some lies upon the box's side, and some above and beside it.
    """
    generator = torch.Generator().manual_seed(0)
    spread = torch.rand(60, 3, generator=generator) - 0.5
    round_ = torch.nn.functional.normalize(torch.randn(200, 3, generator=generator), dim=-1)
    means = {
        "box": walls(),
        "ball": torch.tensor([0.8, 0.0, 0.0]) + ball * round_,
        "upon": torch.tensor([0.09, 0.0, -0.05]) + spread * torch.tensor([0.01, 0.2, 0.2]),
        "beside": torch.tensor([0.22, 0.0, 0.24]) + spread * torch.tensor([0.04, 0.4, 0.04]),
    }
    boxes = Box(SE3.identity(2), torch.tensor([[0.3, 0.3, 0.3], [1.0, 1.0, 1.0]]))
    motions = SE3(torch.stack([SE3.identity().wxyz_xyz, motion.wxyz_xyz.float()]))
    splats = Splats.concatenate(blobs(some, 0.03 if name == "box" else 0.01) for name, some in means.items())
    counts = (len(means["box"]), len(splats) - len(means["box"]))
    ends = np.cumsum([len(some) for some in means.values()]).tolist()
    places = {name: slice(end - len(some), end) for (name, some), end in zip(means.items(), ends, strict=True)}
    return PosedParts(boxes, motions, splats, counts, torch.zeros(len(splats), 3)), places


def test_what_hangs_before_the_base_in_one_state_alone_has_no_support(capture: Capture):
    parts, places = carried(ball=0.15, motion=TURN)
    known = supported(parts, [stack_views(views, 64) for views in capture.train])
    share = {name: float(known[where].float().mean()) for name, where in places.items()}
    assert share["box"] == 1
    assert share["ball"] == 1
    assert share["beside"] > 0.7
    assert share["upon"] < 0.1


@pytest.mark.parametrize(("ball", "motion"), [(0.01, TURN), (0.15, SLIDE)])
def test_all_has_support_of_what_slides_or_shows_for_the_most_in_one_state(capture: Capture, ball: float, motion: SE3):
    assert supported(carried(ball, motion)[0], [stack_views(views, 64) for views in capture.train]).all()
