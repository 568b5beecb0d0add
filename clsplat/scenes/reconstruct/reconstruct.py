"""A scene from photographs or a video: structure from motion with COLMAP's library, then photos undistorted."""

from __future__ import annotations

import os
import shutil
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TypeVar

from ...errors import InputError, OutputError
from ...files.images import PhotoHeader, read_photo_header
from ...files.json_file import read_json, write_json
from ...files.lock import folder_lock
from .options import FEWEST, ReconstructOptions
from .photo_files import (
    PhotoFile,
    StagedPhoto,
    complete_masks,
    find_photos,
    fingerprint,
    group_by_camera,
    is_video,
    stage_photo,
    unsupported_photos,
)
from .sfm_process import Step, Tell, run_sfm
from .sfm_worker import ENOUGH
from .undistorted_scene import SparseModel, write_flat_model, write_flat_photo
from .video_frames import extract_frames

T = TypeVar("T")
R = TypeVar("R")

RECORD = "reconstruct.json"  # in the scene: what it was made of and how
EXHAUSTIVE = 150  # photos; of more, "auto" matches neighbours by name
SMALL = 640  # longest side [px] of photos that are searched at twice their size too, four times as long
_OVERLAP = 10  # neighbours of a photo in a sequence
_LOOP = 10  # every so many-th photo of a sequence is matched with all others of these, to close loops


@dataclass(frozen=True)
class ReconstructionResult:
    """What came of it: the scene's folder and figures.

    Parameters
    ----------
    photos, registered : how many were read, and how many have a pose.
    points, track_length, error : of the cloud; photos that see a point and reprojection error [px], both in the mean.
    seconds : that it took.
    """

    scene: Path
    photos: int
    registered: int
    points: int
    track_length: float
    error: float
    seconds: float


