"""Structure from motion on staged photos as a separate program: `python -m ...sfm_worker JOB.json`.

pycolmap runs in a separate process for three reasons. It may abort the process, and Ctrl-C does not interrupt it. And
its SQLite database must not have another reader in the same process: closing one connection drops the locks of the
other. The program prints its progress as JSON lines, and ends when its standard input ends, that is, with its parent.

Photos of a rig, such as the faces of panoramas, have exact pinhole lenses and exact places in the rig.

The job's paths are `database`, `photos`, `masks` (or null), `pairs` (a file of names) and `output`. The other keys:

    groups          lists of photos that share a camera
    rig             for each group, the folder of its photos and the rotation from the frame of the first group, row by
                    row; empty without a rig
    focal           focal length of the photos of a rig, in their width
    n_pairs         number of pairs
    camera_model, max_size, seed    see ReconstructOptions
    doubled         photos are also searched at twice their size

Each sparse model is written to a separate folder in `output`.

Photos are imported in order, and all random numbers are seeded. So the same photos give the same model.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import reason_of
from ..undistort import colmap_library

MIN_REGISTERED = 0.8  # share of photos; if fewer are registered, photos are matched a second time
_MAX_ERROR, _MIN_ANGLE = 4.0, 1.5  # bounds of points: reprojection error [px], angle [degrees]; as in COLMAP's mapper
_PEAK = 0.003  # SIFT's contrast threshold; COLMAP's 0.0067 finds too few features in small or soft photos
# Lens models with many parameters diverge on the first photos. Mapping starts with a model of one distortion parameter,
# and the other parameters are refined last.
_FIRST_MODEL = {
    "RADIAL": "SIMPLE_RADIAL",
    "OPENCV": "SIMPLE_RADIAL",
    "FULL_OPENCV": "SIMPLE_RADIAL",
    "RADIAL_FISHEYE": "SIMPLE_RADIAL_FISHEYE",
    "OPENCV_FISHEYE": "SIMPLE_RADIAL_FISHEYE",
    "THIN_PRISM_FISHEYE": "SIMPLE_RADIAL_FISHEYE",
}
_FISHEYE_FOCAL = 0.6  # focal length over the longest side without EXIF; COLMAP's 1.2 does not fit fisheye lenses
_MAX_FEATURES = 4096  # per photo; COLMAP's 8192 is meant for GPUs and makes matching on CPUs slow


def main(job_path: str) -> None:
    """Run the job; an error is printed as the last line."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        job = json.loads(Path(job_path).read_text(encoding="utf-8"))
        _run(colmap_library(), job)
    except Exception as error:  # pycolmap raises many types; the parent shows the message
        _send(error=reason_of(error))


def _run(colmap: Any, job: dict[str, Any]) -> None:
    if not hasattr(colmap, "FeatureExtractionOptions"):
        raise RuntimeError("pycolmap is too old, version 4 is needed: pip install -U pycolmap")
    photos = [name for group in job["groups"] for name in group]
    _send(stage="features", total=len(photos))
    _find_features(colmap, job, photos)
    _send(stage="pairs", total=job["n_pairs"])
    _match(colmap, job, guided=False)
    models = _map(colmap, job, Path(job["output"]) / "plain", len(photos))
    registered = max(models.values(), default=0)
    if registered < MIN_REGISTERED * len(photos):
        # Matching along epipolar lines is slower and less exact, but it connects distant photos.
        _send(stage="pairs again", total=job["n_pairs"])
        database = colmap.Database.open(job["database"])
        database.clear_matches()
        database.clear_two_view_geometries()
        database.close()
        _match(colmap, job, guided=True)
        again = _map(colmap, job, Path(job["output"]) / "guided", len(photos))
        if max(again.values(), default=0) > registered:
            models = again
    if models and job["camera_model"] in _FIRST_MODEL:
        _refine(colmap, max(models, key=lambda name: models[name]), job["camera_model"])
    _send(models=models)


