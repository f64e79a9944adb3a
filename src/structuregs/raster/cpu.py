"""The CPU back end: Numba kernels in float32, held against the reference by tests."""

from collections.abc import Iterable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..geometry import Camera
from ..jit import lanes
from ..model import Splats
from . import blend_kernels as bk
from . import plane_kernels as plk
from . import project_kernels as pk
from .records import LEAST_DISTANCE, STEEPEST, Projection, Render, frustum_limits, splat_rgb


def render(splats: Splats, camera: Camera, *, background: Float[Tensor, " 3"], dilation: float) -> Render:
    """See `structuregs.raster.render`; computes in float32, and gives no gradient to the camera's pose."""
    return blend(project(splats, camera, dilation), camera.width, camera.height, background)


def project(splats: Splats, camera: Camera, dilation: float) -> Projection:
    """See `reference.project`."""
    T_camera_world = camera.T_world_camera.inverse()
    lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy, *frustum_limits(camera), dilation], np.float32)
    view = (_array(T_camera_world.rotation), _array(T_camera_world.xyz), lens, np.array([camera.width, camera.height]))
    xy, conic, depth, extent, opacity = _Project.apply(
        splats.means, splats.quats, splats.log_scales, splats.logit_opacities, view
    )
    return Projection(xy, conic, depth, extent, splat_rgb(splats, camera).float(), opacity)


def blend(projection: Projection, width: int, height: int, background: Float[Tensor, " 3"]) -> Render:
    """See `reference.blend`."""
    p = projection
    rgb, alpha, depth = _Blend.apply(p.xy, p.conic, p.depth, p.rgb, p.opacity, p.extent, background, (height, width))
    return Render(rgb, alpha, depth, projection)


def tangent_planes(splats: Splats, camera: Camera) -> Float[Tensor, "N 3"]:
    """See `planes.tangent_planes`; gives no gradient to the camera's pose."""
    T_camera_world = camera.T_world_camera.inverse()
    view = (_array(T_camera_world.rotation), _array(T_camera_world.xyz), np.float32(STEEPEST), np.float32(LEAST_DISTANCE))
    return _Planes.apply(splats.means, splats.quats, splats.log_scales.detach(), view)


def _array(tensor: Tensor) -> np.ndarray:
    """The tensor's values as a contiguous float32 array; shared with the tensor where they already are one."""
    return tensor.detach().to("cpu", torch.float32).contiguous().numpy()


def _or_zeros(gradient: Tensor | None, *shape: int) -> np.ndarray:
    return np.zeros(shape, np.float32) if gradient is None else _array(gradient)


def _tensors(arrays: Iterable[np.ndarray]) -> tuple[Tensor, ...]:
    return tuple(torch.from_numpy(a) for a in arrays)


class _Project(torch.autograd.Function):
    """Splats to 2D Gaussians."""

    @staticmethod
    def forward(ctx, means, quats, log_scales, logit_opacities, view):
        arrays = [_array(t) for t in (means, quats, log_scales, logit_opacities)]
        n = len(means)
        outputs = [np.empty(shape, np.float32) for shape in ((n, 2), (n, 3), n, (n, 2), n)]
        with lanes():
            pk.project_forward(*arrays, *view, *outputs)
        xy, conic, depth, extent, opacity = _tensors(outputs)
        ctx.save_for_backward(means, quats, log_scales, opacity, extent)
        ctx.view, ctx.logit_dtype = view[:3], logit_opacities.dtype
        ctx.mark_non_differentiable(extent)
        ctx.set_materialize_grads(False)
        return xy, conic, depth, extent, opacity

    @staticmethod
    @once_differentiable
    def backward(ctx, *gradients):
        g_xy, g_conic, g_depth, _, g_opacity = gradients
        *inputs, opacity, extent = ctx.saved_tensors
        n = len(opacity)
        incoming = _or_zeros(g_xy, n, 2), _or_zeros(g_conic, n, 3), _or_zeros(g_depth, n), _or_zeros(g_opacity, n)
        outgoing = [np.empty(shape, np.float32) for shape in ((n, 3), (n, 4), (n, 3), n)]
        with lanes():
            pk.project_backward(*map(_array, inputs), *ctx.view, _array(opacity), _array(extent), *incoming, *outgoing)
        dtypes = [*(t.dtype for t in inputs), ctx.logit_dtype]
        return *(t.to(dtype) for t, dtype in zip(_tensors(outgoing), dtypes, strict=True)), None


class _Planes(torch.autograd.Function):
    """Splats to the planes that they lie in."""

    @staticmethod
    def forward(ctx, means, quats, log_scales, view):
        ctx.save_for_backward(means, quats, log_scales)
        ctx.view = view
        planes = np.empty((len(means), 3), np.float32)
        with lanes():
            plk.planes_forward(_array(means), _array(quats), _array(log_scales), *view, planes)
        return torch.from_numpy(planes)

    @staticmethod
    @once_differentiable
    def backward(ctx, *gradients):
        inputs = [_array(t) for t in ctx.saved_tensors]
        outgoing = [np.empty_like(a) for a in inputs[:2]]
        with lanes():
            plk.planes_backward(*inputs, *ctx.view, _array(gradients[0]), *outgoing)
        return *_tensors(outgoing), None, None


class _Blend(torch.autograd.Function):
    """2D Gaussians to an image."""

    @staticmethod
    def forward(ctx, xy, conic, depth, rgb, opacity, extent, background, size):
        height, width = size
        z, reached = _array(depth), _array(extent)
        order = bk.depth_order(z, reached)
        drawn = [np.empty(shape, np.float32) for shape in ((*size, 3), size, size)]
        with lanes() as threads:
            drawing, reach = bk.pack(_array(xy), _array(conic), _array(opacity), _array(rgb), z, reached)
            starts, splats = bk.tile_lists(reach, order, width, height, threads)
            ends = np.empty(len(starts) - 1, np.int64)
            bk.blend_forward(starts, splats, drawing, _array(background), threads, *drawn, ends)
        outputs = _tensors(drawn)
        ctx.save_for_backward(conic, opacity, *outputs)
        ctx.lists, ctx.drawing = (starts, ends, splats), drawing
        ctx.set_materialize_grads(False)
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx, *gradients):
        starts, ends, splats = ctx.lists
        conic, opacity, *drawn = map(_array, ctx.saved_tensors)
        size = drawn[1].shape
        g_image, g_alpha = _or_zeros(gradients[0], *size, 3), _or_zeros(gradients[1], *size)
        g_depth = None if gradients[2] is None else _array(gradients[2])
        partials = np.empty((len(splats), bk.PARTIALS), np.float32)
        with lanes() as threads:
            bk.blend_backward(starts, splats, ctx.drawing, ends, threads, *drawn, g_image, g_alpha, g_depth, partials)
            sums = bk.sum_partials(starts, ends, splats, partials, conic, opacity, threads)
        g_xy, g_conic, g_opacity, g_rgb, g_z = _tensors(sums)
        g_background = None
        if ctx.needs_input_grad[6]:
            through = 1 - torch.from_numpy(drawn[1])
            g_background = torch.einsum("hwc,hw->c", torch.from_numpy(g_image), through)
        return g_xy, g_conic, g_z, g_rgb, g_opacity, None, g_background, None
