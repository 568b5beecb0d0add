"""What identifies the scene of a run in runs.jsonl, and its title in tables and charts."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from ..scenes.scene import Scene, View

Record = dict[str, Any]  # a line of runs.jsonl

CONTENT = "content"  # key of the digest; rows of older versions lack it
_TITLE = "title"  # key of the title in memory; no row of a file has it
_DIGITS = 16  # of the digest, in hex
_SHOWN = 4  # digits of the digest in a title


def scene_identity(scene: Scene) -> dict[str, Any]:
    """Return what identifies a scene as it was read: name, size of the first view, numbers of views, and a digest.

    The digest differs for other photos, masks, cameras, points, or test views.
    """
    camera = scene.views[0].camera
    return {
        "name": scene.name,
        "width": camera.width,
        "height": camera.height,
        "train": len(scene.train),
        "test": len(scene.test),
        CONTENT: _content(scene),
    }


def with_contents(records: Sequence[Record]) -> list[Record]:
    """Return the records with a digest in each scene, as far as one is known.

    A row of an older version does not have one. It counts as a run on the first scene here with the same numbers.
    """
    first: dict[str, str] = {}
    for record in records:
        if CONTENT in record["scene"]:
            first.setdefault(_numbers(record["scene"]), record["scene"][CONTENT])
    known = []
    for record in records:
        scene = record["scene"]
        content = first.get(_numbers(scene))
        lacks = CONTENT not in scene and content is not None
        known.append({**record, "scene": {**scene, CONTENT: content}} if lacks else record)
    return known


def titled(records: Sequence[Record]) -> list[Record]:
    """Return the records with titles that differ between different scenes; see `scene_title`.

    A title is the name and size. Scenes that share both have more in their titles: their numbers of views, or else
    digits of the digest. Scenes of a published set keep the short title, because its tables name the differences.
    """
    if all(_TITLE in record["scene"] for record in records):
        return list(records)
    records = with_contents(records)
    groups: dict[str, dict[str, Mapping[str, Any]]] = {}
    for record in records:
        groups.setdefault(scene_title(record), {})[_key(record["scene"])] = record["scene"]
    titles: dict[str, str] = {}
    for title, scenes in groups.items():
        details = _details(list(scenes.values()))
        titles |= {key: title + more for key, more in zip(scenes, details, strict=True)}
    return [{**record, "scene": {**record["scene"], _TITLE: titles[_key(record["scene"])]}} for record in records]


def scene_title(record: Record) -> str:
    """Return the title of a record's scene: that of `titled`, or its name and size."""
    scene = record["scene"]
    return str(scene.get(_TITLE, f"{scene['name']} {scene['width']}x{scene['height']}"))


def _details(scenes: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return what distinguishes scenes of one name and size: the fewest kinds of details with which all differ."""
    details = [""] * len(scenes)
    if any("set" in scene for scene in scenes):
        return details
    contents = [str(scene.get(CONTENT, "unknown")) for scene in scenes]
    kinds = (
        [f", {_views(scene.get('test'), 'test')}" for scene in scenes],
        [f", {_views(scene.get('train'), 'training')}" for scene in scenes],
        [f", content {content[:_SHOWN]}" for content in contents],
        [f" {content}" for content in contents],
    )
    for kind in kinds:
        longer = [before + more for before, more in zip(details, kind, strict=True)]
        if len(set(longer)) > len(set(details)):
            details = longer
    return details


def _views(count: Any, kind: str) -> str:
    return f"{count} {kind} view{'' if count == 1 else 's'}"


def _key(scene: Mapping[str, Any]) -> str:
    return json.dumps(scene, sort_keys=True)


def _numbers(scene: Mapping[str, Any]) -> str:
    """Return all of a scene's identity but the digest: what older versions have written."""
    return _key({key: value for key, value in scene.items() if key not in (CONTENT, _TITLE)})


def _content(scene: Scene) -> str:
    """Return the digest of all that a run learns from or is measured on."""
    digest = hashlib.sha256()
    reading = {key: scene.reading.get(key) for key in ("alpha", "bars")}
    if scene.reading.get("rim"):  # rows of older versions stay valid for scenes without a rim
        reading["rim"] = True
    digest.update(json.dumps(reading, sort_keys=True).encode())
    for views in (scene.train, scene.test):
        digest.update(f"\n{len(views)} views\n".encode())
        for view in views:
            pixels = scene.photo_digests.get(view.name) or _pixels(view)
            digest.update(f"{json.dumps(view.name)} {pixels}\n".encode() + _camera(view))
    # Single precision leaves out the last bits, which can differ between machines.
    digest.update(scene.points.xyz.astype(np.float32).tobytes() + scene.points.rgb.tobytes())
    return digest.hexdigest()[:_DIGITS]


def _camera(view: View) -> bytes:
    camera = view.camera
    lens = [camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy]
    return np.array([*lens, *camera.cam_from_world.ravel()], np.float32).tobytes()


def _pixels(view: View) -> str:
    """Return the digest of a view that no file holds."""
    view = view.loaded()
    digest = hashlib.sha256()
    for array in (view.image, view.mask, view.alpha):
        digest.update(b"none" if array is None else np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:_DIGITS]
