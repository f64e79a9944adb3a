"""One fit of a study."""

from collections.abc import Callable
from dataclasses import dataclass

from ..capture import Capture
from ..fit.schedule import FitConfig


def as_they_are(capture: Capture) -> Capture:
    """The photos, unchanged."""
    return capture


@dataclass(frozen=True)
class Setting:
    """One fit of a study, and what is different about it.

    Attributes:
        name: of the setting and of its run's folder.
        says: what is different, in a few words.
        config: of the fit.
        points: where the first points come from, as `fit_run` takes it.
        photos: makes the photos that are fitted of the capture's.
    """

    name: str
    says: str
    config: FitConfig
    points: str = "hull"
    photos: Callable[[Capture], Capture] = as_they_are
