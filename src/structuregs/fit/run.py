"""The folder of a run: its files, and what is read from them to go on."""

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..capture import Capture
from ..files import replace_file
from .events import Step

_OFF_CENTRE = 0.4  # pixels: a principal point that was off by so much, such as half a pixel, is worth a sentence


@dataclass(frozen=True)
class RunFolder:
    """The files of a run (docs/format.md)."""

    root: Path

    @property
    def config(self) -> Path:
        """The effective configuration."""
        return self.root / "config.json"

    @property
    def checkpoint(self) -> Path:
        """The last checkpoint."""
        return self.root / "checkpoints" / "last.pt"

    @property
    def metrics(self) -> Path:
        """Loss and PSNR, one JSON record a line."""
        return self.root / "metrics.jsonl"

    @property
    def timing(self) -> Path:
        """Seconds spent, over all sittings."""
        return self.root / "timing.json"

    @property
    def cameras(self) -> Path:
        """How the cameras were put right; not there where the fit took them as they were."""
        return self.root / "cameras.json"

    @property
    def notes(self) -> Path:
        """What the fit said of its result, a sentence a line; not there where it said nothing."""
        return self.root / "notes.txt"

    @property
    def object(self) -> Path:
        """The folder of the articulated object."""
        return self.root / "object"

    def begin(self, record: dict) -> None:
        """Writes the configuration of a new run, or holds an old run's against it.

        Raises:
            ValueError: the folder holds a run of another configuration, or something that is no run.
        """
        if not self.config.exists():
            if self.root.exists() and any(p.name != "capture" for p in self.root.iterdir()):
                raise ValueError(f"{self.root}: the folder is not empty and holds no run; choose another with -o.")
            replace_file(self.config, json.dumps(record, indent=1) + "\n")
            return
        try:
            before = json.loads(self.config.read_text())
        except json.JSONDecodeError as error:
            raise ValueError(f"{self.config}: not a configuration ({error}); choose another folder with -o.") from error
        if not isinstance(before, dict):
            raise ValueError(f"{self.config}: not a configuration (no JSON object); choose another folder with -o.")
        changed = [key for key in sorted(record.keys() | before.keys()) if _plain(record.get(key)) != before.get(key)]
        if changed:
            raise ValueError(
                f"{self.root}: a run with another {', '.join(changed)} lies here; go on with the same or choose another folder."
            )

    def seconds(self) -> float:
        """Seconds spent so far."""
        return json.loads(self.timing.read_text())["total"] if self.timing.exists() else 0.0

    def put_right(self, capture: Capture) -> Capture:
        """The capture that the run was fitted to, its cameras as the fit has put them right: turns are of training views only.

        Raises:
            ValueError: `cameras` is damaged, or of another capture.
        """
        if not self.cameras.exists():
            return capture
        try:
            record = json.loads(self.cameras.read_text())
            shifted = capture.shifted(torch.tensor(record["principal_point"]).reshape(2))
            if "turns" not in record:
                return shifted
            turns = [
                torch.tensor([record["turns"][s][view.name] for view in views]).reshape(len(views), 3)
                for s, views in enumerate(capture.train)
            ]
        except (ValueError, KeyError, IndexError, TypeError, RuntimeError) as error:
            raise ValueError(f"{self.cameras}: does not say how this capture's cameras are ({error!r}); fit again.") from error
        return shifted.turned(turns)

    def keep_cameras(self, offset: Float[Tensor, " 2"], turns: Sequence[Float[Tensor, "_ 3"]] | None, capture: Capture) -> None:
        """Writes `cameras`, and adds to `notes` how far they were off where that is clear to see.

        Args:
            offset: of every camera's principal point (see `Camera.shifted`).
            turns: of the training cameras of either state; None where none was turned.
            capture: that was fitted.
        """
        record: dict[str, Any] = {"principal_point": offset.tolist()}
        camera, notes = capture.train[0][0].camera, []
        right, down = (offset * torch.tensor([camera.fx, camera.fy])).tolist()
        if max(abs(right), abs(down)) >= _OFF_CENTRE:
            beside = f"{abs(right):.2f} pixels {'right' if right > 0 else 'left'} of"
            over = f"{abs(down):.2f} {'below' if down > 0 else 'above'}"
            notes.append(f"all photos lie {beside} and {over} what their cameras show: the principal point was moved")
        if turns is not None:
            record["turns"] = [
                {view.name: turn for view, turn in zip(views, state.tolist(), strict=True)}
                for views, state in zip(capture.train, turns, strict=True)
            ]
            degrees = float(torch.cat(list(turns)).norm(dim=-1).median().rad2deg())
            notes.append(f"cameras pointed {degrees:.2f} degrees beside their photos (median) and were turned")
        replace_file(self.cameras, json.dumps(record, indent=1) + "\n")
        if notes:
            self.keep_sentences(list(dict.fromkeys([*self.sentences(), *notes])))

    def sentences(self) -> list[str]:
        """The sentences of `notes`; none where it is not there."""
        return self.notes.read_text().splitlines() if self.notes.exists() else []

    def keep_sentences(self, sentences: Sequence[str]) -> None:
        """Writes `notes`."""
        replace_file(self.notes, "".join(f"{sentence}\n" for sentence in sentences))

    def records(self) -> list[dict[str, Any]]:
        """The records of `metrics`, step by step; none where it is not there."""
        return [json.loads(line) for line in self.metrics.read_text().splitlines()] if self.metrics.exists() else []

    def report(self, step: Step) -> None:
        """Adds a record to `metrics`."""
        with self.metrics.open("a") as out:
            out.write(json.dumps({"step": step.step, "loss": step.loss, "psnr": step.psnr, "splats": step.splats}) + "\n")

    def cut_metrics(self, step: int) -> None:
        """Drops the records of steps after `step`, which a run that goes on will write again."""
        if self.metrics.exists():
            lines = [line for line in self.metrics.read_text().splitlines(keepends=True) if line.endswith("\n")]
            replace_file(self.metrics, "".join(line for line in lines if json.loads(line)["step"] <= step))


def _plain(value: object) -> object:
    """A value as JSON gives it back."""
    return json.loads(json.dumps(value))


class Clock:
    """Adds this sitting's seconds to the run's."""

    def __init__(self, folder: RunFolder):
        self.file, self.before, self.began = folder.timing, folder.seconds(), time.monotonic()

    def save(self) -> None:
        """Writes the total so far."""
        replace_file(self.file, json.dumps({"total": round(self.before + time.monotonic() - self.began, 2)}) + "\n")
