"""What shows in the photos: splats that none shows are nothing, and a motion between two places wants its part seen in both."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor

from ..capture import Capture, ImageStack, spread_cameras, stack_views
from ..joints import REVIEW_BELOW
from ..model import ArticulatedObject, Joint, PosedParts
from ..raster import painted

_SIZE = 128  # side of a square with as many pixels as the photos that are asked
_PHOTOS = 16  # of either state
_ENOUGH = 0.2  # of what a part shows in one state: as much in the other leaves nothing to wish for
_TRACE = 2e-6  # of a photo: a splat that paints less in all of them is not missed
_LOOK = 400  # side of a square with as many pixels as the pictures that tell
_LOOKS = 48  # of either state


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
    state, times five, at most 1; where that makes a joint doubtful, a sentence asks for a look.  A part that was shut
    shows its front (.3 to .7 where measured); one that was behind a door shows .03 and less, and where it was then is a
    guess.

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
    score = min(min(shares) / max(*shares, 1e-12) / _ENOUGH, 1.0)
    hidden = shares.index(min(shares))
    confidence = joint.confidence * score
    sentence = f"Hardly a photo of state {hidden} shows the part: where it is there is a guess."
    return replace(joint, confidence=confidence, review=joint.review or (sentence if confidence < REVIEW_BELOW else ""))
