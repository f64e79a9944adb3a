"""From a capture to an articulated object: the whole way, in a run's folder that it can go on from."""

import tempfile
from collections.abc import Callable, Generator, Iterator
from copy import deepcopy
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from ..boxes import MovingPart, PartSearch, boxes_at_rest, boxes_of_parts, look_at_states, seeded, strewn
from ..capture import Capture
from ..geometry import SE3, JointKind
from ..joints import articulate, joints_of
from ..model import ArticulatedObject, PosedParts, load_object, save_object
from ..points import points_from
from .boxes import object_size, tightened
from .events import Finished, FitEvent, Note, Preview, StageStarted, Step
from .evidence import alike_in_both, covered_in_both, outlined_in_both, seen_in_both
from .loop import Fitter
from .run import Clock, RunFolder
from .schedule import PRESETS, FitConfig
from .state import FitState
from .straight import straight_where_loose

_PREVIEW_EVERY = 50  # steps
_ANEW = 0.35  # of the fit: by then cameras that are turned are nearly right, and all begins anew with them
_Beginning = Generator[FitEvent, None, FitState]


def choose_device(name: str) -> torch.device:
    """The device of a name: "auto" takes the GPU where the renderer can use it.

    Raises:
        ValueError: "cuda" on a machine without a GPU that torch can use.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise ValueError("--device cuda: torch finds no GPU here; use --device cpu, or install a torch build with CUDA.")
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    return torch.device(name)


def start_parts(
    capture: Capture, config: FitConfig, *, parts: int | None, points: str, seed: int
) -> Generator[FitEvent, None, PosedParts]:
    """Boxes, motions and the splats strewn in them, its progress as events."""
    given = points_from(capture, points)
    for sentence in given.says if given else ():
        yield Note(sentence, lasting=True)
    yield StageStarted("look", 2)
    looks = []
    for look in look_at_states(capture, given, config.start, seed):
        looks.append(look)
        yield Step("look", len(looks), None, None, sum(len(look.splats) for look in looks))
    pair = (looks[0], looks[1])
    generator = torch.Generator().manual_seed(seed)
    filling = (config.splats_per_part, config.sh_degree, generator)
    if config.hypotheses:
        search = PartSearch(pair, config.start.search, seed)
        found = (yield from _searched(search))[:parts]
        for state, share in search.left_over:
            yield Note(
                f"{share:.0%} of what state {state} shows is in no part: no one motion puts it where state {1 - state} has it",
                lasting=True,
            )
        boxes, motions = boxes_of_parts(search.pieces, found, config.start)
        posed = seeded(boxes, motions, pair, found, *filling, config.growth.reach * object_size(boxes))
    else:
        boxes, motions = boxes_at_rest(pair, parts, config.start)
        posed = strewn(boxes, motions, *filling, pair[0].splats.base_rgb.mean(0))
    count = len(posed) - 1
    yield Note(f"{count} moving part{'' if count == 1 else 's'} found")
    if parts is not None and count != parts:
        yield Note(f"{parts} were asked for: what else moves does not show in masks and photos", lasting=True)
    return posed


def _searched(search: PartSearch) -> Generator[FitEvent, None, list[MovingPart]]:
    """The moving parts that a search finds, its progress as events."""
    clusters = len(search.pieces)
    yield StageStarted("search", max(clusters, 1))
    steps = search.steps()
    while True:
        try:
            yield Step("search", next(steps), None, None, 0)
        except StopIteration as done:
            yield Step("search", max(clusters, 1), None, None, 0)
            return done.value


def finished_object(state: FitState) -> ArticulatedObject:
    """The object of a fit that has taken its last step.

    A moving part that has no splats left was in the air, and is none.  A joint is no clearer than it was while its motion was
    still free: the lower confidence of the two stands.
    """
    parts = state.variables.parts().detach()
    left = [k for k, count in enumerate(parts.counts) if k == 0 or count]
    counts = tuple(parts.counts[k] for k in left)
    parts = tightened(replace(parts, boxes=parts.boxes[left], motions=parts.motions[left], counts=counts))
    if state.variables.kinds is None:
        return articulate(parts)
    kinds: list[JointKind] = [state.variables.kinds[k - 1] for k in left[1:]]
    obj = articulate(parts, kinds)
    free = joints_of(replace(parts, motions=SE3(state.free_motions[left])), kinds)
    joints = [
        replace(joint, confidence=before.confidence, review=joint.review or before.review)
        if before.confidence < joint.confidence
        else joint
        for joint, before in zip(obj.joints, free, strict=True)
    ]
    return replace(obj, joints=tuple(joints))


def unfinished_object(state: FitState) -> ArticulatedObject:
    """The object of a fit as it stands: a copy on the CPU, which no later step changes."""
    obj = finished_object(state)
    return replace(obj, parts=deepcopy(obj.parts.to(torch.device("cpu"))))


def fit_run(
    capture: Capture,
    run: Path,
    config: FitConfig,
    *,
    device: str = "auto",
    parts: int | None = None,
    points: str = "hull",
    seed: int = 0,
) -> Iterator[FitEvent]:
    """Fits a capture in a run's folder, from its last checkpoint where there is one, and yields what happens.

    Args:
        capture: what was photographed.
        run: folder of the run; made if it is not there.
        config: the whole configuration.
        device: "auto", "cpu" or "cuda".
        parts: number of moving parts, of which then none is merged with another; estimated if None.
        points: where first points come from: "hull", "depth", "vggt", "pi3" or a file (see `points.points_from`).
        seed: of all randomness; the same seed gives the same bytes on a CPU.

    Raises:
        ValueError: the folder holds another run, or a damaged one.
    """
    chosen, folder = choose_device(device), RunFolder(run)
    config = config if parts is None else replace(config, join_at=1.0)
    views = [len(state) for state in capture.train]
    record = {"capture": str(capture.root.resolve()), "views": views, "seed": seed, "parts": parts, "points": points}
    folder.begin(record | {"fit": asdict(config)})
    if (folder.object / "object.json").exists():
        yield Note(f"{run} is finished; nothing is left to do")
        yield Finished(load_object(folder.object), run)
        return
    torch.set_num_threads(1)  # the renderer has the cores; small tensors only lose by being shared out
    clock = Clock(folder)
    begin = partial(_begin, folder=folder, config=config, device=chosen, parts=parts, points=points, seed=seed)
    if folder.checkpoint.exists():
        state = FitState.load(folder.checkpoint, chosen)
        folder.cut_metrics(state.step)
        yield Note(f"going on from step {state.step}")
    else:
        state = yield from begin(capture)
        clock.save()
    fitter = Fitter(capture, config, state, seed, chosen)
    yield from _all_steps(fitter, folder, clock, begin)
    if config.rates.principal_point or fitter.state.turns is not None:
        folder.keep_cameras(fitter.state.offset.detach(), fitter.state.turns, capture)
    photos = folder.put_right(capture)
    obj = finished_object(fitter.state)
    if config.along_base:
        obj = straight_where_loose(obj, photos)
    for evidence in (seen_in_both, covered_in_both, outlined_in_both, alike_in_both):
        obj = evidence(obj, photos)
    save_object(obj, folder.object)
    clock.save()
    yield Finished(obj, run)


def _all_steps(fitter: Fitter, folder: RunFolder, clock: Clock, begin: Callable[..., _Beginning]) -> Iterator[FitEvent]:
    """The steps that are left, with records and checkpoints; where cameras had to be turned, all begins anew with them."""
    config = fitter.config
    yield StageStarted("fit", config.steps)
    yield Preview(partial(unfinished_object, fitter.state))
    while (done := fitter.state.step) < config.steps:
        if fitter.state.turns is not None and not fitter.state.anew and done >= _ANEW * config.steps:
            yield Note("parts are searched for again, with the cameras as they are turned by now")
            fitter.state = yield from begin(fitter.capture, turns=fitter.state.turns)
            yield StageStarted("fit", config.steps)
            continue
        for event in fitter.run(done - done % config.checkpoint_every + config.checkpoint_every):
            if isinstance(event, Step):
                folder.report(event)
            yield event
            if isinstance(event, Step) and event.step % _PREVIEW_EVERY == 0:
                yield Preview(partial(unfinished_object, fitter.state))
        fitter.state.save(folder.checkpoint)
        clock.save()


def _begin(
    capture: Capture,
    *,
    folder: RunFolder,
    config: FitConfig,
    device: torch.device,
    parts: int | None,
    points: str,
    seed: int,
    turns: tuple[Tensor, Tensor] | None = None,
) -> _Beginning:
    """The state before the first step, which is also the run's checkpoint, the cameras turned if they have to be."""
    photos = capture if turns is None else capture.turned(turns)
    begun = yield from _noted(start_parts(photos, config, parts=parts, points=points, seed=seed), folder)
    state = replace(FitState.start(begun.to(device), config.give_way), turns=turns, anew=turns is not None)
    folder.cut_metrics(0)
    state.save(folder.checkpoint)
    return state


