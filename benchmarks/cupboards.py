"""Captures of cupboards that chance made, with their truth, for `structuregs bench`: objects that nobody tuned anything to.

    python benchmarks/cupboards.py -o DIR [--parts 2,3,4] [--seeds 0,1,2] [--size 256] [--views 40]
    structuregs bench DIR -o DIR/bench --seeds 0 --preset fast

Each is a cupboard with so many doors and drawers, some ajar in state 0, some shut (`structuregs.synthetic.random_object`).
"""

import argparse
from pathlib import Path

from structuregs.synthetic import RenderOptions, make_capture, random_object, save_known


def numbers(text):
    """Whole numbers with commas between."""
    return [int(word) for word in text.split(",")]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder of the captures")
    parser.add_argument("--parts", type=numbers, default=[2, 3, 4], metavar="N,...", help="numbers of moving parts")
    parser.add_argument("--seeds", type=numbers, default=[0, 1, 2], metavar="N,...", help="of the objects")
    parser.add_argument("--size", type=int, default=256, help="of the square photos, pixels")
    parser.add_argument("--views", type=int, default=40, help="of each state")
    options = parser.parse_args()
    for parts in options.parts:
        for seed in options.seeds:
            obj = random_object(seed, parts)
            capture = make_capture(obj, RenderOptions(size=options.size, views=options.views, samples=2))
            save_known(obj, capture, options.output / f"{parts}_parts_{seed}", "artgs")
            print(options.output / f"{parts}_parts_{seed}")


if __name__ == "__main__":
    main()
