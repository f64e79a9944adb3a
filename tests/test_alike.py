"""A patterned board that moves, photographed in both states: whether its photos are alike, and where in its plane they are."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import ndimage

from structuregs.boxes import Face, Overlap, Shown
from structuregs.boxes.appearance import LOOK_DILATION
from structuregs.capture import Capture, ImageStack, View
from structuregs.fit.evidence import alike_in_both
from structuregs.fit.laying import BothStates, laid_anew
from structuregs.geometry import SE3, Box, Camera
from structuregs.joints import articulate
from structuregs.model import SH_C0, ArticulatedObject, PosedParts, Splats
from structuregs.raster import render

F64 = torch.float64
UNIT = 0.03
BOX = Box(SE3.identity(dtype=F64), torch.tensor([0.6, 0.4, 0.02], dtype=F64))
# Off the board's plane, so that the board is seen from elsewhere in state 1.
TRUE = SE3.exp(torch.tensor([0.1, -0.05, 0.2, 0.3, -0.2, 0.1], dtype=F64))


PLAIN = np.full((13, 9), 0.5)
PATCHES = np.random.default_rng(0).uniform(0.2, 0.8, (13, 9))
CHECKS = 0.2 + 0.6 * (np.indices((13, 9)).sum(0) % 2)


def board(pattern: np.ndarray) -> Splats:
    """Splats in the plane z = 0 with a pattern of patches a tenth wide."""
    x, y = (t.flatten() for t in torch.meshgrid(torch.linspace(-0.6, 0.6, 61), torch.linspace(-0.4, 0.4, 41), indexing="ij"))
    means = torch.stack([x, y, torch.zeros_like(x)], 1)
    grey = torch.from_numpy(pattern).float()[((x + 0.6) * 10).long(), ((y + 0.4) * 10).long()]
    n = len(means)
    scales = torch.tensor([0.012, 0.012, 0.002]).log().repeat(n, 1)
    sh = ((grey - 0.5) / SH_C0)[:, None, None].repeat(1, 1, 3)
    return Splats(means, torch.tensor([1.0, 0, 0, 0]).repeat(n, 1), scales, torch.full((n,), 4.0), sh)


def cameras() -> tuple[Camera, ...]:
    """Twelve that look at the board from before it, from up to 40 degrees aside."""
    rows = []
    for angle in np.linspace(0, 2 * np.pi, 12, endpoint=False):
        tilt = 0.2 + 0.5 * (angle / (2 * np.pi))
        turn = SE3.exp(torch.tensor([0, 0, 0, tilt * np.cos(angle), tilt * np.sin(angle), 0], dtype=torch.float32))
        rows.append(Camera(turn @ SE3.exp(torch.tensor([0, 0, -3.0, 0, 0, 0])), 140.0, 140.0, 48.0, 48.0, 96, 96))
    return tuple(rows)


def shown(splats: Splats, gain: float = 1.0, lift: float = 0.0) -> Shown:
    """A state's photos of the splats, all of which are the part's, the photos in another light."""
    rgb, alpha = [], []
    for camera in cameras():
        picture = render(splats, camera, dilation=LOOK_DILATION)
        rgb.append(((picture.rgb * gain + lift).clamp(0, 1) * 255).round().byte().numpy())
        alpha.append((picture.alpha * 255).round().byte().numpy())
    return Shown(ImageStack(cameras(), np.stack(rgb), np.stack(alpha)), splats, torch.ones(len(splats), dtype=torch.bool))


def overlap(motion: SE3, *, pattern: np.ndarray = PATCHES, gain: float = 1.0, lift: float = 0.0) -> Overlap:
    """Both states of the board, its motion taken for `motion`."""
    splats = board(pattern)
    return Overlap.between(shown(splats), shown(splats.moved(TRUE), gain, lift), motion, BOX, UNIT)


def beside(x: float, y: float, turn: float) -> SE3:
    """The true motion after one in the board's plane, in units; at the rim for the turn."""
    rim = float(BOX.half_extents.norm())
    return TRUE @ SE3.exp(torch.tensor([x * UNIT, y * UNIT, 0, 0, 0, turn * UNIT / rim], dtype=F64))


def test_photos_of_a_part_are_alike_where_it_is_and_nowhere_near():
    assert overlap(TRUE).unlike() < 0.3
    assert min(overlap(beside(*place)).unlike() for place in ((3, 0, 0), (0, -3, 0), (-2, 2, 1))) > 0.85


