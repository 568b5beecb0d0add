"""What a run decides by itself: options that the caller did not name, from what the scene shows and how long it is.

- A short run learns Gaussians. A step with skewed splats takes longer, and in as much time a short run gains more from
  further steps. A run that names its shape or an option of the skew keeps its shape.
- Transparent photos are trained over random backgrounds for most of the run. Over one colour, a splat of that colour
  costs nothing wherever it is, and other views see it before the object.
- If the photos show an object in front of one colour, that colour is behind the splats (plain_background.py). It is cut
  out of the photos (scenes/cut_out.py).
- A run that starts at random places, or at few points of the scene, has splats that no photo needs. Transparent photos
  get the strategy that relocates them (`mcmc`). With `adc` a penalty on opacity lets them fade until they are pruned.
- Beside the points of a scene, some splats start at random places too: a plain wall has no points, and would else get
  no splats. They also need the penalty.
- With few photos, splats that fit a single photo are cheap, and other views see them. A part of the splats is not drawn
  in each iteration (dropout.py). Longer runs fit each photo more closely, so they need this with more photos, too.
  Depths have a penalty on steps (depth_smoothness.py). Splats that only views between the photos show large are removed
  (occluders.py). With very few photos, no splat starts at a random place beside the scene's points.
- Splats that start at random places have a longer way, so their learning rates are twice as high.
- On several devices, an iteration has a photo for each of them.
- A step of Adam reads and writes every parameter, also of splats that the image does not show. On a GPU it takes a
  large part of an iteration. If photos show a part of a large scene, only visible splats step (optim/lazy.py).
- A model is antialiased, with a low pass as wide as a pixel. It then looks alike at all sizes of the image, and sharper
  at that of the photos. A run that starts from a model keeps the model's filter.
- Splats very close to a camera are not drawn (`near_plane.py`): one of them can hide a whole scene from views between
  those of the photos.

docs/decisions.md has the measurements.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ..cameras.seen import mean_share_seen, sampled, sampled_views
from ..device.device import open_device
from ..device.specs import count_devices, first_device
from ..splats.color import BLACK
from ..splats.low_pass import LOW_PASS, PIXEL
from ..splats.shapes import PLAIN_SHAPE
from ..splats.splats import Splats
from .config import OPTIONS, TrainConfig
from .initialise import FROM_POINTS, MIN_POINTS, names_model
from .log import Progress
from .near_plane import choose_near_plane
from .options.density import Adc, Mcmc
from .options.groups import OptimConfig
from .options.option import option_table
from .plain_background import plain_background
from .silhouettes import TRANSPARENT_SHARE, transparent_share

if TYPE_CHECKING:
    from ..scenes.scene import Scene

DECIDED = tuple(name for name, definition in OPTIONS.items() if definition.by_scene)
FEW_POINTS = 0.05  # fewer points than this share of the cap are few
PENALTY = 0.005  # weight of the mean opacity in a run with splats that start at random and adc
RANDOM_SHARE = 0.05  # share of the cap that starts at random places beside the scene's points
RANDOM_SHARE_OF_FEW = 0.1  # the same, if the scene has fewer points than this share
RANDOM_SHARE_OF_VERY_FEW = 0.5  # the same, if it has so few that the start counts as random (FEW_POINTS)
FEW_VIEWS = 12  # with more training views, a short run loses more by dropout than it gains
FEW_FOR_LONG_RUN = 18  # the same for a longer run, which fits each photo more closely
VERY_FEW_VIEWS = 6  # with more training views, random points beside the scene's gain more than they cost
DROPOUT = 0.3  # part of the splats that is not drawn in an iteration of a run with few views
SMALL_DROPOUT = 0.1  # the same with few views for a long run
SMOOTHNESS = 0.1  # weight of the penalty on steps of the depth of a run with few views
RANDOM_START_RATES = 2.0  # factor on the learning rates of a run that starts at random
SEEN_SHARE = 0.7  # of the scene's points in a photo: with a smaller share, only visible splats step on a GPU
UNSEEN_SPLATS = 50_000  # fewer splats outside of a photo save less time than the two further commands take
SHORT_RUN = 2500  # photos in all iterations: in longer runs the skew gains as much as further iterations do, or more
SKEW_OPTIONS = {"shape", "normalisation", "skew_lr", "skew_map", "alternation"}  # who names one wants a skew
SCREEN_FILTER = ("antialiased", "low_pass")
# Decided by transparent photos, and by those that an object does not fill.
BY_TRANSPARENCY = {"random_points", "random_background", "strategy", "background", "cut_background"}
CUT_SHARE = 0.2  # of the photos: a smaller background is the frame of a photo that shows more than an object
FEWEST_ITERATIONS = 100  # shorter runs have rates that must not be raised
_RATES = tuple(name for name in option_table(OptimConfig) if name.endswith("_lr") or name.startswith("position_lr"))


@dataclass(frozen=True)
class Decision:
    """The options of a run, and why it has them.

    Attributes
    ----------
    config : complete options; deciding again changes nothing.
    reasons : a phrase for each decision, such as "strategy mcmc, because the scene has no points".
    """

    config: TrainConfig
    reasons: tuple[str, ...]

    def __str__(self) -> str:
        return f"decided: {'; '.join(self.reasons)}"

    def tell(self, progress: Callable[[Progress], None] | None) -> TrainConfig:
        """Send the reasons as one message, and return the options."""
        if progress is not None and self.reasons:
            progress(Progress.note(str(self), self.config.iterations))
        return self.config


def decide(scene: Scene, config: TrainConfig) -> Decision:
    """Return the options of a run on a scene. Options that the caller named stay as they are.

    Parameters
    ----------
    scene : its training views and points are looked at, never its test views.
    config : options of the run. All options of a stored run count as named (`TrainConfig.named_options`).
    """
    from ..scenes.split import split_for_run  # lazy: it loads an image library, which would slow down --help

    scene = split_for_run(scene, config.validation.validate)
    chosen, reasons, share = for_background(scene, config)
    transparent = share >= TRANSPARENT_SHARE
    why = random_start(scene, config)
    share_random = config.start.random_points if config.start.init == "sfm" else 0.0
    if "random_points" not in config.named_options and (beside := share_beside(scene, config, transparent)):
        chosen["random_points"] = share_random = beside
        reasons.append(f"random points beside the scene's ({beside:.0%} of the cap), because some parts may have none")
    if (devices := count_devices(config.device)) > 1 and "batch" not in config.named_options:
        chosen["batch"] = devices
        reasons.append(f"{devices} photos in an iteration, because there are {devices} devices")
    batch = chosen.get("batch", config.schedule.batch)
    is_short = config.iterations * batch <= SHORT_RUN
    for name, value, reason in for_few_photos(len(scene.train), is_short):
        if name not in config.named_options:
            chosen[name] = value
            reasons.append(reason)
    if transparent and "random_background" not in config.named_options:
        chosen["random_background"] = True
        part = "" if config.random_background_until == 1 else f" for {config.random_background_until:.0%} of the run"
        reasons.append(f"random backgrounds{part}, because {share:.0%} of the photos' pixels are transparent")
    if transparent and why and "strategy" not in config.named_options:
        chosen["strategy"] = Mcmc.strategy
        reasons.append(f"strategy {Mcmc.strategy}, because {why}")
    elif config.strategy == Adc.strategy and "opacity_reg" not in config.named_options and (why or share_random):
        chosen["opacity_reg"] = PENALTY
        reasons.append(f"a penalty on opacity of {PENALTY:g}, because {why or 'some points are random'}")
    if why and config.iterations >= FEWEST_ITERATIONS and not {"lr_factor", *_RATES} & config.named_options.keys():
        chosen["lr_factor"] = RANDOM_START_RATES
        reasons.append(f"learning rates times {RANDOM_START_RATES:g}, because {why}")
    if is_short and config.start.init in FROM_POINTS and not SKEW_OPTIONS & config.named_options.keys():
        chosen["shape"] = PLAIN_SHAPE
        reasons.append(f"shape {PLAIN_SHAPE}, because a short run gains more from quick iterations than from skew")
    # Smooth depths also move splats that the photo does not show.
    smooths = chosen.get("depth_smoothness", config.views.depth_smoothness)
    waits = batch == 1 and not smooths and "visible_adam" not in config.named_options
    if waits and (seen_by_photo := waits_for_sight(scene, config)):
        chosen["visible_adam"] = True
        reasons.append(f"steps of visible splats only, because a photo shows {seen_by_photo:.0%} of the points")
    filtered = screen_filter(config)
    chosen |= filtered
    if filtered.get("antialiased") is False:
        reasons.append("no antialiasing, because the model that it starts from has none")
    if config.near_plane is None:
        chosen["near_plane"], nearer = choose_near_plane(scene)
        if nearer:
            reasons.append(f"a near plane of {chosen['near_plane']:g} units, because {nearer}")
    return Decision(_with(config, chosen), tuple(reasons))


def as_decided(config: TrainConfig, stored: Mapping[str, Any]) -> TrainConfig:
    """Return the options with the decisions of a stored run. stored : options of the run in the form of `to_json`."""
    undecided = [name for name in DECIDED if name not in config.named_options]
    undecided += [name for name in ("near_plane", *SCREEN_FILTER) if getattr(config, name) is None]
    return _with(config, {name: stored[name] for name in undecided})


def _with(config: TrainConfig, chosen: Mapping[str, Any]) -> TrainConfig:
    """Return the complete options. Those that the caller named replace the defaults of the chosen strategy."""
    decided = TrainConfig(**({**config.named_options, **chosen})) if "strategy" in chosen else config.replace(**chosen)
    return TrainConfig.from_json(decided.to_json())


def screen_filter(config: TrainConfig) -> dict[str, Any]:
    """Return the antialiasing and the low pass [px²] of a run, but for those that the caller named.

    Raises InputError if the run starts from a model that cannot be read. What the file lacks is said when its splats
    are read for the run, not here.
    """
    undecided = [name for name in SCREEN_FILTER if getattr(config, name) is None]
    if not undecided:
        return {}
    if names_model(config.start.init):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = Splats.load(config.start.init)
        found = {"antialiased": model.antialiased, "low_pass": model.low_pass}
    else:
        antialiased = config.antialiased is not False
        found = {"antialiased": antialiased, "low_pass": PIXEL if antialiased else LOW_PASS}
    return {name: found[name] for name in undecided}


def random_start(scene: Scene, config: TrainConfig) -> str:
    """Return why most splats of a run start at random places; empty if they start at points or at a model."""
    n_points, init = len(scene.points.xyz), config.start.init
    if init == "random":
        return "the start is random"
    if init != "sfm" or n_points >= max(FEW_POINTS * config.cap_max, MIN_POINTS):
        return ""
    return f"the scene has only {n_points} points" if n_points else "the scene has no points"


def for_few_photos(n_photos: int, is_short: bool) -> list[tuple[str, Any, str]]:
    """Return name, value and reason of the options of a run with few photos; an empty list with many.

    Parameters
    ----------
    n_photos : number of training views. is_short : whether all iterations have at most SHORT_RUN photos.
    """
    if n_photos > (FEW_VIEWS if is_short else FEW_FOR_LONG_RUN):
        return []
    rate = DROPOUT if n_photos <= FEW_VIEWS else SMALL_DROPOUT
    dropout = ("dropout", rate, f"a dropout of {rate:.0%} of the splats, because there are only {n_photos} photos")
    if n_photos > FEW_VIEWS:
        return [dropout]
    return [
        dropout,
        ("depth_smoothness", SMOOTHNESS, "a penalty on steps of the depth"),
        ("occluder_check", True, "no splats that would cover the view between the photos"),
    ]


def for_background(scene: Scene, config: TrainConfig) -> tuple[dict[str, Any], list[str], float]:
    """Return options for what is behind an object in the photos, their reasons, and the share of transparent pixels.

    Photos that are not in memory are decoded for it, which takes longer than all other decisions.
    """
    chosen: dict[str, Any] = {}
    reasons: list[str] = []
    named = config.named_options
    if not BY_TRANSPARENCY - named.keys():
        return chosen, reasons, 0.0
    if share := transparent_share(scene.train):
        return chosen, reasons, share
    color = None if {"background", "cut_background"} <= named.keys() else plain_background(scene.train)
    if color is not None and color != BLACK and "background" not in named:
        chosen["background"] = color
        reasons.append(f"a background of {','.join(f'{part:.2g}' for part in color)}, because all photos end in it")
    background = chosen.get("background", config.background)
    if not named.get("cut_background", color is not None):
        return chosen, reasons, 0.0
    from ..scenes.cut_out import share_cut_out  # lazy: it loads an image library, which would slow down --help

    share = share_cut_out(sampled_views(scene.train), background)
    if "cut_background" not in named:
        if share < CUT_SHARE:
            return chosen, reasons, 0.0
        chosen["cut_background"] = True
        reasons.append(f"the background is cut out of the photos, because {share:.0%} of their pixels have its colour")
    return chosen, reasons, share


def share_beside(scene: Scene, config: TrainConfig, transparent: bool) -> float:
    """Return the share of the cap that starts at random places beside the points of a scene.

    Where photos are transparent, nothing is missing that good points do not show. With very few photos, no
    second one shows whether the depth of a random point is right.
    """
    n_points = len(scene.points.xyz)
    if config.start.init != "sfm" or n_points < MIN_POINTS or len(scene.train) <= VERY_FEW_VIEWS:
        return 0.0
    if n_points < FEW_POINTS * config.cap_max:
        return RANDOM_SHARE_OF_VERY_FEW
    if n_points < RANDOM_SHARE_OF_FEW * config.cap_max:
        return RANDOM_SHARE_OF_FEW
    return 0.0 if transparent else RANDOM_SHARE


def waits_for_sight(scene: Scene, config: TrainConfig) -> float:
    """Return the mean share of the scene's points in a photo if a GPU trains and many splats are not visible, else 0.

    The points stand for the splats. Without points, nothing is known before the run.
    """
    share = mean_share_seen([view.camera for view in scene.train], sampled(scene.points.xyz))
    if share >= SEEN_SHARE or (1.0 - share) * config.cap_max < UNSEEN_SPLATS:
        return 0.0
    return share if open_device(first_device(config.device)).info.type == "GPU" else 0.0
