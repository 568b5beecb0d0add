"""Structure from motion on prepared photos, as a program of its own: `python -m clsplat.sfm JOB.json`.

A process, because COLMAP's library may abort, cannot be interrupted by Ctrl-C, and must not share a process with
another reader of its SQLite database (closing one connection drops the locks of the other). It tells what it does as
JSON lines on standard output, and ends when its standard input does: with its parent.

The job: `database`, `photos`, `masks` (folder, or null), `groups` (lists of names that share a camera), `pairs` (file
of names), `n_pairs`, `output`, `camera_model`, `max_size`, `doubled` (whether photos are searched at twice their size
too), `seed`. Each sparse model is left in a folder of its own in `output`.

Photos are imported in their order and everything is seeded: the same photos give the same model.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from pathlib import Path
from typing import Any

from ...errors import reason_of
from ..undistort import colmap_library

ENOUGH = 0.8  # of the photos registered; below, they are matched once more
_FAR_OFF, _NARROW = 4.0, 1.5  # reprojection error [px] and angle [degrees] of points to leave out, as COLMAP's mapper
_PEAK = 0.003  # SIFT's contrast threshold; COLMAP's 0.0067 finds too little in small or soft photos
# Lens models of many parameters run astray on the first photos: these are placed with one, and the others come last.
_FIRST_MODEL = {
    "RADIAL": "SIMPLE_RADIAL",
    "OPENCV": "SIMPLE_RADIAL",
    "FULL_OPENCV": "SIMPLE_RADIAL",
    "RADIAL_FISHEYE": "SIMPLE_RADIAL_FISHEYE",
    "OPENCV_FISHEYE": "SIMPLE_RADIAL_FISHEYE",
    "THIN_PRISM_FISHEYE": "SIMPLE_RADIAL_FISHEYE",
}
_FISHEYE_FOCAL = 0.6  # of the longest side, where EXIF does not say; COLMAP's 1.2 is no fisheye's
# Of a photo. COLMAP takes 8192, for GPUs: matching a pair then takes 0.54 s of a CPU core instead of 0.19 s.
_FEATURES = 4096


def main(job_path: str) -> None:
    """Run the job; an error becomes the last line."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        job = json.loads(Path(job_path).read_text(encoding="utf-8"))
        _run(colmap_library(), job)
    except Exception as error:  # whatever the library raises: the parent tells the user
        _tell(error=reason_of(error))


def _run(colmap: Any, job: dict[str, Any]) -> None:
    if not hasattr(colmap, "FeatureExtractionOptions"):
        raise RuntimeError("pycolmap is too old, version 4 is needed: pip install -U pycolmap")
    photos = [name for group in job["groups"] for name in group]
    _tell(stage="features", total=len(photos))
    _find_features(colmap, job, photos)
    _tell(stage="pairs", total=job["n_pairs"])
    _match(colmap, job, guided=False)
    models = _map(colmap, job, Path(job["output"]) / "plain", len(photos))
    most = max(models.values(), default=0)
    if most < ENOUGH * len(photos):
        # Matches along epipolar lines: dearer and less exact, but photos far apart hang together by them.
        _tell(stage="pairs again", total=job["n_pairs"])
        database = colmap.Database.open(job["database"])
        database.clear_matches()
        database.clear_two_view_geometries()
        database.close()
        _match(colmap, job, guided=True)
        again = _map(colmap, job, Path(job["output"]) / "guided", len(photos))
        if max(again.values(), default=0) > most:
            models = again
    if models and job["camera_model"] in _FIRST_MODEL:
        _refine(colmap, max(models, key=lambda name: models[name]), job["camera_model"])
    _tell(models=models)