@pytest.mark.parametrize(("gain", "lift"), [(0.7, 0.0), (1.0, 0.15), (0.6, 0.3)])
def test_a_state_s_light_does_not_count(gain: float, lift: float):
    assert overlap(TRUE, gain=gain, lift=lift).unlike() < 0.3


def test_a_further_motion_is_that_of_the_world_in_the_other_state():
    wrong = beside(2, 1, 0)
    assert overlap(wrong).unlike((TRUE @ wrong.inverse()).as_matrix().numpy()) == pytest.approx(
        overlap(TRUE).unlike(), abs=0.03
    )


@pytest.mark.parametrize("lift", [0.0, 0.3])
def test_what_is_left_is_what_scipy_s_interpolation_leaves(lift: float):
    """Pair by pair, with numpy: brightness of the one photo against that of the other, as a line fits it best."""
    found = overlap(beside(0.5, -0.3, 0.2), lift=lift)
    motion = SE3.exp(torch.tensor([0.02, 0.01, 0.03, 0.02, -0.01, 0.03], dtype=F64))
    moved = motion.apply(torch.from_numpy(found.points))
    left, varied = [], []
    for v, u in np.unique(np.stack([found.pixels[:, 0], found.photos]), axis=1).T:
        pair = (found.pixels[:, 0] == v) & (found.photos == u)
        columns, rows = (found.there.stack.cameras[u].project(moved[pair])[0].numpy() - 0.5).T
        seen = ndimage.map_coordinates(found.there.blurred[0.8][u].astype(float), [rows, columns], order=1, mode="nearest")
        asked = found.here.blurred[0.8][v][tuple(found.pixels[pair, 1:].T)].astype(float)
        asked -= asked.mean()
        contrast = np.clip(np.mean(seen * asked) / max(np.var(seen), 1e-12), 0.5, 2.0)
        left.append(np.minimum(np.abs(asked - contrast * (seen - seen.mean())) / max(contrast, 1.0), 0.15).sum())
        varied.append(np.minimum(np.abs(asked), 0.15).sum())
    assert found.unlike(motion.as_matrix().numpy()) == pytest.approx(sum(left) / sum(varied), rel=1e-4)


@pytest.mark.parametrize("place", [(1.5, 0.0, 0.0), (-1.0, 2.0, 0.0), (1.0, -1.0, 1.5), (5.5, -2.0, 0.0)])
def test_a_face_is_laid_where_its_photos_are_alike(place: tuple[float, float, float]):
    wrong = beside(*place)
    face = Face.most_shown(overlap(wrong))
    at = face.alike_at()
    assert at is not None
    found = face.laid(at)
    error = (found.apply(BOX.corners) - TRUE.apply(BOX.corners)).norm(dim=-1)
    before = (wrong.apply(BOX.corners) - TRUE.apply(BOX.corners)).norm(dim=-1)
    assert float(error.max()) < 0.25 * UNIT < 0.2 * float(before.max())


def test_a_face_goes_in_its_plane_only():
    face = Face.most_shown(overlap(beside(1, 0, 0)))
    moved = SE3.from_matrix(torch.from_numpy(face.moved(np.array([2.0, -1.0, 3.0]))))
    normal = TRUE.rotation[:, 2]
    heights = (moved.apply(face.pose.apply(BOX.corners * torch.tensor([1.0, 1.0, 0.0]))) - face.pose.xyz) @ normal
    torch.testing.assert_close(heights, torch.zeros_like(heights), rtol=0, atol=1e-9)


def test_a_plain_face_tells_nothing():
    plain = overlap(beside(1.5, 0, 0), pattern=PLAIN)
    assert plain.unlike() == 1
    assert Face.most_shown(plain).alike_at() is None


def test_photos_that_cannot_be_asked_by_halves_say_where_a_face_is_likeliest():
    """All of them of one half, as where few see the face."""
    wrong = beside(2.0, -1.0, 0.0)
    found = overlap(wrong)
    face = Face.most_shown(found.of(found.pixels[:, 0] % 2 == 0))
    assert face.alike_at() is None
    place = face.likeliest()
    assert place is not None
    error = (face.laid(place).apply(BOX.corners) - TRUE.apply(BOX.corners)).norm(dim=-1)
    assert float(error.max()) < 0.25 * UNIT


