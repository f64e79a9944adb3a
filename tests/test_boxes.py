import math
from dataclasses import dataclass, fields, replace
from functools import lru_cache

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from structuregs.boxes import (
    CueConfig,
    MovingPart,
    PartSearch,
    SearchConfig,
    StartConfig,
    StateLook,
    box_around,
    boxes_at_rest,
    boxes_of_parts,
    clusters,
    find_parts,
    strewn,
    survey,
)
from structuregs.boxes.appearance import LOOK_DILATION, AppearanceConfig
from structuregs.boxes.cue import Cluster
from structuregs.boxes.divide import AROUND, FACTORS, cut_across, divide, moving_along
from structuregs.boxes.hypotheses import (
    Hypothesis,
    candidate_motions,
    displacements,
    distinct,
    flips,
    hinge_screws,
    oddity,
    registrations,
    square_with,
    stack_motions,
    turn_about,
)
from structuregs.boxes.judge import Scene, Trial
from structuregs.boxes.pieces import Pieces
from structuregs.boxes.progress import Division, Found, undivided, worth_more
from structuregs.boxes.refine import along_base, just_out_of_sight, refine, shortest_out_of_sight, simplest
from structuregs.boxes.review import PartReview
from structuregs.boxes.several import _ways, several_in
from structuregs.capture import Capture, ImageStack, TrueJoint
from structuregs.geometry import SE3, Box, Camera, Screw, screw_at
from structuregs.joints import kind_of
from structuregs.model import SH_C0, Splats
from structuregs.points import points_from
from structuregs.raster import render
from structuregs.synthetic import KnownObject, Lighting, RenderOptions, make_capture, make_object
from structuregs.synthetic.catalog import Front, _cupboard

F64 = torch.float64
SMALL = StartConfig(
    voxels=64,
    mask_size=128,
    appearance=AppearanceConfig(size=80, steps=200, splats=4000, looks=12),
    # Dense enough that points strewn between the cabinet's door and drawer do not link the two.
    search=SearchConfig(cue=CueConfig(neighbours=16), shortlist=30, finalists=4, looks=6, steps=30),
)
NO_MOTION = SE3.identity(dtype=F64)
NOTHING = KDTree(np.zeros((0, 3)))


def random_box(seed: int) -> Box:
    g = torch.Generator().manual_seed(seed)
    quat, centre, half = (torch.randn(4, generator=g), torch.randn(3, generator=g), 0.2 + torch.rand(3, generator=g))
    return Box(SE3.from_quat(quat.to(F64), centre.to(F64)), half.to(F64))


def points_of(box: Box, count: int, seed: int = 0) -> np.ndarray:
    """Points on the six faces of a box."""
    g = torch.Generator().manual_seed(seed)
    canonical = torch.rand(count, 3, generator=g, dtype=F64) * 2 - 1
    face = torch.randint(3, (count,), generator=g)
    rows = torch.arange(count)
    canonical[rows, face] = canonical[rows, face].sign()
    return box.to_world(canonical).numpy()


class TestBoxAround:
    @pytest.mark.parametrize("seed", range(6))
    def test_recovers_a_random_box(self, seed: int):
        true = random_box(seed)
        found = box_around(np.concatenate([points_of(true, 4000), true.corners.numpy()]), thinnest=0.01, trim=0.0)
        torch.testing.assert_close(found.T_world_box.xyz, true.T_world_box.xyz, atol=1e-3, rtol=0)
        assert found.contains(true.corners, margin=1e-3).all()
        assert true.contains(found.corners, margin=1e-2).all()
        torch.testing.assert_close(found.half_extents.sort().values, true.half_extents.sort().values, atol=1e-2, rtol=0)

    def test_its_axes_are_right_handed(self):
        for seed in range(5):
            R = box_around(points_of(random_box(seed), 200), thinnest=0.01).T_world_box.rotation
            torch.testing.assert_close(R @ R.T, torch.eye(3, dtype=F64))
            assert torch.linalg.det(R) > 0

    def test_a_few_points_astray_do_not_blow_it_up(self):
        true = random_box(0)
        points = points_of(true, 4000)
        astray = true.to_world(torch.tensor([[1.6, 0.0, 0.0], [0.0, 0.0, -1.6]], dtype=F64)).numpy()
        found = box_around(np.concatenate([points, astray]), thinnest=0.01)
        assert float(found.volume) < 1.15 * float(true.volume)

    def test_points_on_a_plane_get_the_least_thickness(self):
        square = np.array([[x, y, 0.5] for x in np.linspace(-1, 1, 11) for y in np.linspace(-2, 2, 11)])
        found = box_around(square, thinnest=0.03, trim=0.0)
        assert found.half_extents.sort().values.tolist() == pytest.approx([0.03, 1.0, 2.0])
        torch.testing.assert_close(found.T_world_box.xyz, torch.tensor([0.0, 0.0, 0.5], dtype=F64), atol=1e-6, rtol=0)


def corner_error(motions: SE3, true: SE3, box: Box) -> Tensor:
    """Mean distance of the box's corners moved by each motion from where the true one takes them, over the half diagonal."""
    gap = motions[:, None].apply(box.corners) - true.apply(box.corners)
    return gap.norm(dim=-1).mean(-1) / box.half_extents.norm()


class TestCandidates:
    @pytest.mark.parametrize("seed", range(3))
    def test_hold_one_near_a_turn_about_any_edge(self, seed: int):
        box, base = random_box(seed), random_box(seed + 100)
        motions = candidate_motions([box], base, [])
        for edge, angle in zip(box.edges, np.linspace(20, 170, 12), strict=True):
            axis = torch.nn.functional.normalize(edge[1] - edge[0], dim=0)
            true = Screw("revolute", axis, edge[0]).motion(math.radians(angle) * (-1) ** int(angle))
            assert corner_error(motions, true, box).min() < 0.2  # half of 15 degrees, at twice the half diagonal at most

    @pytest.mark.parametrize("seed", range(3))
    def test_hold_one_near_a_slide_along_any_axis_of_the_box_or_the_base(self, seed: int):
        box, base = random_box(seed), random_box(seed + 100)
        motions = candidate_motions([box], base, [])
        axes = torch.cat([box.T_world_box.rotation.T, base.T_world_box.rotation.T])
        for axis in [*axes, *-axes]:
            reach = float((box.T_world_box.rotation.T @ axis).abs() @ (2 * box.half_extents))
            true = Screw("prismatic", axis, torch.zeros(3, dtype=F64)).motion(0.63 * reach)
            assert corner_error(motions, true, box).min() < 0.1 * reach / float(box.half_extents.norm())

    def test_lay_the_box_on_another_of_its_size_in_every_way(self):
        box = random_box(0)
        true = SE3.exp(torch.tensor([1.0, -2.0, 0.5, 1.2, -0.8, 2.0], dtype=F64))
        motions = registrations(box, box.moved(true))
        assert len(motions) == 24
        stacked = SE3(torch.stack([motion.wxyz_xyz for motion in motions]))
        assert corner_error(stacked, true, box).min() < 1e-9
        landed = stacked.apply(box.T_world_box.xyz)
        torch.testing.assert_close(landed, true.apply(box.T_world_box.xyz).expand(24, 3))
        gaps = torch.cdist(stacked.rotation.reshape(24, 9), stacked.rotation.reshape(24, 9)) + torch.eye(24)
        assert gaps.min() > 0.9, "24 different turns"
        without, with_target = (candidate_motions([box], box, pairs) for pairs in ([], [(box, box.moved(true))]))
        assert len(with_target.wxyz_xyz) == len(without.wxyz_xyz) + 24

    def test_a_round_door_s_hinge_goes_by_the_base(self):
        """The least box around a disc may lie any way in its plane: here 30 degrees askew to its upright hinge."""
        base = Box(SE3.identity(dtype=F64), torch.tensor([0.5, 0.5, 0.7], dtype=F64))
        angles, radii = torch.rand(2, 2000, generator=torch.Generator().manual_seed(0), dtype=F64)
        disc = 0.5 * radii.sqrt() * torch.stack([(2 * torch.pi * angles).cos(), (2 * torch.pi * angles).sin()])
        points = torch.stack([disc[0], 0.04 * torch.arange(2000) % 2 - 0.58, disc[1]], 1)
        askew = SE3.from_quat(
            torch.tensor([np.cos(np.pi / 12), 0, np.sin(np.pi / 12), 0], dtype=F64), torch.zeros(3, dtype=F64)
        )
        box = box_around(points.numpy(), 0.01, axes=askew.rotation)
        axes = square_with(box, 1, base)
        assert axes is not None
        torch.testing.assert_close(axes.T @ axes, torch.eye(3, dtype=F64))
        assert float(torch.linalg.det(axes)) == pytest.approx(1)
        square = box_around(points.numpy(), 0.01, axes=axes)
        assert square_with(square, 1, base) is None
        hinge = Screw("revolute", torch.tensor([0.0, 0, 1], dtype=F64), torch.tensor([0.5, -0.56, 0], dtype=F64))
        true = hinge.motion(1.4)
        near = [float(displacements(candidate_motions([one], base, []), true, box).min()) for one in (box, square)]
        assert near[1] < 0.1 < 2 * near[1] < near[0]

    def test_hinges_are_the_edges_the_lines_between_and_some_beyond(self):
        box = random_box(1)
        for screw in hinge_screws(box):
            along = box.T_world_box.rotation.T @ screw.axis
            at = (box.T_world_box.inverse().apply(screw.origin) / box.half_extents).abs()
            assert along.abs().max() == pytest.approx(1.0)
            assert torch.isin((at * 10).round(), torch.tensor([0.0, 10, 13, 16, 22, 30], dtype=at.dtype)).all()
            assert ((at * 10) - (at * 10).round()).abs().max() < 1e-6
            assert (at > 1.1).sum() <= 1, "beyond the box to one side only"
        assert len(hinge_screws(box)) == 3 * (3 * 3 + 2 * 8 * 3)


def slides_by(offsets: list[list[float]]) -> SE3:
    """Translations."""
    xyz = torch.tensor(offsets, dtype=F64)
    return SE3(torch.cat([torch.tensor([[1.0, 0, 0, 0]], dtype=F64).expand(len(xyz), 4), xyz], 1))


CUBE = Box(slides_by([[2.0, 0, 0]])[0], torch.ones(3, dtype=F64))
UP = torch.tensor([0.0, 0, 1], dtype=F64)


def turn(x: float, y: float, angle_deg: float, lift: float = 0.0) -> SE3:
    """A turn about the vertical line through (x, y), and a slide along it."""
    still = Screw("revolute", UP, torch.tensor([x, y, 0.0], dtype=F64)).motion(math.radians(angle_deg))
    return SE3.from_quat(still.wxyz, still.xyz + lift * UP)


