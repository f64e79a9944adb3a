"""What a fit reports while it runs; the command line, a viewer and the tests consume the same stream."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ..model import ArticulatedObject


@dataclass(frozen=True)
class StageStarted:
    """A stage of the fit begins.

    Attributes:
        stage: its name, as `Step.stage` repeats it.
        steps: how many steps it will take.
    """

    stage: str
    steps: int


@dataclass(frozen=True)
class Step:
    """A step is done.

    Attributes:
        stage: the stage it belongs to.
        step: steps done in this stage, from 1.
        loss: total loss of the step; None where the stage has none to show.
        psnr: of the step's training images, dB; None where the stage renders none.
        splats: number of splats of all parts.
    """

    stage: str
    step: int
    loss: float | None
    psnr: float | None
    splats: int


@dataclass(frozen=True)
class Note:
    """Something a user should know, in one sentence.

    Attributes:
        text: the sentence.
        lasting: whether it says something of the result, which whoever reads the report should know too.
    """

    text: str
    lasting: bool = False


@dataclass(frozen=True)
class Preview:
    """The object can be looked at as it stands now.

    Attributes:
        obj: makes a copy of it that no later step changes; to be called before the next event is taken.
    """

    obj: Callable[[], ArticulatedObject]


@dataclass(frozen=True)
class Finished:
    """The fit is done.

    Attributes:
        obj: the articulated object.
        run: the folder of the run; None where nothing was written.
    """

    obj: ArticulatedObject
    run: Path | None


FitEvent = StageStarted | Step | Note | Preview | Finished