def _find_features(colmap: Any, job: dict[str, Any], photos: list[str]) -> None:
    reader = colmap.ImageReaderOptions()
    reader.camera_model = _FIRST_MODEL.get(job["camera_model"], job["camera_model"])
    fisheye = reader.camera_model == "FOV" or "FISHEYE" in reader.camera_model
    if fisheye:
        reader.default_focal_length_factor = _FISHEYE_FOCAL
    if job["masks"]:
        reader.mask_path = job["masks"]
    colmap.Database.open(job["database"]).close()
    for group in job["groups"]:  # in order, where the extraction's threads would number the photos by chance
        colmap.import_images(job["database"], job["photos"], colmap.CameraMode.SINGLE, group, reader)
    if fisheye:
        _trust_focal_lengths(colmap, job["database"])
    options = colmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.max_image_size = job["max_size"]
    options.sift.peak_threshold = _PEAK
    options.sift.max_num_features = _FEATURES
    options.sift.first_octave = -1 if job["doubled"] else 0
    colmap.extract_features(
        job["database"], job["photos"], photos, colmap.CameraMode.AUTO, reader, options, colmap.Device.cpu
    )


def _trust_focal_lengths(colmap: Any, path: str) -> None:
    """Pairs of fisheye photos are verified by rays only, which takes a focal length that counts as known."""
    database = colmap.Database.open(path)
    for camera in database.read_all_cameras():
        camera.has_prior_focal_length = True
        database.update_camera(camera)
    database.close()


def _match(colmap: Any, job: dict[str, Any], guided: bool) -> None:
    matching, pairing = colmap.FeatureMatchingOptions(), colmap.ImportedPairingOptions()
    verification = colmap.TwoViewGeometryOptions()
    matching.use_gpu = False
    matching.guided_matching = guided
    pairing.match_list_path = job["pairs"]
    verification.ransac.random_seed = job["seed"]
    colmap.match_image_pairs(job["database"], matching, pairing, verification, colmap.Device.cpu)


def _map(colmap: Any, job: dict[str, Any], output: Path, photos: int) -> dict[str, int]:
    """Models' folders and how many photos each registers."""
    _tell(stage="photos placed", total=photos)
    options = colmap.IncrementalPipelineOptions()
    for part in (options, options.mapper, options.triangulation):
        part.random_seed = job["seed"]
    # Several threads add up residuals in any order. On two cores one is as fast (50 photos: 39 s and 44 s).
    options.num_threads = options.mapper.num_threads = 1
    output.mkdir(parents=True)
    placed = 0

    def first_pair() -> None:
        nonlocal placed
        placed = 1
        one_more()

    def one_more() -> None:
        nonlocal placed
        placed += 1
        _tell(done=placed)

    models = colmap.incremental_mapping(
        job["database"],
        job["photos"],
        output,
        options,
        initial_image_pair_callback=first_pair,
        next_image_callback=one_more,
    )
    return {str(output / str(index)): model.num_reg_images() for index, model in models.items()}


def _refine(colmap: Any, folder: str, camera_model: str) -> None:
    """Give a model's lenses all their parameters and adjust everything once more."""
    model = colmap.Reconstruction(folder)
    for camera in model.cameras.values():
        focal, cx, cy, bend = camera.params
        two_focals = not camera_model.startswith("RADIAL")
        camera.model = getattr(colmap.CameraModelId, camera_model)
        known = [focal, focal, cx, cy, bend] if two_focals else [focal, cx, cy, bend]
        camera.params = known + [0.0] * (len(camera.params_info.split(",")) - len(known))
    options = colmap.BundleAdjustmentOptions()
    options.ceres.solver_options.num_threads = 1
    options.print_summary = False
    colmap.bundle_adjustment(model, options)
    colmap.ObservationManager(model).filter_all_points3D(_FAR_OFF, _NARROW)
    model.update_point_3d_errors()
    model.write(folder)


def _tell(**event: Any) -> None:
    print(json.dumps(event), flush=True)


def _end_with_parent() -> None:
    os.read(0, 1)  # not through sys.stdin, whose lock would trouble the interpreter's end
    os._exit(1)


if __name__ == "__main__":
    main(sys.argv[1])