class TestOddity:
    # What stands still: a post along the cube's vertical edge at (1, 1), dense enough to have no gaps.
    POST = np.stack([np.ones(2001), np.ones(2001), np.linspace(-2, 2, 2001)], 1)

    def odd(self, motion: SE3) -> float:
        return oddity(motion, CUBE, KDTree(self.POST))

    def travel(self, T: SE3) -> float:
        return float((T.apply(CUBE.corners) - CUBE.corners).square().sum(-1).mean().sqrt()) / math.sqrt(3)

    def test_a_slide_counts_by_its_length(self):
        slide = Screw("prismatic", UP, torch.zeros(3, dtype=F64)).motion(0.6)
        assert self.odd(slide) == pytest.approx(0.6 / math.sqrt(3))
        assert self.odd(NO_MOTION) == 0

    def test_a_turn_about_where_it_meets_what_stands_still_counts_by_the_corners_travel(self):
        assert self.odd(turn(1, 1, 90)) == pytest.approx(self.travel(turn(1, 1, 90)), abs=3e-3)

    def test_an_axis_in_the_air_and_a_slide_along_it_count_too(self):
        away, far, lifted = turn(1.3, 1.4, 30), turn(8, 1, 30), turn(1, 1, 30, lift=0.4)
        assert self.odd(away) == pytest.approx(self.travel(away) + 4 * 0.5 / math.sqrt(3), abs=3e-3)
        assert self.odd(far) == pytest.approx(self.travel(far) + 4, abs=3e-3)
        assert self.odd(lifted) == pytest.approx(self.travel(lifted) + 0.4 / math.sqrt(3), abs=3e-3)

    def test_does_not_depend_on_where_the_world_begins(self):
        T = SE3.exp(torch.tensor([3.0, -2.0, 1.0, 0.4, -1.0, 0.8], dtype=F64))
        motion = turn(1, 2, 40, lift=0.2)
        there = KDTree(T.apply(torch.from_numpy(self.POST)).numpy())
        assert oddity(T @ motion @ T.inverse(), CUBE.moved(T), there) == pytest.approx(self.odd(motion), abs=1e-9)

    def test_a_door_laid_upon_its_place_the_wrong_way_round_turns_about_no_hinge(self):
        door = Box(slides_by([[1.0, 0, 0]])[0], torch.tensor([1.0, 0.05, 1.5], dtype=F64))
        hinge = KDTree(np.stack([np.zeros(301), np.zeros(301), np.linspace(-1.5, 1.5, 301)], 1))
        opened = turn(0, 0, 90)
        wrong = [oddity(motion, door, hinge) for motion in flips(opened, door)]
        assert oddity(opened, door, hinge) + 0.9 < min(wrong)

    def test_an_odd_motion_must_look_better_to_be_preferred(self):
        plain = Hypothesis(NO_MOTION, outside=0.0, unexplained=0.0, oddity=0.0, image_error=0.10, back_error=0.1)
        odd = replace(plain, oddity=2.0, image_error=0.09)
        assert plain.error + plain.against(0.1) < odd.error + odd.against(0.1)
        assert odd.error + odd.against(0.001) < plain.error + plain.against(0.001), "where little is to be gained"


class TestDistinct:
    def test_displacement_of_slides_is_their_difference(self):
        slides = slides_by([[0.0, 0, 0], [0.3, 0, 0], [0, 0.4, 0]])
        np.testing.assert_allclose(displacements(slides, slides[1], CUBE), np.array([0.3, 0.0, 0.5]) / math.sqrt(3))

    def test_displacement_of_a_turn_is_its_corners_chord(self):
        turns = SE3(torch.stack([turn(2, 0, 0).wxyz_xyz, turn(2, 0, 60).wxyz_xyz]))
        chord = 2 * math.sqrt(2) * math.sin(math.radians(30))
        np.testing.assert_allclose(displacements(turns, NO_MOTION, CUBE), np.array([0.0, chord / math.sqrt(3)]), atol=1e-12)

    def test_keeps_the_first_of_those_that_are_close(self):
        slides = slides_by([[0.0, 0.0, z] for z in (0.0, 0.1, 0.5, 0.55, 0.95, 2.0)])
        gap = 0.3 / math.sqrt(3)
        assert distinct(slides, CUBE, gap, 10) == [0, 2, 4, 5]
        assert distinct(slides, CUBE, gap, 2) == [0, 2]

    def test_motions_are_stacked_in_order(self):
        turns = [turn(0, 0, angle) for angle in (10.0, 20.0)]
        torch.testing.assert_close(torch.rad2deg(stack_motions(turns).angle), torch.tensor([10.0, 20.0], dtype=F64))

    def test_flips_take_the_box_to_the_same_place_in_the_three_other_ways(self):
        box, motion = random_box(3), turn(1, 2, 40, lift=0.2)
        flipped = flips(motion, box)
        assert len(flipped) == 3
        for flip in flipped:
            gaps = torch.cdist(flip.apply(box.corners), motion.apply(box.corners))
            assert gaps.amin(0).max() < 1e-9
            assert gaps.argmin(0).tolist() != list(range(8)), "other corners"
        ways = stack_motions([motion, *flipped])
        assert (torch.cdist(ways.rotation.flatten(1), ways.rotation.flatten(1)) + torch.eye(4)).min() > 0.9


def test_a_turn_about_a_centre_leaves_it_where_it_is():
    centre = torch.tensor([1.0, -2.0, 3.0], dtype=F64)
    tangent = torch.tensor([0.1, 0.2, 0.3, 0.0, 0.5, -0.4], dtype=F64)
    rotation_only = torch.cat([torch.zeros(3, dtype=F64), tangent[3:]])
    torch.testing.assert_close(turn_about(centre, rotation_only).apply(centre), centre)
    torch.testing.assert_close(turn_about(centre, tangent).apply(centre), centre + SE3.exp(tangent).xyz)


def _beside(box: Box, points: Tensor) -> Tensor:
    """How far points are from a box, 0 inside."""
    return (box.T_world_box.inverse().apply(points).abs() - box.half_extents).clamp(min=0).norm(dim=-1)


@lru_cache
def capture_of(name: str) -> Capture:
    obj = make_object(name)
    # Two parts side by side are told apart only where enough views look between them.
    views = 24 if len(obj.joints) > 1 else 16
    return make_capture(obj, RenderOptions(size=128, views=views, test_views=1, samples=2))


@lru_cache
def looks_of(name: str) -> tuple[KnownObject, tuple[StateLook, StateLook]]:
    """A known object and the survey of its photos, made once."""
    return make_object(name), survey(capture_of(name), None, SMALL, seed=0)


@lru_cache
def search_of(name: str) -> tuple[PartSearch, list[MovingPart]]:
    """A search of an object, and what it finds, made once."""
    search = PartSearch(looks_of(name)[1], SMALL.search, seed=0)
    return search, search.search(None)


def parts_of(name: str) -> list[MovingPart]:
    """What the search finds in an object."""
    return search_of(name)[1]


@lru_cache
def true_parts_of(name: str) -> tuple[PartReview, list[MovingPart]]:
    """An object's parts as state 1 shows them, cut out by their true boxes, with their true motions; and who reviews them.

    The weightiest comes first, as in a search.
    """
    return true_parts(*looks_of(name))


def true_parts(obj: KnownObject, looks: tuple[StateLook, StateLook]) -> tuple[PartReview, list[MovingPart]]:
    """`true_parts_of`, of an object and its survey."""
    pieces = Pieces(looks, SMALL.search, seed=0)
    margin = 1.5 * pieces.voxel
    parts = []
    for joint, known in zip(obj.joints, obj.parts[1:], strict=True):
        inside, held = (
            torch.stack([item.box.contains(where.double(), margin=margin) for item in known.at_state(1)]).any(0)
            for where in (torch.from_numpy(looks[1].points), looks[1].splats.means)
        )
        points, scene = looks[1].points[inside.numpy()], pieces.scene(1, looks[1].splats[~held])
        weight = scene.absent - scene.error(looks[1].splats[held], NO_MOTION)
        trial = pieces.trial(1, points, looks[1].splats[held], weight, [])
        found = trial.judge(Hypothesis(joint.motion().inverse(), 0.0, 0.0, 0.0))
        parts.append(MovingPart(1, (points,), found, trial.gain(found), weight))
    return PartReview(pieces), sorted(parts, key=lambda part: -part.weight)


@lru_cache
def trial_of_screen() -> Trial:
    """The laptop's screen between the photos of both states, cut out by its true box."""
    obj, looks = looks_of("laptop")
    (true,) = obj.joints
    box = obj.parts[1].boxes[0].box
    screen = Box(box.T_world_box, box.half_extents + 0.03)
    inside = [
        b.contains(look.splats.means.double()) for b, look in zip((screen, screen.moved(true.motion())), looks, strict=True)
    ]
    there, here = (
        Scene(looks[s], looks[1 - s].splats[~inside[1 - s]], np.arange(0, 16, 2), KDTree(looks[s].points)) for s in (1, 0)
    )
    splats, own = looks[0].splats[inside[0]], KDTree(points_of(screen, 4000))
    return Trial(there, here, looks[1].splats, splats, screen, 0.1, most=0.1, near=0.02, own=own, taken=NOTHING, least=0.01)


def panels(box: Box, grey: float) -> Splats:
    """The six faces of a box, opaque, of one colour."""
    means = torch.from_numpy(points_of(box, 12000)).float()
    sh = torch.full((len(means), 1, 3), (grey - 0.5) / SH_C0)
    upright = torch.tensor([1.0, 0, 0, 0]).repeat(len(means), 1)
    return Splats(means, upright, torch.full((len(means), 3), math.log(0.015)), torch.full((len(means),), 4.0), sh)


def scene_of(shown: list[Splats], rest: Splats) -> Scene:
    """Eight photos of what is shown, from z = -4 by x = 4 to z = 4, and the rest as it stands in them."""
    rgb, alpha, cameras = [], [], []
    for k in range(8):
        turn = SE3.exp(torch.tensor([0, 0, 0, 0, -math.pi * (k + 0.5) / 8, 0]))
        cameras.append(Camera(turn @ SE3.exp(torch.tensor([0, 0, -4.0, 0, 0, 0])), 100.0, 100.0, 32.0, 32.0, 64, 64))
        picture = render(Splats.concatenate(shown), cameras[-1])
        rgb.append((picture.rgb.clamp(0, 1) * 255).round().byte().numpy())
        alpha.append((picture.alpha * 255).round().byte().numpy())
    look = replace(looks_of("laptop")[1][0], stack=ImageStack(tuple(cameras), np.stack(rgb), np.stack(alpha)))
    return Scene(look, rest, np.arange(8), KDTree(rest.means.numpy()))


