"""What the photos say of a fit: splats that none shows, what nothing covers, outlines, and parts that both show, and alike."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64
from scipy import ndimage
from torch import Tensor

from ..boxes import Face, Overlap
from ..capture import Capture, ImageStack, spread_cameras, stack_views
from ..geometry import Camera
from ..joints import REVIEW_BELOW, kind_of
from ..model import ArticulatedObject, Joint, PosedParts, Splats
from ..raster import coverage_of, painted, render
from .laying import BothStates

_SIZE = 128  # side of a square with as many pixels as the photos that are asked
_PHOTOS = 16  # of either state
_ENOUGH = 0.2  # of what a part that slides shows in one state: as much in the other leaves nothing to wish for; ...
_ENOUGH_TURNED = 0.35  # ...of one that turns, whose rim alone does not say about which hinge
_TRACE = 2e-6  # of a photo: a splat that paints less in all of them is not missed
_EITHER = 0.2  # of what a splat paints in both states: so much in either, and both show it
_EMPTY = 0.5  # of a pixel: what covers more covers it, and mask and model that differ by more see it differently
_GAPS, _HOLE = 0.005, 0.08  # of what photos show: nothing to say of so much uncovered; as much more leaves no confidence
_RIM, _BESIDE = 0.003, 0.012  # of the pixels that a part covers: the same of pixels that masks and model see differently
_LOOK = 400  # side of a square with as many pixels as the pictures that tell
_LOOKS = 48  # of either state
_FEWEST = 50  # pixels that say something
_HARDLY, _ASIDE = 0.5, 2.0  # units: so far away photos may be more alike; so much farther leaves no confidence
_NOTHING = 0.4  # photos that leave so much more unexplained of each other than nothing would say that a part is elsewhere


@torch.no_grad()
def shown(parts: PosedParts, photos: Sequence[ImageStack]) -> Bool[Tensor, " N"]:
    """Splats that paint a trace of some photo.

    Others hang behind what is seen, in both states, and come to light where the object is moved on.

    Args:
        parts: as fitted so far.
        photos: of either state.
    """
    most = torch.zeros_like(parts.splats.logit_opacities)
    for state, stack in enumerate(photos):
        splats = parts.at_state(state)
        for camera in _small(stack, _LOOKS, _LOOK):
            most = torch.maximum(most, painted(splats, camera))
    return most > _TRACE


def _small(stack: ImageStack, count: int, size: int) -> list[Camera]:
    """Some of the cameras, for pictures with at most as many pixels as a square of that size."""
    cameras = [stack.cameras[v] for v in spread_cameras(stack.cameras, count)]
    scales = [min(1.0, size / (camera.width * camera.height) ** 0.5) for camera in cameras]
    return [c.resized(round(c.width * scale), round(c.height * scale)) for c, scale in zip(cameras, scales, strict=True)]


@torch.no_grad()
def supported(parts: PosedParts, photos: Sequence[ImageStack]) -> Bool[Tensor, " N"]:
    """Splats that both states show, or that stand before nothing but their own part in the one that shows them.

    With few views what moves carries splats along that hang before what stands still in one state, in its colours, and are out
    of sight in the other: the base can paint the same.  All of the base is supported, all of a part that shows for the most in
    one state alone, and all of what slides: the end of a drawer that is in its cabinet hangs there as well.

    Args:
        parts: as fitted so far.
        photos: of either state.
    """
    posed = [parts.at_state(s) for s in (0, 1)]
    cameras = [_small(stack, _PHOTOS, _SIZE) for stack in photos]
    each = [[painted(splats, c) / len(row) for c in row] for splats, row in zip(posed, cameras, strict=True)]
    shares = torch.stack([torch.stack(row).sum(0) for row in each])
    total, part = shares.sum(0), parts.part.to(shares.device)
    known = (shares.amin(0) >= _EITHER * total) | (part == 0)
    for k in range(1, len(parts)):
        own = part == k
        doubtful = own & ~known
        if kind_of(parts.motions[k]) == "prismatic" or total[doubtful].sum() > total[own].sum() / 2:
            known |= own
            continue
        alone = torch.zeros_like(total)
        for splats, row, paints in zip(posed, cameras, each, strict=True):
            showing = [c for c, paint in zip(row, paints, strict=True) if paint[doubtful].sum() > _TRACE]
            for camera in showing:
                alone += _painted_alone(splats, own, doubtful, camera) / len(row)
        known |= doubtful & (alone >= total / 2)
    return known


def _painted_alone(
    splats: Splats, own: Bool[Tensor, " N"], doubtful: Bool[Tensor, " N"], camera: Camera
) -> Float32[Tensor, " N"]:
    """What each splat paints of an image where, without some of a part's splats, nothing shows but that part."""
    others = coverage_of(splats[~doubtful], ~own[~doubtful], camera)
    return painted(splats, camera, others < _EMPTY)


