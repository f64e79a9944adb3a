"""Points from pretrained estimators, VGGT and Pi3: their packages and weights are the user's to install."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64
from torch import Tensor

from ..capture import Capture, CaptureError, View, spread_cameras
from ..geometry import SE3
from .alignment import Alignment, align_cameras

_MOST_VIEWS = 32  # of a state, well apart: what a model of a billion weights can attend to at once
_KEPT = 0.7  # share of the object's pixels, the surest first
_INSTALL = "pip install --no-deps git+https://github.com/"  # past its pins of old versions of torch and numpy
_WORST_DEG, _WORST = 10.0, 0.2  # cameras that disagree by more than this (medians; see `Alignment`) are no help


@dataclass(frozen=True)
class Prediction:
    """What an estimator says of V images, in a frame and a scale of its own.

    Attributes:
        points: what each pixel shows.
        confidence: how sure it is of each; only their order counts.
        T_world_camera: the cameras' poses, OpenCV axes.
    """

    points: Float32[np.ndarray, "V H W 3"]
    confidence: Float32[np.ndarray, "V H W"]
    T_world_camera: SE3


@dataclass(frozen=True)
class Estimator:
    """A pretrained model that predicts points and cameras from images.

    Attributes:
        name: as `--points` has it.
        side: of the square images that it takes, pixels.
        install: the line that installs its package.
        weights: which it loads, and their licence.
        load: loads package and weights for a device; what it returns predicts from images in [0, 1].
    """

    name: str
    side: int
    install: str
    weights: str
    load: Callable[[torch.device], Callable[[Float[Tensor, "V 3 H W"]], Prediction]]


def _load_vggt(device: torch.device) -> Callable[[Float[Tensor, "V 3 H W"]], Prediction]:
    from vggt.models.vggt import VGGT  # pyright: ignore[reportMissingImports]
    from vggt.utils.geometry import unproject_depth_map_to_point_map  # pyright: ignore[reportMissingImports]
    from vggt.utils.pose_enc import pose_encoding_to_extri_intri  # pyright: ignore[reportMissingImports]

    model = VGGT.from_pretrained("facebook/VGGT-1B").to(device).eval()

    def predict(images: Float[Tensor, "V 3 H W"]) -> Prediction:
        with _inference(device):
            said = model(images[None].to(device))
        extrinsics, intrinsics = (a[0].float() for a in pose_encoding_to_extri_intri(said["pose_enc"], images.shape[-2:]))
        depth = said["depth"][0].float()  # its depths say more than its point maps (VGGT's README)
        points = np.asarray(unproject_depth_map_to_point_map(depth.cpu(), extrinsics.cpu(), intrinsics.cpu()), np.float32)
        T_camera_world = SE3.from_rotation(extrinsics[:, :3, :3].cpu(), extrinsics[:, :3, 3].cpu())
        return Prediction(points, said["depth_conf"][0].float().cpu().numpy(), T_camera_world.inverse())

    return predict


def _load_pi3(device: torch.device) -> Callable[[Float[Tensor, "V 3 H W"]], Prediction]:
    from pi3.models.pi3 import Pi3  # pyright: ignore[reportMissingImports]

    model = Pi3.from_pretrained("yyfz233/Pi3").to(device).eval()

    def predict(images: Float[Tensor, "V 3 H W"]) -> Prediction:
        with _inference(device):
            said = {name: said[0].float().cpu() for name, said in model(images[None].to(device)).items() if said is not None}
        pose = said["camera_poses"]
        T_world_camera = SE3.from_rotation(pose[:, :3, :3], pose[:, :3, 3])
        return Prediction(said["points"].numpy(), said["conf"][..., 0].numpy(), T_world_camera)

    return predict


@contextmanager
def _inference(device: torch.device) -> Iterator[None]:
    """No gradients, and on a GPU half the bytes, as both models' authors run them."""
    with torch.inference_mode(), torch.autocast(device.type, torch.bfloat16, enabled=device.type == "cuda"):
        yield


