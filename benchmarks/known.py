"""Captures of known objects with their truth, for `structuregs bench`: objects that nobody tuned anything to.

    python benchmarks/known.py -o DIR [--parts 2,3,4 | --objects scissors,oven] [--seeds 0,1,2] [--size 256] [--views 40]
    structuregs bench DIR -o DIR/bench --seeds 0

Either cupboards that chance made, with so many doors and drawers, some ajar in state 0, some shut
(`structuregs.synthetic.random_object`), or objects by name (`structuregs.synthetic.OBJECTS`).
"""

import argparse
import itertools
from pathlib import Path

from structuregs.synthetic import OBJECTS, RenderOptions, make_capture, make_object, random_object, save_known


def numbers(text):
    """Whole numbers with commas between."""
    return [int(word) for word in text.split(",")]


def names(text):
    """Words with commas between, each an object's name."""
    words = text.split(",")
    if words != ["all"] and (unknown := [word for word in words if word not in OBJECTS]):
        raise argparse.ArgumentTypeError(f"no object is named {', '.join(unknown)}; choose from {', '.join(OBJECTS)}")
    return words


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder of the captures")
    parser.add_argument("--parts", type=numbers, default=[2, 3, 4], metavar="N,...", help="numbers of moving parts")
    parser.add_argument("--objects", type=names, metavar="NAME,...", help="in place of cupboards; or: all")
    parser.add_argument("--seeds", type=numbers, default=[0, 1, 2], metavar="N,...", help="of the objects")
    parser.add_argument("--size", type=int, default=256, help="of the square photos, pixels")
    parser.add_argument("--views", type=int, default=40, help="of each state")
    options = parser.parse_args()
    kinds = options.objects or options.parts
    for kind, seed in itertools.product(list(OBJECTS) if kinds == ["all"] else kinds, options.seeds):
        obj = make_object(kind, seed) if options.objects else random_object(seed, kind)
        folder = options.output / (f"{kind}_{seed}" if options.objects else f"{kind}_parts_{seed}")
        capture = make_capture(obj, RenderOptions(size=options.size, views=options.views, samples=2))
        save_known(obj, capture, folder, "artgs")
        print(folder)


if __name__ == "__main__":
    main()