@torch.no_grad()
def seen_in_both(obj: ArticulatedObject, capture: Capture) -> ArticulatedObject:
    """The object with the confidence of its joints lowered where a part hardly shows in the photos of one state.

    The factor is the share of the photos that the part paints in the state where it paints less, over that in the other
    state, times five, or less than three where it turns, at most 1; where that makes a joint doubtful, a sentence asks for a
    look.  A part that was shut shows its front (a door .5 and more where measured, a drawer .17); one that was behind a door
    shows .03 and less, and where it was then is a guess; a seat under its lid shows a rim of .16 to .23, which tells its
    turn and its hinge only together.

    Args:
        obj: as fitted.
        capture: what it was fitted to.
    """
    shares = torch.zeros(2, len(obj.parts))
    for state, views in enumerate(capture.train):
        stack, splats = stack_views(views, _SIZE), obj.parts.at_state(state)
        cameras = [stack.cameras[v] for v in spread_cameras(stack.cameras, _PHOTOS)]
        for camera in cameras:
            shares[state].index_add_(0, obj.parts.part, painted(splats, camera).cpu() / len(cameras))
    joints = [_weighed(joint, shares[:, k].tolist()) for k, joint in enumerate(obj.joints, start=1)]
    return replace(obj, joints=tuple(joints))


def _weighed(joint: Joint, shares: list[float]) -> Joint:
    """The joint after a look at the share of either state's photos that its part paints."""
    enough = _ENOUGH_TURNED if joint.kind == "revolute" else _ENOUGH
    score = min(min(shares) / max(*shares, 1e-12) / enough, 1.0)
    hidden = shares.index(min(shares))
    return _lowered(joint, score, f"Hardly a photo of state {hidden} shows the part: where it is there is a guess.")


@torch.no_grad()
def covered_in_both(obj: ArticulatedObject, capture: Capture) -> ArticulatedObject:
    """The object with the confidence of its joints lowered where photos of one state show what nothing covers.

    What no motion explains is left out of both states, as the base cannot be there in one alone.  Each uncovered pixel counts
    for the moving part that shows nearest to it.  The factor is 1 where these are up to half a percent of what photos of the
    worse state show (.05 at most where all is right), 0 from 8.5 on; where that makes a joint doubtful, a sentence asks for a
    look.

    Args:
        obj: as fitted.
        capture: what it was fitted to.
    """
    if not obj.joints:
        return obj
    parts = obj.parts.to(torch.device("cpu"))
    bare, photos = np.zeros((2, len(parts))), np.zeros((2, 1))
    for state, splats, camera, covered, alpha in _masks_and_model(parts, capture, _SIZE):
        photos[state] += 1
        empty = covered - alpha > _EMPTY
        if empty.any():
            nearest = 1 + _nearest(_silhouettes(parts, splats, camera)[1:])
            bare[state] += np.bincount(nearest[empty], minlength=len(parts)) / covered.sum()
    sentence = "Beside the part, photos of state {state} show what nothing covers ({share:.0%} of the object)."
    return _doubted(obj, bare / photos, _GAPS, _HOLE, sentence)


@torch.no_grad()
def outlined_in_both(obj: ArticulatedObject, capture: Capture) -> ArticulatedObject:
    """The object with the confidence of its joints lowered where masks of one state say otherwise than the model.

    A panel whose turn is a few degrees off still explains most of what faces the cameras, the more so with a grain that
    repeats; seen along its plane it lies beside its outline.  Each pixel that only the mask or only the model covers counts for
    the part that shows nearest to it.  The factor is 1 where these are up to .3 percent of the pixels that the part covers in
    photos of the worse state (.15 at most where all is right, 1.1 and more from two degrees on), 0 from 1.5 on; where that
    makes a joint doubtful, a sentence asks for a look.

    Args:
        obj: as fitted.
        capture: what it was fitted to.
    """
    if not obj.joints:
        return obj
    parts = obj.parts.to(torch.device("cpu"))
    off, own = np.zeros((2, len(parts))), np.zeros((2, len(parts)))
    for state, splats, camera, covered, alpha in _masks_and_model(parts, capture, _LOOK):
        silhouettes = _silhouettes(parts, splats, camera)
        own[state] += silhouettes.sum((1, 2))
        wrong = np.abs(covered - alpha) > _EMPTY
        if wrong.any():
            off[state] += np.bincount(_nearest(silhouettes)[wrong], minlength=len(parts))
    sentence = "Where the part lies in state {state}, its outline is not the masks' (by {share:.1%} of what it covers)."
    return _doubted(obj, off / np.maximum(own, 1), _RIM, _BESIDE, sentence)


