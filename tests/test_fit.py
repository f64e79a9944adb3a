import hashlib
import json
import math
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
import torch
from torch import Tensor

from door_and_drawer import DOOR, DRAWER, made_of, photographed
from structuregs.capture import stack_views
from structuregs.export import part_meshes
from structuregs.fit.boxes import base_tightened, drawn_in, drawn_out, squared_up, tightened
from structuregs.fit.densify import ScreenGradients, grow
from structuregs.fit.events import Note
from structuregs.fit.laying import BothStates
from structuregs.fit.loop import Fitter
from structuregs.fit.merge import idle_part, moving_alike
from structuregs.fit.reconstruct import choose_device, finished_object
from structuregs.fit.run import RunFolder
from structuregs.fit.schedule import PRESETS, FitConfig, Growth, Rates
from structuregs.fit.state import FitState
from structuregs.fit.straight import askew, held_along_base, lie_along_base, straight_where_loose
from structuregs.fit.variables import SPLAT_NAMES, Variables, part_index
from structuregs.geometry import SE3, Box, JointKind, Screw, quat_to_matrix
from structuregs.joints import articulate, constrain
from structuregs.model import ArticulatedObject, PosedParts, Splats
from structuregs.raster import render

DOOR_AND_DRAWER = made_of(DOOR.motion(), DRAWER.motion()).parts


def turned_parts() -> PosedParts:
    """The door and the drawer with boxes turned every way."""
    pose = SE3.exp(torch.tensor([[0.0, 0, 0, 0.3, -0.2, 0.5], [0.5, 0.1, 0.2, 1.0, 0.4, -0.3], [-0.2, 0, 0.3, -0.8, 1.1, 0.2]]))
    return replace(DOOR_AND_DRAWER, boxes=Box(pose, DOOR_AND_DRAWER.boxes.half_extents))


def stretched(by: float) -> PosedParts:
    """The same, all splats opaque, the door's spread evenly along its box and that much farther."""
    parts = turned_parts()
    means = parts.splats.means.clone()
    means[parts.part == 1, 0] = torch.linspace(-by, by, parts.counts[1])
    return replace(parts, splats=replace(parts.splats, means=means, logit_opacities=torch.full_like(means[:, 0], 3.0)))


def same_motion(a: SE3, b: SE3, atol: float = 2e-6) -> None:
    torch.testing.assert_close(a.as_matrix().double(), b.as_matrix().double(), atol=atol, rtol=0)