def cupboard_and_tray(pushed: float) -> Trial:
    """A tray before the front of a shut cupboard, .8 wide; photos of the other state see it pushed in so far, or, at 0, not."""
    cupboard = panels(Box(NO_MOTION, torch.tensor([0.4, 0.4, 0.4], dtype=F64)), 0.7)
    box = Box(SE3.from_quat(NO_MOTION.wxyz, torch.tensor([0.75, 0, 0], dtype=F64)), torch.tensor([0.15, 0.2, 0.1], dtype=F64))
    tray = panels(box, 0.2)
    pushed_in = [tray.moved(SE3.from_quat(NO_MOTION.wxyz, torch.tensor([-pushed, 0, 0], dtype=F64)))] if pushed else []
    there, here = scene_of([cupboard, *pushed_in], cupboard), scene_of([cupboard, tray], cupboard)
    own = KDTree(tray.means.numpy())
    return Trial(there, here, cupboard, tray, box, weight=0.04, most=0.04, near=0.02, own=own, taken=NOTHING, least=0.002)


def doors_above_each_other(lower: float, upper: float) -> tuple[Trial, Screw]:
    """Two doors, .4 high, that touch, on one upright line at x = .4; shut in the other state and open by so many degrees here.

    Returns:
        Both as one part, and the line.
    """
    hinge = Screw("revolute", torch.tensor([0.0, 1, 0], dtype=F64), torch.tensor([0.4, 0, -0.4], dtype=F64))
    beside = SE3.from_quat(NO_MOTION.wxyz, torch.tensor([0.45, 0, 0], dtype=F64))
    post = panels(Box(beside, torch.full((3,), 0.05, dtype=F64)), 0.5)
    shut, opened = [], []
    for level, grey, degrees in ((-0.2, 0.2, lower), (0.2, 0.8, upper)):
        at = SE3.from_quat(NO_MOTION.wxyz, torch.tensor([0, level, -0.4], dtype=F64))
        box = Box(at, torch.tensor([0.4, 0.2, 0.02], dtype=F64))
        shut.append(panels(box, grey))
        opened.append(shut[-1].moved(hinge.motion(math.radians(degrees))))
    piece, others = Splats.concatenate(opened), Splats.concatenate([post, *shut])
    there, here = scene_of([post, *shut], post), scene_of([post, *opened], post)
    weight = here.absent - here.error(piece, NO_MOTION)
    own = KDTree(piece.means.double().numpy())
    box = box_around(own.data, 0.01)
    trial = Trial(there, here, others, piece, box, weight, weight, 0.02, own, taken=NOTHING, least=0.1 * weight)
    return trial, hinge


def pieces_on(base: Box) -> Pieces:
    """What the laptop's photos show, with another base's box."""
    pieces = Pieces(looks_of("laptop")[1], SMALL.search, seed=0)
    pieces.base_box = base
    return pieces


@dataclass(frozen=True)
class Loose(Trial):
    """A part that the photos lose little by wherever it goes: `aside` for a unit that it comes to lie aside of `at`."""

    at: SE3
    aside: float

    @property
    def absent(self) -> float:
        return 1.0

    def judge(self, hypothesis: Hypothesis, quick: bool = False) -> Hypothesis:  # noqa: ARG002
        aside = float((hypothesis.motion.xyz - self.at.xyz).norm())
        return replace(hypothesis, image_error=0.1, back_error=0.1 + self.aside * aside)


def distance_to_surface(points: np.ndarray, obj: KnownObject, state: int) -> Tensor:
    rows = []
    for item in (item for part in obj.parts for item in part.at_state(state)):
        beyond = item.box.T_world_box.inverse().apply(torch.from_numpy(points)).abs() - item.box.half_extents
        rows.append(beyond.clamp(min=0).norm(dim=-1) + beyond.amax(-1).clamp(max=0).abs())
    return torch.stack(rows).amin(0)


class TestSurvey:
    @pytest.mark.parametrize("name", ["laptop", "drawer"])
    def test_its_points_lie_near_the_true_surface(self, name: str):
        obj, looks = looks_of(name)
        for state, look in enumerate(looks):
            assert len(look.points) > 500
            assert float(distance_to_surface(look.points, obj, state).median()) < 0.7 * look.hull.voxel

    def test_its_splats_lie_in_the_hull_and_look_like_the_photos(self):
        _, looks = looks_of("laptop")
        for look in looks:
            scene = Scene(look, look.splats, np.arange(3), KDTree(look.points))
            nothing = Scene(look, look.splats[:1], np.arange(3), KDTree(look.points))
            assert scene.absent < 0.2 * nothing.absent

    def test_given_points_take_the_place_of_its_own(self):
        obj, looks = looks_of("laptop")
        quick = replace(SMALL, appearance=replace(SMALL.appearance, steps=1))
        given = survey(capture_of("laptop"), points_from(capture_of("laptop"), "depth"), quick, seed=0)
        for state in (0, 1):
            assert float(distance_to_surface(given[state].points, obj, state).max()) < 2e-3
            np.testing.assert_array_equal(given[state].hull.occupied, looks[state].hull.occupied)


def share_of_part(points: np.ndarray, obj: KnownObject, part: int, state: int, margin: float) -> float:
    inside = torch.zeros(len(points), dtype=torch.bool)
    for item in obj.parts[part].at_state(state):
        inside |= item.box.contains(torch.from_numpy(points), margin=margin)
    return float(inside.double().mean())


class TestCue:
    def test_a_drawer_that_was_shut_only_arrives(self):
        obj, looks = looks_of("drawer")
        found = clusters(looks, SMALL.search.cue)
        assert [cluster.state for cluster in found] == [1]
        assert share_of_part(found[0].points, obj, 1, 1, 1.5 * looks[0].hull.voxel) > 0.75

    def test_what_is_open_in_both_states_departs_and_arrives(self):
        obj, looks = looks_of("laptop")
        found = clusters(looks, SMALL.search.cue)
        assert {cluster.state for cluster in found} == {0, 1}
        for cluster in found:
            assert share_of_part(cluster.points, obj, 1, cluster.state, 1.5 * looks[0].hull.voxel) > 0.9

    def test_an_inside_that_came_to_light_is_no_motion(self):
        """Behind the cabinet's door and drawer walls are seen in state 1 that state 0 hid; only the fronts moved."""
        obj, looks = looks_of("cabinet")
        for cluster in clusters(looks, SMALL.search.cue):
            shares = [share_of_part(cluster.points, obj, k, cluster.state, 1.5 * looks[0].hull.voxel) for k in (1, 2)]
            assert sum(shares) > 0.7  # they touch: a cluster may hold a corner of the other

    def test_what_stands_still_shows_nothing(self):
        assert clusters(looks_of("static")[1], SMALL.search.cue) == []

    def test_the_largest_cluster_comes_first(self):
        for name in ("laptop", "cabinet"):
            sizes = [len(cluster.points) for cluster in clusters(looks_of(name)[1], SMALL.search.cue)]
            assert sizes == sorted(sizes, reverse=True)


def errors(motion: SE3, points: np.ndarray, true: TrueJoint) -> tuple[float, float]:
    """Of a motion against a true joint's: degrees, and how far a part's points land from their places, world units."""
    at = torch.from_numpy(points)
    gap = (motion.apply(at) - true.motion().apply(at)).norm(dim=-1).mean()
    return math.degrees(float((true.motion().inverse() @ motion).angle)), float(gap)