ESTIMATORS = {
    row.name: row
    for row in (
        Estimator(
            "vggt",
            side=518,
            install=f"{_INSTALL}facebookresearch/vggt.git && pip install einops huggingface_hub",
            weights="facebook/VGGT-1B, CC BY-NC 4.0: not for commercial use",
            load=_load_vggt,
        ),
        Estimator(
            "pi3",
            side=504,
            install=f"{_INSTALL}yyfz/Pi3.git && pip install huggingface_hub plyfile",
            weights="yyfz233/Pi3, CC BY-NC 4.0: not for commercial use",
            load=_load_pi3,
        ),
    )
}


def estimated_points(capture: Capture, estimator: Estimator) -> tuple[list[Float64[np.ndarray, "_ 3"]], list[str]]:
    """Points of the object's surface in both states, in the capture's frame, and a sentence about each state's cameras.

    Each state is shown to the model by itself, over white; its frame is laid upon the capture's by the cameras.

    Args:
        capture: whose training views are shown.
        estimator: which model.

    Raises:
        CaptureError: the model's package is not installed, or its cameras are not the capture's.
    """
    try:
        predict = estimator.load(torch.device("cuda" if torch.cuda.is_available() else "cpu"))
    except ImportError as error:
        raise CaptureError(
            f"--points {estimator.name}: its package cannot be loaded ({error}); run `{estimator.install}`"
            f" (weights {estimator.weights}), or use --points hull, which needs none."
        ) from error
    clouds, says = [], [f"points from {estimator.name} (weights {estimator.weights})"]
    for state, views in enumerate(capture.train):
        shown = [views[i] for i in spread_cameras([view.camera for view in views], _MOST_VIEWS)]
        images, masks = _canvases(shown, estimator.side)
        prediction = predict(images)
        alignment = _aligned(prediction, shown, estimator.name, state)
        sure = prediction.confidence >= np.quantile(prediction.confidence[masks], 1 - _KEPT)
        clouds.append(alignment.similarity.apply(prediction.points[masks & sure].astype(np.float64)))
        says.append(f"its cameras of state {state} agree with the capture's to {_told(alignment)}")
    return clouds, says


def _aligned(prediction: Prediction, views: Sequence[View], name: str, state: int) -> Alignment:
    """How a prediction lies upon the capture; the cameras tell."""
    poses = SE3(torch.stack([view.camera.T_world_camera.wxyz_xyz for view in views]))
    try:
        alignment = align_cameras(prediction.T_world_camera, poses)
    except ValueError as error:
        raise CaptureError(f"--points {name}, state {state}: {error}") from error
    if alignment.angle_deg > _WORST_DEG or alignment.distance > _WORST:
        raise CaptureError(
            f"--points {name}, state {state}: its cameras agree with the capture's only to {_told(alignment)};"
            " use --points hull, which takes the capture's."
        )
    return alignment


def _told(alignment: Alignment) -> str:
    return f"{alignment.angle_deg:.2f} degrees and {alignment.distance:.1%} of their distance"


def _canvases(views: Sequence[View], side: int) -> tuple[Float[Tensor, "V 3 H W"], Bool[np.ndarray, "V H W"]]:
    """The views over white, in the middle of squares, and the pixels that are all the object's."""
    images = torch.ones(len(views), 3, side, side)
    masks = np.zeros((len(views), side, side), bool)
    for i, view in enumerate(views):
        scale = side / max(view.camera.width, view.camera.height)
        width, height = max(round(view.camera.width * scale), 1), max(round(view.camera.height * scale), 1)
        rgb, alpha = view.image(width, height)
        x, y = (side - width) // 2, (side - height) // 2
        images[i, :, y : y + height, x : x + width] = torch.from_numpy(rgb).permute(2, 0, 1)
        masks[i, y : y + height, x : x + width] = alpha > 0.99
    return images, masks