def _masks_and_model(
    parts: PosedParts, capture: Capture, size: int
) -> Iterator[tuple[int, Splats, Camera, Float32[np.ndarray, "H W"], Float32[np.ndarray, "H W"]]]:
    """Of some photos: their state, the splats as they stand in it, the camera, the mask, and how the splats cover it."""
    for state, views in enumerate(capture.train):
        stack, splats = stack_views(views, size), parts.at_state(state)
        for v in spread_cameras(stack.cameras, _PHOTOS):
            camera = stack.cameras[v]
            yield state, splats, camera, stack.target(v)[1].numpy(), render(splats, camera).alpha.numpy()


def _silhouettes(parts: PosedParts, splats: Splats, camera: Camera) -> Bool[np.ndarray, "K H W"]:
    """The pixels of a photo that each part covers, splats as they stand in its state."""
    return np.stack([coverage_of(splats, parts.part == k, camera).numpy() > _EMPTY for k in range(len(parts))])


def _nearest(silhouettes: Bool[np.ndarray, "K H W"]) -> Int64[np.ndarray, "H W"]:
    """The silhouette that is nearest to each pixel."""
    none = float(silhouettes[0].size)  # farther than anything
    away = [np.asarray(ndimage.distance_transform_edt(~own)) if own.any() else np.full(own.shape, none) for own in silhouettes]
    return np.argmin(away, 0)


def _doubted(
    obj: ArticulatedObject, shares: Float64[np.ndarray, "2 K"], least: float, more: float, sentence: str
) -> ArticulatedObject:
    """The object with the confidence of its joints lowered by what speaks against their parts in the worse state.

    Args:
        obj: as fitted.
        shares: of either state and each part, what speaks against it.
        least: nothing to say of so much.
        more: no confidence is left with so much more.
        sentence: where that makes a joint doubtful, with the fields `state` and `share`.
    """
    worst, state = shares.max(0), shares.argmax(0)
    joints = [
        _lowered(joint, _score(worst[k], least, more), sentence.format(state=state[k], share=worst[k]))
        for k, joint in enumerate(obj.joints, start=1)
    ]
    return replace(obj, joints=tuple(joints))


def _score(value: float, least: float, more: float) -> float:
    """1 up to the least, and from there down to 0 where the value is so much more."""
    return float(np.clip(1 - (value - least) / more, 0, 1))


@torch.no_grad()
def alike_in_both(obj: ArticulatedObject, capture: Capture) -> ArticulatedObject:
    """The object with the confidence of its joints lowered where a part's photos of the two states are not alike.

    Photos of one state are laid upon those of the other, as the model says where each pixel went.  They leave at most as much
    of what varies unexplained as if nothing were laid there; where they leave more than that, what one state shows is not
    where the other has it.  The factor is 1 up to there, 0 from 1.4 times that on, of the worse of both directions.  A second
    one is 1 unless photos are most alike with the part elsewhere in the plane of its face (`Face.likeliest`), more than half a
    unit away (.7 at most of parts that are right, 1.6 and 1.7 of wrong ones), and 0 from 2.5 units on.  Where that makes a
    joint doubtful, a sentence asks for a look.  Parts that no photos of both states show say nothing.

    Args:
        obj: as fitted.
        capture: what it was fitted to.
    """
    both, joints = BothStates(obj.parts, capture), []
    for k, joint in enumerate(obj.joints, start=1):
        overlaps = [overlap for overlap in (both.laid(k, s) for s in (0, 1)) if len(overlap) > _FEWEST]
        left = max((overlap.unlike() for overlap in overlaps), default=0.0)
        away = max(map(_better_place, overlaps), default=0.0)
        unlike = "Where the part lies in either state, photos of the two do not look alike."
        aside = f"Photos of the two states look more alike with the part {away * both.unit:.2g} aside, in its face's plane."
        joint = _lowered(joint, _score(left, 1.0, _NOTHING), unlike)
        joints.append(_lowered(joint, _score(away, _HARDLY, _ASIDE), aside))
    return replace(obj, joints=tuple(joints))


def _better_place(overlap: Overlap) -> float:
    """How many units away photos of the two states are most alike; 0 where they do not say."""
    place = Face.most_shown(overlap).likeliest()
    return 0.0 if place is None else float(np.linalg.norm(place))


def _lowered(joint: Joint, score: float, sentence: str) -> Joint:
    """The joint with its confidence times the score; the sentence asks for a look where that makes it doubtful."""
    confidence = joint.confidence * score
    return replace(joint, confidence=confidence, review=joint.review or (sentence if confidence < REVIEW_BELOW else ""))
