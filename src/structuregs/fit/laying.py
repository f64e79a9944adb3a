"""What photos of the two states show of a fitted part, laid upon each other."""

import numpy as np
import torch
from jaxtyping import Float64

from ..boxes import Face, Overlap, Shown
from ..capture import Capture, spread_cameras, stack_views
from ..geometry import SE3, Box
from ..model import PosedParts
from .boxes import object_size

_SIZE = 200  # side of a square with as many pixels as the photos that are laid upon each other
_PHOTOS = 24  # of either state
_EXACT = 1 / 64  # of the object's size, the unit: how exactly surfaces are known
_ELSEWHERE = 1.0  # units: from so far away on a place that all photos of a state find likelier is another one


class BothStates:
    """Photos of the two states, each with the parts as they stand there.

    Args:
        parts: as fitted so far.
        capture: what they are fitted to, its cameras as the fit has put them right.

    Attributes:
        unit: how exactly surfaces are known, world units.
    """

    def __init__(self, parts: PosedParts, capture: Capture):
        self.parts = parts.to(torch.device("cpu"))
        self.unit = _EXACT * object_size(parts.boxes)
        self._stacks = [
            stack_views([views[v] for v in spread_cameras([view.camera for view in views], _PHOTOS)], _SIZE)
            for views in capture.train
        ]
        self._shown: dict[int, list[Shown]] = {}

    def laid(self, k: int, state: int) -> Overlap:
        """What photos of a state show of part k, laid upon those of the other as its motion says."""
        parts, pose = self.parts, self.parts.boxes.T_world_box.wxyz_xyz[k]
        if k not in self._shown:
            shown = [Shown(stack, parts.at_state(s), parts.part == k) for s, stack in enumerate(self._stacks)]
            self._shown = {k: shown}  # photos of one part are asked at a time, and take room
        motion, box = SE3(parts.motions.wxyz_xyz[k].double()), Box(SE3(pose.double()), parts.boxes.half_extents[k].double())
        way, own = (motion.inverse(), box.moved(motion)) if state else (motion, box)
        return Overlap.between(self._shown[k][state], self._shown[k][1 - state], way, own, self.unit)


@torch.no_grad()
def laid_anew(parts: PosedParts, capture: Capture) -> dict[int, SE3]:
    """The motions of parts that photos ask to be laid elsewhere in the plane of their face, by part.

    A shut door whose motion is a little off has its handle painted twice, each copy for the photos of one state, and from then
    on the two hold it where it is.  The photos themselves, laid upon each other, say where it belongs.

    Args:
        parts: as fitted so far.
        capture: what they are fitted to, its cameras as the fit has put them right.
    """
    both = BothStates(parts, capture)
    motions = {k: _laid(both, k) for k in range(1, len(parts))}
    return {k: motion for k, motion in motions.items() if motion is not None}


def _laid(both: BothStates, k: int) -> SE3 | None:
    """The motion of part k where photos of either state laid upon those of the other are alike, whichever are more so.

    Less than a unit away it is laid only if photos of neither state are less alike there: so near, those of one state may err.
    Where few photos see the part in both states, they cannot be asked by halves; then it is laid if all photos of either
    state find it likelier elsewhere, and in one place.
    """
    faces = [Face.most_shown(both.laid(k, state)) for state in (0, 1)]
    box, now = faces[0].overlap.box, faces[0].overlap.motion
    laid = _at(faces, [face.alike_at() for face in faces])
    if not laid:
        laid = _at(faces, [face.likeliest() for face in faces], _ELSEWHERE)
        if len(laid) < 2 or _apart(box, laid[0][1], laid[1][1]) > both.unit:
            return None
    motion = min(laid, key=lambda found: found[0])[1]
    return motion if _apart(box, motion, now) > both.unit or _suits_both(faces, motion) else None


def _suits_both(faces: list[Face], motion: SE3) -> bool:
    """Whether photos of neither state are less alike with a motion than where their faces were found."""
    to_other = (motion, motion.inverse())
    further = [(way @ face.overlap.motion.inverse()).as_matrix().numpy() for face, way in zip(faces, to_other, strict=True)]
    return all(face.overlap.unlike(by) <= face.overlap.unlike() for face, by in zip(faces, further, strict=True))


def _at(faces: list[Face], places: list[Float64[np.ndarray, " 3"] | None], least: float = 0.0) -> list[tuple[float, SE3]]:
    """What photos leave unexplained with a face at its place, and the motion from state 0 to 1 that lays it there.

    Args:
        faces: of a part, as photos of state 0 and of state 1 show it.
        places: of either face, or None.
        least: units; a place that is less far away counts as none.
    """
    laid = []
    for state, (face, place) in enumerate(zip(faces, places, strict=True)):
        if place is not None and np.linalg.norm(place) >= least:
            motion = face.laid(place)
            laid.append((face.unlike(place), motion.inverse() if state else motion))
    return laid


def _apart(box: Box, one: SE3, other: SE3) -> float:
    """How far two motions take a corner of a box apart at most, world units."""
    return float((one.apply(box.corners) - other.apply(box.corners)).norm(dim=-1).max())