def same_splats(a: Splats, b: Splats) -> None:
    """The same Gaussians: quaternions of one rotation may differ in sign."""
    for name in ("means", "log_scales", "logit_opacities", "sh"):
        torch.testing.assert_close(getattr(a, name), getattr(b, name), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(quat_to_matrix(a.quats), quat_to_matrix(b.quats), atol=1e-5, rtol=0)


class TestVariables:
    def test_give_back_the_parts_they_were_made_of(self):
        parts = turned_parts()
        again = Variables.of(parts).parts()
        same_motion(again.motions, parts.motions)
        same_motion(again.boxes.T_world_box, parts.boxes.T_world_box)
        torch.testing.assert_close(again.boxes.half_extents, parts.boxes.half_extents)
        same_splats(again.splats, parts.splats)
        torch.testing.assert_close(again.tint, parts.tint)
        assert again.counts == parts.counts

    def test_changing_a_leaf_changes_no_part_they_were_made_of(self):
        parts = turned_parts()
        before = parts.splats.means.clone()
        with torch.no_grad():
            Variables.of(parts).leaves["means"].add_(1.0)
        torch.testing.assert_close(parts.splats.means, before)

    def test_a_free_rotation_turns_about_the_part_where_it_has_come_to(self):
        parts = turned_parts()
        variables = Variables.of(parts)
        arrived = parts.motions.apply(parts.boxes.T_world_box.xyz)
        rows = torch.tensor([[0.0] * 6, [0.0, 0, 0, 0.3, 0.1, -0.2], [0.1, -0.2, 0.05, 0.0, 0, 0]])
        with torch.no_grad():
            variables.leaves["motions"].copy_(rows)
        moved = variables.motions()
        landed = moved.apply(parts.boxes.T_world_box.xyz)
        torch.testing.assert_close(landed, arrived + rows[:, :3], atol=1e-6, rtol=0)
        turn = moved @ parts.motions.inverse()
        torch.testing.assert_close(turn.log()[:, 3:], rows[:, 3:], atol=1e-5, rtol=0)

    @pytest.mark.parametrize("held", [False, True])
    def test_the_base_stands_still_whatever_its_row_says(self, held: bool):
        variables = Variables.of(turned_parts())
        if held:
            variables.hold(["revolute", "prismatic"])
        with torch.no_grad():
            variables.leaves["motions"][0] = 1.0
        same_motion(variables.motions()[0], SE3.identity(), atol=0)

    def test_holding_keeps_motions_of_one_degree_of_freedom(self):
        g = torch.Generator().manual_seed(3)
        for _ in range(5):
            axes = torch.nn.functional.normalize(torch.randn(2, 3, generator=g, dtype=torch.float64), dim=-1)
            hinge = Screw("revolute", axes[0], torch.randn(3, generator=g, dtype=torch.float64)).motion(1.1)
            slide = Screw("prismatic", axes[1], torch.zeros(3, dtype=torch.float64)).motion(0.4)
            variables = Variables.of(replace(turned_parts(), motions=made_of(hinge, slide).parts.motions))
            before = variables.motions()
            variables.hold(["revolute", "prismatic"])
            same_motion(variables.motions(), before, atol=5e-6)
            assert variables.kinds == ("revolute", "prismatic")

    def test_holding_another_motion_takes_the_closest_screw_at_the_part(self):
        parts = turned_parts()
        mixed = SE3.exp(torch.tensor([[0.0] * 6, [0.2, 0.1, 0.3, 0.5, 0.2, 0.1], [0.4, 0.1, 0.0, 0.02, 0.01, 0.03]]))
        variables = Variables.of(replace(parts, motions=mixed))
        variables.hold(["revolute", "prismatic"])
        for k, kind in ((1, "revolute"), (2, "prismatic")):
            same_motion(variables.motions()[k], constrain(mixed[k], kind, parts.boxes.T_world_box.xyz[k]), atol=5e-6)

    def test_a_held_motion_stays_one_screw_for_any_values(self):
        variables = Variables.of(turned_parts())
        variables.hold(["revolute", "prismatic"])
        rows = torch.randn(3, 6, generator=torch.Generator().manual_seed(0))
        with torch.no_grad():
            variables.leaves["motions"].copy_(rows)
        motions = variables.motions()
        torch.testing.assert_close(motions[1].apply(rows[1, 3:]), rows[1, 3:], atol=1e-5, rtol=0)
        torch.testing.assert_close(motions[1].log()[3:], rows[1, :3], atol=1e-5, rtol=0)
        same_motion(motions[2], SE3.from_quat(torch.tensor([1.0, 0, 0, 0]), rows[2, :3]))

    @pytest.mark.parametrize("held", [False, True])
    def test_gradients_reach_every_leaf_that_moves_the_picture(self, held: bool):
        variables = Variables.of(turned_parts())
        if held:
            variables.hold(["revolute", "prismatic"])
        splats = variables.parts().at_state(1)
        sum((value.square().sum() for value in splats.tensors().values()), torch.zeros(())).backward()
        for name, leaf in variables.leaves.items():
            assert leaf.grad is not None, name
            assert leaf.grad.abs().sum() > 0, name

    @pytest.mark.parametrize("share", [0.5, 0.8])
    def test_a_part_gives_way_in_state_0_to_what_its_motion_changes_by(self, share: float):
        parts = turned_parts()
        variables = Variables.of(parts, share)
        rows = 0.1 * torch.randn(3, 6, generator=torch.Generator().manual_seed(1))
        with torch.no_grad():
            variables.leaves["motions"].copy_(rows)
        after = variables.parts().detach()
        for k in range(3):
            before = parts.motions[k].as_matrix().double()
            change = scipy.linalg.logm((torch.linalg.inv(before) @ after.motions[k].as_matrix().double()).numpy())
            gone_back = torch.from_numpy(scipy.linalg.expm(-share * np.real(change))).float()
            expected = gone_back @ parts.boxes.T_world_box[k].as_matrix()
            torch.testing.assert_close(after.boxes.T_world_box[k].as_matrix(), expected, atol=2e-5, rtol=0)
        torch.testing.assert_close(after.boxes.half_extents, parts.boxes.half_extents)

    @pytest.mark.parametrize("share", [0.0, 0.5])
    def test_boxes_are_where_they_are_set_and_stay_there_when_motions_are_held(self, share: float):
        parts = turned_parts()
        variables = Variables.of(parts, share)
        with torch.no_grad():
            variables.leaves["motions"].copy_(0.1 * torch.randn(3, 6, generator=torch.Generator().manual_seed(2)))
        other = Box(SE3.exp(torch.randn(3, 6, generator=torch.Generator().manual_seed(3))), parts.boxes.half_extents * 1.5)
        variables.set_boxes(other)
        same_motion(variables.parts().boxes.T_world_box, other.T_world_box, atol=1e-5)
        torch.testing.assert_close(variables.parts().boxes.half_extents, other.half_extents)
        variables.hold(["revolute", "prismatic"])
        same_motion(variables.parts().boxes.T_world_box, other.T_world_box, atol=1e-5)

    def test_an_object_without_joints_can_be_held(self):
        variables = Variables.of(made_of().parts)
        variables.hold([])
        same_motion(variables.motions(), SE3.identity(1), atol=0)

    @pytest.mark.parametrize("kinds", [None, ("revolute", "prismatic")])
    def test_a_motion_can_be_set(self, kinds: tuple[JointKind, JointKind] | None):
        variables = Variables.of(turned_parts(), give_way=0.5)
        if kinds:
            variables.hold(kinds)
        others = variables.motions().wxyz_xyz.detach().clone()[[0, 2]]
        turn = Screw("revolute", torch.tensor([0.6, 0.0, 0.8]).double(), torch.tensor([0.3, -0.2, 0.1]).double()).motion(0.7)
        variables.set_motions({1: turn})
        same_motion(variables.motions()[1], turn)
        torch.testing.assert_close(variables.motions().wxyz_xyz[[0, 2]], others, atol=0, rtol=0)


def gradients_of(count: int, strong: Tensor) -> ScreenGradients:
    """Three images seen by all, with mean gradients of 1 for the splats in `strong` and none for others."""
    gradients = ScreenGradients.zeros(count)
    gradients.total[strong] = 3.0
    gradients.seen += 3
    return gradients


class TestDensification:
    growth = Growth(gradient=0.5, small=0.1, most=10_000, faint=0.01, reach=0.2)
    size = 1.0

    def grown(self, variables: Variables, strong: Tensor | None, growth: Growth | None = None, seed: int = 0):
        gradients = None if strong is None else gradients_of(sum(variables.counts), strong)
        return grow(variables, gradients, growth or self.growth, self.size, torch.Generator().manual_seed(seed))

    def variables(self, large: slice | Tensor) -> Variables:
        """360 small splats (0.05) in three parts; those that `large` selects are 0.2 by 0.3 by 0.4."""
        variables = Variables.of(turned_parts())
        with torch.no_grad():
            variables.leaves["log_scales"][large] = torch.tensor([0.2, 0.3, 0.4]).log()
        return variables

    def test_pruning_takes_what_faded_and_what_went_far_from_its_box(self):
        variables = self.variables(slice(0, 0))
        half = variables.leaves["log_half_extents"].exp()
        with torch.no_grad():
            variables.leaves["logit_opacities"][[0, 130]] = math.log(0.009 / 0.991)
            variables.leaves["logit_opacities"][1] = math.log(0.011 / 0.989)
            for part, splat in enumerate((2, 140, 350)):
                variables.leaves["means"][splat, 1] = -1 - 0.21 / half[part, 1]
            variables.leaves["means"][3] = (1 + 0.19 / half[0]) * torch.tensor([1, -1, 1])
        after, source, fresh = self.grown(variables, None)
        assert sorted(source.tolist()) == [i for i in range(360) if i not in (0, 2, 130, 140, 350)]
        assert after.counts == (118, 118, 119)
        assert not fresh.any()
        for name in SPLAT_NAMES:
            torch.testing.assert_close(after.leaves[name], variables.leaves[name][source])

    def test_pruning_takes_what_sticks_out_of_the_base_into_a_moving_box(self):
        """The door's box reaches from (.2, -.1, .1) to (1, .1, .5), the base's to .5 on all sides."""
        variables = Variables.of(DOOR_AND_DRAWER)
        with torch.no_grad():
            variables.leaves["means"].clamp_(-0.9, 0.9)
            places = torch.tensor([[0.55, 0, 0.3], [0.45, 0, 0.3], [0.55, 0, -0.2], [0.55, 0.115, 0.3], [0.55, 0.13, 0.3]])
            variables.leaves["means"][:5] = places / 0.5
            variables.leaves["means"][120] = torch.tensor([1.1, 0, 0])
        _, source, _ = self.grown(variables, None)
        assert sorted(set(range(360)) - set(source.tolist())) == [0, 3]

    def test_what_no_photo_shows_goes(self):
        shown = torch.arange(360) % 5 > 0
        after, source, _ = grow(self.variables(slice(0, 0)), None, self.growth, self.size, torch.Generator(), shown)
        assert sorted(source.tolist()) == shown.nonzero()[:, 0].tolist()
        assert after.counts == (96, 96, 96)

    def test_small_splats_are_cloned_and_large_ones_split(self):
        large = torch.zeros(360, dtype=torch.bool)
        large[100:140] = True
        strong = torch.arange(360) % 4 == 0
        variables = self.variables(large)
        after, source, fresh = self.grown(variables, strong)
        clones, splits = strong & ~large, strong & large
        per_part = [int((clones | splits)[120 * k : 120 * k + 120].sum()) for k in range(3)]
        assert after.counts == tuple(120 + n for n in per_part), "a clone adds one; two halves take one splat's place"
        assert int(fresh.sum()) == int(clones.sum()) + 2 * int(splits.sum())
        times = torch.bincount(source, minlength=360)
        torch.testing.assert_close(times, 1 + strong.long())
        assert sorted(source[fresh].tolist()) == sorted(
            [*clones.nonzero()[:, 0].tolist(), *2 * splits.nonzero()[:, 0].tolist()]
        )

    def test_children_stay_in_the_part_of_their_parent(self):
        after, source, _ = self.grown(self.variables(slice(60, 200)), torch.ones(360, dtype=torch.bool))
        part = part_index(after.counts, torch.device("cpu"))
        torch.testing.assert_close(part, part_index((120, 120, 120), torch.device("cpu"))[source])
        assert (part.diff() >= 0).all()
        assert {len(after.leaves[name]) for name in SPLAT_NAMES} == {sum(after.counts)}

    def test_clones_are_their_parents_and_halves_are_smaller(self):
        variables = self.variables(slice(200, 260))
        after, source, fresh = self.grown(variables, torch.ones(360, dtype=torch.bool))
        half = fresh & (source >= 200) & (source < 260)
        for name in SPLAT_NAMES:
            same = ~half if name in ("means", "log_scales") else torch.ones_like(half)
            torch.testing.assert_close(after.leaves[name][same], variables.leaves[name][source][same])
        expected = torch.tensor([0.2, 0.3, 0.4]) / 1.6
        torch.testing.assert_close(after.leaves["log_scales"][half].exp(), expected.expand(120, 3))

    def test_halves_are_strewn_as_their_parent_is(self):
        """Standardised by the parent's Gaussian, in the world, the places of the halves are standard normal."""
        parts = turned_parts()
        variables = self.variables(slice(0, 360))
        rows = []
        for seed in range(4):
            after, source, _ = self.grown(variables, torch.ones(360, dtype=torch.bool), seed=seed)
            children, parents = after.parts().at_state(1), variables.parts().at_state(1)[source]
            offset = quat_to_matrix(parents.quats).transpose(1, 2) @ (children.means - parents.means)[..., None]
            rows.append((offset[..., 0] / parents.scales).detach())
        normal = torch.cat(rows)
        assert len(normal) == 4 * 720
        assert len(parts) == 3
        torch.testing.assert_close(normal.mean(0), torch.zeros(3), atol=0.08, rtol=0)
        torch.testing.assert_close(normal.T.cov(), torch.eye(3), atol=0.1, rtol=0)

    def test_there_are_never_more_than_allowed_and_the_strongest_come_first(self):
        gradients = gradients_of(360, torch.ones(360, dtype=torch.bool))
        gradients.total += torch.arange(360)
        growth = replace(self.growth, most=370)
        after, source, fresh = grow(self.variables(slice(0, 0)), gradients, growth, self.size, torch.Generator())
        assert sum(after.counts) == 370
        assert sorted(source[fresh].tolist()) == list(range(350, 360))
        too_many = grow(self.variables(slice(0, 0)), gradients, replace(growth, most=100), self.size, torch.Generator())
        assert sum(too_many[0].counts) == 360

    def test_the_mean_gradient_counts_the_images_that_show_the_splat(self):
        gradients = ScreenGradients(torch.tensor([6.0, 0.0, 5.0]), torch.tensor([3.0, 0.0, 1.0]))
        assert gradients.mean.tolist() == [2.0, 0.0, 5.0]


def fitter(config: FitConfig, parts: PosedParts = DOOR_AND_DRAWER) -> Fitter:
    capture = photographed(made_of(DOOR.motion(), DRAWER.motion()))
    return Fitter(capture, config, FitState.start(parts, config.give_way), 0, torch.device("cpu"))


QUICK = FitConfig(
    steps=40,
    structure_until=4,
    loose_until=2,
    image_from=4,
    structure_size=24,
    sizes=((0.0, 32),),
    checkpoint_every=10,
    join_at=2.0,
    growth=Growth(interval=8, first=0.2, gradient=1e-5, most=500),
)


CONSTANT = Rates(means_final=1.0, motions_final=1.0, poses_final=1.0, appearance_final=1.0)
# The preset without stages in which some rates wait for others.
PLAIN = replace(PRESETS["paper"], image_from=0, structure_size=24, one_joint_from=1.0)


class TestLastStep:
    def test_takes_what_hangs_unseen_behind_the_rest(self):
        """All photos are taken from below: what lies on top of an opaque base is hidden in both states."""
        g = torch.Generator().manual_seed(1)
        floor, hidden = torch.rand(600, 3, generator=g) * 2 - 1, torch.rand(50, 3, generator=g) - 0.5
        floor[:, 2], hidden[:, 2] = -1, 0.9
        base = DOOR_AND_DRAWER.part_splats(0)
        rows = base[torch.zeros(650, dtype=torch.long)]
        splats = replace(rows, means=torch.cat([floor, hidden]), logit_opacities=torch.full((650,), 6.0))
        splats = replace(splats, log_scales=torch.full((650, 3), math.log(0.06)))
        parts = replace(
            DOOR_AND_DRAWER,
            splats=Splats.concatenate([splats, DOOR_AND_DRAWER.splats[torch.arange(120, 360)]]),
            counts=(650, 120, 120),
            tint=torch.zeros(890, 3),
        )
        fit = fitter(
            replace(QUICK, steps=6, image_from=1, structure_until=1, loose_until=1, growth=Growth(interval=100)), parts
        )
        list(fit.run(5))
        assert fit.state.variables.counts[0] == 650
        list(fit.run(6))
        heights = fit.state.variables.parts().part_splats(0).means[:, 2]
        assert (heights > 0).sum() < 5
        assert (heights < 0).sum() > 400
        assert len(fit.state.moments["means"][0]) == sum(fit.state.variables.counts)


def test_the_share_of_ssim_changes_when_its_time_has_come():
    """Two fits whose shares differ from the half on are one until then."""
    always, later = (fitter(replace(QUICK, ssim_weights=((0.0, 0.1), *rest))) for rest in ((), ((0.5, 0.9),)))
    colours = []
    for steps in (20, 21):
        for fit in (always, later):
            list(fit.run(steps))
        colours.append([fit.state.variables.leaves["sh"].detach().clone() for fit in (always, later)])
    assert torch.equal(*colours[0])
    assert not torch.equal(*colours[1])


class TestOptimiser:
    def test_is_adam(self):
        """The same random gradients through `torch.optim.Adam`; a motion's are of one size, so that sharing it is no matter."""
        config = replace(PLAIN, steps=1000, structure_until=1000, rates=CONSTANT)
        fit = fitter(config)
        leaves = fit.state.variables.leaves
        rates = {name: getattr(config.rates, name, config.rates.boxes) for name in leaves}
        mirror = {name: leaf.detach().clone().requires_grad_() for name, leaf in leaves.items()}
        reference = torch.optim.Adam([{"params": [mirror[name]], "lr": rates[name]} for name in leaves], eps=1e-15)
        g = torch.Generator().manual_seed(0)
        for step in range(12):
            fit.state.step = step
            for name, leaf in leaves.items():
                leaf.grad = torch.randn(leaf.shape, generator=g)
                if name == "motions":
                    leaf.grad = leaf.grad.sign() * leaf.grad[:, :1].abs()
                mirror[name].grad = leaf.grad.clone()
            fit._adam()
            reference.step()
        for name, leaf in leaves.items():
            torch.testing.assert_close(leaf, mirror[name], atol=2e-5, rtol=1e-5)
            first, second = fit.state.moments[name]
            torch.testing.assert_close(first, reference.state[mirror[name]]["exp_avg"])
            torch.testing.assert_close(second, reference.state[mirror[name]]["exp_avg_sq"])

    @pytest.mark.parametrize("hypotheses", [True, False])
    def test_the_base_s_box_moves_only_where_no_search_has_found_it(self, hypotheses: bool):
        fit = fitter(replace(QUICK, hypotheses=hypotheses))
        before = fit.state.variables.parts().boxes.half_extents.detach().clone()
        list(fit.run(QUICK.structure_until))
        moved = (fit.state.variables.parts().boxes.half_extents.detach() - before).abs().amax(1) > 1e-6
        assert moved.tolist() == [not hypotheses, True, True]

    def test_a_motion_goes_where_its_gradient_points(self):
        """Of a direction that the photos hardly see, Adam would make as much as of the others."""
        fit = fitter(replace(PLAIN, steps=1000, structure_until=1000))
        leaf = fit.state.variables.leaves["motions"]
        before = leaf.detach().clone()
        gradient = torch.tensor([3.0, -2.0, 1.0, 0.1, 0.0, -0.01]).repeat(len(leaf), 1)
        leaf.grad = gradient.clone()
        fit._adam()
        step = leaf.detach() - before
        rate = fit.config.rates.motions
        torch.testing.assert_close(
            step, -rate * gradient / gradient.square().mean(-1, keepdim=True).sqrt(), rtol=1e-4, atol=1e-8
        )

    def test_a_leaf_that_joins_late_takes_no_larger_steps(self):
        """Moments begin at zero whenever a leaf's first gradient comes; the correction must begin there too."""
        fit = fitter(replace(PLAIN, steps=1000, structure_until=1000, rates=CONSTANT))
        leaf = fit.state.variables.leaves["sh"]
        fit.state.step = 700
        before = leaf.detach().clone()
        leaf.grad = torch.ones_like(leaf)
        fit._adam()
        torch.testing.assert_close(before - leaf.detach(), torch.full_like(leaf, Rates().sh), rtol=1e-3, atol=1e-8)

    @pytest.mark.parametrize(("name", "final"), [("means", 0.02), ("motions", 0.03), ("box_centres", 0.04), ("sh", 0.2)])
    def test_rates_fall_by_a_constant_factor_a_step(self, name: str, final: float):
        """Under a constant gradient Adam's step is the rate."""
        rates = Rates(means_final=0.02, motions_final=0.03, poses_final=0.04, appearance_final=0.2)
        config = replace(PLAIN, steps=10, structure_until=10, rates=rates)
        fit = fitter(config)
        leaf = fit.state.variables.leaves[name]
        rate = getattr(config.rates, name, config.rates.boxes)
        for step in range(10):
            fit.state.step = step
            before = leaf.detach().clone()
            leaf.grad = torch.ones_like(leaf)
            fit._adam()
            torch.testing.assert_close(
                before - leaf.detach(), torch.full_like(leaf, rate * final ** (step / 10)), atol=1e-6, rtol=1e-3
            )

    def test_motions_wait_for_the_splats(self):
        fit = fitter(replace(QUICK, motions_from=0.5))
        start = fit.state.variables.motions().wxyz_xyz.detach().clone()
        list(fit.run(20))
        assert torch.equal(fit.state.variables.motions().wxyz_xyz, start)
        list(fit.run(21))
        assert not torch.equal(fit.state.variables.motions().wxyz_xyz, start)

    def test_a_part_that_was_laid_anew_rests_while_the_others_move(self, monkeypatch):
        fit = fitter(replace(QUICK, lay_at=(0.0,), laid_rest=0.5, straight_until=0.0))
        start = fit.state.variables.motions().wxyz_xyz.detach().clone()
        monkeypatch.setattr("structuregs.fit.loop.laid_anew", lambda *_: {1: SE3(start[1])})
        list(fit.run(20))
        now = fit.state.variables.motions().wxyz_xyz
        assert torch.equal(now[1], start[1])
        assert not torch.equal(now[2], start[2])
        list(fit.run(21))
        assert not torch.equal(fit.state.variables.motions().wxyz_xyz[1], start[1])

    def test_only_what_was_laid_last_rests(self, monkeypatch):
        fit = fitter(replace(QUICK, lay_at=(0.0, 0.5), laid_rest=0.5, straight_until=0.0, one_joint_from=1.0))
        for part, until in ((1, 20), (2, 21)):
            monkeypatch.setattr("structuregs.fit.loop.laid_anew", lambda parts, _, k=part: {k: SE3(parts.motions.wxyz_xyz[k])})
            list(fit.run(until))
        before = fit.state.variables.motions().wxyz_xyz.detach().clone()
        list(fit.run(25))
        now = fit.state.variables.motions().wxyz_xyz
        assert torch.equal(now[2], before[2])
        assert not torch.equal(now[1], before[1])

    @pytest.mark.parametrize("one_joint_from", [0.2, 1.0])
    def test_a_joint_along_the_base_stays_so_until_its_time_has_come(self, one_joint_from: float):
        """Its photos see the drawer come out askew."""
        straight = made_of(DOOR.motion(), SE3.from_quat(SE3.identity().wxyz, torch.tensor([0.0, -0.4, 0.0]))).parts
        askew_drawer = SE3.from_quat(SE3.identity().wxyz, torch.tensor([0.03, -0.4, 0.0]))
        config = replace(QUICK, along_base=0.0, straight_until=0.5, lay_at=(), square_at=(), one_joint_from=one_joint_from)
        capture = photographed(made_of(DOOR.motion(), askew_drawer))
        fit = Fitter(capture, config, FitState.start(straight), 0, torch.device("cpu"))
        assert fit.state.straight.tolist() == [False, True, True]
        list(fit.run(20))
        moved = fit.state.variables.parts().detach()
        assert float(askew(moved, ["revolute", "prismatic"])) < 1e-10
        assert not torch.equal(moved.motions.wxyz_xyz, straight.motions.wxyz_xyz)
        list(fit.run(40))
        assert float(askew(fit.state.variables.parts().detach(), ["revolute", "prismatic"])) > 1e-7

    def test_a_fit_to_its_own_pictures_brings_a_wrong_motion_back(self):
        off = SE3.exp(torch.tensor([[0.0] * 6, [0.02, -0.02, 0.01, 0.0, 0.03, -0.06], [0.0] * 6]))
        parts = replace(DOOR_AND_DRAWER, motions=off @ DOOR_AND_DRAWER.motions)
        still = Rates(*[0.0] * 7, motions=1e-2, motions_final=0.1)
        growth = Growth(interval=1000)
        now = replace(QUICK, image_from=0, structure_until=0, motions_from=0.0, straight_until=0.0)
        config = replace(now, steps=150, one_joint_from=1.0, rates=still, growth=growth, alpha_weight=0.0, give_way=0.0)
        fit = fitter(config, parts)
        list(fit.run(150))
        found = fit.state.variables.motions()[1]
        error = (DOOR_AND_DRAWER.motions[1].inverse() @ found).angle
        assert math.degrees(error.item()) < 0.2
        assert math.degrees(off.angle[1].item()) > 3

    def test_the_type_is_settled_on_the_way_and_the_free_motion_is_kept(self):
        fit = fitter(replace(QUICK, one_joint_from=0.5))
        list(fit.run(20))
        assert fit.state.variables.kinds is None
        with torch.no_grad():
            free = fit.state.variables.motions().wxyz_xyz.clone()
        list(fit.run(21))
        assert fit.state.variables.kinds == ("revolute", "prismatic")
        torch.testing.assert_close(fit.state.free_motions, free)


def digest() -> str:
    """Of a fit with all losses, of how alike its photos are laid upon each other, and of its meshes."""
    surfaces = {"planarity_from": 0.0, "planarity_weight": 0.1, "planarity_size": 48}
    splats, g = DOOR_AND_DRAWER.splats, torch.Generator().manual_seed(0)
    uneven = replace(splats, log_scales=splats.log_scales + 0.5 * torch.randn(len(splats), 3, generator=g))
    config = replace(QUICK, steps=10, image_from=2, structure_until=10, loose_until=5, lay_at=(), **surfaces)
    fit = fitter(config, replace(DOOR_AND_DRAWER, splats=uneven))
    list(fit.run(10))
    with torch.no_grad():
        parts = fit.state.variables.parts()
        alike = [BothStates(parts, fit.capture).laid(k, state).unlike() for k in (1, 2) for state in (0, 1)]
        meshes = part_meshes(articulate(parts), fit.capture, voxel=0.05)
    arrays = [leaf.detach().numpy() for leaf in fit.state.variables.leaves.values()]
    assert all(share < 1 for share in alike)
    assert all(len(mesh.faces) for mesh in meshes)
    every = (np.ascontiguousarray(array) for array in (*arrays, *(mesh.vertices for mesh in meshes), np.array(alike)))
    return hashlib.sha256(b"".join(array.tobytes() for array in every)).hexdigest()


def test_kernels_compiled_just_now_and_from_the_cache_give_the_same_bytes(tmp_path: Path):
    """A first run compiles them, and the same run after it, or one that goes on where it was killed, loads them."""
    code = "import test_fit; print(test_fit.digest())"
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(Path(__file__).parent)}
    compiled, loaded = (
        subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True).stdout
        for _ in range(2)
    )
    assert compiled == loaded