def test_a_face_that_is_where_it_was_found_is_likeliest_there_and_a_plain_one_nowhere():
    place = Face.most_shown(overlap(TRUE)).likeliest()
    assert place is not None
    assert np.linalg.norm(place) < 0.25
    assert Face.most_shown(overlap(beside(1.5, 0, 0), pattern=PLAIN)).likeliest() is None


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_photos_that_show_something_else_tell_nothing(seed: int):
    """Somewhere even faces with nothing in common are most alike, but either half of the photos finds a place of its own."""
    other = np.random.default_rng(seed).uniform(0.2, 0.8, PATCHES.shape)
    found = Overlap.between(shown(board(PATCHES)), shown(board(other).moved(TRUE)), TRUE, BOX, UNIT)
    assert found.unlike() > 0.9
    assert Face.most_shown(found).alike_at() is None


def test_a_place_stands_out_to_every_side(monkeypatch):
    there = np.zeros(3)
    assert Face.most_shown(overlap(TRUE)).stands_out(there)
    aside = Face.most_shown(overlap(beside(2, 0, 0)))
    assert not aside.stands_out(there)
    monkeypatch.setattr(Face, "unlike", lambda _, place: float(0.6 + 0.1 * abs(place[0]) - 0.01 * place[1]))  # a shade along y
    assert not aside.stands_out(there)


def test_a_face_that_is_where_it_was_found_stays():
    assert Face.most_shown(overlap(TRUE)).alike_at() is None


def test_what_is_out_of_reach_is_not_found():
    assert Face.most_shown(overlap(beside(16, 0, 0))).alike_at() is None


def test_what_no_photo_shows_in_both_states_is_no_overlap():
    away = overlap(SE3.exp(torch.tensor([0, 0, 1.0, 0, 0, 0], dtype=F64)) @ TRUE)
    assert len(away) == 0
    assert away.unlike() == 1
    assert Face.most_shown(away).alike_at() is None


def test_pixels_lie_on_the_part_in_the_state_they_are_of():
    found = overlap(TRUE)
    back = TRUE.inverse().apply(torch.from_numpy(found.points)).numpy()
    assert np.abs(back[:, 2]).max() < 0.02
    np.testing.assert_allclose(found.local, back, atol=1e-5)
    assert np.abs(found.normals[:, 2]).mean() > 0.95


def test_where_the_part_is_not_known_all_that_is_seen_may_be_it():
    splats = board(PATCHES)
    there = shown(splats.moved(TRUE))
    unknown = Overlap.between(shown(splats), Shown(there.stack, there.splats, None), TRUE, BOX, UNIT)
    known = Overlap.between(shown(splats), there, TRUE, BOX, UNIT)
    assert len(unknown) > len(known) > 0.8 * len(unknown)


def with_a_base(motion: SE3, pattern: np.ndarray = CHECKS) -> ArticulatedObject:
    """The board as the moving part of an object whose base is a plain block beside it."""
    block = board(PLAIN)
    block = replace(block, means=block.means * 0.3 + torch.tensor([0.0, 1.0, 0.0]))
    poses = torch.tensor([[1.0, 0, 0, 0, 0, 1, 0], [1.0, 0, 0, 0, 0, 0, 0]])
    boxes = Box(SE3(poses), torch.tensor([[0.6, 0.4, 0.4], [0.6, 0.4, 0.02]]))
    motions = SE3(torch.stack([SE3.identity().wxyz_xyz, motion.wxyz_xyz.float()]))
    counts = (len(block), len(board(pattern)))
    splats = Splats.concatenate([block, board(pattern)])
    part = torch.arange(2).repeat_interleave(torch.tensor(counts))
    local = replace(splats, means=(splats.means - poses[part, 4:]) / boxes.half_extents[part])
    return articulate(PosedParts(boxes, motions, local, counts, torch.zeros(sum(counts), 3)))


def slide(aside: float) -> SE3:
    """Away from the cameras, and so far along the board."""
    return SE3.exp(torch.tensor([aside, 0, 0.5, 0, 0, 0], dtype=F64))


def photographed(obj: ArticulatedObject) -> Capture:
    """Both states, from all cameras."""
    rows = []
    for state in (0, 1):
        pictures = [render(obj.parts.at_state(state), camera, dilation=LOOK_DILATION) for camera in cameras()]
        rgba = [torch.cat([p.rgb, p.alpha[..., None]], -1).clamp(0, 1).mul(255).round().byte().numpy() for p in pictures]
        rows.append(tuple(View(f"{i}", camera, image) for i, (camera, image) in enumerate(zip(cameras(), rgba, strict=True))))
    return Capture("board", Path("board"), (rows[0], rows[1]), (rows[0], rows[1]), "memory")