class TestParts:
    @pytest.mark.parametrize("name", ["laptop", "drawer", "door"])
    def test_one_part_and_its_motion_are_found(self, name: str):
        obj, _ = looks_of(name)
        (true,) = obj.joints
        (part,) = parts_of(name)
        assert kind_of(part.motion) == true.kind
        degrees, gap = errors(part.motion, part.points_in(0), true)
        assert degrees < 5
        assert gap < 0.05
        assert part.gain > 0.02

    def test_a_door_and_a_drawer_both_shut_are_found(self):
        obj = make_object("cabinet")
        # In even light: where a door looks quite another colour once it is open, so few photos do not tell its angle.
        options = RenderOptions(size=128, views=32, test_views=1, samples=2, lighting=Lighting(ambient=0.75))
        looks = survey(make_capture(obj, options), None, SMALL, seed=0)
        parts = find_parts(looks, None, SMALL, seed=0)
        assert len(parts) == 2
        for true in obj.joints:
            (part,) = [p for p in parts if kind_of(p.motion) == true.kind]
            degrees, gap = errors(part.motion, part.points_in(0), true)
            assert degrees < 3
            assert gap < 0.04
        assert parts[0].weight >= parts[1].weight

    def test_photos_pull_what_moves_little_home_from_rest(self):
        obj, looks = looks_of("switch")
        (true,) = obj.joints
        search = PartSearch(looks, SMALL.search, seed=0)
        pieces, (cluster, *_) = search.pieces, search.pieces.clusters
        alone = pieces.trial(cluster.state, cluster.points, pieces.splats_in({0}), pieces.weights[0], [])
        found = search.from_rest(0, alone, set())
        part = MovingPart(cluster.state, (cluster.points,), found, 0.0, alone.weight)
        (_, left), (_, moved) = (errors(motion, part.points_in(0), true) for motion in (part.motion, NO_MOTION))
        assert left < 0.4 * moved
        assert found.outside < 0.2
        assert alone.cost(found) < 0

    def test_points_that_no_photo_needs_are_no_part(self):
        looks = looks_of("laptop")[1]
        search = PartSearch(looks, SMALL.search, seed=0)
        low, high = looks[0].points.min(0), looks[0].points.max(0)
        air = np.random.default_rng(0).uniform(0, 0.2 * (high - low), (400, 3)) + high + 0.2 * (high - low)
        haunted = replace(looks[0], points=np.concatenate([looks[0].points, air]))
        found = clusters((haunted, looks[1]), SMALL.search.cue)
        assert len(found) == len(clusters(looks, SMALL.search.cue)) + 1
        kept = PartSearch((haunted, looks[1]), SMALL.search, seed=0)
        assert [len(c.points) for c in kept.pieces.clusters] == [len(c.points) for c in search.pieces.clusters]

    def test_points_in_the_air_with_hardly_a_splat_are_no_part(self):
        """However much photos need of the little that is painted there."""
        looks = looks_of("laptop")[1]
        pieces = Pieces(looks, SMALL.search, seed=0)
        (largest, *_), (held, *_) = pieces.clusters, pieces.held
        look = looks[largest.state]
        left = torch.ones(len(look.splats), dtype=torch.bool)
        left[held.nonzero()[3:]] = False
        emptied = [replace(look, splats=look.splats[left]) if s == largest.state else looks[s] for s in (0, 1)]
        after = Pieces((emptied[0], emptied[1]), SMALL.search, seed=0)
        scene, few = pieces.scene(largest.state, look.splats[~held]), look.splats[left & held]
        weight = scene.absent - scene.error(few, NO_MOTION)
        assert weight > SMALL.search.there * scene.footprint(few) > 0
        assert all(cluster.state != largest.state for cluster in after.clusters)

    def test_splats_of_what_stands_still_beside_a_part_are_not_its_own(self):
        """Below the laptop's screen lie its keys, three voxels from the box around the screen's points and less."""
        obj, looks = looks_of("laptop")
        pieces = Pieces(looks, SMALL.search, seed=0)
        for cluster, held in zip(pieces.clusters, pieces.held, strict=True):
            means = looks[cluster.state].splats.means[held].double()
            base, screen = (
                torch.stack([_beside(item.box, means) for item in part.at_state(cluster.state)]).amin(0) for part in obj.parts
            )
            assert float((base < screen - 0.5 * pieces.voxel).double().mean()) < 0.02

    def test_what_stands_in_both_states_is_not_brought_back_as_the_part(self):
        """A screen that sinks into the base brings back less of it; laid upon its place it brings back itself."""
        obj, looks = looks_of("laptop")
        pieces = Pieces(looks, SMALL.search, seed=0)
        beside = torch.stack(
            [_beside(item.box, torch.from_numpy(pieces.stays.data)) for item in obj.parts[0].at_state(0)]
        ).amin(0)
        assert len(pieces.stays.data) > 500
        assert float((beside < 2 * pieces.voxel).double().mean()) > 0.95
        state = pieces.clusters[0].state
        trial = pieces.trial(state, pieces.clusters[0].points, pieces.splats_in({0}), pieces.weights[0], [])
        anything = replace(trial, taken=NOTHING)

        def kept(motions: SE3) -> float:
            return sum(len(trial.brought(motion)) for motion in motions) / sum(len(anything.brought(m)) for m in motions)

        true = obj.joints[0].motion() if state == 0 else obj.joints[0].motion().inverse()
        assert kept(true[None]) > 0.9
        assert kept(slides_by([[0.0, 0.0, -d] for d in (0.2, 0.4, 0.6)])) < kept(true[None]) - 0.05

    def test_what_was_found_before_is_not_forgotten(self):
        """Tried once more with fewer motions to choose from, a cluster keeps the better one that it was given before."""
        obj, looks = looks_of("laptop")
        search = PartSearch(looks, replace(SMALL.search, shortlist=1, finalists=1, steps=1), seed=0)
        state = search.pieces.clusters[0].state
        motion = obj.joints[0].motion() if state == 0 else obj.joints[0].motion().inverse()
        known = Hypothesis(motion, 0.0, 0.0, 0.0), frozenset[int]()
        part, members, _ = search._try(0, [], set(), known)
        assert displacements(motion[None], part.hypothesis.motion, search.pieces.boxes[0])[0] < 0.1
        assert members == {0}

    def test_where_everything_seems_to_move_it_still_ends(self):
        looks = looks_of("laptop")[1]
        everywhere = CueConfig(threshold=-1e3, neighbours=16)  # every point is further from the other state than that
        search = PartSearch(looks, replace(SMALL.search, cue=everywhere, shortlist=6, finalists=1, steps=5), seed=0)
        assert len(search.pieces.still.data) == len(looks[0].points)
        assert all(len(part.points) > 0 for part in search.search(None))

    @pytest.mark.parametrize("share", [0.0, 1.0])
    def test_a_footprint_is_the_share_of_the_photos_that_a_piece_covers(self, share: float):
        look = looks_of("laptop")[1][0]
        cut = int(share * len(look.splats))
        scene = Scene(look, look.splats[cut:], np.arange(3), KDTree(look.points))
        cameras = look.stack.cameras[:3]
        alphas = [float(render(look.splats, camera, dilation=LOOK_DILATION).alpha.mean()) for camera in cameras]
        assert scene.footprint(look.splats[:cut]) == pytest.approx(share * float(np.mean(alphas)), abs=1e-5)

    def test_what_no_motion_explains_is_left_over_and_told(self):
        looks = looks_of("laptop")[1]
        search, parts = search_of("laptop")
        assert len(parts) == 1
        assert search.left_over == []
        never = PartSearch(looks, replace(SMALL.search, harm=-9.0), seed=0)  # a gain of nine times the photos' error
        assert never.search(None) == []
        assert {state for state, _ in never.left_over} == {0, 1}
        assert all(SMALL.search.large < share < 1 for _, share in never.left_over)

    def test_nothing_moves_in_a_still_object(self):
        assert parts_of("static") == []

    def test_points_follow_the_motion_both_ways(self):
        (part,) = parts_of("laptop")
        moved = part.motion.apply(torch.from_numpy(part.points_in(0))).numpy()
        np.testing.assert_allclose(moved, part.points_in(1), atol=1e-5)

    def test_a_motion_five_degrees_off_is_pulled_back(self):
        (true,) = looks_of("laptop")[0].joints
        screen = trial_of_screen().box
        off = turn_about(true.motion().apply(screen.T_world_box.xyz), torch.tensor([0.0, 0, 0, 0.05, 0.06, 0.04], dtype=F64))
        start = Hypothesis(off @ true.motion(), 0.0, 0.0, 0.0)
        assert errors(start.motion, screen.corners.numpy(), true)[0] > 4.9
        trial = trial_of_screen()
        start = trial.judge(start)
        found = refine(start, trial, 60, 0.03)
        degrees, gap = errors(found.motion, screen.corners.numpy(), true)
        assert degrees < 1.5
        assert gap < 0.03
        assert found.error < start.error
        assert found.oddity == pytest.approx(oddity(found.motion, screen, trial.there.still), abs=1e-6)

    def test_a_part_that_shows_more_in_the_other_state_is_pulled_all_the_way(self):
        """What it explains there beyond its weight says as well where it is: what is less odd, but not in place, is worse."""
        obj, looks = looks_of("laptop")
        (true,) = obj.joints
        screw, q = screw_at(true.motion(), "revolute", trial_of_screen().box.T_world_box.xyz)
        trial = replace(trial_of_screen(), most=0.001)
        start = trial.judge(Hypothesis(screw.motion(q - 0.1), 0.0, 0.0, 0.0))
        pulled = Pieces(looks, SMALL.search, seed=0).pulled(start, trial, 60)
        assert trial.explained(start) == trial.explained(pulled) == pytest.approx(0.002)
        assert errors(pulled.motion, trial.box.corners.numpy(), true)[0] < 1.5

    @pytest.mark.parametrize("degrees", [5.0, 30.0])
    def test_a_slide_that_photos_leave_loose_runs_along_an_axis(self, degrees: float):
        angle = np.deg2rad(degrees)
        slide = SE3.from_quat(NO_MOTION.wxyz, torch.tensor([0.3 * np.cos(angle), 0.0, 0.3 * np.sin(angle)], dtype=F64))
        box = Box(NO_MOTION, torch.tensor([0.5, 0.3, 0.2], dtype=F64))
        known = {field.name: getattr(trial_of_screen(), field.name) for field in fields(Trial)}
        for aside, told in ((0.0, False), (10.0, True)):
            trial = Loose(**known | {"box": box}, at=slide, aside=aside)
            found = simplest(trial.judge(Hypothesis(slide, 0.0, 0.0, 0.0)), trial, box, 0.1).motion
            assert float(found.angle) == 0
            x, y, z = found.xyz.tolist()
            assert (x, y, z) == pytest.approx(slide.xyz.tolist() if told else (0.3 * np.cos(angle), 0, 0), abs=1e-9)

    def test_of_what_does_not_show_the_way_runs_along_an_axis_of_the_base(self):
        slide = SE3.from_quat(NO_MOTION.wxyz, torch.tensor([0.3, 0.0, 0.1], dtype=F64))
        base = Box(NO_MOTION, torch.tensor([0.5, 0.3, 0.2], dtype=F64))
        along_slide = SE3.exp(torch.tensor([0, 0, 0, 0, -math.atan2(0.1, 0.3), 0], dtype=F64))
        known = {field.name: getattr(trial_of_screen(), field.name) for field in fields(Trial)}
        trial = Loose(**known | {"box": Box(along_slide, base.half_extents)}, at=slide, aside=10.0)
        start = trial.judge(Hypothesis(slide, 0.0, 0.0, 0.0))
        assert simplest(start, trial, base, 0.1).motion.xyz.tolist() == pytest.approx([0.3, 0.0, 0.1], abs=1e-9)
        straight = along_base(start, trial, base)
        assert straight.motion.xyz.tolist() == pytest.approx([0.3, 0.0, 0.0], abs=1e-9)
        assert straight.error == pytest.approx(0.2 + 10.0 * 0.1)
        turn = trial.judge(replace(start, motion=along_slide))
        assert along_base(turn, trial, base) is turn

    def test_what_turns_into_the_way_slides(self):
        trial = cupboard_and_tray(0.0)
        rest = trial.box.T_world_box.xyz
        aside = SE3.from_quat(NO_MOTION.wxyz, torch.tensor([-0.3, 0.05, 0], dtype=F64))
        askew = turn_about(aside.apply(rest), torch.tensor([0, 0, 0, 0, 0, 0.4], dtype=F64)) @ aside
        start = trial.judge(Hypothesis(askew, 0.0, 0.0, 0.0))
        assert kind_of(askew) == "revolute"
        assert trial.in_the_way(start)
        assert not trial.out_of_sight(askew)
        straight = along_base(start, trial, Box(NO_MOTION, torch.tensor([0.4, 0.4, 0.4], dtype=F64)))
        assert straight.motion.xyz.tolist() == pytest.approx([-0.3, 0.0, 0.0], abs=1e-9)
        assert kind_of(straight.motion) == "prismatic"

    @pytest.mark.parametrize(
        ("pushed", "told"),
        [
            pytest.param(0.0, 0.62, id="hidden"),
            pytest.param(0.0, 0.42, id="not hidden yet"),
            pytest.param(0.4, 0.4, id="seen to stop half way"),
        ],
    )
    def test_a_slide_out_of_sight_goes_straight_in_and_no_farther_than_it_has_to(self, pushed: float, told: float):
        trial = cupboard_and_tray(pushed)
        aside = 0.0 if pushed else 0.15
        slide = SE3.from_quat(NO_MOTION.wxyz, torch.tensor([-told, aside, 0], dtype=F64))
        start = trial.judge(Hypothesis(slide, 0.0, 0.0, 0.0))
        found = just_out_of_sight(start, trial, Box(NO_MOTION, torch.tensor([0.4, 0.4, 0.4], dtype=F64)))
        if pushed:
            assert found is start
        else:  # the tray's front is .5 before the front of the cupboard
            assert 0.5 <= -float(found.motion.xyz[0]) < 0.56
            assert found.motion.xyz[1:].abs().max() < 1e-9

    def test_the_shortest_way_out_of_sight_is_along_the_base_and_no_longer_than_it(self):
        trial = cupboard_and_tray(0.0)
        for size, found in ((0.4, True), (0.2, False)):  # the tray's front is .5 before the front of the cupboard
            motion = shortest_out_of_sight(trial, Box(NO_MOTION, torch.full((3,), size, dtype=F64)))
            assert (motion is not None) == found
            if motion is not None:
                assert 0.5 <= -float(motion.xyz[0]) < 0.56
                assert motion.xyz[1:].abs().max() < 1e-9
                assert trial.in_view(motion, replace(trial.there, rest=trial.there.rest[:0]))

    def test_doors_above_each_other_that_look_like_one_askew_are_two(self):
        """One motion for doors open by 30 and by 70 degrees leans; only along their hinge does each say how far it goes."""
        trial, hinge = doors_above_each_other(30.0, 70.0)
        pieces = pieces_on(Box(NO_MOTION, torch.tensor([0.4, 0.4, 0.4], dtype=F64)))
        both = trial.judge(Hypothesis(hinge.motion(-math.radians(50.0)), 0.0, 0.0, 0.0))
        leaning = refine(both, trial, 60, 0.03)
        part = MovingPart(1, (trial.own.data,), leaning, 1.0, trial.weight)
        screw, _ = screw_at(leaning.motion, "revolute", trial.box.T_world_box.xyz)
        assert math.degrees(math.acos(abs(float(screw.axis[1])))) > 3
        several = several_in(part, trial, pieces, known_cut=False)
        assert len(several) == 2
        for points in several:
            aside = points[np.abs(points[:, 1]) > 0.05, 1]  # off the faces with which they touch
            assert abs(np.sign(aside).mean()) > 0.95
        leaning_so = Rotation.align_vectors(screw.axis[None].numpy(), np.array([[0.0, 1, 0]]))[0].as_matrix()
        leant = SE3.from_rotation(torch.from_numpy(leaning_so), torch.zeros(3, dtype=F64))
        pieces.base_box = Box(leant, pieces.base_box.half_extents)
        assert len(several_in(part, trial, pieces, known_cut=False)) == 1, "a base that leans as they do says nothing new"

    def test_a_part_is_asked_along_its_own_way_the_same_along_the_base_and_rivals_that_differ(self):
        trial = trial_of_screen()
        pieces = pieces_on(Box(NO_MOTION, torch.ones(3, dtype=F64)))

        def part_with(*motions: SE3) -> MovingPart:
            best, *rivals = (Hypothesis(motion, 0.0, 0.0, 0.0) for motion in motions)
            return MovingPart(0, (trial.own.data,), best, 1.0, 0.1, tuple(rivals))

        def slide(x: float, y: float) -> SE3:
            return SE3.from_quat(NO_MOTION.wxyz, torch.tensor([x, y, 0.0], dtype=F64))

        (own,), also = _ways(part_with(slide(0.3, 0.0), slide(0.5, 0.1), slide(0.1, 0.4), turn(2, 0, 40)), trial, pieces)
        assert own[1] == pytest.approx(0.3)
        assert [screw.kind for screw, _ in also] == ["prismatic", "revolute"], (
            "the first rival slides along x, as the part does"
        )
        torch.testing.assert_close(also[0][0].axis, torch.tensor([0.0, 1, 0], dtype=F64))
        assert also[0][1] == pytest.approx(0.4)
        ways, also = _ways(part_with(slide(0.3, 0.1), slide(0.2, 0.0)), trial, pieces)
        assert [float(screw.axis[0]) for screw, _ in ways] == pytest.approx([0.3 / math.hypot(0.3, 0.1), 1.0])
        assert not also

    def test_what_is_seen_through_a_frame_is_not_brought_back_with_it(self):
        """In the shut place of a frame lies also what fills it, in the same box."""
        trial = trial_of_screen()
        local = trial.box.to_canonical(torch.from_numpy(np.asarray(trial.own.data)))
        rim = np.asarray(trial.own.data)[(local.abs() > 0.95).sum(1).numpy() >= 2]
        (true,) = looks_of("laptop")[0].joints
        whole = trial.brought(true.motion())
        frame = replace(trial, own=KDTree(rim)).brought(true.motion())
        assert 0 < len(frame) < 0.8 * len(whole)
        back = true.motion().inverse().apply(frame.means.double())
        assert KDTree(rim).query(back.numpy())[0].max() < 0.15

    def test_the_photos_of_both_states_speak_for_the_true_motion(self):
        (true,) = looks_of("laptop")[0].joints
        trial = trial_of_screen()
        right, shut = (trial.judge(Hypothesis(T, 0.0, 0.0, 0.0)) for T in (true.motion(), NO_MOTION))
        assert right.image_error < 0.6 * trial.there.absent
        assert right.back_error < 0.6 * trial.here.absent
        assert right.image_error < shut.image_error
        assert right.back_error < shut.back_error
        assert trial.gain(right) == pytest.approx(1 - right.error / (trial.there.absent + trial.here.absent))

    def test_what_explains_more_than_the_part_weighs_counts_no_further(self):
        trial = replace(trial_of_screen(), weight=0.02, most=0.02)
        without = trial.there.absent, trial.here.absent
        fair = Hypothesis(NO_MOTION, 0.0, 0.0, 0.0, without[0] - 0.02, without[1] - 0.015)
        greedy = replace(fair, image_error=without[0] - 0.09, back_error=without[1] - 0.01)
        assert trial.cost(fair) == pytest.approx(-0.035)
        assert trial.cost(greedy) == pytest.approx(-0.03)
        assert greedy.error < fair.error

    def test_the_less_is_seen_of_a_part_after_a_turn_the_more_speaks_against_it(self):
        trial = replace(trial_of_screen(), weight=0.02)
        (true,) = looks_of("laptop")[0].joints
        for seen, against in ((0.0, 0.006), (0.05, 0.0045), (0.2, 0.0), (0.8, 0.0)):
            turned = Hypothesis(true.motion(), 0.0, 0.0, 0.0, 0.1, 0.1, seen)
            assert trial.gone_in(turned) == pytest.approx(against, abs=1e-9)
            assert trial.cost(turned) - trial.cost(replace(turned, seen=1.0)) == pytest.approx(against, abs=1e-9)

    def test_how_much_is_seen_of_a_part_does_not_hang_on_its_colours(self):
        trial = trial_of_screen()
        (true,) = looks_of("laptop")[0].joints
        away = Screw("revolute", torch.tensor([0.0, 0, 1], dtype=F64), torch.tensor([10.0, 0, 0], dtype=F64)).motion(math.pi)
        for some in (trial, replace(trial, piece=replace(trial.piece, sh=torch.zeros_like(trial.piece.sh)))):
            turned, gone, slid = (some.judge(Hypothesis(T, 0.0, 0.0, 0.0)) for T in (true.motion(), away, NO_MOTION))
            assert 0.7 < turned.seen < 1.4
            assert gone.seen == 0
            assert slid.seen == 1, "only turns are asked"

    def test_what_a_splat_takes_off_the_error_adds_up_to_what_the_part_does(self):
        obj, looks = looks_of("laptop")
        look = looks[0]
        screen = obj.parts[1].boxes[0].box
        inside = Box(screen.T_world_box, screen.half_extents + 0.03).contains(look.splats.means.double())
        part, scene = look.splats[inside], Scene(look, look.splats[~inside], np.arange(0, 16, 2), KDTree(look.points))
        here, lifted = SE3.identity(1, dtype=F64), slides_by([[0.0, 0.0, 0.5]])
        support = scene.support(part, SE3(torch.cat([here.wxyz_xyz, lifted.wxyz_xyz])))
        assert support.shape == (2, len(part))
        for row, motion in zip(support, (here, lifted), strict=True):
            fall = scene.absent - scene.error(part, motion[0])
            assert row.sum() / scene.pixels == pytest.approx(fall, rel=0.1)
        assert support[0].sum() > 0 > support[1].sum()
        assert (support[0] > 0).mean() > 0.7

    def test_two_doors_on_one_line_that_open_differently_are_two_parts(self):
        parts = parts_of("fridge")
        assert len(parts) == 2
        for true in make_object("fridge").joints:
            assert min(errors(part.motion, part.points_in(0), true)[0] for part in parts) < 4


