"""What the photos of both states show of a part, laid upon each other: whether it is alike, and where in its plane it would be.

Photos and masks judge a motion by all that is drawn.  A door that is shut, plain, and of its cupboard's colour is then held by
little but its outline, which quick looks draw too wide.  What a face shows within its outline, such as a handle, panels or
grain, says better how it lies in its plane; how far before that plane, and how it leans, it does not say.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64
from scipy import ndimage
from scipy.optimize import minimize
from torch import Tensor

from ..capture import ImageStack, spread_cameras
from ..geometry import SE3, Box
from ..jit import lanes
from ..model import Splats
from ..raster import coverage_of, render_surface
from .alike_kernels import left_unexplained
from .appearance import LOOK_DILATION

_VIEWS = 48  # photos of the one state, each laid upon...
_NEIGHBOURS = 4  # ...so many of the other's: those that see the part most nearly alike,...
_ASKEW = 0.5  # ...from directions whose cosine is at least this
_OBLIQUE = 0.2  # the cosine to a face's normal below which a camera does not see it
_FLAT = 0.85  # the cosine to a face's normal from which a pixel's surface is its
_CLEAR = 0.8  # of a pixel's light has to be the part's
_BEFORE, _UNDER = 2.5, 1.5  # units: what lies farther from the other state's surface is hidden there, or under the face
_BLURS = (1.6, 0.8)  # pixels
_CUT_OFF = 0.15  # differences of brightness count as at most this
_PLAIN = 0.002  # what varies by less than half a grey level says nothing
_REACH = 7  # units to either side in which a face is looked for,...
_FINER = 2  # ...and so many about what was found in each finer look
_GLANCE, _MOST = 8_000, 30_000  # pixels that do for that, and for the finer looks
_ASIDE, _LESS = 3, 1.1  # so many units beside its place photos leave so many times as much, or it is none
_TOGETHER = 1.0  # units: the places that either half of the photos finds lie no farther apart
_BETTER = 0.98  # where one half of the photos is most alike leaves no more than this share of what was unexplained of the other
_TURNED = 0.95  # a face turns in its plane where that leaves less than this share of what is left without
_FEWEST = 100  # pixels of each half of the photos that say something
_ALIKE = 0.8  # no more than this share of what varies may be left unexplained in the end


class Shown:
    """One state's photos, and the splats of a part among all that they show.

    Args:
        stack: the photos.
        splats: all splats, in the world.
        part: which of them are the part's; None where that is not known.
    """

    def __init__(self, stack: ImageStack, splats: Splats, part: Bool[Tensor, " N"] | None):
        self.stack = stack
        self.splats = splats
        self.part = part
        self._depths: dict[int, Float32[np.ndarray, "H W"]] = {}
        self._clear: dict[int, Bool[np.ndarray, "H W"]] = {}

    @cached_property
    def centres(self) -> Float64[Tensor, "V 3"]:
        """Of the cameras, in the world."""
        return torch.stack([camera.centre.double() for camera in self.stack.cameras])

    @cached_property
    def projections(self) -> Float64[np.ndarray, "V 3 4"]:
        """From the world to the photos' pixels."""
        return np.stack([camera.projection.numpy() for camera in self.stack.cameras])

    @cached_property
    def blurred(self) -> dict[float, Float32[np.ndarray, "V H W"]]:
        """Brightness of what is not background, by how many pixels it is blurred."""
        return {by: np.stack([self._blurred(v, by) for v in range(len(self.stack))]) for by in _BLURS}

    def _blurred(self, v: int, by: float) -> Float32[np.ndarray, "H W"]:
        rgb, alpha = (image.numpy() for image in self.stack.target(v))
        covered = ndimage.gaussian_filter(alpha, by)
        return ndimage.gaussian_filter(rgb.mean(-1) * alpha, by) / np.maximum(covered, 1e-3)

    def depth(self, v: int) -> Float32[np.ndarray, "H W"]:
        """Of the surface in a photo; 0 where there is none."""
        if v not in self._depths:
            self._depths[v] = render_surface(self.splats, self.stack.cameras[v], LOOK_DILATION).depth
        return self._depths[v]

    def clear(self, v: int) -> Bool[np.ndarray, "H W"]:
        """Which pixels of a photo show the part, or any surface where the part is not known, and so do those beside them."""
        if v not in self._clear:
            solid = self.depth(v) > 0
            if self.part is not None:
                with torch.no_grad():
                    solid &= coverage_of(self.splats, self.part, self.stack.cameras[v], LOOK_DILATION).numpy() > _CLEAR
                solid = ndimage.binary_erosion(solid)
            self._clear[v] = solid
        return self._clear[v]

    def surface(self, v: int) -> tuple[Float64[np.ndarray, "H W 3"], Float64[np.ndarray, "H W 3"]]:
        """What each pixel of a photo shows, and its normal toward the camera, in the world."""
        origin, rays = (t.double().numpy() for t in self.stack.cameras[v].rays())
        points = origin + rays * self.depth(v)[..., None]
        normals = ndimage.uniform_filter(np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0)), 3, axes=(0, 1))
        normals *= -np.sign((normals * rays).sum(-1, keepdims=True))
        return points, normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)

    def sees(self, points: Float64[np.ndarray, "P 3"], v: int, within: float) -> Bool[np.ndarray, " P"]:
        """Which points lie on the surface that a photo shows of the part, as far as `within` before or behind it."""
        surface, clear = self.depth(v), self.clear(v)
        pixels, z = self.stack.cameras[v].project(torch.from_numpy(points))
        column, row = np.floor(pixels.numpy()).astype(np.int64).T
        inside = (row >= 0) & (row < surface.shape[0]) & (column >= 0) & (column < surface.shape[1])
        row, column = row * inside, column * inside
        return inside & clear[row, column] & (np.abs(surface[row, column] - z.numpy()) < within)


