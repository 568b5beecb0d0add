"""Where the skew is: a view of a model beside the same view coloured by |skew|, and quantiles of |skew|.

    python benchmarks/skew_picture.py MODEL_OR_PLY CAMERAS_JSON OUT.png [--view 0]

The left half is the render. The right half shows |m| / its limit, from black (Gaussian) over orange to white
(half-Gaussian).
"""

from __future__ import annotations

from pathlib import Path

import common
import numpy as np

from clsplat.cameras.cameras_json import read_cameras
from clsplat.files.images import write_png
from clsplat.rendering.renderer import Renderer
from clsplat.splats.harmonics import SH_C0
from clsplat.splats.shapes import SKEW_LIMIT
from clsplat.splats.splats import Splats
from clsplat.training.folder import ModelFolder


def main() -> None:
    parser = common.parser(__doc__, device=False, table=False, smoke=False)
    parser.add_argument("model", type=Path)
    parser.add_argument("cameras", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--view", type=int, default=0)
    args = parser.parse_args()
    path = args.model if args.model.is_file() else ModelFolder(args.model).latest_ply()[0]
    splats = Splats.load(path)
    camera = read_cameras(args.cameras)[args.view].camera
    size = np.linalg.norm(splats.skew, axis=1) / SKEW_LIMIT
    heat = np.stack([np.minimum(2 * size, 1), size, np.maximum(2 * size - 1, 0)], axis=1)
    arrays = splats.to_numpy() | {"sh": ((heat - 0.5) / SH_C0)[:, None, :].astype(np.float32)}
    renderer = Renderer()
    pictures = [renderer.render(s, camera).color for s in (splats, Splats(splats.shape, arrays, splats.normalisation))]
    write_png(args.out, np.clip(np.concatenate(pictures, axis=1), 0, 1))
    opacity = 1 / (1 + np.exp(-splats.opacity_logit))
    print(
        f"{len(splats)} splats; |skew|/limit quantiles 10 25 50 75 90 %: "
        + " ".join(f"{q:.2f}" for q in np.quantile(size, (0.1, 0.25, 0.5, 0.75, 0.9)))
        + f"; share above 0.4: {np.mean(size > 0.4):.0%}, by opacity {np.average(size > 0.4, weights=opacity):.0%}"
    )


if __name__ == "__main__":
    main()