class TestPartsThatMayBeOne:
    """Those that touch, and that the other state does not show."""

    @pytest.mark.parametrize("shows", [False, True])
    def test_a_part_cut_in_two_whose_pieces_go_astray_is_tried_as_one(self, shows: bool, monkeypatch: pytest.MonkeyPatch):
        search, (right,) = PartSearch(looks_of("laptop")[1], SMALL.search, seed=0), parts_of("laptop")
        monkeypatch.setattr(search.review, "shows", lambda *_: shows)
        left, astray = right.points[:, 0] < 0, SE3.exp(torch.tensor([0, 0, 0.5, 0, 0.6, 0], dtype=F64))
        ways = [right.hypothesis.motion @ astray, right.hypothesis.motion @ astray.inverse()]
        halves = [
            replace(right, pieces=(right.points[side],), hypothesis=replace(right.hypothesis, motion=motion))
            for side, motion in zip((left, ~left), ways, strict=True)
        ]
        found = search._whole_again(halves)
        if shows:
            assert found == halves
        else:
            (whole,) = found
            assert len(whole.points) == len(right.points)
            moved, truly = whole.points_in(1 - whole.state), right.points_in(1 - right.state)
            assert np.abs(np.sort(moved, 0) - np.sort(truly, 0)).max() < 0.05

    def test_two_parts_stay_two(self, monkeypatch: pytest.MonkeyPatch):
        search, (_, parts) = PartSearch(looks_of("cabinet")[1], SMALL.search, seed=0), true_parts_of("cabinet")
        monkeypatch.setattr(search.review, "shows", lambda *_: False)
        monkeypatch.setattr(search.review, "touch", lambda *_: True)
        assert search._whole_again(parts) == parts


@lru_cache
def doors_as_one(lower: float, upper: float) -> tuple[PartReview, MovingPart, list[MovingPart]]:
    """Two doors above each other, shut in state 0, that open by so many degrees; both as one that opens as the lower does.

    Returns:
        Who reviews them, both as one, and each.
    """
    rows = [[Front("door", 0.0, degrees)] for degrees in (lower, upper)]
    obj = _cupboard("doors", np.random.default_rng(0), 0.8, 0.7, 1.4, rows)
    capture = make_capture(obj, RenderOptions(size=128, views=24, test_views=1, samples=2))
    review, parts = true_parts(obj, survey(capture, None, SMALL, seed=0))
    one, two = sorted(parts, key=lambda part: part.points[:, 2].mean())
    return review, replace(one, pieces=(np.concatenate([one.points, two.points]),), weight=one.weight + two.weight), [one, two]


