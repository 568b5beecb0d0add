"""The sets of scenes that papers report on: their protocols, and the figures published for them, from `sets/*.toml`."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..splats.color import Color

# Names on the command line. Each is the stem of a file in `sets`.
SETS = ("nerf-synthetic", "mipnerf360", "tanks", "deepblending", "llff")
BLENDER, COLMAP = "blender", "colmap"
METRICS = ("psnr", "ssim", "lpips")


@dataclass(frozen=True)
class SetScene:
    """A scene as its set defines it.

    Attributes
    ----------
    size : width and height of the photos of the protocol [px].
    train, test : numbers of views.
    splats : default cap.
    images : folder of photos inside the scene; None for scenes of transforms files.
    """

    name: str
    size: tuple[int, int]
    train: int
    test: int
    splats: int
    images: str | None

    @property
    def factor(self) -> int:
        """Number that the sizes of the original photos are divided by: N of images_N, else 1."""
        _, _, number = (self.images or "").partition("images_")
        return int(number) if number else 1

    def with_images(self, images: str) -> SetScene:
        """Return the scene with another folder of reduced photos, such as images_8."""
        other = replace(self, images=images)
        width, height = (round(side * self.factor / other.factor) for side in self.size)
        return replace(other, size=(width, height))


@dataclass(frozen=True)
class Published:
    """Figures that others published for some scenes of a set.

    Attributes
    ----------
    source : the paper or page.
    iterations : length of the runs; None if it is not known.
    note : how the protocol differs; empty if it does not.
    values : figures by metric ("psnr" [dB], "ssim", "lpips") and scene.
    splats : numbers of splats by scene.
    mean : mean PSNR [dB] over all scenes of the set, for sources without figures by scene.
    photos : training views of each scene; None for all.
    """

    system: str
    source: str
    iterations: int | None = None
    note: str = ""
    values: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    splats: Mapping[str, int] = field(default_factory=dict)
    mean: float | None = None
    photos: int | None = None


@dataclass(frozen=True)
class FewPhotos:
    """How a set is used with few training views.

    Attributes
    ----------
    images : folder of photos inside the scenes. iterations : published length of a run.
    """

    images: str
    iterations: int


@dataclass(frozen=True)
class StartCube:
    """Random points from which published runs start in scenes without points.

    Attributes
    ----------
    points : their number.
    side : side of the cube around the origin that they fill [world units].
    """

    points: int
    side: float


@dataclass(frozen=True)
class BenchmarkSet:
    """A set of scenes with its protocol.

    Attributes
    ----------
    name : as on the command line. title : as in papers.
    layout : "blender" for transforms files, "colmap" for a COLMAP model in `sparse`.
    iterations : published length of a run.
    background : colour 0..1.
    traps : sentences on what makes figures incomparable.
    scenes : by name.
    other_images : folders of photos to use if the folder of the protocol is missing.
    counted : whether the scenes' default caps are published numbers of splats.
    start : the start of published runs; None if they start at the points of a scene.
    few : the protocol with few training views; None if none is published.
    photos : training views of each scene that are used; None for all.
    """

    name: str
    title: str
    layout: str
    iterations: int
    background: Color
    traps: Sequence[str]
    scenes: Mapping[str, SetScene]
    published: Sequence[Published]
    other_images: Sequence[str] = ()
    counted: bool = True
    start: StartCube | None = None
    few: FewPhotos | None = None
    photos: int | None = None

    @property
    def figures(self) -> list[Published]:
        """Published figures for the training views that are used."""
        return [each for each in self.published if each.photos == self.photos]

    def with_photos(self, count: int) -> BenchmarkSet:
        """Return the set with `count` training views of each scene, and the figures that are published for them.

        Without a published protocol, size and iterations are those with all views.
        """
        few = self.few
        return replace(
            self,
            name=f"{self.name}-{count}",
            title=f"{self.title} with {count} training views",
            iterations=self.iterations if few is None else few.iterations,
            scenes={
                name: replace(scene if few is None else scene.with_images(few.images), train=count)
                for name, scene in self.scenes.items()
            },
            counted=False,
            photos=count,
        )


def benchmark_set(name: str, photos: int | None = None) -> BenchmarkSet:
    """Return the set of a name in SETS. photos : see `BenchmarkSet.with_photos`; None for all.

    Raises
    ------
    InputError : an unknown name.
    """
    if name not in SETS:
        raise InputError(f"unknown benchmark {name!r}: choose one of {', '.join(SETS)}")
    chosen = _read(name)
    return chosen if photos is None else chosen.with_photos(photos)


@cache
def _read(name: str) -> BenchmarkSet:
    values = tomllib.loads((Path(__file__).with_name("sets") / f"{name}.toml").read_text(encoding="utf-8"))
    layout = values["layout"]
    red, green, blue = values["background"]
    return BenchmarkSet(
        name,
        values["title"],
        layout,
        values["iterations"],
        (red, green, blue),
        tuple(values["traps"]),
        {scene: _scene(scene, layout, entry) for scene, entry in values["scenes"].items()},
        [_published(entry) for entry in values["published"]],
        tuple(values.get("other_images", ())),
        values.get("counted", True),
        StartCube(**values["start"]) if "start" in values else None,
        FewPhotos(**values["few"]) if "few" in values else None,
    )


def _scene(name: str, layout: str, entry: Mapping[str, Any]) -> SetScene:
    width, height = entry["size"]
    images = None if layout == BLENDER else entry.get("images", "images")
    return SetScene(name, (width, height), entry["train"], entry["test"], entry["splats"], images)


def _published(entry: Mapping[str, Any]) -> Published:
    return Published(
        entry["system"],
        entry["source"],
        entry.get("iterations"),
        entry.get("note", ""),
        {metric: entry[metric] for metric in METRICS if metric in entry},
        entry.get("splats", {}),
        entry.get("mean"),
        entry.get("photos"),
    )