def reconstruct(
    photos: str | os.PathLike[str],
    scene: str | os.PathLike[str],
    options: ReconstructOptions | None = None,
    tell: Tell | None = None,
    overwrite: bool = False,
) -> ReconstructionResult:
    """Find the poses of photographs and write them as a scene: images/, sparse/0/, masks/ and reconstruct.json.

    The scene appears whole or not at all. Images are upright and without distortion (PINHOLE).

    Parameters
    ----------
    photos : a folder, looked through with all below it (with `masks` beside, black where a photo does not count), or
        a video.
    scene : folder to write. tell : called with each Step.
    overwrite : replace a scene that this function made.

    Warns
    -----
    UserWarning : photos that cannot be read, few photos registered, several models.

    Raises
    ------
    InputError : fewer than 3 photos, or nothing that fits together. OutputError : the scene is there or cannot be
        written.
    """
    source, target, options = Path(photos), Path(scene), options or ReconstructOptions()
    _refuse_used(target, overwrite)
    start = time.perf_counter()
    say: Tell = tell or (lambda step: None)
    with _unfinished(target.absolute()) as work:
        if is_video(source):
            given = extract_frames(
                source, work / "frames", options.frames, lambda seen: say(Step("video frames looked at", seen))
            )
        else:
            given = find_photos(source)
        mark = fingerprint(source)
        ready = _prepared(given, source, work, say)
        groups = [[photo.staged for photo in group] for group in group_by_camera(ready, options.camera_mode)]
        pairs = _pairs(len(ready), _sequential(options, source, len(ready)))
        names = [photo.staged for photo in ready]
        (work / "pairs.txt").write_text("".join(f"{names[a]} {names[b]}\n" for a, b in pairs))
        masks = complete_masks(ready, work / "masks")
        job = {
            "masks": masks and str(masks),
            "groups": groups,
            "n_pairs": len(pairs),
            "doubled": _longest_side(ready[len(ready) // 2].facts, options) < SMALL,
            "camera_model": options.camera_model,
            "max_size": options.max_size,
            "seed": options.seed,
        }
        models = run_sfm(work, job, say, str(source))
        folder = max(models, key=lambda name: models[name])
        model = SparseModel(Path(folder))
        registered = [photo for photo in ready if photo.staged in model.names]
        _warn_of_rest(source, ready, registered, models)
        views = list(
            _each("photos undistorted", lambda photo: write_flat_photo(model, photo, work / "scene"), registered, say)
        )
        write_flat_model(model, views, work / "scene")
        points = model.points
        result = ReconstructionResult(
            target,
            len(ready),
            len(registered),
            len(points),
            float(points.track_length.mean()),
            float(model.errors.mean()),
            time.perf_counter() - start,
        )
        write_json(
            work / "scene" / RECORD,
            {
                "source": str(source.resolve()),
                "fingerprint": mark,
                "options": asdict(options),
                **{key: value for key, value in asdict(result).items() if key != "scene"},
            },
        )
        _put(work / "scene", target)
    return result


def estimate_seconds(photos: Sequence[PhotoFile], options: ReconstructOptions | None = None) -> float:
    """Roughly how long `reconstruct` will take: from a header, figures of one CPU core, and the number of cores.

    Raises
    ------
    InputError : the first photo cannot be read.
    """
    options = options or ReconstructOptions()
    facts = read_photo_header(photos[0].file)
    side = _longest_side(facts, options)
    megapixels = facts.width * facts.height * (side / max(facts.width, facts.height)) ** 2 / 1e6
    features = min(1.0, 3.0 * megapixels)  # of the most
    pairs = len(_pairs(len(photos), _sequential(options, photos[0].file, len(photos))))
    search = len(photos) * megapixels * (4.9 if side < SMALL else 1.2)
    return (search + 0.2 * pairs * features**2 + 0.5 * len(photos)) / (os.cpu_count() or 1)


def is_made_from(scene: Path, photos: Path) -> bool | None:
    """Whether the scene was reconstructed from just these photos; None where none is there.

    Raises
    ------
    InputError : the record is damaged.
    """
    if not (scene / RECORD).is_file():
        return None
    record = read_json(scene / RECORD, "another folder")
    return isinstance(record, dict) and record.get("fingerprint") == fingerprint(photos)


def _refuse_used(scene: Path, overwrite: bool) -> None:
    if not scene.exists() or (scene.is_dir() and not any(scene.iterdir())):
        return
    if not (scene / RECORD).is_file():
        raise OutputError(f"{scene}: is there, and no scene that was reconstructed; choose another folder")
    if not overwrite:
        raise OutputError(f"{scene}: already holds a scene: use --overwrite or another folder")


@contextmanager
def _unfinished(scene: Path) -> Iterator[Path]:
    """An empty folder beside the scene to work in, removed in the end; what a killed run left of it goes first."""
    work = scene.with_name(f".{scene.name}.unfinished")
    try:
        work.mkdir(parents=True, exist_ok=True)
        with folder_lock(work):
            for left in work.iterdir():
                shutil.rmtree(left) if left.is_dir() else left.unlink()
            try:
                yield work
            finally:
                shutil.rmtree(work, ignore_errors=True)
    except OSError as error:
        raise OutputError(f"{scene}: cannot be written ({error.strerror or error}); choose another place") from None


def _put(finished: Path, scene: Path) -> None:
    """Move the scene to its place; one that is there goes."""
    if scene.exists():
        old = finished.with_name("old")
        scene.rename(old)
    finished.rename(scene)


def _prepared(given: Sequence[PhotoFile], source: Path, work: Path, say: Tell) -> list[StagedPhoto]:
    for part in ("photos", "masks"):
        (work / part).mkdir()
    jobs = list(enumerate(given))
    found = list(
        _each("photos read", lambda job: stage_photo(job[1], job[0], work / "photos", work / "masks"), jobs, say)
    )
    reasons = [result for result in found if isinstance(result, str)]
    ready = [result for result in found if not isinstance(result, str)]
    foreign = unsupported_photos(source)
    if foreign:
        warnings.warn(f"left out: {foreign} in {source}; convert to JPEG to use them", stacklevel=3)
    if reasons:
        more = f" (and {len(reasons) - 1} more)" if len(reasons) > 1 else ""
        warnings.warn(f"left out: {reasons[0]}{more}", stacklevel=3)
    if len(ready) < FEWEST:
        raise InputError(
            f"{source}: {len(ready)} photos that can be read; at least {FEWEST} are needed, 30 or more "
            "that overlap are better"
        )
    return ready


def _longest_side(facts: PhotoHeader, options: ReconstructOptions) -> int:
    """Of the photo as it is searched for features [px]."""
    return min(max(facts.width, facts.height), options.max_size)


def _sequential(options: ReconstructOptions, source: Path, photos: int) -> bool:
    if options.matcher == "auto":
        return is_video(source) or photos > EXHAUSTIVE
    return options.matcher == "sequential"


def _pairs(photos: int, sequential: bool) -> list[tuple[int, int]]:
    """Pairs to match. In a sequence: neighbours, photos 16, 32, 64 ... further on, and a coarse net over all."""
    if not sequential:
        return [(a, b) for a in range(photos) for b in range(a + 1, photos)]
    offsets = {*range(1, _OVERLAP + 1), *(1 << power for power in range(4, photos.bit_length()))}
    near = {(a, a + offset) for a in range(photos) for offset in offsets if a + offset < photos}
    net = {(a, b) for a in range(0, photos, _LOOP) for b in range(a + _LOOP, photos, _LOOP)}
    return sorted(near | net)


def _warn_of_rest(
    source: Path, ready: Sequence[StagedPhoto], registered: Sequence[StagedPhoto], models: dict[str, int]
) -> None:
    placed = {photo.staged for photo in registered}
    rest = [photo.source.name for photo in ready if photo.staged not in placed]
    if len(registered) < ENOUGH * len(ready):
        warnings.warn(
            f"{source}: only {len(registered)} of {len(ready)} photos could be placed; left out are "
            f"{', '.join(rest[:3])}{', ...' if len(rest) > 3 else ''}. Take more photos in between, with "
            "steps of a few degrees, sharp and of things at rest",
            stacklevel=3,
        )
    parts = sum(size >= FEWEST for size in models.values())
    if rest and parts > 1:
        warnings.warn(
            f"{source}: the photos fall into {parts} parts that do not hang together; the largest "
            f"({len(registered)} photos) is kept",
            stacklevel=3,
        )


def _each(label: str, function: Callable[[T], R], items: Sequence[T], say: Tell) -> Iterator[R]:
    """Results in order, made several at a time."""
    with ThreadPoolExecutor() as pool:
        for number, result in enumerate(pool.map(function, items), start=1):
            say(Step(label, number, len(items)))
            yield result