@dataclass(frozen=True)
class Overlap:
    """Pixels of photos of one state that show a part, each with a photo of the other state that shows the same place of it.

    Attributes:
        here, there: the one state and the other.
        motion: of the part, from the one to the other, as it was found.
        box: of the part, in the one state.
        unit: how exactly surfaces are known, world units.
        pixels: number of the photo, row, and column.
        points: what they show, moved to the other state, in the world.
        local: the same from the centre of the box, in its axes.
        normals: of the surface, in these axes.
        photos: of the other state; pixels of the same two photos lie together.
    """

    here: Shown
    there: Shown
    motion: SE3
    box: Box
    unit: float
    pixels: Int64[np.ndarray, "P 3"]
    points: Float64[np.ndarray, "P 3"]
    local: Float64[np.ndarray, "P 3"]
    normals: Float64[np.ndarray, "P 3"]
    photos: Int64[np.ndarray, " P"]

    @staticmethod
    def between(here: Shown, there: Shown, motion: SE3, box: Box, unit: float) -> "Overlap":
        """What photos of both states show together; the arguments are the attributes of the same names."""
        centre, axes = box.T_world_box.xyz.numpy(), box.T_world_box.rotation.numpy()
        to_here, to_there = _directions(here, there, motion, box)
        rows = [[np.zeros((0, 3), int), *np.zeros((3, 0, 3)), np.zeros(0, int)]]
        for v in spread_cameras(here.stack.cameras, _VIEWS):
            pixels = np.argwhere(here.clear(v))
            alike = to_there @ to_here[v]
            if not len(pixels) or alike.max() < _ASKEW:
                continue
            points, normals = (image[tuple(pixels.T)] for image in here.surface(v))
            moved = motion.apply(torch.from_numpy(points)).numpy()
            numbered = np.insert(pixels, 0, v, axis=1)
            for u in np.argsort(-alike)[:_NEIGHBOURS]:
                if alike[u] >= _ASKEW:
                    seen = there.sees(moved, int(u), _BEFORE * unit)
                    row = (numbered, moved, (points - centre) @ axes, normals @ axes, np.full(len(points), u))
                    rows.append([column[seen] for column in row])
        return Overlap(here, there, motion, box, unit, *map(np.concatenate, zip(*rows, strict=True)))

    def __len__(self) -> int:
        return len(self.points)

    def of(self, chosen: Bool[np.ndarray, " P"]) -> "Overlap":
        """As some of the pixels show it."""
        names = ("pixels", "points", "local", "normals", "photos")
        return replace(self, **{name: getattr(self, name)[chosen] for name in names})

    def unlike(self, further: Float64[np.ndarray, "4 4"] | None = None, blur: float = _BLURS[-1]) -> float:
        """What photos of the other state leave unexplained of those of the one, as a share of how much these vary.

        Each pair of photos has a brightness and a contrast of its own.  Photos that have nothing in common leave a little more
        than 1; 1 is also what is plain, or not seen at all.

        Args:
            further: a motion of the world in the other state, after the one that was found.
            blur: of the photos, pixels.
        """
        if not len(self):
            return 1.0
        asked, varied = self._asked[blur]
        if varied <= _PLAIN:
            return 1.0
        projections = self.there.projections if further is None else self.there.projections @ further
        images = self.there.blurred[blur]
        with lanes():
            left = left_unexplained(self.points, self.photos, self._starts, asked, projections, images, _CUT_OFF)
        return float(left.sum() / len(self) / varied)

    @cached_property
    def _starts(self) -> Int64[np.ndarray, " G"]:
        """Where pixels of two other photos begin, and the end."""
        changes = (np.diff(self.pixels[:, 0]) != 0) | (np.diff(self.photos) != 0)
        return np.concatenate([[0], np.flatnonzero(changes) + 1, [len(self)]])

    @cached_property
    def _asked(self) -> dict[float, tuple[Float64[np.ndarray, " P"], float]]:
        """By blur: brightness of the pixels, less its mean over those of the same two photos, and how much that varies."""
        return {
            blur: self._varying(image[tuple(self.pixels.T)].astype(np.float64)) for blur, image in self.here.blurred.items()
        }

    def _varying(self, values: Float64[np.ndarray, " P"]) -> tuple[Float64[np.ndarray, " P"], float]:
        count = np.diff(self._starts)
        values = values - np.repeat(np.add.reduceat(values, self._starts[:-1]) / count, count)
        return values, float(np.minimum(np.abs(values), _CUT_OFF).mean())