class TestPartsThatGoNearlyAsFar:
    def test_doors_above_each_other_are_told_apart_each_with_its_angle(self):
        review, both, parts = doors_as_one(50.0, 56.0)
        found = sorted(review._told_apart([both]), key=lambda part: part.points[:, 2].mean())
        assert len(found) == 2
        for part, true, degrees in zip(found, parts, (50.0, 56.0), strict=True):
            assert abs(len(part.points) - len(true.points)) < 0.1 * len(true.points)
            _, q = screw_at(part.hypothesis.motion, "revolute", torch.zeros(3, dtype=F64))
            assert math.degrees(float(q)) == pytest.approx(degrees, abs=2)

    def test_doors_that_open_alike_stay_as_they_are(self):
        review, both, _ = doors_as_one(50.0, 50.0)
        assert review._told_apart([both]) == [both]

    def test_each_stays_what_it_is(self):
        review, _, parts = doors_as_one(50.0, 56.0)
        assert review._told_apart(parts) == parts


class TestWhereAPartLies:
    def test_what_is_between_pieces_far_apart_is_not_theirs(self):
        """Two drawers that come out alike, on either side of a cupboard, and a door between them."""
        (part,) = parts_of("laptop")
        pieces = Pieces(looks_of("laptop")[1], SMALL.search, seed=0)
        cube = points_of(Box(NO_MOTION, torch.full((3,), 0.2, dtype=F64)), 500)
        aside = np.array([1.0, 0, 0])
        left, right, middle = cube - aside, cube + aside, Cluster(part.state, cube)
        apart = replace(part, pieces=(left, right))
        assert not pieces.within(apart, middle).any()
        for points in (left, right):
            assert pieces.within(apart, Cluster(part.state, points)).all()
        rail = points_of(Box(NO_MOTION, torch.tensor([0.9, 0.2, 0.01], dtype=F64)), 500)
        assert pieces.within(replace(part, pieces=(left, right, rail)), middle).all(), "what lies together lies in one box"

    def test_it_goes_where_the_part_goes(self):
        (part,) = parts_of("laptop")
        pieces = Pieces(looks_of("laptop")[1], SMALL.search, seed=0)
        there = Cluster(1 - part.state, part.points_in(1 - part.state))
        assert pieces.within(part, there).double().mean() > 0.95


class TestReview:
    """The laptop's screen, found rightly and wrongly."""

    @staticmethod
    def found() -> tuple[PartReview, MovingPart, MovingPart]:
        """A review, the screen as it was found, and the same with another motion."""
        (part,) = parts_of("laptop")
        wrong = replace(
            part.hypothesis, motion=part.hypothesis.motion @ SE3.exp(torch.tensor([0, 0, 0.5, 0, 0.6, 0], dtype=F64))
        )
        review = PartReview(Pieces(looks_of("laptop")[1], SMALL.search, seed=0))
        return review, part, replace(part, hypothesis=wrong)

    def test_of_two_parts_in_one_place_the_wrong_one_goes(self):
        review, right, wrong = self.found()
        for parts in ([right, wrong], [wrong, right]):
            (kept,) = review.without_doubles(parts)
            assert kept is right
        assert review.without_doubles([right]) == [right]

    @pytest.mark.parametrize(("voxels", "kept"), [(1.4, 0), (1.6, 1)])
    def test_what_goes_no_farther_than_still_points_may_lie_is_no_part(self, voxels: float, kept: int):
        review, right, wrong = self.found()
        slide = Screw("prismatic", torch.tensor([1.0, 0, 0], dtype=F64), torch.zeros(3, dtype=F64))
        idle = replace(right, hypothesis=replace(right.hypothesis, motion=slide.motion(voxels * review.pieces.voxel)))
        assert review.going_somewhere([right, idle, wrong]) == [right, *[idle] * kept, wrong]

    def test_what_lies_in_a_larger_part_s_box_goes_unless_it_explains_what_it_should(self):
        review, parts = true_parts_of("cabinet")
        small, large = sorted(parts, key=lambda part: len(part.points))
        corners = review.pieces.box(np.concatenate([part.points_in(large.state) for part in parts])).corners.numpy()
        wide = replace(large, pieces=(*large.pieces, corners))
        scrap = replace(small, hypothesis=replace(small.hypothesis, motion=NO_MOTION))
        assert review._without_pieces([small, wide]) == [wide, small]
        assert review._without_pieces([scrap, wide]) == [wide]

    def test_a_part_found_in_two_is_one_however_its_lesser_piece_moves(self):
        review, right, wrong = self.found()
        left = right.points[:, 0] < 0.5
        for astray in (right, wrong):
            large = replace(right, pieces=(right.points[left],), weight=0.9 * right.weight)
            small = replace(astray, pieces=(right.points[~left],), weight=0.1 * right.weight)
            for parts in ([large, small], [small, large]):
                (whole,) = review.joined(parts)
                assert len(whole.points) == len(right.points)
                same = right.hypothesis.motion.as_matrix()
                torch.testing.assert_close(whole.hypothesis.motion.as_matrix(), same, atol=0.01, rtol=0)

    def test_what_either_state_shows_of_one_part_is_one(self):
        """The half of the screen, found in the one state; found in the other, it goes where that state shows the other half."""
        review, right, _ = self.found()
        left = right.points[:, 0] < 0
        aside = Screw("prismatic", torch.tensor([1.0, 0, 0], dtype=F64), torch.zeros(3, dtype=F64))
        beside = aside.motion(float(right.points[:, 0].max())) @ right.hypothesis.motion.inverse()
        leader = replace(right, pieces=(right.points[left],))
        follower = replace(
            right,
            state=1 - right.state,
            pieces=(leader.points_in(1 - right.state),),
            hypothesis=replace(right.hypothesis, motion=beside),
            weight=0.4 * right.weight,
        )
        (whole,) = review.joined([leader, follower])
        assert len(whole.points) > 0.95 * len(right.points)
        same = right.hypothesis.motion.as_matrix()
        torch.testing.assert_close(whole.hypothesis.motion.as_matrix(), same, atol=0.01, rtol=0)
        upon = replace(follower, hypothesis=replace(right.hypothesis, motion=right.hypothesis.motion.inverse()))
        assert review.joined([leader, upon]) == [leader, upon], "nothing but the leader lies there"
        heavier = replace(follower, weight=0.9 * right.weight)
        assert review.joined([leader, heavier]) == [leader, heavier], "it shows less there"

    @pytest.mark.parametrize(("weight", "count"), [(0.1, 1), (10.0, 2)])
    def test_a_piece_beyond_the_hinge_goes_with_its_part_if_photos_tell_so(
        self, weight: float, count: int, monkeypatch: pytest.MonkeyPatch
    ):
        """It touches none, and little of it shows in the other state: what it explains of both states' photos tells."""
        review, right, wrong = self.found()
        one, other = (right.points[side] for side in (right.points[:, 0] < 0, right.points[:, 0] > 0.4))
        large = replace(right, pieces=(one,), weight=20 * right.weight)
        small = replace(wrong, pieces=(other,), weight=weight * right.weight)
        monkeypatch.setattr(Trial, "shows", lambda *_: False)
        assert not review.touch(large, small)
        kept = review._reconsider([large, small])
        assert len(kept) == count
        same = right.hypothesis.motion.as_matrix()
        torch.testing.assert_close(kept[0].hypothesis.motion.as_matrix(), same, atol=0.05, rtol=0)

    def test_parts_side_by_side_that_move_differently_stay_two(self):
        review, parts = true_parts_of("cabinet")
        assert len(parts) == 2
        assert review.joined(parts) == parts
        assert review.joined(parts[:1]) == parts[:1]

    def test_what_lies_nearer_to_another_part_is_not_brought_back(self):
        review, right, _ = self.found()
        left = right.points[:, 0] < 0.0
        one, other = (replace(right, pieces=(right.points[side],)) for side in (left, ~left))
        whole = review.pieces.trial(right.state, right.points, review.pieces.splats_of(right), 1.0, [])
        taken = KDTree(other.points_in(1 - right.state))
        free = whole.brought(right.hypothesis.motion)
        kept = replace(whole, own=KDTree(one.points), taken=taken).brought(right.hypothesis.motion)
        back = right.hypothesis.motion.inverse().apply(kept.means.double())
        assert 0 < len(kept) < len(free)
        assert float(back[:, 0].max()) < 2 * review.pieces.voxel
        assert float(right.hypothesis.motion.inverse().apply(free.means.double())[:, 0].max()) > 4 * review.pieces.voxel

    def test_a_part_is_taken_from_the_state_that_shows_it_thinner_and_as_clearly(self):
        review, right, _ = self.found()
        box = review.pieces.box(right.points)
        thinnest = int(box.half_extents.argmin())
        aside = 3 * (box.half_extents[thinnest] * box.T_world_box.rotation[:, thinnest]).numpy()
        thick = replace(right, pieces=(np.concatenate([right.points, right.points + aside]),))
        taken = review.at_its_clearest(thick)
        assert taken.state == 1 - right.state
        same = right.hypothesis.motion.inverse().as_matrix()
        torch.testing.assert_close(taken.hypothesis.motion.as_matrix(), same, atol=1e-12, rtol=0)
        clearer = replace(thick, weight=2 * taken.weight)
        assert review.at_its_clearest(clearer) is clearer

    def test_a_part_takes_what_moves_along_from_one_that_moves_wrongly(self):
        review, right, wrong = self.found()
        points = right.points
        left = points[:, 0] < 0.3
        taker, giver = (
            replace(right, pieces=(points[left],)),
            replace(wrong, pieces=(points[~left],), weight=0.5 * right.weight),
        )
        (whole,) = review.exchanged([giver, taker])
        assert whole.hypothesis is right.hypothesis
        assert len(whole.points) == len(points)
        rightly = replace(giver, hypothesis=right.hypothesis)
        assert [len(part.points) for part in review.exchanged([taker, rightly])] == [left.sum(), (~left).sum()]
        unseen = replace(taker, weight=100 * right.weight)  # so heavy that what the other state shows of it is nothing
        assert [len(part.points) for part in review.exchanged([unseen, giver])] == [left.sum(), (~left).sum()]

    def test_what_of_a_part_goes_another_s_way_is_handed_over_though_that_lies_a_little_off(self):
        """Half of the screen is taken for the base's, and the other half turns too little for the exchange to tell."""
        review, right, wrong = self.found()
        points, base = right.points, review.pieces.looks[right.state].points
        left = points[:, 0] < 0
        base = base[KDTree(points).query(base)[0] > 3 * review.pieces.voxel]
        turn, q = screw_at(right.hypothesis.motion, "revolute", torch.zeros(3, dtype=F64))
        less = replace(right.hypothesis, motion=turn.motion(0.75 * q))
        like = replace(right, pieces=(points[left],), hypothesis=less)
        part = replace(wrong, pieces=(points[~left], base), weight=0.5 * right.weight)
        assert [len(one.points) for one in review.exchanged([like, part])] == [left.sum(), (~left).sum() + len(base)]
        handed = review._handed_over(part, like, right.hypothesis, [like, part])
        assert handed is not None
        assert [len(one.points) for one in handed] == pytest.approx([len(points), len(base)], abs=0.1 * len(points))
        assert handed[0].hypothesis is less, "where it lies is asked again"
        whole = replace(part, pieces=(points[~left],))
        assert review._handed_over(whole, like, right.hypothesis, [like, whole]) is None, "nothing would be left of it"
        elsewhere = replace(part, state=1 - part.state)
        assert review._handed_over(elsewhere, like, right.hypothesis, [like, elsewhere]) is None

    @pytest.mark.parametrize("continues", [True, False])
    def test_a_piece_that_the_other_state_does_not_show_is_one_only_with_what_it_continues(
        self, continues: bool, monkeypatch: pytest.MonkeyPatch
    ):
        review, right, _ = self.found()
        left = right.points[:, 0] < 0.5
        heavy = 100 * right.weight  # so heavy that what the other state shows of it is nothing
        pieces = [replace(right, pieces=(right.points[side],), weight=heavy * n) for side, n in ((left, 2), (~left, 1))]
        monkeypatch.setattr(review, "_continues", lambda *_: continues)
        assert len(review.joined(pieces)) == (1 if continues else 2)

    @pytest.mark.parametrize(("times", "count"), [(1, 1), (100, 2)])
    def test_what_does_not_show_is_not_carried_off_by_a_lesser_piece(
        self, times: int, count: int, monkeypatch: pytest.MonkeyPatch
    ):
        """As a tray by a scrap of its door; of what is a hundred times as heavy the other state shows as good as nothing."""
        review, right, wrong = self.found()
        left = right.points[:, 0] < 0.5
        large = replace(wrong, pieces=(right.points[left],), weight=times * right.weight)
        small = replace(right, pieces=(right.points[~left],), weight=0.1 * right.weight)
        monkeypatch.setattr(review, "_continues", lambda *_: False)
        assert len(review.joined([large, small])) == count

    @pytest.mark.parametrize(("explains", "count"), [(0.4, 1), (0.6, 2)])
    def test_a_piece_that_explains_little_moves_as_what_it_continues(
        self, explains: float, count: int, monkeypatch: pytest.MonkeyPatch
    ):
        review, right, wrong = self.found()
        left = right.points[:, 0] < 0.5
        heavy = 100 * right.weight  # so heavy that what the other state shows of it is nothing
        plain = replace(right.hypothesis, outside=0.0, unexplained=0.0, oddity=0.0)
        small = replace(right, pieces=(right.points[~left],), hypothesis=plain, weight=heavy, rivals=())
        large = replace(wrong, pieces=(right.points[left],), weight=2 * heavy, rivals=())
        monkeypatch.setattr(review.pieces, "pulled", lambda start, *_: start)
        monkeypatch.setattr(Trial, "explained", lambda *_: explains * heavy)
        parts = review._reconsider([large, small])
        assert len(parts) == count
        assert parts[0].hypothesis.motion is large.hypothesis.motion

    def test_a_small_piece_that_does_not_show_agrees_with_the_part_beside_it_within_what_photos_tell(self):
        """A corner of the screen moves 1.2 voxels otherwise: seen, or far off, or heavier it has a way of its own."""
        review, right, _ = self.found()
        far = np.linalg.norm(right.points - right.points[right.points[:, 0].argmax()], axis=1)
        small, large = (replace(right, pieces=(right.points[side],)) for side in (far < 0.15, far >= 0.15))
        small = replace(small, weight=0.1 * right.weight)
        size = float(review.pieces.box(small.points).half_extents.norm())
        assert 1.2 * review.pieces.voxel > review.config.same * size / 2
        voxel = np.array([review.pieces.voxel / size])  # between motions, over the half diagonal
        assert review._agree(small, [large], 1.2 * voxel, False).all()
        assert not review._agree(small, [large], 1.8 * voxel, False).any()
        assert not review._agree(small, [large], 1.2 * voxel, True).any()
        assert not review._agree(replace(small, weight=2 * right.weight), [large], 1.2 * voxel, False).any()
        away = replace(large, pieces=(large.points - np.array([0.5, 0.0, 0.0]),))
        assert not review._agree(small, [away], 1.2 * voxel, False).any()
        assert review._agree(small, [large, away], np.array([0.05, 0.01]), True).all()
        assert not review._agree(small, [away], np.array([0.05]), True).any()


