"""What the photos say of a fit: splats that none shows, what none covers, and parts that both states show, and alike."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float64
from scipy import ndimage
from torch import Tensor

from ..boxes import Overlap, Shown
from ..capture import Capture, ImageStack, spread_cameras, stack_views
from ..geometry import SE3, Box, Camera
from ..joints import REVIEW_BELOW
from ..model import ArticulatedObject, Joint, PosedParts, Splats
from ..raster import coverage_of, painted, render
from .boxes import object_size

_SIZE = 128  # side of a square with as many pixels as the photos that are asked
_PHOTOS = 16  # of either state
_ENOUGH = 0.2  # of what a part that slides shows in one state: as much in the other leaves nothing to wish for; ...
_ENOUGH_TURNED = 0.35  # ...of one that turns, whose rim alone does not say about which hinge
_TRACE = 2e-6  # of a photo: a splat that paints less in all of them is not missed
_EMPTY = 0.5  # a pixel's coverage by the model is at least so much less than the object's where nothing shows it
_GAPS, _HOLE = 0.005, 0.08  # of what photos show: nothing to say of so much uncovered; as much more leaves no confidence
_RIM, _BESIDE = 0.003, 0.012  # of the pixels that a part covers: the same of pixels that masks and model see differently
_LOOK = 400  # side of a square with as many pixels as the pictures that tell
_LOOKS = 48  # of either state
_CLOSER = 200  # side of a square with as many pixels as the photos that are laid upon each other
_LAID = 24  # of either state
_FEWEST = 50  # pixels that say something
_EXACT = 1 / 64  # of the object's size: how exactly surfaces are known
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
        for camera in (stack.cameras[v] for v in spread_cameras(stack.cameras, _LOOKS)):
            scale = min(1.0, _LOOK / (camera.width * camera.height) ** 0.5)
            small = camera.resized(round(camera.width * scale), round(camera.height * scale))
            most = torch.maximum(most, painted(splats, small))
    return most > _TRACE


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
    bare = np.zeros((2, len(parts)))
    for state, views in enumerate(capture.train):
        stack, splats = stack_views(views, _SIZE), parts.at_state(state)
        asked = spread_cameras(stack.cameras, _PHOTOS)
        for v in asked:
            shown, alpha = stack.target(v)[1].numpy(), render(splats, stack.cameras[v]).alpha.numpy()
            empty = shown - alpha > _EMPTY
            if not empty.any():
                continue
            nearest = 1 + _away(_silhouettes(parts, splats, stack.cameras[v])[1:]).argmin(0)
            bare[state] += np.bincount(nearest[empty], minlength=len(parts)) / (shown.sum() * len(asked))
    worst, state = bare.max(0), bare.argmax(0)
    joints = [
        _lowered(
            joint,
            float(np.clip(1 - (worst[k] - _GAPS) / _HOLE, 0, 1)),
            f"Beside the part, photos of state {state[k]} show what nothing covers ({worst[k]:.0%} of the object).",
        )
        for k, joint in enumerate(obj.joints, start=1)
    ]
    return replace(obj, joints=tuple(joints))


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
    for state, views in enumerate(capture.train):
        stack, splats = stack_views(views, _LOOK), parts.at_state(state)
        for v in spread_cameras(stack.cameras, _PHOTOS):
            silhouettes = _silhouettes(parts, splats, stack.cameras[v])
            own[state] += silhouettes.sum((1, 2))
            shown, alpha = stack.target(v)[1].numpy(), render(splats, stack.cameras[v]).alpha.numpy()
            wrong = np.abs(shown - alpha) > _EMPTY
            if wrong.any():
                off[state] += np.bincount(_away(silhouettes).argmin(0)[wrong], minlength=len(parts))
    shares = off / np.maximum(own, 1)
    worst, state = shares.max(0), shares.argmax(0)
    joints = [
        _lowered(
            joint,
            float(np.clip(1 - (worst[k] - _RIM) / _BESIDE, 0, 1)),
            f"Where the part lies in state {state[k]}, its outline is not the masks' (by {worst[k]:.1%} of what it covers).",
        )
        for k, joint in enumerate(obj.joints, start=1)
    ]
    return replace(obj, joints=tuple(joints))


def _silhouettes(parts: PosedParts, splats: Splats, camera: Camera) -> Bool[np.ndarray, "K H W"]:
    """The pixels of a photo that each part covers, splats as they stand in its state."""
    return np.stack([coverage_of(splats, parts.part == k, camera).numpy() > _EMPTY for k in range(len(parts))])


def _away(silhouettes: Bool[np.ndarray, "K H W"]) -> Float64[np.ndarray, "K H W"]:
    """How many pixels away from each silhouette every pixel lies; farther than all others where there is none."""
    none = float(silhouettes[0].size)
    return np.stack(
        [np.asarray(ndimage.distance_transform_edt(~own)) if own.any() else np.full(own.shape, none) for own in silhouettes]
    )


@torch.no_grad()
def alike_in_both(obj: ArticulatedObject, capture: Capture) -> ArticulatedObject:
    """The object with the confidence of its joints lowered where a part's photos of the two states are not alike.

    Photos of one state are laid upon those of the other, as the model says where each pixel went.  They leave at most as much
    of what varies unexplained as if nothing were laid there; where they leave more than that, what one state shows is not
    where the other has it.  The factor is 1 up to there, 0 from 1.4 times that on, of the worse of both directions; where
    that makes a joint doubtful, a sentence asks for a look.  Parts that no photos of both states show say nothing.

    Args:
        obj: as fitted.
        capture: what it was fitted to.
    """
    parts = obj.parts.to(torch.device("cpu"))
    unit = _EXACT * object_size(parts.boxes)
    stacks = [
        stack_views([views[v] for v in spread_cameras([view.camera for view in views], _LAID)], _CLOSER)
        for views in capture.train
    ]
    boxes = Box(SE3(parts.boxes.T_world_box.wxyz_xyz.double()), parts.boxes.half_extents.double())
    joints = []
    for k, joint in enumerate(obj.joints, start=1):
        first, second = (Shown(stack, parts.at_state(state), parts.part == k) for state, stack in enumerate(stacks))
        motion = SE3(parts.motions.wxyz_xyz[k].double())
        laid = (
            Overlap.between(first, second, motion, boxes[k], unit),
            Overlap.between(second, first, motion.inverse(), boxes[k].moved(motion), unit),
        )
        left = [overlap.unlike() for overlap in laid if len(overlap) > _FEWEST]
        score = 1 - (max(left, default=0.0) - 1) / _NOTHING
        sentence = "Where the part lies in either state, photos of the two do not look alike."
        joints.append(_lowered(joint, min(max(score, 0.0), 1.0), sentence))
    return replace(obj, joints=tuple(joints))


def _lowered(joint: Joint, score: float, sentence: str) -> Joint:
    """The joint with its confidence times the score; the sentence asks for a look where that makes it doubtful."""
    confidence = joint.confidence * score
    return replace(joint, confidence=confidence, review=joint.review or (sentence if confidence < REVIEW_BELOW else ""))
