"""Which reconstructed part is which true part."""

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from ..capture import Truth
from ..model import ArticulatedObject

# What another type costs, in sizes of the object: parts can lie no farther apart than a few of these, so a type is
# only ever mistaken where no assignment gets all types right.
_OTHER_KIND = 100.0


def match_joints(obj: ArticulatedObject, truth: Truth) -> list[int | None]:
    """The joint of the object that each true joint is compared with, by Hungarian assignment; None where none is left.

    The cost of a pair is, in the object's size: how far apart the two motions carry the corners of the part's box
    (root mean square), plus, where the truth has meshes, how far the part lies from the true one in the start state
    (parallel drawers move alike, and only their places tell them apart).  Another type costs more than any place.
    """
    cost = _costs(obj, truth)
    rows, columns = linear_sum_assignment(cost)
    matched = {int(true): int(found) for found, true in zip(rows, columns, strict=True)}
    return [matched.get(true) for true in range(len(truth.joints))]


def _costs(obj: ArticulatedObject, truth: Truth) -> Float[np.ndarray, "found true"]:
    boxes = obj.parts.boxes
    corners = boxes.corners.double()
    size = float((corners.reshape(-1, 3).amax(0) - corners.reshape(-1, 3).amin(0)).norm())
    cost = np.zeros((len(obj.joints), len(truth.joints)))
    for i, joint in enumerate(obj.joints):
        carried = joint.motion(joint.q[1]).apply(corners[i + 1])
        for k, true in enumerate(truth.joints):
            apart = (carried - true.motion().apply(corners[i + 1])).square().sum(-1).mean().sqrt()
            cost[i, k] = float(apart) / size + (_OTHER_KIND if joint.kind != true.kind else 0.0)
            place = true_centre(truth, k)
            if place is not None:
                cost[i, k] += float((boxes.T_world_box.xyz[i + 1].double() - place).norm()) / size
    return cost


def true_centre(truth: Truth, joint: int) -> Float[Tensor, " 3"] | None:
    """Centre of the bounds of a true part in the start state, in the world (float64); None where it has no mesh."""
    path = truth.meshes.get((0, joint + 1))
    if path is None:
        return None
    bounds = trimesh.load_mesh(path, process=False).bounds
    return torch.as_tensor(np.mean(bounds, axis=0), dtype=torch.float64)