class TestDivide:
    """Two boards side by side, the left of which would rather go .6 of the way."""

    @staticmethod
    def boards() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points, centres of splats, and which of both are the left board's."""
        generator = np.random.default_rng(0)
        points, means = (generator.uniform([-1, -0.02, 0], [1, 0.02, 1], (n, 3)) for n in (3000, 400))
        return points, means, means[:, 0] < 0

    @staticmethod
    def support(means: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        """Highest at each splat's own factor, and noise."""
        factors = np.array(FACTORS)[:, None]
        return 1 - 5 * np.abs(factors - wanted) + 0.2 * np.random.default_rng(1).standard_normal((len(factors), len(means)))

    def pieces(self, left: float, *, least: float = 0.0) -> list[np.ndarray]:
        points, means, is_left = self.boards()
        support = self.support(means, np.where(is_left, left, 1.0))
        return divide(points, means, support, 1.6, least, CueConfig(), voxel=0.05)

    def test_boards_that_want_different_ways_are_parted_where_they_meet(self):
        pieces = self.pieces(0.6)
        assert len(pieces) == 2
        assert sum(map(len, pieces)) == 3000
        for piece, side in zip(sorted(pieces, key=lambda p: p[:, 0].mean()), (-1, 1), strict=True):
            assert (side * piece[:, 0] > -0.1).all()
            assert abs(len(piece) - 1500) < 150

    def test_what_hardly_minds_either_way_is_not_taken_for_a_part_because_it_is_large(self):
        """A fifth on the left says loudly where to go; the half on the right thinks the same, but hardly minds."""
        points, means, _ = self.boards()
        left, hardly = means[:, 0] < -0.6, means[:, 0] > 0
        loud = np.where(left, 3.0, np.where(hardly, 0.1, 1.0))
        support = loud * self.support(means, np.where(left | hardly, 0.6, 1.0)) + np.where(hardly, 0.4, 0.0)
        pieces = divide(points, means, support, 1.2, 0.0, CueConfig(), voxel=0.05)
        ends = sorted((piece[:, 0].min(), piece[:, 0].max()) for piece in pieces)
        np.testing.assert_allclose(ends, [(-1, -0.5), (-0.5, 1)], atol=0.1)

    def test_one_way_is_one_part(self):
        (piece,) = self.pieces(1.0)
        assert len(piece) == 3000

    def test_too_little_to_gain_is_one_part(self):
        assert len(self.pieces(0.6, least=1e3)) == 1

    def test_what_no_factor_suits_is_left_whole(self):
        points, means, _ = self.boards()
        assert len(divide(points, means, np.full((len(FACTORS), len(means)), -1.0), 1.6, 0.0, CueConfig(), voxel=0.05)) == 1


class TestUndivided:
    """Cluster 3 stood for one part and was divided into 5 and 6, and 6 into 7 and 8."""

    @staticmethod
    def clusters(whole: float, five: float, seven: float, eight: float, six: float = 0.4, elsewhere: int = -1) -> set[int]:
        """Which clusters stand for a part in the end, given what each explained; 2 is another part."""
        part = MovingPart(
            0, (np.zeros((1, 3)),), Hypothesis(SE3.identity(dtype=F64), outside=0.0, unexplained=0.0, oddity=0.0), 0.1, 1.0, ()
        )
        found = {2: Found(part, 0.1), 5: Found(part, five), 7: Found(part, seven), 8: Found(part, eight)}
        divisions = [Division(3, Found(part, whole), [5, 6]), Division(6, Found(part, six), [7, 8])]
        return set(undivided({i: one for i, one in found.items() if one.worth}, divisions, {elsewhere}))

    def test_pieces_that_explain_more_than_the_whole_stay(self):
        assert self.clusters(whole=0.8, five=0.4, seven=0.3, eight=0.2) == {2, 5, 7, 8}

    def test_a_whole_that_explained_more_than_its_pieces_is_one_part_again(self):
        assert self.clusters(whole=1.0, five=0.4, seven=0.3, eight=0.2) == {2, 5, 7, 8}, "hardly more"
        assert self.clusters(whole=1.2, five=0.4, seven=0.3, eight=0.2) == {2, 3}

    def test_a_piece_may_be_whole_again_by_itself(self):
        assert self.clusters(whole=0.7, five=0.4, seven=0.1, eight=0.2) == {2, 5, 6}

    def test_of_a_piece_that_became_no_part_nothing_counts(self):
        assert self.clusters(whole=0.7, five=0.0, seven=0.3, eight=0.2) == {2, 3}

    def test_a_piece_that_belongs_to_another_part_keeps_its_cluster_divided(self):
        assert self.clusters(whole=0.7, five=0.0, seven=0.3, eight=0.2, elsewhere=5) == {2, 7, 8}


def test_what_waits_is_not_given_up_for_a_part_that_explains_less():
    waiting = {2: 0.005, 3: 0.001, 4: 0.007, 5: 0.009}
    assert worth_more(waiting, {2, 3, 4}, 0.002) == 4
    assert worth_more(waiting, {2, 3, 6}, 0.002) == 2
    assert worth_more(waiting, {3, 6}, 0.002) is None
    assert worth_more(waiting, {2, 3, 4}, 0.008) is None
    assert worth_more({}, {2}, 0.0) is None


class TestCutAcross:
    """Three drawers side by side, shut in the other state; the outer ones come out .6 and .8 as far as the middle one."""

    WIDTHS = (-1.0, -0.4, 0.5, 1.0)
    BOX = Box(
        SE3.from_quat(torch.tensor([1.0, 0, 0, 0], dtype=F64), torch.zeros(3, dtype=F64)),
        torch.tensor([2.0, 0.3, 0.1], dtype=F64),
    )

    def pieces(self, factors: tuple[float, float, float], kind: str = "prismatic", voxel: float = 0.02) -> list[np.ndarray]:
        generator = np.random.default_rng(0)
        points = generator.uniform(-1, 1, (2000, 3)) * self.BOX.half_extents.numpy()
        fronts = generator.uniform(-1, 1, (600, 3))
        wanted = np.array(factors)[np.digitize(fronts[:, 0], self.WIDTHS[1:3])]
        tried = np.array(FACTORS)[:, None]
        # The farther out up to the right place, the more of the drawer is covered; beyond it the front hides the rest.
        support = np.where(tried <= wanted, tried, 2 * wanted - tried - 0.3) + 0.1 * generator.standard_normal(
            (len(tried), 600)
        )
        along = Screw(kind, torch.tensor([0.0, 1, 0], dtype=F64), torch.zeros(3, dtype=F64))  # pyright: ignore[reportArgumentType]
        return [points[within] for within, _ in cut_across(points, self.BOX, fronts, support, along, voxel, 1.13, 1.04)]

    def test_drawers_that_come_out_differently_are_cut_where_they_meet(self):
        pieces = sorted(self.pieces((0.6, 1.0, 0.8)), key=lambda piece: piece[:, 0].mean())
        assert [len(piece) for piece in pieces] == pytest.approx([600, 900, 500], abs=60)
        ends = [(piece[:, 0].min() / 2, piece[:, 0].max() / 2) for piece in pieces]
        np.testing.assert_allclose(ends, list(zip(self.WIDTHS, self.WIDTHS[1:], strict=False)), atol=0.03)

    def test_one_that_comes_out_as_a_whole_is_left_whole(self):
        (piece,) = self.pieces((1.0, 1.0, 1.0))
        assert len(piece) == 2000

    def test_nothing_is_cut_that_is_hardly_wider_than_the_clusters_are_sharp(self):
        assert len(self.pieces((0.6, 1.0, 0.8), voxel=0.4)) == 3
        assert len(self.pieces((0.6, 1.0, 0.8), voxel=0.6)) == 1

    def test_nothing_is_cut_where_the_motion_carries_it(self):
        (piece,) = self.pieces((0.6, 1.0, 0.8), kind="revolute")
        assert len(piece) == 2000, "the boards lie beside each other across the axis, not along it"


class TestMovingAlong:
    """A panel and a tray that hang together; the panel moves along with a door, whose photos show nothing of the tray."""

    @staticmethod
    def belongs(peak: float, so_far: float = 0.0, door: tuple[float, float] = (-1, 0)) -> tuple[np.ndarray, np.ndarray]:
        """What is said to move along, and what is the panel; the door lies above, between two places along x."""
        generator = np.random.default_rng(0)
        points, means = (generator.uniform([-1, -0.02, 0], [1, 0.02, 1], (n, 3)) for n in (3000, 600))
        panel = means[:, 0] < 0
        shown = 1 - 2 * np.abs(np.array(AROUND)[:, None] - peak)
        support = np.where(panel, 0.4 * shown, 0.0) + 0.05 * generator.standard_normal((len(AROUND), 600))
        before = np.full(600, so_far)
        low, high = door
        part = generator.uniform([low, -0.02, 1], [high, 0.02, 2], (2000, 3))
        return moving_along(part, points, means, support, before, np.ones(600), CueConfig(), voxel=0.05), points[:, 0] < 0

    def test_the_panel_belongs_to_the_door_and_the_tray_does_not(self):
        found, panel = self.belongs(1.0)
        assert (found == panel).mean() > 0.93

    def test_what_goes_further_or_less_far_belongs_to_another(self):
        for peak in (0.8, 1.2):
            assert not self.belongs(peak)[0].any()

    def test_what_is_explained_as_well_already_stays(self):
        assert not self.belongs(1.0, so_far=0.38)[0].any()

    def test_what_no_box_holds_with_the_door_belongs_to_another(self):
        """As next to a hinge that two doors share."""
        assert self.belongs(1.0, door=(-1.2, 0.2))[0].any()
        assert not self.belongs(1.0, door=(-6, 0))[0].any()


def pieces_in_full_hulls(points: np.ndarray) -> Pieces:
    """Of two states that show the same points, in hulls that hold everything within 3 units; voxels are .1 units."""
    first, second = (
        replace(
            look,
            points=points,
            hull=replace(look.hull, occupied=np.ones((60, 60, 60), bool), origin=np.full(3, -3.0), voxel=0.1),
        )
        for look in looks_of("laptop")[1]
    )
    return Pieces((first, second), SMALL.search, seed=0)


class TestBoxesOfParts:
    @pytest.mark.parametrize("name", ["laptop", "drawer"])
    def test_hold_the_parts_in_state_0(self, name: str):
        obj, looks = looks_of(name)
        boxes, motions = boxes_of_parts(search_of(name)[0].pieces, parts_of(name), SMALL)
        assert boxes.half_extents.shape == (2, 3)
        assert motions.wxyz_xyz[0].tolist() == [1, 0, 0, 0, 0, 0, 0]
        assert boxes.half_extents.dtype == motions.wxyz_xyz.dtype == torch.float32
        voxel = looks[0].hull.voxel
        front = obj.parts[1].boxes[0].box.corners.float()
        assert boxes[1].contains(front, margin=2 * voxel).all()
        still = torch.cat([item.box.corners for item in obj.parts[0].boxes]).float()
        assert boxes[0].contains(still, margin=2 * voxel).all()

    @pytest.mark.parametrize(("gap", "left_out"), [(0.2, True), (0.4, False)])
    def test_the_base_s_box_need_not_hold_what_is_beside_a_hinge(
        self, gap: float, left_out: bool, monkeypatch: pytest.MonkeyPatch
    ):
        """A door from x = 0 to 1, its hinge and the base from x = -gap on; between the two what both hulls hold."""
        g = np.random.default_rng(0)
        base, strip, door = (
            g.uniform([low, -0.02 - deep, 0], [high, 0.02, 0.8], (2000, 3))
            for low, high, deep in ((-2 - gap, -gap, 0.7), (-gap, 0, 0), (0, 1, 0))
        )
        pieces = pieces_in_full_hulls(np.concatenate([base, strip]))
        hinge = Screw("revolute", torch.tensor([0.0, 0, 1]).double(), torch.tensor([-gap, 0.0, 0]).double())
        found = MovingPart(0, (door,), Hypothesis(hinge.motion(1.0), 0.0, 0.0, 0.0), 0.5, 0.1)
        monkeypatch.setattr(pieces, "is_surface", lambda *_: False)
        boxes, _ = boxes_of_parts(pieces, [found], SMALL)
        by = SMALL.margin * 0.1
        assert float(boxes[0].corners[:, 0].max()) == pytest.approx((-gap if left_out else 0.0) + by, abs=0.08)
        assert float(boxes[1].corners[:, 0].min()) == pytest.approx(-by, abs=0.05), "the door's own box stays as it is"

    @pytest.mark.parametrize("surface", [True, False])
    def test_what_a_part_covers_in_one_state_alone_is_the_base_s_if_it_is_a_surface(
        self, surface: bool, monkeypatch: pytest.MonkeyPatch
    ):
        """Two blades, one upon the other in state 0, a quarter of a turn about z apart in state 1."""
        g = np.random.default_rng(0)
        grip, below, upon = (
            g.uniform([low, -0.1, z], [high, 0.1, z + 0.1], (3000, 3)) for low, high, z in ((-1, 0, 0), (0.3, 2, 0), (0, 2, 0))
        )
        pieces = pieces_in_full_hulls(np.concatenate([grip, below]))
        pin = Screw("revolute", torch.tensor([0.0, 0, 1]).double(), torch.zeros(3).double())
        found = MovingPart(0, (upon,), Hypothesis(pin.motion(0.5 * math.pi), 0.0, 0.0, 0.0), 0.5, 0.1)
        monkeypatch.setattr(pieces, "is_surface", lambda _, state: surface and state == 1)
        boxes, _ = boxes_of_parts(pieces, [found], SMALL)
        by = SMALL.margin * 0.1
        reach = float(boxes[0].corners[:, 0].max())
        assert reach == pytest.approx(2.0 + by, abs=0.05) if surface else reach < 0.3

    def test_what_hangs_in_the_air_is_no_surface(self):
        pieces, (screen,) = search_of("laptop")[0].pieces, parts_of("laptop")
        assert pieces.is_surface(screen.points, screen.state)
        assert not pieces.is_surface(screen.points + 5.0, screen.state)

    def test_what_few_masks_leave_in_the_air_is_not_the_base_s(self):
        _, looks = looks_of("laptop")
        clean = boxes_of_parts(search_of("laptop")[0].pieces, parts_of("laptop"), SMALL)[0]
        haunted = []
        for look in looks:
            occupied = look.hull.occupied.copy()
            occupied[:6, :6, -6:] = True  # a corner of the grid, far from the laptop
            haunted.append(replace(look, hull=replace(look.hull, occupied=occupied)))
        pieces = Pieces((haunted[0], haunted[1]), SMALL.search, seed=0)
        found = boxes_of_parts(pieces, parts_of("laptop"), SMALL)[0]
        torch.testing.assert_close(found.half_extents, clean.half_extents)

    def test_splats_on_trial_are_strewn_evenly_in_and_around_them(self):
        """What sticks out of a box by less than the reach, such as a handle, has some near it: half extents grow by it."""
        boxes = boxes_of_parts(search_of("laptop")[0].pieces, parts_of("laptop"), SMALL)[0]
        generator = torch.Generator().manual_seed(0)
        faint = strewn(boxes, SE3.identity(2), 4000, 0, generator, torch.ones(3), reach=0.2).splats
        local = faint.means.reshape(2, -1, 3) * boxes.half_extents[:, None]
        reach = boxes.half_extents + 0.2
        assert (local.abs() <= reach[:, None] + 1e-6).all()
        torch.testing.assert_close(local.std(1) * math.sqrt(3), reach, atol=0, rtol=0.03)

    def test_at_rest_nothing_moves_yet(self):
        obj, looks = looks_of("laptop")
        boxes, motions = boxes_at_rest(looks, 1, SMALL)
        torch.testing.assert_close(motions.wxyz_xyz, SE3.identity(2).wxyz_xyz)
        corners = obj.parts[1].boxes[0].box.corners.float()
        assert boxes[1].contains(corners, margin=2 * looks[0].hull.voxel).all()

    def test_at_rest_a_shut_drawer_is_taken_from_where_it_arrived(self):
        _, looks = looks_of("drawer")
        boxes, _ = boxes_at_rest(looks, None, SMALL)
        assert len(boxes.half_extents) == 2


def test_a_survey_of_the_same_seed_is_the_same():
    capture = make_capture(make_object("slider"), RenderOptions(size=64, views=6, test_views=1, samples=1))
    quick = replace(SMALL, appearance=replace(SMALL.appearance, steps=20, size=48), voxels=32)
    first, again, other = (survey(capture, None, quick, seed=seed) for seed in (1, 1, 2))
    assert torch.equal(first[0].splats.means, again[0].splats.means)
    assert np.array_equal(first[1].points, again[1].points)
    assert not torch.equal(first[0].splats.means[:100], other[0].splats.means[:100])