def test_a_part_whose_photos_are_not_alike_asks_for_a_look():
    true = with_a_base(slide(0.0))
    capture = photographed(true)
    (joint,) = alike_in_both(true, capture).joints
    assert joint == true.joints[0]
    assert joint.review == ""
    aside = with_a_base(slide(0.1))
    (joint,) = alike_in_both(aside, capture).joints
    assert joint.confidence < 0.75 * aside.joints[0].confidence
    assert joint.review == "Where the part lies in either state, photos of the two do not look alike."


def test_a_part_whose_photos_are_more_alike_beside_it_asks_for_a_look():
    true = with_a_base(slide(0.0), PATCHES)
    capture = photographed(true)
    assert alike_in_both(true, capture).joints == true.joints
    aside = with_a_base(slide(0.05), PATCHES)
    (joint,) = alike_in_both(aside, capture).joints
    assert joint.confidence < 0.75 * aside.joints[0].confidence
    assert joint.review == "Photos of the two states look more alike with the part 0.05 aside, in its face's plane."


def test_a_fitted_part_that_lies_beside_its_place_is_laid_anew():
    true = with_a_base(slide(0.0), PATCHES)
    laid = laid_anew(with_a_base(slide(0.05), PATCHES).parts, photographed(true))
    assert list(laid) == [1]
    corners = true.parts.boxes.corners[1].double()
    torch.testing.assert_close(laid[1].apply(corners), slide(0.0).apply(corners), atol=0.005, rtol=0)


def test_a_plain_part_is_laid_by_what_shows_beside_it():
    """Where state 1 shows the background in its place, and state 0 does so beside it."""
    capture = photographed(with_a_base(slide(0.0), PLAIN))
    aside = with_a_base(slide(0.05), PLAIN)
    laid = laid_anew(aside.parts, capture)
    corners = aside.parts.boxes.corners[1].double()
    torch.testing.assert_close(laid[1].apply(corners), slide(0.0).apply(corners), atol=0.005, rtol=0)


def test_what_one_state_finds_hardly_beside_a_part_is_believed_if_the_other_does_not_contradict(monkeypatch):
    capture = photographed(with_a_base(slide(0.0), PATCHES))
    near, right = (with_a_base(slide(aside), PATCHES).parts for aside in (0.01, 0.0))
    assert list(laid_anew(near, capture)) == [1]
    monkeypatch.setattr(Face, "alike_at", lambda face: np.array([0.4, 0, 0]) if face.overlap.motion.xyz[2] > 0 else None)
    assert laid_anew(right, capture) == {}
    monkeypatch.setattr(Face, "alike_at", lambda face: np.array([1.5, 0, 0]) if face.overlap.motion.xyz[2] > 0 else None)
    assert list(laid_anew(right, capture)) == [1]


@pytest.mark.parametrize(("slid", "to"), [(0.05, 0.0), (0.015, None)])
def test_a_part_that_one_photo_shows_is_laid_where_those_of_both_states_say_if_that_is_elsewhere(slid, to):
    """One photo of either state has no halves."""
    whole = photographed(with_a_base(slide(0.0), PATCHES))
    capture = replace(whole, train=(whole.train[0][3:4], whole.train[1][3:4]))
    fitted = with_a_base(slide(slid), PATCHES).parts
    both = BothStates(fitted, capture)
    faces = [Face.most_shown(both.laid(1, state)) for state in (0, 1)]
    assert [face.alike_at() for face in faces] == [None, None]
    assert all(face.likeliest() is not None for face in faces)
    laid = laid_anew(fitted, capture)
    if to is None:
        assert laid == {}
    else:
        corners = fitted.boxes.corners[1].double()
        torch.testing.assert_close(laid[1].apply(corners), slide(to).apply(corners), atol=0.005, rtol=0)


def test_a_part_stays_where_photos_of_the_two_states_find_it_likelier_in_two_places(monkeypatch):
    capture = photographed(with_a_base(slide(0.0), PATCHES))
    fitted = with_a_base(slide(0.05), PATCHES).parts
    monkeypatch.setattr(Face, "alike_at", lambda _: None)
    assert list(laid_anew(fitted, capture)) == [1]
    monkeypatch.setattr(Face, "likeliest", lambda _: np.array([2.0, 0, 0]))  # the same place in either would be opposite
    assert laid_anew(fitted, capture) == {}


def test_a_fitted_part_stays_where_either_state_shows_something_else():
    other = np.random.default_rng(1).uniform(0.2, 0.8, PATCHES.shape)
    one, two = (photographed(with_a_base(slide(0.0), pattern)) for pattern in (PATCHES, other))
    capture = replace(one, train=(one.train[0], two.train[1]), test=(one.test[0], two.test[1]))
    assert laid_anew(with_a_base(slide(0.05), PATCHES).parts, capture) == {}
