"""New scenes with exact cameras, rendered by Blender: a check of the defaults on what nobody has tuned them on.

    pip install -e '.[blender]'                     # Blender as a module, for Python 3.11
    python benchmarks/blender_scenes.py FOLDER                        # all scenes, 800 x 800 px, 100 + 50 views
    python benchmarks/blender_scenes.py FOLDER --scenes plant --size 400
    CLSPLAT_DATA=FOLDER python benchmarks/defaults.py --cases plant:-1:50000:7000 --systems default,3dgs

Each object lies in a cube of side 2.6 around the origin. Cameras look at it from the upper half of a sphere, as in
NeRF-synthetic: test views are a spiral, training views are random. Photos are RGBA. Five places are seen from inside
instead. They have points on surfaces that cameras see, as from COLMAP. `room` is closed. `flat` is a walk through two
rooms with windows. `front` has photos from one side only, as LLFF's scenes: a plant before a shelf and a window.
`garden` has a table that cameras walk around, and houses, hills and the sky behind it. `lane` is a walk between houses.
Everything is drawn with fixed seeds. Photos that are there are kept, so an interrupted command goes on.
"""

from __future__ import annotations

import argparse
import importlib.util
from pathlib import Path

OBJECTS = ("plant", "metals", "wires", "dishes")  # with transparent photos
NAMES = (*OBJECTS, "room", "flat", "front", "garden", "lane")


def main() -> None:
    """Read the command line, and render what is missing."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("folder", type=Path, help="where the scenes are written, a folder each")
    arguments.add_argument("--scenes", nargs="+", choices=NAMES, default=NAMES, help="which scenes")
    arguments.add_argument("--size", type=int, default=800, help="width and height [pixels]")
    arguments.add_argument("--train", type=int, default=100, help="number of training views")
    arguments.add_argument("--test", type=int, default=50, help="number of test views")
    args = arguments.parse_args()
    if importlib.util.find_spec("bpy") is None:
        arguments.exit(1, "Blender is not here as a module: pip install bpy==5.0.* with Python 3.11\n")
    from blender_render import render

    for name in args.scenes:
        render(args.folder / name, name, args.size, args.train, args.test)


if __name__ == "__main__":
    main()
