"""Reconstruction of a scene from photos or a video: structure from motion with pycolmap, then undistortion."""

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
from ...files.atomic import move
from ...files.images import PhotoHeader, read_photo_header
from ...files.json_file import read_json, write_json
from ...files.lock import folder_lock
from ...files.real_path import real_path
from .options import MIN_PHOTOS, RECORD, ReconstructOptions
from .pairs import is_sequential, named_pairs, pairs_of
from .panoramas import FACE_FOCAL, rig_of, with_faces
from .photo_files import (
    PhotoFile,
    StagedPhoto,
    complete_masks,
    find_photos,
    fingerprint,
    group_by_camera,
    is_video,
    left_out_below,
    stage_photo,
    unsupported_photos,
)
from .sfm_process import Step, StepCallback, run_sfm
from .sfm_worker import MIN_REGISTERED
from .undistorted_scene import SparseModel, write_undistorted_model, write_undistorted_photo
from .video_frames import extract_frames

T = TypeVar("T")
R = TypeVar("R")

SMALL = 640  # photos with a shorter longest side [px] are also searched at twice their size, which takes longer


@dataclass(frozen=True)
class ReconstructionResult:
    """Result of a reconstruction.

    Parameters
    ----------
    scene : the scene's folder.
    photos, registered : number of photos that were read, and of photos with a pose.
    points : number of points.
    track_length : mean number of photos that see a point.
    error : mean reprojection error of the points [px].
    seconds : duration [s].
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
    progress: StepCallback | None = None,
    overwrite: bool = False,
) -> ReconstructionResult:
    """Find the poses of photos and write a scene: images/, sparse/0/, masks/ and reconstruct.json.

    The scene is written completely or not at all. Its images are upright and undistorted (PINHOLE).

    Parameters
    ----------
    photos : a video, or a folder with photos in it or its subfolders; masks in `masks` are black for hidden pixels.
    scene : folder to write.
    options : by default ReconstructOptions().
    progress : called with each Step.
    overwrite : whether to replace a scene that this function wrote.

    Returns
    -------
    The scene's folder and figures.

    Warns
    -----
    UserWarning : some photos cannot be read, few photos are registered, or there are several models.

    Raises
    ------
    InputError : there are fewer than 3 photos, or no two photos match.
    OutputError : the scene exists or cannot be written.
    """
    source, target, options = Path(photos), Path(scene), options or ReconstructOptions()
    _finish_killed(target.absolute())
    _refuse_used(target, overwrite)
    start = time.perf_counter()
    report: StepCallback = progress or (lambda step: None)
    with _unfinished(target.absolute()) as work:
        if is_video(source):
            photo_files = extract_frames(
                source, work / "frames", options.frames, lambda done: report(Step("video frames compared", done))
            )
        else:
            photo_files = find_photos(source)
            if options.frames != ReconstructOptions().frames:
                warnings.warn(f"{source}: frames {options.frames} has no effect: these are photos", stacklevel=2)
        source_digest = fingerprint(source)
        photo_files = with_faces(source, photo_files, options.panoramas, work / "faces", report)
        ready = _stage_all(photo_files, source, work, report)
        rig = rig_of(ready)
        grouped = [faces for _, _, faces in rig] if rig else group_by_camera(ready, options.camera_mode)
        pairs = named_pairs(ready, options.matcher, is_video(source))
        (work / "pairs.txt").write_bytes("".join(f"{a} {b}\n" for a, b in pairs).encode())
        masks = complete_masks(ready, work / "masks")
        job = {
            "masks": masks and str(masks),
            "groups": [[photo.staged for photo in group] for group in grouped],
            "rig": [(face, rotation.ravel().tolist()) for face, rotation, _ in rig],
            "focal": FACE_FOCAL,
            "n_pairs": len(pairs),
            "doubled": _longest_side(ready[len(ready) // 2].header, options) < SMALL,
            "camera_model": options.camera_model,
            "max_size": options.max_size,
            "seed": options.seed,
        }
        models = run_sfm(work, job, report, str(source))
        folder = max(models, key=lambda name: models[name])
        model = SparseModel(Path(folder))
        registered = [photo for photo in ready if photo.staged in model.names]
        _warn_of_unplaced(source, ready, registered, models)
        views = list(
            _map_in_order(
                "photos undistorted",
                lambda photo: write_undistorted_photo(model, photo, work / "scene"),
                registered,
                report,
            )
        )
        write_undistorted_model(model, views, work / "scene")
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
                "source": str(real_path(source)),
                "photo_digest": source_digest,
                "options": asdict(options),
                **{key: value for key, value in asdict(result).items() if key != "scene"},
            },
        )
        _move_into_place(work / "scene", target.absolute())
    return result


def estimate_seconds(photos: Sequence[PhotoFile], options: ReconstructOptions | None = None) -> float:
    """Return a rough estimate of the duration of `reconstruct` [s].

    The estimate follows from the header of the first photo that can be read, constants measured on one CPU core, and
    the number of cores.

    Raises
    ------
    InputError : no photo can be read.
    """
    options = options or ReconstructOptions()
    header = _first_header(photos)
    side = _longest_side(header, options)
    megapixels = header.width * header.height * (side / max(header.width, header.height)) ** 2 / 1e6
    features = min(1.0, 3.0 * megapixels)  # number of features over their limit
    pairs = len(pairs_of(len(photos), is_sequential(options.matcher, is_video(photos[0].file), len(photos))))
    search = len(photos) * megapixels * (4.9 if side < SMALL else 1.2)
    return (search + 0.2 * pairs * features**2 + 0.5 * len(photos)) / (os.cpu_count() or 1)


def _first_header(photos: Sequence[PhotoFile]) -> PhotoHeader:
    for photo in photos[:-1]:
        try:
            return read_photo_header(photo.file)
        except InputError:  # reading the photos later names it and leaves it out
            continue
    return read_photo_header(photos[-1].file)


def is_made_from(scene: Path, photos: Path) -> bool | None:
    """Return whether the scene was reconstructed from exactly these photos; None if it does not record its photos.

    Scenes of earlier versions record times of modification instead, under another key.

    Raises
    ------
    InputError : the record is damaged, or there are no photos.
    """
    if not (scene / RECORD).is_file():
        return None
    record = read_json(scene / RECORD, "another folder")
    if not isinstance(record, dict):
        raise InputError(f"{scene / RECORD}: expected a JSON object; remove the file")
    digest = record.get("photo_digest")
    return None if digest is None else digest == fingerprint(photos)


def _refuse_used(scene: Path, overwrite: bool) -> None:
    if not scene.exists() or (scene.is_dir() and not any(scene.iterdir())):
        return
    if not (scene / RECORD).is_file():
        raise OutputError(f"{scene}: exists and is not a reconstructed scene; choose another folder")
    if not overwrite:
        raise OutputError(f"{scene}: already holds a scene: use --overwrite or another folder")


@contextmanager
def _unfinished(scene: Path) -> Iterator[Path]:
    """Yield an empty working folder beside the scene, and remove it at the end.

    Leftovers of a killed run are removed first.
    """
    work = scene.with_name(f".{scene.name}.unfinished")
    try:
        work.mkdir(parents=True, exist_ok=True)
        with folder_lock(work):
            for leftover in work.iterdir():
                shutil.rmtree(leftover) if leftover.is_dir() else leftover.unlink()
            try:
                yield work
            finally:
                shutil.rmtree(work, ignore_errors=True)
    except OSError as error:
        raise OutputError(f"{scene}: cannot be written ({error.strerror or error}); choose another place") from None


def _place_of_old(scene: Path) -> Path:
    """Return where an old scene lies while the new one takes its place."""
    return scene.with_name(f".{scene.name}.old")


def _finish_killed(scene: Path) -> None:
    """End the exchange of scenes of a killed command: with the old scene if the new one is not in its place."""
    old = _place_of_old(scene)
    if not old.is_dir():
        return
    if scene.exists():
        shutil.rmtree(old, ignore_errors=True)
    else:
        move(old, scene)


def _move_into_place(finished: Path, scene: Path) -> None:
    """Move the finished scene to its folder in place of an old scene, which goes last."""
    old = _place_of_old(scene)
    if scene.exists():
        move(scene, old)
    try:
        move(finished, scene)
    except BaseException:
        if old.exists():
            move(old, scene)
        raise
    shutil.rmtree(old, ignore_errors=True)


def _stage_all(photos: Sequence[PhotoFile], source: Path, work: Path, report: StepCallback) -> list[StagedPhoto]:
    """Stage all photos; warn about unusable photos, and raise InputError if too few remain."""
    for part in ("photos", "masks"):
        (work / part).mkdir()
    jobs = list(enumerate(photos))

    def stage(job: tuple[int, PhotoFile]) -> StagedPhoto | str:
        return stage_photo(job[1], job[0], work / "photos", work / "masks")

    results = list(_map_in_order("photos read", stage, jobs, report))
    reasons = [result for result in results if isinstance(result, str)]
    ready = [result for result in results if not isinstance(result, str)]
    if below := left_out_below(source):
        warnings.warn(f"left out: {below} in {source}: scenes, models and renders are not photos", stacklevel=3)
    unsupported = unsupported_photos(source)
    if unsupported:
        warnings.warn(f"left out in {source}: {unsupported}", stacklevel=3)
    if reasons:
        more = f" (and {len(reasons) - 1} more)" if len(reasons) > 1 else ""
        warnings.warn(f"left out: {reasons[0]}{more}", stacklevel=3)
    if len(ready) < MIN_PHOTOS:
        raise InputError(
            f"{source}: {len(ready)} photos that can be used; at least {MIN_PHOTOS} are needed, and 30 or more "
            f"overlapping photos are better{f' ({reasons[0]})' if reasons else ''}"
        )
    return ready


def _longest_side(header: PhotoHeader, options: ReconstructOptions) -> int:
    """Return the longest side of the photo in which features are searched for [px]."""
    return min(max(header.width, header.height), options.max_size)


def _warn_of_unplaced(
    source: Path, ready: Sequence[StagedPhoto], registered: Sequence[StagedPhoto], models: dict[str, int]
) -> None:
    placed = {photo.staged for photo in registered}
    rest = [photo.source.name for photo in ready if photo.staged not in placed]
    if len(registered) < MIN_REGISTERED * len(ready):
        warnings.warn(
            f"{source}: only {len(registered)} of {len(ready)} photos could be placed; left out are "
            f"{', '.join(rest[:3])}{', ...' if len(rest) > 3 else ''}. Take more photos in between, a "
            "few degrees apart, sharp, and of a scene at rest",
            stacklevel=3,
        )
    parts = sum(size >= MIN_PHOTOS for size in models.values())
    if rest and parts > 1:
        warnings.warn(
            f"{source}: the photos fall into {parts} parts that do not connect; the largest "
            f"({len(registered)} photos) is kept",
            stacklevel=3,
        )


def _map_in_order(label: str, function: Callable[[T], R], items: Sequence[T], report: StepCallback) -> Iterator[R]:
    """Yield results in order; several threads compute them."""
    with ThreadPoolExecutor() as pool:
        for number, result in enumerate(pool.map(function, items), start=1):
            report(Step(label, number, len(items)))
            yield result
