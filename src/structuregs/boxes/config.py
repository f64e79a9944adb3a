"""How the moving parts are searched."""

from dataclasses import dataclass, field

from .cue import CueConfig


@dataclass(frozen=True)
class SearchConfig:
    """How widely motions are searched."""

    cue: CueConfig = field(default_factory=CueConfig)
    """The motion cue."""
    most: int = 12
    """Clusters that are looked at, the largest first, of twice as many."""
    mixed: float = 1.6
    """A cluster holds several parts if its splats, each with as much or as little of the motion as suits it, would take this
    many times as much off the photos' error as with one motion for all; of single parts it is .95 to 1.25 times..."""
    divided: float = 0.06
    """...and by more than this share of the cluster's weight: what hardly shows in the other state says nothing."""
    cut: float = 1.04
    """A cluster is cut across where its pieces, each going as far as suits it, explain so many times as much of both states'
    photos as together: single parts have nowhere such a cut..."""
    cut_shut: float = 1.13
    """...and so many times, where only fronts show in the other state."""
    cut_finely: float = 1.02
    """With all others in place it is cut in two where pieces that go nearly as far explain so many times as much..."""
    unlike: float = 0.1
    """...if going as one costs the photos more than this fraction of the weight of the lesser."""
    clear_case: float = 1.0
    """A part that explains less than this share of its weight, of the 2 that it could of both states' photos, waits until the
    other state's clusters have been tried: it may be several."""
    shows: float = 0.1
    """What takes less than this share of a cluster's weight off the error of the other state's photos was shut there, and is
    told by its front; where it is several parts, by theirs."""
    hopeless: float = 0.3
    """Another way for a part to lie is not pulled into place if it costs this share of the part's weight more."""
    thinner: float = 0.7
    """A part is shown by the other state's splats if its box has less than this share of the volume there..."""
    as_clear: float = 0.7
    """...and if it has at least this share of its weight there: what is shut shows its front only."""
    together: int = 3
    """A part may show as several clusters of a state: the boxes of so many with any one are laid upon the other state's."""
    there: float = 0.12
    """A cluster whose absence costs the photos of its own state less than this, in mean error of the pixels that show it, is
    no surface, but splats in the air before one that few views see; surfaces come out at .15 to 1, these below .1."""
    painted: float = 0.05
    """A cluster that paints less of its own state's photos than this times its share of the state's points is no surface, but
    points in the air where there are hardly any splats; surfaces come out at .3 and more, these below .01."""
    clear: float = 3.0
    """Splats this near to a cluster's box, in voxels, belong to it."""
    shortlist: int = 110
    """Hypotheses per cluster that pass the hull and are shown to the photos."""
    finalists: int = 3
    """Distinct hypotheses per cluster that the photos pull into place: so many of the photos' choice and of the masks'."""
    looks: int = 10
    """Photos of either state that judge."""
    steps: int = 40
    """Optimiser steps for each finalist."""
    rate: float = 0.03
    """Of a finalist's pose: radians, and parts of the box's half diagonal."""
    plain: float = 0.1
    """The simplest motion near a finalist is taken if that costs less than this share of what the part explains..."""
    plain_if_shut: float = 0.25
    """...or this, of what was shut: its front was brought back without the sides that the photos show, and is drawn aside."""
    same: float = 0.15
    """Two parts may be one if their motions are this close, over the half diagonal of the one..."""
    alike: float = 0.12
    """...and if moving it just like the other, or both as one, costs the photos less than this fraction of the part's weight,
    the lesser's."""
    crumbs: float = 0.3
    """Of a part that is left with less than this share of its points, when one beside it has taken what moves along, nothing
    stays."""
    shown: float = 0.2
    """Clusters are moved together if the photos of the other state then show this share of the weight of each."""
    large: float = 0.01
    """A part that holds this fraction of its state's points came from somewhere: it is kept if it does little harm..."""
    harm: float = 0.01
    """...and adds less than this fraction to the photo error; what is shut may show in no photo, and out of sight it is
    kept whatever it adds."""
