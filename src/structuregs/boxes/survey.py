"""From a capture to a look at each state, and from moving parts to boxes with their motions."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from ..capture import Capture, stack_views
from ..geometry import SE3, Box, screw_at
from ..joints import kind_of
from ..points import Clouds, Silhouettes, object_bounds
from .appearance import AppearanceConfig, fit_state, surface_points
from .config import SearchConfig
from .cue import Points, StateLook, base_axes, box_around, clusters, held_by_hull, linked
from .partition import PartSearch
from .pieces import MovingPart, Pieces

_HINGE = 0.5  # of a box's half extents: a hinge so far outside the box may still be its part's


@dataclass(frozen=True)
class StartConfig:
    """How boxes and motions are found before the fit."""

    voxels: int = 96
    """Voxels of the visual hulls along the object's longest side."""
    mask_size: int = 256
    """Size of the masks that carve the hulls: the side of a square with as many pixels."""
    margin: float = 1.0
    """By how many voxels boxes are grown beyond the points that they hold."""
    appearance: AppearanceConfig = field(default_factory=AppearanceConfig)
    """The quick look at each state."""
    search: SearchConfig = field(default_factory=SearchConfig)
    """The search for motions."""


def look_at_states(capture: Capture, given: Clouds | None, config: StartConfig, seed: int) -> Iterator[StateLook]:
    """Hull, quick look and surface points of state 0, then of state 1.

    Args:
        capture: its training views are used.
        given: points from elsewhere (see `points.points_from`); None to read them off the quick looks.
        config: sizes.
        seed: of the splats' places.
    """
    stacks = [stack_views(views, config.mask_size) for views in capture.train]
    silhouettes = tuple(Silhouettes(stack.cameras, stack.alpha.astype(np.float32) / 255) for stack in stacks)
    low, high = object_bounds(silhouettes)
    for state, views in enumerate(capture.train):
        hull = silhouettes[state].carve(low, high, config.voxels)
        stack = stack_views(views, config.appearance.size)
        splats = fit_state(stack, hull, config.appearance, seed)
        points = given.points[state] if given else surface_points(splats, stack, hull, config.appearance.looks)
        yield StateLook(stack, hull, points, splats)


def survey(capture: Capture, given: Clouds | None, config: StartConfig, seed: int) -> tuple[StateLook, StateLook]:
    """Both of `look_at_states`, with its arguments."""
    first, second = look_at_states(capture, given, config, seed)
    return first, second


def _grown(points: Float64[np.ndarray, "P 3"], by: float, axes: Float64[Tensor, "3 3"] | None = None) -> Box:
    box = box_around(points, thinnest=0.5 * by, axes=axes)
    return Box(box.T_world_box, box.half_extents + by)


def boxes_of_parts(pieces: Pieces, parts: list[MovingPart], config: StartConfig) -> tuple[Box, SE3]:
    """Boxes in state 0 and motions (K of each, float32, the base first) of the parts that a search found.

    Args:
        pieces: that it worked with.
        parts: that it found.
        config: of the start.
    """
    looks, by = pieces.looks, config.margin * pieces.voxel
    moving = [_grown(part.points_in(0), by) for part in parts]
    drawn = [_to_hinge(box, part.motion) for box, part in zip(moving, parts, strict=True)]
    posed = [(box, box.moved(part.motion)) for box, part in zip(drawn, parts, strict=True)]
    still, axes = _still_points(looks, posed), base_axes(looks)
    uncovered = _uncovered(pieces, _grown(still, by, axes), posed)
    base = _grown(np.concatenate([still, *uncovered]), by, axes)
    return _stacked([base, *moving], [SE3.identity(dtype=torch.float64), *(part.motion for part in parts)])


def _to_hinge(box: Box, motion: SE3) -> Box:
    """The box, drawn out to the hinge that its part turns about, where that is near.

    Beside its hinge a part stands where it stood in the other state, and hulls cannot tell it from what is still: the base's
    box need not hold it.  The part's own box does not reach there either, or it would take the frame with it.
    """
    if kind_of(motion) == "prismatic":
        return box
    screw, _ = screw_at(motion, "revolute", box.T_world_box.xyz)
    hinge = box.T_world_box.inverse().apply(screw.origin)
    if not (hinge.abs() < (1 + _HINGE) * box.half_extents).all():
        return box
    return Box.around(torch.cat([box.corners, screw.origin[None]]), box.T_world_box.rotation)


def _still_points(looks: tuple[StateLook, StateLook], moving: list[tuple[Box, Box]]) -> Float64[np.ndarray, "P 3"]:
    """Surface points of either state in the hull of the other, outside the moving boxes, given as they lie in either state.

    Where boxes hold everything, all that both hulls hold.
    """
    boxes = [box for pair in moving for box in pair]
    rows = [_outside(boxes, look, other) for look, other in (looks, looks[::-1])]
    hull = looks[0].hull
    return np.concatenate(rows) if any(map(len, rows)) else hull.centres(hull.occupied & looks[1].hull.occupied)


def _uncovered(pieces: Pieces, base: Box, moving: list[tuple[Box, Box]]) -> list[Points]:
    """Surfaces of the base beyond its box that moving parts cover in one state and leave free in the other.

    Two blades may lie one upon the other when they are shut.  Few views leave points in the air where a part has been; these
    are no surfaces.

    Args:
        pieces: that the search worked with.
        base: the box of what stands still and lies in no moving box.
        moving: the moving boxes, as they lie in either state.
    """
    looks = pieces.looks
    found = []
    for state, (look, other) in enumerate((looks, looks[::-1])):
        free = _outside([base, *(pair[state] for pair in moving)], look, other)
        some = linked(free, pieces.config.cue, pieces.voxel)
        found += [piece for piece in some if pieces.is_surface(piece, state)]
    return found


def _outside(boxes: list[Box], look: StateLook, other: StateLook) -> Points:
    """Surface points of a state in the hull of the other, outside some boxes."""
    points, outside = torch.from_numpy(look.points), torch.from_numpy(held_by_hull(look.points, other))
    for box in boxes:
        outside &= ~box.contains(points)
    return look.points[outside.numpy()]


def boxes_at_rest(looks: tuple[StateLook, StateLook], count: int | None, config: StartConfig) -> tuple[Box, SE3]:
    """The supplement's start (1.3): a box for each dominant cluster of departed points, one for the rest, and no motion.

    Where nothing departed (the parts are shut in state 0), the clusters of arrived points serve.

    Args:
        looks: of both states.
        count: the expected number of moving parts; all clusters if None.
        config: sizes.
    """
    by = config.margin * looks[0].hull.voxel
    found = clusters(looks, config.search.cue)
    chosen = [c for c in found if c.state == 0] or found
    moving = [_grown(c.points, by) for c in chosen[:count]]
    boxes = [_grown(_still_points(looks, [(box, box) for box in moving]), by, base_axes(looks)), *moving]
    return _stacked(boxes, [SE3.identity(dtype=torch.float64)] * len(boxes))


def _stacked(boxes: list[Box], motions: list[SE3]) -> tuple[Box, SE3]:
    pose = SE3(torch.stack([box.T_world_box.wxyz_xyz for box in boxes]).float())
    half_extents = torch.stack([box.half_extents for box in boxes]).float()
    return Box(pose, half_extents), SE3(torch.stack([motion.wxyz_xyz for motion in motions]).float())


def find_parts(looks: tuple[StateLook, StateLook], count: int | None, config: StartConfig, seed: int) -> list[MovingPart]:
    """The moving parts with the motions that the photos prefer; `count` of them where it is given and that many are found."""
    return PartSearch(looks, config.search, seed).search(count)
