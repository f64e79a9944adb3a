"""A run's figures under a protocol, and the JSON that holds them."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import trimesh

from ..capture import Capture, Truth, find_truth, load_capture, load_truth
from ..export.mesh import part_meshes
from ..files import replace_file
from ..fit.run import RunFolder
from ..model import ArticulatedObject, load_object
from .images import psnr_on_views
from .scores import JointScore, score_joints
from .surfaces import SURFACE_PROTOCOLS, SurfaceScore, score_surfaces


@dataclass(frozen=True)
class Protocol:
    """What a benchmark's numbers are, where benchmarks differ.

    All of them compare axes, turns and slides alike, match parts by Hungarian assignment and count failures.

    Attributes:
        name: as `--protocol` takes it.
        printed_unit: the unit in which distances of axes are *printed*, in the capture's unit.  The JSON of a report
            is in the capture's unit under every protocol.
        object_psnr: whether PSNR is also taken over the object's own pixels.
    """

    name: str
    printed_unit: float
    object_psnr: bool


PROTOCOLS = {
    row.name: row
    for row in (
        Protocol("paris", printed_unit=1.0, object_psnr=False),
        Protocol("artgs", printed_unit=0.1, object_psnr=False),
        Protocol("strict", printed_unit=1.0, object_psnr=True),
    )
}


@dataclass(frozen=True)
class Report:
    """The figures of one run.

    Attributes:
        protocol: their protocol's name.
        joints: one entry for each true joint; empty where the capture has no ground truth.
        unmatched_parts: reconstructed parts that no true joint stands for.
        flagged_parts: reconstructed parts whose joints ask for a human's look.
        psnr: mean over the images of the test views of both states, dB; None without test views.
        psnr_by_state: the same for each state.
        psnr_object: over the object's own pixels; None unless the protocol asks for it.
        seconds: what the fit took, all sessions together; None where the run does not say.
        surfaces: errors of the parts' surfaces; None where no meshes were given or the ground truth has none.
    """

    protocol: str
    joints: tuple[JointScore, ...]
    unmatched_parts: tuple[int, ...]
    flagged_parts: tuple[int, ...]
    psnr: float | None
    psnr_by_state: tuple[float | None, float | None]
    psnr_object: float | None
    seconds: float | None
    surfaces: SurfaceScore | None = None

    @property
    def failures(self) -> int:
        """How many true joints have no part, or one of another type."""
        return sum(score.failed for score in self.joints)

    def as_json(self) -> dict[str, Any]:
        """The report as JSON holds it: distances in the capture's unit, angles in degrees, `null` where not applicable."""
        record = asdict(self)
        surfaces = record.pop("surfaces") or dict.fromkeys(SurfaceScore.__dataclass_fields__)
        return record | surfaces | {"failures": self.failures}


def evaluate_run(run: Path, *, truth: Path | None = None, protocol: str = "strict") -> Report:
    """The figures of a run's object on the capture that it was fitted to.

    Args:
        run: the run's folder (docs/format.md).
        truth: folder of the ground truth; where the PARIS and ArtGS layouts keep it beside the capture by default.
        protocol: one of `PROTOCOLS`.

    Raises:
        ValueError: the run holds no object, or its capture is not where it was.
    """
    obj = load_object(run / "object")
    capture = training_capture(run)
    folder = truth or find_truth(capture)
    true = load_truth(folder) if folder else None
    meshes = part_meshes(obj, capture) if true is not None and true.meshes else None
    return evaluate_object(obj, capture, true, protocol=protocol, seconds=_seconds_of_run(run), meshes=meshes)


def evaluate_object(
    obj: ArticulatedObject,
    capture: Capture,
    truth: Truth | None,
    *,
    protocol: str = "strict",
    seconds: float | None = None,
    meshes: Sequence[trimesh.Trimesh] | None = None,
) -> Report:
    """The figures of an object; arguments as in `evaluate_run`, and the surfaces of its parts (`part_meshes`).

    Raises:
        ValueError: no such protocol.
    """
    if protocol not in PROTOCOLS:
        raise ValueError(f"protocol {protocol!r}: there is none of this name; give one of {', '.join(PROTOCOLS)}.")
    joints = score_joints(obj, truth) if truth else ()
    found = {score.part for score in joints}
    states = (obj.at([0.0] * len(obj.joints)), obj.at([joint.q[1] for joint in obj.joints]))
    rows = [psnr_on_views(splats, views) for splats, views in zip(states, capture.test, strict=True)]
    by_object: list[float | None] = [None, None]
    if PROTOCOLS[protocol].object_psnr:
        by_object = [psnr_on_views(splats, views, object_only=True) for splats, views in zip(states, capture.test, strict=True)]
    counts = [len(views) for views in capture.test]
    surfaces = None
    if truth and meshes is not None:
        parts = [score.part for score in joints]
        surfaces = score_surfaces(meshes, obj, truth, parts, SURFACE_PROTOCOLS[protocol], capture.train)
    return Report(
        protocol,
        joints,
        tuple(k for k in range(1, len(obj.parts)) if truth and k not in found),
        tuple(k for k, joint in enumerate(obj.joints, start=1) if joint.review),
        _mean(rows, counts),
        (rows[0], rows[1]),
        _mean(by_object, counts),
        seconds,
        surfaces,
    )


def write_report(report: Report, file: Path) -> None:
    """Writes a report as JSON, aside and then into place."""
    replace_file(file, json.dumps(report.as_json(), indent=1) + "\n")


def capture_of_run(run: Path) -> Path:
    """The folder of the capture that a run was fitted to.

    Raises:
        ValueError: the run's configuration is missing or damaged.
    """
    return Path(_configuration(run, "capture")[0])


def training_capture(run: Path) -> Capture:
    """The capture that a run was fitted to, with the training views that the fit had and cameras as it put them right.

    Raises:
        ValueError: the run's configuration, or the record of its cameras, is missing or damaged.
    """
    folder, views, seed = _configuration(run, "capture", "views", "seed")
    return RunFolder(run).put_right(load_capture(Path(folder), views=max(views), seed=seed))


def _configuration(run: Path, *names: str) -> list[Any]:
    """Entries of a run's configuration."""
    file = run / "config.json"
    try:
        record = json.loads(file.read_text())
        return [record[name] for name in names]
    except FileNotFoundError as error:
        raise ValueError(f"{run}: no run here (config.json is missing); run `structuregs fit` first.") from error
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{file}: not a run's configuration ({error!r}); fit again.") from error


def _seconds_of_run(run: Path) -> float | None:
    file = run / "timing.json"
    if not file.is_file():
        return None
    try:
        return float(json.loads(file.read_text())["total"])
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{file}: not a run's timing ({error!r}); delete it, or fit again.") from error


def _mean(values: list[float | None], counts: list[int]) -> float | None:
    """Mean over images, of the means of both states; None where there are no images."""
    rows = [(value, n) for value, n in zip(values, counts, strict=True) if value is not None]
    return sum(value * n for value, n in rows) / sum(n for _, n in rows) if rows else None
