"""A trained model's folder: config, cameras, log, checkpoint and point clouds, in 3DGS's layout."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..cameras.cameras_json import NamedCamera, named_cameras, write_cameras
from ..errors import InputError, OutputError, Remedy
from ..files.existing import probe
from ..files.json_file import read_object, write_json
from ..files.lock import folder_lock
from ..files.real_path import real_path
from ..splats.formats.any_file import READ_NAMES
from ..splats.splats import Splats

if TYPE_CHECKING:
    from ..scenes.scene import Scene, View

BUDGET, BLOCKS = "budget.json", "blocks.json"
STAGES = {BUDGET: "budget", BLOCKS: "blocks"}  # files of trainings of several stages, and the folders of their runs
# Files of `eval`: of test views, and of other sets of views.
_RESULTS = tuple(
    f"{stem}{views}{ending}"
    for stem, ending in (("results", ".json"), ("per_view", ".json"), ("report", ".html"))
    for views in ("", "_train", "_validation", "_all")
)
_ITERATION = re.compile(r"iteration_(\d+)")


def scene_record(scene: Scene, folder: Path) -> dict[str, Any]:
    """Return what is needed to read a run's scene again: its path, its test views and the arguments of `load_scene`.

    Digests of the photos show later whether they have changed. The path of a scene in the model's folder is relative to
    that folder, so that both can be moved together.
    """
    path, home = real_path(scene.path), real_path(folder)
    return {
        "path": path.relative_to(home).as_posix() if path.is_relative_to(home) else path.as_posix(),
        "test_names": sorted(scene.test_names),
        **({"validation_names": sorted(scene.validation_names)} if scene.validation_names else {}),
        **scene.reading,
        **({"photos": dict(scene.photo_digests)} if scene.photo_digests else {}),
    }


class ModelFolder:
    """Paths and small files of one model."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)

    @property
    def config_path(self) -> Path:
        return self.path / "config.json"

    @property
    def cfg_args_path(self) -> Path:
        """3DGS's record of a run."""
        return self.path / "cfg_args"

    @property
    def cameras_path(self) -> Path:
        return self.path / "cameras.json"

    @property
    def exposures_path(self) -> Path:
        return self.path / "exposure.json"

    @property
    def log_path(self) -> Path:
        return self.path / "log.jsonl"

    @property
    def checkpoint_path(self) -> Path:
        return self.path / "checkpoint.npz"

    def ply_path(self, iteration: int) -> Path:
        """Return the path of an iteration's point cloud."""
        return self.path / "point_cloud" / f"iteration_{iteration}" / "point_cloud.ply"

    @property
    def is_used(self) -> bool:
        """Whether a run or a training of several stages has written into the folder."""
        return self.can_resume or self.config_path.exists() or (self.path / "point_cloud").exists()

    @property
    def can_resume(self) -> bool:
        """Whether the folder has a checkpoint, or the state of a training of several stages."""
        return any(p.exists() for p in (self.checkpoint_path, *(self.path / name for name in STAGES)))

    def iterations(self) -> list[int]:
        """Iterations with a point cloud, in rising order."""
        found = []
        for folder in (self.path / "point_cloud").glob("iteration_*"):
            match = _ITERATION.fullmatch(folder.name)
            if match and (folder / "point_cloud.ply").is_file():
                found.append(int(match[1]))
        return sorted(found)

    def latest_ply(self, iteration: int | None = None) -> tuple[Path, int]:
        """Return the file and the iteration of a point cloud, by default the last. Raise InputError without one."""
        found = self.iterations()
        if not found and self.can_resume:
            raise InputError(
                f"{self.path}: its training has written no point cloud yet: continue it with clsplat train --resume"
            )
        for name in READ_NAMES if not found else ():
            if (self.path / name).is_file():
                raise InputError(f"{self.path}: is a folder of SOG: name {self.path / name}")
        if not found:
            raise InputError(f"{self.path}: no point_cloud/iteration_N/point_cloud.ply in it: train a model first")
        if iteration is not None and iteration not in found:
            raise InputError(f"{self.path}: no iteration {iteration}: it has {', '.join(map(str, found))}")
        chosen = found[-1] if iteration is None else iteration
        return self.ply_path(chosen), chosen

    @contextmanager
    def for_run(self, *, resume: bool, overwrite: bool) -> Iterator[None]:
        """Keep the folder for one run while the block lasts. A new run must not replace a model unasked.

        The folder is made if it is missing, except for `resume`: there the caller finds out that it has nothing.

        Raises
        ------
        OutputError : the folder holds a model, another run writes into it, or it cannot be written.
        """
        if resume and not self.path.is_dir():
            yield
            return
        self.refuse_model(resume or overwrite)
        self.prepare()
        with folder_lock(self.path):
            self.refuse_model(resume or overwrite)  # another run may have ended since
            yield

    def refuse_model(self, allowed: bool) -> None:
        """Raise OutputError if the folder holds a model, or a part of one, unless the caller may change it."""
        if self.is_used and not allowed:
            raise OutputError(
                f"{self.path}: already holds a model",
                Remedy("replace it", "--overwrite"),
                Remedy("continue it", "--resume"),
                Remedy("choose another folder"),
            )

    def prepare(self) -> None:
        """Make the folder; raise OutputError if it cannot be written."""
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            probe(self.path)
        except OSError as error:
            reason = error.strerror or error
            raise OutputError(f"{self.path}: cannot be written ({reason}): choose another folder") from None

    def check_space(self, nbytes: int) -> None:
        """Raise OutputError if the disk has less room than `nbytes`, also without an earlier model in the folder."""
        replaced = [self.checkpoint_path, *(self.ply_path(iteration) for iteration in self.iterations())]
        try:
            disk = shutil.disk_usage(self.path)
        except (AttributeError, OSError):  # some systems do not say
            return
        free = disk.free + sum(path.stat().st_size for path in replaced if path.is_file())
        if disk.total and free < nbytes:  # some network disks have no size
            raise OutputError(
                f"{self.path}: its disk has {free / 1e6:.3g} MB for a model and a checkpoint, which need at least "
                f"{nbytes / 1e6:.3g} MB: free some space, or choose another folder"
            )

    def clear(self) -> None:
        """Remove the files of an earlier run, and nothing else."""
        for path in (
            self.checkpoint_path,
            self.log_path,
            self.config_path,
            self.cameras_path,
            self.exposures_path,
            *(self.path / name for name in (*_RESULTS, *STAGES)),
        ):
            path.unlink(missing_ok=True)
        for folder in STAGES.values():
            shutil.rmtree(self.path / folder, ignore_errors=True)
        for iteration in self.iterations():
            self.remove_ply(iteration)

    def write_run(self, config: dict[str, Any], scene: Scene) -> None:
        """Write the run's options and the record of its scene to config.json."""
        self.write_config({"config": config, "scene": scene_record(scene, self.path)})

    def write_config(self, values: dict[str, Any]) -> None:
        """Write config.json."""
        write_json(self.config_path, values)

    def read_config(self) -> dict[str, Any]:
        """Return the values in config.json. Raise InputError if it is missing or damaged."""
        return read_object(self.config_path)

    def write_cameras(self, named: list[NamedCamera]) -> None:
        """Write 3DGS's cameras.json."""
        write_cameras(self.cameras_path, named)

    def write_views(self, views: Sequence[View]) -> None:
        """Write the cameras of views to 3DGS's cameras.json."""
        self.write_cameras(named_cameras([view.name for view in views], [view.camera for view in views]))

    def write_exposures(self, by_photo: dict[str, list[list[float]]]) -> None:
        """Write 3DGS's exposure.json."""
        write_json(self.exposures_path, by_photo)

    def remove_ply(self, iteration: int) -> None:
        """Remove the point cloud of an iteration, if there is one, and its folder if it is empty then."""
        ply = self.ply_path(iteration)
        ply.unlink(missing_ok=True)
        if ply.parent.is_dir() and not any(ply.parent.iterdir()):
            ply.parent.rmdir()

    def save(self, splats: Splats, iteration: int) -> Path:
        """Write the point cloud of an iteration and return its file."""
        path = self.ply_path(iteration)
        splats.save(path)
        return path