def _noted(events: Generator[FitEvent, None, PosedParts], folder: RunFolder) -> Generator[FitEvent, None, PosedParts]:
    """The events; what lasts of their notes is written into the run when they end."""
    notes: list[str] = []
    while True:
        try:
            event = next(events)
        except StopIteration as done:
            if notes:
                folder.keep_sentences(notes)
            return done.value
        if isinstance(event, Note) and event.lasting:
            notes.append(event.text)
        yield event


def reconstruct(
    capture: Capture,
    run: Path | None = None,
    config: FitConfig | None = None,
    *,
    device: str = "auto",
    parts: int | None = None,
    points: str = "hull",
    seed: int = 0,
) -> ArticulatedObject:
    """The articulated object of a capture.

    Args:
        capture: what was photographed.
        run: folder to keep the run in, as `structuregs fit -o` does; nothing is kept if None.
        config: default: the preset "default".
        device: "auto", "cpu" or "cuda".
        parts: number of moving parts; estimated if None.
        points: where first points come from: "hull", "depth", "vggt", "pi3" or a file (see `points.points_from`).
        seed: of all randomness.
    """
    config = config or PRESETS["default"]
    with tempfile.TemporaryDirectory() as scratch:
        folder = run if run is not None else Path(scratch)
        for event in fit_run(capture, folder, config, device=device, parts=parts, points=points, seed=seed):
            if isinstance(event, Finished):
                return event.obj
    raise RuntimeError("the fit ended without a result.")
