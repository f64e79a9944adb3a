"""How far a search for parts has come: what was found, what was divided, what waits; clusters by index."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from .hypotheses import Hypothesis
from .pieces import MovingPart

_TORN = 0.8  # of what a cluster explained as one part: several that explain less together are that part, torn to pieces


Known = tuple[Hypothesis, frozenset[int]]
"""What a cluster was found to do, and the indices of those that move along."""


@dataclass(frozen=True)
class Found:
    """A part, and what it explains of both states' photos, less what speaks against its motion, in mean error."""

    part: MovingPart
    worth: float


@dataclass(frozen=True)
class Division:
    """A cluster taken for several parts: what it was as one, and the indices of the clusters in its place."""

    index: int
    whole: Found
    pieces: list[int]


@dataclass
class Progress:
    """What a search knows, and what it has still to try."""

    todo: list[int]  # in the order in which they are tried
    found: dict[int, Found] = field(default_factory=dict)  # parts, by the cluster that led to each
    explained: set[int] = field(default_factory=set)  # clusters that belong to a part, or that others took the place of
    divisions: list[Division] = field(default_factory=list)
    waiting: dict[int, float] = field(default_factory=dict)  # nothing fits these well; what each is worth
    known: dict[int, Known] = field(default_factory=dict)  # of those that wait or have waited
    refused: dict[int, tuple[int, float]] = field(default_factory=dict)  # large, and no part: state, share of its points

    @property
    def parts(self) -> list[MovingPart]:
        """Those found so far."""
        return [one.part for one in self.found.values()]

    def put_first(self, indices: Sequence[int]) -> None:
        """What is tried next."""
        self.todo = [*indices, *(i for i in self.todo if i not in indices)]

    def put_off(self, index: int, worth: float, sizes: Sequence[int]) -> None:
        """Until all others have been tried, as the other state may tell more; of those that wait the largest goes first.

        Args:
            index: of the cluster.
            worth: of the part that it would be as far as is known.
            sizes: of all clusters.
        """
        self.waiting[index] = worth
        at_last = [i for i in self.todo if i in self.waiting]
        self.todo = [i for i in self.todo if i not in self.waiting]
        self.todo += sorted([*at_last, index], key=lambda i: -sizes[i])


def undivided(found: dict[int, Found], divisions: Sequence[Division], explained: set[int]) -> dict[int, Found]:
    """What was found, by clusters; one that explained clearly more as a whole than its pieces do is one part again.

    Args:
        found: by the index of its cluster.
        divisions: in the order in which they were made; a piece may have been divided in its turn.
        explained: clusters that belong to a part; a piece among them that is no part belongs to another's, and the cluster
            that held it stays divided.
    """
    found = dict(found)
    ends: dict[int, list[int]] = {}  # of clusters that were divided: what became of them
    for division in reversed(divisions):
        pieces = [end for index in division.pieces for end in ends.get(index, [index])]
        worth = sum(found[index].worth for index in pieces if index in found)
        if worth < _TORN * division.whole.worth and explained.isdisjoint(set(pieces) - found.keys()):
            found = {index: one for index, one in found.items() if index not in pieces}
            found[division.index], pieces = division.whole, [division.index]
        ends[division.index] = pieces
    return found


def worth_more(waiting: dict[int, float], explains: set[int], worth: float) -> int | None:
    """The waiting cluster that is itself worth most, of those that a part of less worth would explain; None if none is.

    Such a part is a scrap of what waits, as the other state shows it, and would be all that is left of it.

    Args:
        waiting: what each waiting cluster is worth, by index.
        explains: clusters that lie where the part is.
        worth: of the part.
    """
    better = [index for index in explains & waiting.keys() if waiting[index] > worth]
    return max(better, key=waiting.__getitem__, default=None)