@dataclass(frozen=True)
class Face:
    """A face of a part that photos of both states show.

    How it goes in its plane is told in units: along both its axes, and at its rim when it turns.

    Attributes:
        overlap: the pixels that show it.
        pose: of the face where it was found in the other state, z along its normal.
    """

    overlap: Overlap
    pose: SE3

    @staticmethod
    def most_shown(overlap: Overlap) -> "Face":
        """The face of which there are most pixels, with what stands out from it."""
        to_here, to_there = _directions(overlap.here, overlap.there, overlap.motion, overlap.box)
        most, best, chosen = 0, 0, np.zeros(len(overlap), bool)
        for axis, sign in itertools.product(range(3), (1, -1)):
            both = sign * np.stack([to_here[overlap.pixels[:, 0], axis], to_there[overlap.photos, axis]])
            faced, height = (both > _OBLIQUE).all(0), sign * overlap.local[:, axis]
            on = faced & (sign * overlap.normals[:, axis] > _FLAT)
            if on.sum() > most:
                most, best, chosen = on.sum(), axis, faced & (height > np.median(height[on]) - _UNDER * overlap.unit)
        pose = overlap.motion @ overlap.box.T_world_box
        turned = pose.rotation[:, [(best + 1) % 3, (best + 2) % 3, best]]
        return Face(overlap.of(chosen), SE3.from_rotation(turned, pose.xyz))

    def moved(self, place: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "4 4"]:
        """The motion of the world that brings the face from where it was found to a place."""
        x, y, turn = place * self.overlap.unit
        angle = turn / self._rim
        planar = np.eye(4)
        planar[:2] = [[np.cos(angle), -np.sin(angle), 0, x], [np.sin(angle), np.cos(angle), 0, y]]
        return self._T_world_face @ planar @ self._T_face_world

    @cached_property
    def _rim(self) -> float:
        return float(self.overlap.box.half_extents.norm())

    @cached_property
    def _T_world_face(self) -> Float64[np.ndarray, "4 4"]:
        return self.pose.as_matrix().numpy()

    @cached_property
    def _T_face_world(self) -> Float64[np.ndarray, "4 4"]:
        return self.pose.inverse().as_matrix().numpy()

    def unlike(self, place: Float64[np.ndarray, " 3"], blur: float = _BLURS[-1]) -> float:
        """What photos leave unexplained of each other with the face at a place (see `Overlap.unlike`)."""
        return self.overlap.unlike(self.moved(place), blur)

    def place(self) -> Float64[np.ndarray, " 3"]:
        """Where the photos are most alike, not turned."""
        steps = np.arange(-_REACH, _REACH + 1.0)
        tried = [np.array([x, y, 0.0]) for x in steps for y in steps]
        glance = self._thinned(_GLANCE)
        return self.nearby(min(tried, key=lambda at: glance.unlike(at, _BLURS[0])))

    def nearby(self, place: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, " 3"]:
        """Where near a place the photos are most alike, turned as they are there."""
        for blur in _BLURS:
            place = self._best(place, blur, np.array([_FINER, _FINER, 0.0]))
        return place

    def turned(self, place: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, " 3"]:
        """The same where the face may turn, too."""
        return self._best(place, _BLURS[-1], np.full(3, float(_FINER)))

    def _best(
        self, place: Float64[np.ndarray, " 3"], blur: float, reach: Float64[np.ndarray, " 3"]
    ) -> Float64[np.ndarray, " 3"]:
        bounds = list(zip(place - reach, place + reach, strict=True))
        options = {"maxfev": 200, "xtol": 3e-3, "ftol": 1e-4}
        return minimize(self._thinned(_MOST).unlike, place, args=(blur,), method="Powell", bounds=bounds, options=options).x

    def stands_out(self, place: Float64[np.ndarray, " 3"]) -> bool:
        """Whether photos are clearly less alike to all sides of a place.  Light that falls off along a face leads astray."""
        face = self._thinned(_MOST)
        around = [place + _ASIDE * np.array([np.cos(a), np.sin(a), 0]) for a in np.arange(8) * np.pi / 4]
        return min(map(face.unlike, around)) > _LESS * face.unlike(place)

    def _thinned(self, most: int) -> "Face":
        """The face as not many more than so many of its pixels show it."""
        every = max(len(self.overlap) // most, 1)
        return self if every == 1 else replace(self, overlap=self.overlap.of(np.arange(len(self.overlap)) % every == 0))

    def laid(self, place: Float64[np.ndarray, " 3"]) -> SE3:
        """The motion of the part with the face at a place."""
        return SE3.from_matrix(torch.from_numpy(self.moved(place))) @ self.overlap.motion

    def likeliest(self) -> Float64[np.ndarray, " 3"] | None:
        """The place where all photos of the face together are most alike; None if they are not clearly less alike around it.

        Not so sure as `alike_at`, which asks them by halves: one state's photos do to doubt where the face is, both states'
        have to agree for it to be laid elsewhere.
        """
        if len(self.overlap) < _FEWEST:
            return None
        place = self.nearby(self.place())
        return place if not _at_the_rim(place) and self.stands_out(place) else None

    def alike_at(self) -> Float64[np.ndarray, " 3"] | None:
        """The place where the photos of the face are alike.

        None where they say no better: a face may tell nothing, or light make it look another way.  Either half of the photos
        has to find the place, what the one half finds has to make the other more alike, and around it photos have to be less
        alike.
        """
        halves = [Face(self.overlap.of(self.overlap.pixels[:, 0] % 2 == odd), self.pose) for odd in (0, 1)]
        if min(len(half.overlap) for half in halves) < _FEWEST:
            return None
        flat = [half.place() for half in halves]
        if np.linalg.norm(flat[0] - flat[1]) > _TOGETHER or any(map(_at_the_rim, flat)):
            return None
        turned = [half.turned(place) for half, place in zip(halves, flat, strict=True)]
        left, left_turned = (_left_of_each_other(halves, places) for places in (flat, turned))
        place = self.nearby((flat[0] + flat[1]) / 2)
        if left_turned < _TURNED * left:
            left, place = left_turned, self.turned(place)
        if left > _BETTER or self.unlike(place) > _ALIKE or not self.stands_out(place):
            return None
        return place


def _at_the_rim(place: Float64[np.ndarray, " 3"]) -> bool:
    """Whether a face was looked for hardly farther than a place: it may be likelier still beyond."""
    return bool(np.abs(place).max() > _REACH - 0.5)


def _left_of_each_other(halves: Sequence[Face], places: Sequence[Float64[np.ndarray, " 3"]]) -> float:
    """What the place that either half of the photos finds leaves unexplained of the other half.

    As a share of what is left where the face was found, the worse of the two: 1 and more if they say nothing of each other.
    """
    pairs = ((halves[0], places[1]), (halves[1], places[0]))
    return max(half.unlike(place) / max(half.unlike(np.zeros(3)), 1e-12) for half, place in pairs)


def _directions(here: Shown, there: Shown, motion: SE3, box: Box) -> tuple[np.ndarray, np.ndarray]:
    """From the part to the cameras of either state (V 3), in the axes of its box."""
    one, other = (
        torch.nn.functional.normalize(centres - box.T_world_box.xyz, dim=-1) @ box.T_world_box.rotation
        for centres in (here.centres, motion.inverse().apply(there.centres))
    )
    return one.numpy(), other.numpy()