class TestCheckpoint:
    def advanced(self) -> Fitter:
        fit = fitter(replace(QUICK, one_joint_from=0.4))
        list(fit.run(18))
        return fit

    def test_round_trip(self, tmp_path: Path):
        state = self.advanced().state
        state.save(tmp_path / "last.pt")
        again = FitState.load(tmp_path / "last.pt")
        assert (again.step, again.variables.counts, again.variables.kinds) == (
            18,
            state.variables.counts,
            state.variables.kinds,
        )
        assert again.variables.kinds == ("revolute", "prismatic")
        for name, leaf in state.variables.leaves.items():
            assert torch.equal(again.variables.leaves[name], leaf)
            assert again.variables.leaves[name].requires_grad
            assert all(torch.equal(a, b) for a, b in zip(again.moments[name], state.moments[name], strict=True))
        assert torch.equal(again.gradients.total, state.gradients.total)
        assert torch.equal(again.gradients.seen, state.gradients.seen)
        assert torch.equal(again.free_motions, state.free_motions)
        assert [file.name for file in tmp_path.iterdir()] == ["last.pt"]

    def test_going_on_from_it_is_the_same_as_not_having_stopped(self, tmp_path: Path):
        fit = self.advanced()
        fit.state.save(tmp_path / "last.pt")
        other = Fitter(fit.capture, fit.config, FitState.load(tmp_path / "last.pt"), 0, torch.device("cpu"))
        for one in (fit, other):
            list(one.run(40))
        assert fit.state.variables.counts == other.state.variables.counts
        assert sum(other.state.variables.counts) > 360, "splats multiplied on the way"
        for name, leaf in fit.state.variables.leaves.items():
            assert torch.equal(other.state.variables.leaves[name], leaf), name

    def test_a_damaged_one_is_named(self, tmp_path: Path):
        file = tmp_path / "last.pt"
        FitState.start(DOOR_AND_DRAWER).save(file)
        whole = file.read_bytes()
        for damaged in (b"", b"no checkpoint", whole[:1000], whole[: len(whole) // 2]):
            file.write_bytes(damaged)
            with pytest.raises(ValueError, match=r"last\.pt: the checkpoint is damaged; delete it to fit this run from"):
                FitState.load(file)

    @pytest.mark.parametrize("record", [{"step": 3}, [1, 2], {"leaves": [], "counts": 3}])
    def test_another_program_s_file_is_none(self, tmp_path: Path, record: object):
        torch.save(record, tmp_path / "last.pt")
        with pytest.raises(ValueError, match=r"last\.pt: the checkpoint is damaged"):
            FitState.load(tmp_path / "last.pt")


def jointed(way: Tensor, tilt: float = 0.0) -> PosedParts:
    """The door and the drawer in a turned base: the drawer slides along a direction of the base's box, the hinge is tilted."""
    parts = turned_parts()
    axes = parts.boxes.T_world_box.rotation[0]
    hinge = (axes @ torch.tensor([0.0, math.sin(tilt), math.cos(tilt)])).double()
    motions = parts.motions.wxyz_xyz.clone()
    motions[1] = Screw("revolute", hinge / hinge.norm(), torch.ones(3, dtype=torch.float64)).motion(0.8).wxyz_xyz.float()
    motions[2] = SE3.from_quat(SE3.identity().wxyz, axes @ way).wxyz_xyz
    return replace(parts, motions=SE3(motions.requires_grad_()))


class TestAlongBase:
    @pytest.mark.parametrize(("degrees", "along"), [(0.0, True), (1.5, True), (2.5, False), (20.0, False)])
    def test_a_joint_lies_along_the_base_or_does_not(self, degrees: float, along: bool):
        angle = math.radians(degrees)
        parts = jointed(0.3 * torch.tensor([0.0, -math.cos(angle), math.sin(angle)]), tilt=angle).detach()
        assert lie_along_base(parts).tolist() == [False, along, along]

    def test_what_stands_still_has_no_axis(self):
        assert lie_along_base(jointed(torch.zeros(3)).detach()).tolist() == [False, True, False]

    def test_held_along_it_a_part_s_centre_goes_on_the_nearest_way(self):
        angle = math.radians(3)
        parts = jointed(0.3 * torch.tensor([0.0, -math.cos(angle), math.sin(angle)])).detach()
        motions = held_along_base(parts, torch.tensor([False, False, True]))
        assert list(motions) == [2]
        way = parts.boxes.T_world_box.rotation[0].T.double() @ motions[2].xyz
        torch.testing.assert_close(way, torch.tensor([0.0, -0.3 * math.cos(angle), 0.0]).double(), atol=1e-6, rtol=0)


class TestAskew:
    @pytest.mark.parametrize("degrees", [0.0, 3.0, 8.0])
    def test_is_the_squared_sine_of_the_angle_to_the_nearest_axis(self, degrees: float):
        angle = math.radians(degrees)
        slide = jointed(0.3 * torch.tensor([0.0, -math.cos(angle), math.sin(angle)]))
        hinge = jointed(torch.tensor([0.0, -0.3, 0.0]), tilt=angle)
        for parts in (slide, hinge):
            assert float(askew(parts, ["revolute", "prismatic"]).detach()) == pytest.approx(math.sin(angle) ** 2, abs=1e-6)

    @pytest.mark.parametrize("way", [(0.2, 0.1, 0.0), (0.0, 0.0, 0.0), (1e-5, 1e-7, 0.0)])
    def test_does_not_draw_what_is_far_from_an_axis_or_stands_still(self, way: tuple[float, float, float]):
        parts = jointed(torch.tensor(way), tilt=math.radians(20))
        askew(parts, ["revolute", "prismatic"]).backward()
        assert parts.motions.wxyz_xyz.grad is not None
        assert float(parts.motions.wxyz_xyz.grad.abs().max()) == 0

    def test_draws_a_slide_from_the_first_step_with_an_image(self):
        angle = math.radians(3)
        true = DRAWER.motion()
        skew = SE3.exp(torch.tensor([0.0, 0, 0, 0, 0, angle])).rotation @ true.xyz.float()
        parts = made_of(DOOR.motion(), SE3.from_quat(SE3.identity().wxyz, skew)).parts
        blind = replace(QUICK, image_weight=1e-9, one_joint_from=1.0, steps=40, along_base=1.0, join_at=1.0, square_at=())
        fit = Fitter(photographed(made_of(DOOR.motion(), true)), blind, FitState.start(parts), 0, torch.device("cpu"))
        before = float(askew(parts, ["revolute", "prismatic"]))
        list(fit.run(40))
        assert float(askew(fit.state.variables.parts().detach(), ["revolute", "prismatic"])) < 0.2 * before


class TestStraight:
    """A drawer that comes out towards -y, photographed along z from places a little aside of each other."""

    @staticmethod
    def drawn(way: tuple[float, float, float], seen: tuple[float, float, float]) -> ArticulatedObject:
        """An object whose drawer was fitted to go one way, drawn straight by photos that saw it go another."""
        fitted, true = (made_of(DOOR.motion(), SE3.from_quat(SE3.identity().wxyz, torch.tensor(t))) for t in (way, seen))
        return straight_where_loose(fitted, photographed(true, views=6, aside=0.1))

    def test_a_slide_that_photos_do_not_tell_from_a_straight_one_is_straight(self):
        obj = self.drawn((0.0, -0.4, 0.004), (0.0, -0.4, 0.0))
        assert obj.joints[1].axis == pytest.approx((0.0, -1.0, 0.0), abs=1e-7)
        assert obj.joints[1].q == pytest.approx((0.0, 0.4), abs=1e-4)
        same_motion(obj.parts.motions[2], obj.joints[1].motion(obj.joints[1].q[1]))
        same_motion(obj.parts.motions[1], DOOR.motion())

    def test_one_that_is_truly_askew_stays_as_it_is(self):
        askew_way = (0.04, -0.4, 0.0)
        obj = self.drawn(askew_way, askew_way)
        assert obj.joints[1].axis == pytest.approx(tuple(np.array(askew_way) / np.linalg.norm(askew_way)), abs=1e-5)

    def test_a_hinge_is_drawn_about_the_point_that_is_nearest_to_its_part(self):
        leaning = replace(DOOR, axis=(0.0, math.sin(0.004), math.cos(0.004)), origin=(1.0, 0.0, 0.3)).motion()
        fitted, true = made_of(leaning), made_of(DOOR.motion())
        before = fitted.joints[0]
        (joint,) = straight_where_loose(fitted, photographed(true, views=6, aside=0.1)).joints
        assert joint.axis == pytest.approx((0.0, 0.0, 1.0), abs=1e-7)
        assert joint.origin == pytest.approx(before.origin, abs=1e-6)
        assert joint.q[1] == pytest.approx(before.q[1], abs=1e-4)
        assert joint.confidence == before.confidence

    def test_what_has_no_joints_is_left_alone(self):
        still = made_of()
        assert straight_where_loose(still, photographed(still)) is still


def two_pieces(gap: float, **second: float) -> PosedParts:
    """Two boxes side by side along x that turn about the z axis through the origin by one radian."""
    turn = {"angle": 1.0, "lift": 0.0} | second
    rows = [SE3.identity().wxyz_xyz]
    for angle, lift in ((1.0, 0.0), (turn["angle"], turn["lift"])):
        rows.append(SE3.exp(torch.tensor([0.0, 0, lift, 0, 0, angle])).wxyz_xyz)
    parts = made_of(DOOR.motion(), DOOR.motion(), centres=((0.0, 0, 0), (0.6, 0.0, 0.3), (1.4 + gap, 0.05, 0.3))).parts
    return replace(parts, motions=SE3(torch.stack(rows)))


class TestJoining:
    def test_what_the_photos_need_not_see_move_is_the_one_part_that_is_idle(self):
        still = made_of(DOOR.motion(), SE3.identity())
        photos = stack_views(photographed(still).train[1], 32)
        assert idle_part(made_of(DOOR.motion(), DRAWER.motion()).parts, photos) == 2
        photos = stack_views(photographed(made_of(DOOR.motion(), DRAWER.motion())).train[1], 32)
        assert idle_part(made_of(DOOR.motion(), DRAWER.motion()).parts, photos) is None

    def test_an_idle_part_becomes_the_base_s_and_the_fit_goes_on(self):
        capture = photographed(made_of(DOOR.motion(), SE3.identity()))
        config = replace(QUICK, join_at=0.2, rates=Rates(motions=0.0), growth=replace(QUICK.growth, interval=100))
        fit = Fitter(capture, config, FitState.start(DOOR_AND_DRAWER), 0, torch.device("cpu"))
        notes = [event.text for event in fit.run(12) if isinstance(event, Note)]
        assert notes == ["a part that need not move is the base's from step 8 on; 1 left"]
        assert fit.state.variables.counts == (240, 120)
        assert fit.state.step == 12

    def test_joined_parts_hold_the_same_splats_in_both_states(self):
        parts = two_pieces(0.0)
        joined = parts.joined(1, 2)
        assert joined.counts == (120, 240)
        for state in (0, 1):
            same_splats(joined.at_state(state), parts.at_state(state))
        joined = parts.joined(2, 1)
        order = torch.cat([torch.arange(120), torch.arange(240, 360), torch.arange(120, 240)])
        for state in (0, 1):
            same_splats(joined.at_state(state), parts.at_state(state)[order])

    def test_turned_boxes_join_too_and_the_picture_stays(self):
        parts = turned_parts()
        joined = parts.joined(2, 1)
        camera = photographed(made_of(DOOR.motion())).train[0][0].camera
        before, after = (render(p.at_state(0), camera).rgb for p in (parts, joined))
        torch.testing.assert_close(after, before, atol=1e-4, rtol=0)
        same_motion(joined.motions[1], parts.motions[2])
        assert joined.boxes[1].contains(parts.boxes.corners[1:].reshape(-1, 3), margin=1e-5).all()

    def test_other_parts_are_left_as_they_are(self):
        parts = made_of(DOOR.motion(), DRAWER.motion(), DOOR.motion(), centres=((0.0, 0, 0),) * 4).parts
        joined = parts.joined(1, 3)
        assert joined.counts == (120, 240, 120)
        same_motion(joined.motions[2], parts.motions[2])
        same_splats(joined.part_splats(2), parts.part_splats(2))

    def test_parts_that_touch_and_move_alike_are_one(self):
        assert moving_alike(two_pieces(0.0)) == (1, 2)
        larger = two_pieces(0.0)
        counts = (120, 100, 140)
        assert moving_alike(replace(larger, counts=counts)) == (2, 1), "the larger leads"

    @pytest.mark.parametrize(
        "parts",
        [two_pieces(0.5), two_pieces(0.0, angle=0.8), two_pieces(0.0, angle=-1.0), two_pieces(0.0, lift=0.3), DOOR_AND_DRAWER],
        ids=["apart", "less far", "the other way", "lifted", "a door and a drawer"],
    )
    def test_others_are_two(self, parts: PosedParts):
        assert moving_alike(parts) is None


class TestResult:
    def test_tight_boxes_hold_the_opaque_splats_where_they_were(self):
        parts = turned_parts()
        opacities = parts.splats.logit_opacities.clone()
        opacities[::2] = -3.0
        means = torch.where((torch.arange(360) % 2 == 0)[:, None], parts.splats.means, 0.5 * parts.splats.means + 0.2)
        loose = replace(parts, splats=replace(parts.splats, means=means, logit_opacities=opacities))
        tight = tightened(loose)
        for state in (0, 1):
            same_splats(tight.at_state(state), loose.at_state(state))
        opaque = tight.splats.means[1::2]
        assert opaque.abs().max() < 1.1
        assert ((opaque.abs() > 0.95).sum(0) >= 6).all(), "every face is reached, in each of three parts"
        assert (tight.boxes.half_extents < 0.55 * loose.boxes.half_extents).all()

    def test_the_base_s_box_alone_is_made_tight(self):
        parts = turned_parts()
        shrunk = replace(parts, splats=replace(parts.splats, means=0.5 * parts.splats.means))
        tight = base_tightened(shrunk)
        torch.testing.assert_close(tight.boxes.half_extents[0], tightened(shrunk).boxes.half_extents[0])
        torch.testing.assert_close(tight.boxes.half_extents[1:], shrunk.boxes.half_extents[1:])
        for state in (0, 1):
            same_splats(tight.at_state(state), shrunk.at_state(state))

    def test_boxes_of_what_moves_are_drawn_out_where_splats_press_on(self):
        """Along one axis the door's splats lie as far as 1.7 of its box, all but two in a hundred as far as 1.632."""
        parts = stretched(1.7)
        slid = SE3(torch.tensor([[1.0, 0, 0, 0, 0, 0, 0], [1, 0, 0, 0, 0.3, 0, 0.1], [1, 0, 0, 0, 0, 0.2, 0]]))
        out, half_extents = replace(parts, motions=slid), parts.boxes.half_extents
        length, every = float(half_extents[1, 0]), torch.ones(360, dtype=torch.bool)
        drawn = drawn_out(out, every, 0.65 * length)
        expected = half_extents.clone()
        expected[1, 0] *= 1.632
        torch.testing.assert_close(drawn.boxes.half_extents, expected)
        for state in (0, 1):
            same_splats(drawn.at_state(state), out.at_state(state))

        torch.testing.assert_close(drawn_out(out, every, 0.75 * length).boxes.half_extents, half_extents)
        inside = (out.splats.means.abs() <= 1).all(-1)
        torch.testing.assert_close(drawn_out(out, inside, 0.65 * length).boxes.half_extents, half_extents)
        faint = replace(out, splats=replace(out.splats, logit_opacities=torch.full_like(out.splats.logit_opacities, -3.0)))
        torch.testing.assert_close(drawn_out(faint, every, 0.65 * length).boxes.half_extents, half_extents)

    def test_outside_its_box_a_splat_needs_support_once_boxes_fit(self, monkeypatch: pytest.MonkeyPatch):
        parts = stretched(1.05)
        inside = (parts.splats.means.abs() <= 1).all(-1)
        assert 0 < int((~inside).sum()) < 20
        monkeypatch.setattr("structuregs.fit.loop.supported", lambda *_: torch.arange(360) == 120)
        fit = fitter(replace(QUICK, growth=Growth(interval=1, first=1.0, last=1.0)), parts)
        assert not inside[120]
        for step, gone in ((10, 0), (20, int((~inside).sum()) - 1)):
            fit.state.step = step
            fit._densify()
            assert sum(fit.state.variables.counts) == 360 - gone

    def test_boxes_of_what_moves_are_drawn_in_to_what_photos_support(self):
        """Of the door's splats those from -1 to .8 along its box are supported: all but two in a hundred from -.98 to .78."""
        parts = stretched(1.0)
        row = torch.arange(360) - 120
        supported = (row < 0) | (row >= 120) | (row < 0.9 * 120)
        out, half = replace(parts, motions=DOOR_AND_DRAWER.motions), parts.boxes.half_extents
        drawn = drawn_in(out, supported)
        torch.testing.assert_close(drawn.boxes.half_extents[0], half[0])
        ends = half[1, 0] * torch.tensor([[-0.98, 0, 0], [0.78, 0, 0]])
        sides = drawn.boxes[1].half_extents * torch.tensor([[-1.0, 0, 0], [1, 0, 0]])
        placed = out.boxes[1].T_world_box.inverse().apply(drawn.boxes[1].T_world_box.apply(sides))[:, 0]
        torch.testing.assert_close(placed, ends[:, 0], rtol=0, atol=0.02 * float(half[1, 0]))
        for state in (0, 1):
            same_splats(drawn.at_state(state), out.at_state(state))

        far = drawn_in(stretched(3.0), torch.ones(360, dtype=torch.bool)).boxes.half_extents
        assert (far <= half * (1 + 1e-6)).all(), "never out"
        few = supported & ((row >= 120) | (row < 60))
        torch.testing.assert_close(drawn_in(out, few).boxes.half_extents[1], half[1])

    def test_a_box_is_not_drawn_out_over_its_hinge(self):
        """The splats reach beyond both ends of the box alike; only the end that the motion moves is drawn out."""
        parts = stretched(1.7)
        pose, half = parts.boxes.T_world_box[1], parts.boxes.half_extents[1]
        hinge = pose.apply(half * torch.tensor([-1.4, 0.0, 0.0]))
        motions = parts.motions.wxyz_xyz.clone()
        motions[1] = Screw("revolute", pose.rotation[:, 2], hinge).motion(1.0).wxyz_xyz
        every = torch.ones(360, dtype=torch.bool)
        drawn = drawn_out(replace(parts, motions=SE3(motions)), every, 0.6 * float(half[0])).boxes[1]
        sides = drawn.half_extents * torch.tensor([[-1.0, 0, 0], [1, 0, 0]])
        ends = pose.inverse().apply(drawn.T_world_box.apply(sides))[:, 0]
        torch.testing.assert_close(ends, half[0] * torch.tensor([-1.0, 1.65]), rtol=0.01, atol=0.0)

    def test_boxes_are_turned_along_the_faces_of_their_splats(self):
        """Splats on the faces of the boxes; each box is then put askew, and comes back."""
        parts = turned_parts()
        generator = torch.Generator().manual_seed(0)
        counts = (2000, 2000, 2000)
        means = torch.rand(sum(counts), 3, generator=generator) * 2 - 1
        axis = torch.randint(3, (len(means), 1), generator=generator)
        means.scatter_(1, axis, means.gather(1, axis).sign())
        source = torch.arange(len(parts)).repeat_interleave(2000) * 120
        splats = replace(parts.splats[source], means=means, logit_opacities=torch.full((len(means),), 3.0))
        right = replace(parts, splats=splats, counts=counts, tint=parts.tint[source])
        askew_ = right
        for k, turn in enumerate(((0.1, 0, 0.05), (-0.06, 0.08, 0.0), (0.02, 0.1, -0.1))):
            R = right.boxes.T_world_box.rotation[k] @ SE3.exp(torch.tensor([0.0, 0, 0, *turn])).rotation
            askew_ = askew_.in_box(k, Box(SE3.from_rotation(R, right.boxes.T_world_box.xyz[k]), right.boxes.half_extents[k]))
        again = squared_up(askew_)
        for state in (0, 1):
            same_splats(again.at_state(state), right.at_state(state))
        off = (again.boxes.T_world_box.inverse() @ right.boxes.T_world_box).angle
        assert float(off.max()) < math.radians(0.5)
        torch.testing.assert_close(tightened(again).boxes.half_extents, right.boxes.half_extents, atol=0.02, rtol=0.03)

    def test_a_held_joint_is_no_clearer_than_the_free_motion_was(self):
        variables = Variables.of(DOOR_AND_DRAWER)
        variables.hold(["revolute", "prismatic"])
        state = FitState.start(DOOR_AND_DRAWER)
        held = replace(state, variables=variables)
        clear = finished_object(held)
        odd = held.free_motions.clone()
        odd[1, 4:] += torch.tensor([0.0, 0.0, 0.5])  # a slide along the hinge, which no joint explains
        unclear = finished_object(replace(held, free_motions=odd))
        assert [joint.kind for joint in unclear.joints] == ["revolute", "prismatic"]
        assert unclear.joints[0].confidence < 0.2 < clear.joints[0].confidence
        assert unclear.joints[0].review
        assert unclear.joints[1] == clear.joints[1]
        assert unclear.joints[0].axis == clear.joints[0].axis


@pytest.mark.parametrize("settled", [True, False])
def test_a_part_without_splats_is_none(settled: bool):
    left = DOOR_AND_DRAWER.splats[DOOR_AND_DRAWER.part != 1]
    parts = replace(DOOR_AND_DRAWER, splats=left, counts=(120, 0, 120), tint=torch.zeros(240, 3))
    state = FitState.start(parts)
    if settled:
        state.variables.hold(["revolute", "prismatic"])
    (drawer,) = finished_object(state).joints
    whole = finished_object(FitState.start(DOOR_AND_DRAWER))
    assert drawer == whole.joints[1]


RECORD = {"capture": "here", "seed": 0, "fit": {"steps": 3, "sizes": ((0.0, 10),)}}


class TestRunFolder:
    def test_a_new_run_writes_its_configuration(self, tmp_path: Path):
        RunFolder(tmp_path / "run").begin(RECORD)
        assert json.loads((tmp_path / "run" / "config.json").read_text())["fit"]["sizes"] == [[0.0, 10]]
        RunFolder(tmp_path / "run").begin(RECORD)

    def test_another_configuration_is_refused_by_name(self, tmp_path: Path):
        RunFolder(tmp_path).begin(RECORD)
        with pytest.raises(
            ValueError, match=r"a run with another capture, seed lies here; go on with the same or choose another"
        ):
            RunFolder(tmp_path).begin(RECORD | {"seed": 1, "capture": "there"})
        with pytest.raises(ValueError, match=r"a run with another fit lies here"):
            RunFolder(tmp_path).begin(RECORD | {"fit": {"steps": 4, "sizes": ((0.0, 10),)}})

    def test_a_folder_of_something_else_is_left_alone(self, tmp_path: Path):
        (tmp_path / "thesis.tex").touch()
        with pytest.raises(ValueError, match=r"the folder is not empty and holds no run; choose another with -o\.$"):
            RunFolder(tmp_path).begin(RECORD)
        assert [file.name for file in tmp_path.iterdir()] == ["thesis.tex"]

    @pytest.mark.parametrize("text", ["", "{", "[1]", "3"])
    def test_a_damaged_configuration_is_named(self, tmp_path: Path, text: str):
        (tmp_path / "config.json").write_text(text)
        with pytest.raises(ValueError, match=r"config\.json: not a configuration"):
            RunFolder(tmp_path).begin(RECORD)

    def test_records_after_the_checkpoint_and_half_written_ones_go(self, tmp_path: Path):
        folder = RunFolder(tmp_path)
        folder.metrics.write_text('{"step": 10}\n{"step": 20}\n{"step": 30}\n{"st')
        folder.cut_metrics(20)
        assert folder.metrics.read_text() == '{"step": 10}\n{"step": 20}\n'

    @pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
    def test_a_gpu_that_is_not_there(self):
        assert choose_device("auto") == torch.device("cpu")
        with pytest.raises(ValueError, match=r"^--device cuda: torch finds no GPU here; use --device cpu"):
            choose_device("cuda")


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"structure_until": 3}, "structure_until 3 lies before image_from 4: no loss is on in between."),
        (
            {"motions_with_structure": True},
            "motions_with_structure: the losses on boxes end at step 4, before motions move (from step 8 on); give a lower"
            " motions_from.",
        ),
    ],
)
def test_a_configuration_in_which_something_would_do_nothing_is_refused(change: dict[str, int], sentence: str):
    with pytest.raises(ValueError, match=rf"^{re.escape(sentence)}$"):
        replace(QUICK, **change)  # pyright: ignore[reportArgumentType]
    assert replace(QUICK, motions_with_structure=True, motions_from=0.05).motions_with_structure


def test_the_paper_s_preset_has_the_supplement_s_numbers():
    paper = PRESETS["paper"]
    assert (paper.steps, paper.splats_per_part, paper.image_from, paper.loose_until) == (10_000, 10_000, 400, 1500)
    assert (paper.rates.means, paper.rates.boxes, paper.rates.motions) == (1.6e-2, 1e-2, 1e-2)
    assert (paper.image_weight, paper.ssim_weights, paper.hypotheses) == (10.0, ((0.0, 0.2),), False)