def _find_features(colmap: Any, job: dict[str, Any], photos: list[str]) -> None:
    reader = colmap.ImageReaderOptions()
    reader.camera_model = _FIRST_MODEL.get(job["camera_model"], job["camera_model"])
    fisheye = reader.camera_model == "FOV" or "FISHEYE" in reader.camera_model
    if fisheye:
        reader.default_focal_length_factor = _FISHEYE_FOCAL
    if job["masks"]:
        reader.mask_path = job["masks"]
    colmap.Database.open(job["database"]).close()
    if job["rig"]:
        reader.camera_model = "SIMPLE_PINHOLE"
    for group in job["groups"]:  # extraction by several threads would number photos at random
        colmap.import_images(job["database"], job["photos"], colmap.CameraMode.SINGLE, group, reader)
    if job["rig"]:
        _define_rig(colmap, job)
    if fisheye:
        _trust_focal_lengths(colmap, job["database"])
    options = colmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.max_image_size = job["max_size"]
    options.sift.peak_threshold = _PEAK
    options.sift.max_num_features = _MAX_FEATURES
    options.sift.first_octave = -1 if job["doubled"] else 0
    colmap.extract_features(
        job["database"], job["photos"], photos, colmap.CameraMode.AUTO, reader, options, colmap.Device.cpu
    )


def _define_rig(colmap: Any, job: dict[str, Any]) -> None:
    """Set the focal lengths of the cameras of the rig, and their places in it."""
    database = colmap.Database.open(job["database"])
    for camera in database.read_all_cameras():
        camera.params = [job["focal"] * camera.width, 0.5 * camera.width, 0.5 * camera.height]
        camera.has_prior_focal_length = True
        database.update_camera(camera)
    cameras = []
    for index, (folder, rotation) in enumerate(job["rig"]):
        camera = colmap.RigConfigCamera()
        camera.ref_sensor = index == 0
        camera.image_prefix = f"{folder}/"
        if index:
            turn = colmap.Rotation3d(np.array(rotation, np.float64).reshape(3, 3))
            camera.cam_from_rig = colmap.Rigid3d(turn, np.zeros(3))
        cameras.append(camera)
    config = colmap.RigConfig()
    config.cameras = cameras
    colmap.apply_rig_config([config], database)
    database.close()


def _trust_focal_lengths(colmap: Any, path: str) -> None:
    """Mark focal lengths as known, because pycolmap verifies pairs of fisheye photos only with known focal lengths."""
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
    """Run the mapper and return the number of registered photos of each model, by the model's folder."""
    _send(stage="photos placed", total=photos)
    options = colmap.IncrementalPipelineOptions()
    for part in (options, options.mapper, options.triangulation):
        part.random_seed = job["seed"]
    # Several threads would sum residuals in random order, and are hardly faster on few cores.
    options.num_threads = options.mapper.num_threads = 1
    if job["rig"]:
        options.ba_refine_sensor_from_rig = options.ba_refine_focal_length = False
        options.ba_refine_extra_params = False
    output.mkdir(parents=True)
    placed = 0

    def first_pair() -> None:
        nonlocal placed
        placed = 1
        one_more()

    def one_more() -> None:
        nonlocal placed
        placed += 1
        _send(done=placed)

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
    """Convert a model's lenses to the requested camera model and run bundle adjustment again."""
    model = colmap.Reconstruction(folder)
    for camera in model.cameras.values():
        focal, cx, cy, distortion = camera.params
        two_focals = not camera_model.startswith("RADIAL")
        camera.model = getattr(colmap.CameraModelId, camera_model)
        known = [focal, focal, cx, cy, distortion] if two_focals else [focal, cx, cy, distortion]
        camera.params = known + [0.0] * (len(camera.params_info.split(",")) - len(known))
    options = colmap.BundleAdjustmentOptions()
    options.ceres.solver_options.num_threads = 1
    options.print_summary = False
    colmap.bundle_adjustment(model, options)
    colmap.ObservationManager(model).filter_all_points3D(_MAX_ERROR, _MIN_ANGLE)
    model.update_point_3d_errors()
    model.write(folder)


def _send(**event: Any) -> None:
    print(json.dumps(event), flush=True)


def _end_with_parent() -> None:
    os.read(0, 1)  # os.read takes no lock; a lock of sys.stdin would block the interpreter's exit
    os._exit(1)


if __name__ == "__main__":
    main(sys.argv[1])
