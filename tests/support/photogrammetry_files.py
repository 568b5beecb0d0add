"""OPF projects and Metashape's cameras, written by the documents of the formats alone, and their projections.

Nothing here shares code with the readers. All of it computes in float64.
"""

from __future__ import annotations

import json
import math
import uuid
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

WIDTH, HEIGHT = 48, 36
N_CAMERAS, N_POINTS = 5, 40
NAMES = [f"DJI_{index:04}.png" for index in range(N_CAMERAS)]


@dataclass(frozen=True)
class Shot:
    """A camera: the angles omega, phi, kappa [degrees], and its centre in the world."""

    name: str
    angles: tuple[float, float, float]
    centre: np.ndarray

    @property
    def axes(self) -> np.ndarray:
        """Columns: where the image's right, its top and the back of the camera point in the world."""
        o, p, k = (math.radians(angle) for angle in self.angles)
        # The product Rx(omega) Ry(phi) Rz(kappa), multiplied out.
        return np.array(
            [
                [math.cos(p) * math.cos(k), -math.cos(p) * math.sin(k), math.sin(p)],
                [
                    math.cos(o) * math.sin(k) + math.sin(o) * math.sin(p) * math.cos(k),
                    math.cos(o) * math.cos(k) - math.sin(o) * math.sin(p) * math.sin(k),
                    -math.sin(o) * math.cos(p),
                ],
                [
                    math.sin(o) * math.sin(k) - math.cos(o) * math.sin(p) * math.cos(k),
                    math.sin(o) * math.cos(k) + math.cos(o) * math.sin(p) * math.sin(k),
                    math.cos(o) * math.cos(p),
                ],
            ]
        )

    def local(self, points: np.ndarray) -> np.ndarray:
        """Points in the camera, (N, 3): x to the right, y down, z forward."""
        right, top, back = self.axes.T
        offsets = points - self.centre
        return np.stack([offsets @ right, -(offsets @ top), -(offsets @ back)], axis=1)


def shots() -> list[Shot]:
    """Cameras above the points that look down, each with other angles."""
    rng = np.random.default_rng(11)
    return [
        Shot(
            name, (float(rng.normal(0, 8)), float(rng.normal(0, 8)), 70.0 * index - 100.0), np.array([*xy, 6.0 + index])
        )
        for index, (name, xy) in enumerate(zip(NAMES, rng.normal(0, 0.7, (N_CAMERAS, 2)), strict=True))
    ]


def points() -> tuple[np.ndarray, np.ndarray]:
    """Positions that float32 holds, and colours, (N, 3) each."""
    rng = np.random.default_rng(12)
    xyz = (rng.normal(size=(N_POINTS, 3)) * 0.8).astype(np.float32).astype(np.float64)
    return xyz, rng.integers(0, 256, (N_POINTS, 3)).astype(np.uint8)


# ---- OPF -----------------------------------------------------------------------------------------------------------

PERSPECTIVE: dict[str, Any] = {
    "type": "perspective",
    "principal_point_px": [24.75, 17.5],
    "focal_length_px": 41.0,
    "radial_distortion": [-0.11, 0.07, -0.012],
    "tangential_distortion": [0.0041, -0.0023],
}
FISHEYE: dict[str, Any] = {
    "type": "fisheye",
    "principal_point_px": [24.5, 17.75],
    "affine": [60.0, 0.0, 0.0, 59.0],
    "polynomial": [0.0, 1.0, 0.0, -0.16],
    "is_p0_zero": True,
    "is_symmetric_affine": False,
}


def opf_pixels(internals: dict[str, Any], local: np.ndarray) -> np.ndarray:
    """The pixels of points in a camera, (N, 2), by the formulas of Pix4D."""
    x, y = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]
    cx, cy = internals["principal_point_px"]
    if internals["type"] == "perspective":
        r1, r2, r3 = internals["radial_distortion"]
        t1, t2 = internals["tangential_distortion"]
        s = x * x + y * y
        grow = 1 + s * (r1 + s * (r2 + s * r3))
        across = grow * x + 2 * t1 * x * y + t2 * (s + 2 * x * x)
        down = grow * y + 2 * t2 * x * y + t1 * (s + 2 * y * y)
        return internals["focal_length_px"] * np.stack([across, down], axis=1) + [cx, cy]
    radius = np.hypot(x, y)
    t = 2 / math.pi * np.arctan(radius)
    rho = sum(p * t**power for power, p in enumerate(internals["polynomial"]))
    c, d, e, f = internals["affine"]
    across, down = rho * x / radius, rho * y / radius
    return np.stack([c * across + d * down + cx, e * across + f * down + cy], axis=1)


@dataclass(frozen=True)
class OpfProject:
    """The JSON files of a project by name, to be changed and written."""

    files: dict[str, Any] = field(default_factory=dict)

    def write(self, folder: Path) -> Path:
        for name, values in self.files.items():
            file = folder / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(json.dumps(values), encoding="utf-8")
        return folder / "project.opf"


def opf_project(internals: dict[str, Any] = PERSPECTIVE, prefix: str = "images/") -> OpfProject:
    """A project with the shots of `shots`. Its ids have 64 bits."""
    ids = [(1 << 63) + 17 * index for index in range(N_CAMERAS)]

    def item(kind: str, *resources: tuple[str, str]) -> dict[str, Any]:
        listed = [{"uri": uri, "format": form} for uri, form in resources]
        return {"id": str(uuid.uuid5(uuid.NAMESPACE_URL, kind)), "type": kind, "resources": listed, "sources": []}

    def document(form: str, **values: Any) -> dict[str, Any]:
        return {"format": f"application/opf-{form}+json", "version": "1.0", **values}

    files: dict[str, Any] = {
        "project.opf": document(
            "project",
            id=str(uuid.UUID(int=1)),
            name="test",
            description="",
            items=[
                item("camera_list", ("camera-list.json", "application/opf-camera-list+json")),
                item("input_cameras", ("input-cameras.json", "application/opf-input-cameras+json")),
                item(
                    "calibration",
                    ("calibration/cameras.json", "application/opf-calibrated-cameras+json"),
                    ("calibration/tracks.gltf", "model/gltf+json"),
                    ("calibration/positions.bin", "application/gltf-buffer+bin"),
                ),
                item("point_cloud", ("dense/dense.gltf", "model/gltf+json")),
            ],
        ),
        "camera-list.json": document(
            "camera-list",
            cameras=[{"id": number, "uri": prefix + name} for number, name in zip(ids, NAMES, strict=True)],
        ),
        "input-cameras.json": document(
            "input-cameras", sensors=[{"id": 7, "image_size_px": [WIDTH, HEIGHT]}], captures=[]
        ),
        "calibration/cameras.json": document(
            "calibrated-cameras",
            sensors=[{"id": 7, "internals": internals}],
            cameras=[
                {
                    "id": number,
                    "sensor_id": 7,
                    "position": shot.centre.tolist(),
                    "orientation_deg": list(shot.angles),
                }
                for number, shot in zip(ids, shots(), strict=True)
            ],
        ),
    }
    return OpfProject(files)


def write_opf_cloud(
    file: Path, xyz: np.ndarray, rgb: np.ndarray | None, counts: list[int] | None, shift: tuple[float, float, float]
) -> dict[str, Any]:
    """Write an OPF-glTF point cloud and return its JSON.

    The node's matrix turns z up to y up, as the specification says, and then moves by `shift` in the world.
    """
    stored = (xyz - shift).astype("<f4")
    arrays: list[tuple[str, np.ndarray, int, str]] = [("positions.bin", stored, 5126, "VEC3")]
    primitive: dict[str, Any] = {"attributes": {"POSITION": 0}, "mode": 0, "extensions": {}}
    if rgb is not None:
        primitive["attributes"]["COLOR_0"] = len(arrays)
        arrays.append(("colors.bin", np.hstack([rgb, np.full((len(rgb), 1), 255, np.uint8)]), 5121, "VEC4"))
    if counts is not None:
        offsets = np.concatenate([[0], np.cumsum(counts)[:-1]])
        packed = [
            int(offset).to_bytes(5, "little") + int(count).to_bytes(3, "little")
            for offset, count in zip(offsets, counts, strict=True)
        ]
        primitive["extensions"]["OPF_mesh_primitive_matches"] = {
            "cameraUids": [1],
            "cameraIds": len(arrays) + 1,
            "pointIndexRanges": len(arrays),
        }
        arrays.append(("ranges.bin", np.frombuffer(b"".join(packed), "<u4").reshape(-1, 2), 5125, "VEC2"))
        arrays.append(("ids.bin", np.zeros((sum(counts), 1), "<u4"), 5125, "SCALAR"))
    file.parent.mkdir(parents=True, exist_ok=True)
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "extensions": {"OPF_asset_version": {"version": "1.0"}}},
        "extensionsRequired": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        # Column by column. A world point (a, b, c) is at (a, c, -b) in glTF.
        "nodes": [{"mesh": 0, "matrix": [1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, shift[0], shift[2], -shift[1], 1]}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": [],
        "bufferViews": [],
        "buffers": [],
    }
    for index, (name, array, code, form) in enumerate(arrays):
        data = np.ascontiguousarray(array).tobytes()
        (file.parent / name).write_bytes(data)
        document["buffers"].append({"uri": name, "byteLength": len(data)})
        document["bufferViews"].append({"buffer": index, "byteLength": len(data), "target": 34962})
        document["accessors"].append({"bufferView": index, "componentType": code, "count": len(array), "type": form})
        if code == 5121:
            document["accessors"][-1]["normalized"] = True
    file.write_text(json.dumps(document), encoding="utf-8")
    return document


# ---- Metashape -----------------------------------------------------------------------------------------------------

FRAME = {
    "type": "frame",
    **{"f": 41.0, "cx": 0.75, "cy": -0.5, "b1": 0.3, "b2": 0.0},
    **{"k1": -0.11, "k2": 0.07, "k3": -0.012, "k4": 0.0, "p1": 0.0041, "p2": -0.0023},
}
ROUND = {
    "type": "fisheye",
    **{"f": 40.0, "cx": -0.25, "cy": 0.5, "b1": 0.2, "b2": 0.0},
    **{"k1": 0.03, "k2": -0.01, "k3": 0.002, "k4": -0.0004, "p1": 0.0012, "p2": -0.0009},
}


# The length of (x, y) at an angle from the axis.
FISHEYES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "fisheye": lambda angle: angle,
    "equidistant_fisheye": lambda angle: angle,
    "equisolid_fisheye": lambda angle: 2 * np.sin(angle / 2),
}


def metashape_pixels(lens: dict[str, Any], local: np.ndarray) -> np.ndarray:
    """The pixels of points in a camera, (N, 2), by the appendix of Metashape's manual."""
    x, y = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]
    if lens["type"] in FISHEYES:
        radius = np.hypot(x, y)
        length = FISHEYES[lens["type"]](np.arctan(radius))
        x, y = x * length / radius, y * length / radius
    r = np.sqrt(x**2 + y**2)
    radial = 1 + lens["k1"] * r**2 + lens["k2"] * r**4 + lens["k3"] * r**6 + lens["k4"] * r**8
    p1, p2 = lens["p1"], lens["p2"]
    xd = x * radial + p1 * (r**2 + 2 * x**2) + 2 * p2 * x * y
    yd = y * radial + p2 * (r**2 + 2 * y**2) + 2 * p1 * x * y
    u = WIDTH * 0.5 + lens["cx"] + xd * lens["f"] + xd * lens["b1"] + yd * lens["b2"]
    v = HEIGHT * 0.5 + lens["cy"] + yd * lens["f"]
    return np.stack([u, v], axis=1)


@dataclass(frozen=True)
class Similarity:
    """The transform of a chunk: p -> scale R p + t."""

    rotation: np.ndarray
    translation: np.ndarray
    scale: float

    def inverse(self, xyz: np.ndarray) -> np.ndarray:
        return ((xyz - self.translation) @ self.rotation) / self.scale


def similarity() -> Similarity:
    turn, _ = np.linalg.qr(np.random.default_rng(13).normal(size=(3, 3)))
    return Similarity(turn * np.sign(np.linalg.det(turn)), np.array([3.0, -2.0, 5.0]), 2.5)


def on_earth(world: Similarity, latitude: float, longitude: float, height: float) -> Similarity:
    """The transform to geocentric coordinates if the world has the axes east, north and up at a place.

    The mean of the shots is at the place. Angles are in radians, the height above the ellipsoid of WGS 84 in metres.
    """
    a, f = 6378137.0, 1 / 298.257223563
    across, along = math.cos(latitude), math.sin(latitude)
    normal = a / math.sqrt(1 - f * (2 - f) * along**2)
    position = np.array(
        [
            (normal + height) * across * math.cos(longitude),
            (normal + height) * across * math.sin(longitude),
            ((1 - f) ** 2 * normal + height) * along,
        ]
    )
    east = np.array([-math.sin(longitude), math.cos(longitude), 0.0])
    up = np.array([across * math.cos(longitude), across * math.sin(longitude), along])
    axes = np.stack([east, np.cross(up, east), up], axis=1)
    middle = np.mean([shot.centre for shot in shots()], axis=0)
    return Similarity(axes @ world.rotation, axes @ (world.translation - middle) + position, world.scale)


LOCAL = 'LOCAL_CS["Local Coordinates (m)",LOCAL_DATUM["Local Datum",0]]'


@dataclass(frozen=True)
class Label:
    """What a <camera> has beside its pose."""

    text: str
    enabled: str = "true"
    aligned: bool = True
    component: str | None = "0"
    sensor: str = "0"


def metashape_xml(
    lens: dict[str, Any] = FRAME,
    labels: list[Label] | None = None,
    chunk: Similarity | None = None,
    reference: str = LOCAL,
    in_component: bool = True,
    placement: Similarity | None = None,
) -> str:
    """The XML file of the shots of `shots`, whose world the chunk's transform leads to.

    `placement` is written instead of that transform.
    """
    labels = [Label(Path(name).stem) for name in NAMES] if labels is None else labels
    cameras = []
    for index, (label, shot) in enumerate(zip(labels, shots(), strict=True)):
        transform = f"<transform>{_text(_pose(shot, chunk))}</transform>" if label.aligned else ""
        component = "" if label.component is None else f' component_id="{label.component}"'
        cameras.append(
            f'<camera id="{index}" sensor_id="{label.sensor}"{component} label="{label.text}" '
            f'enabled="{label.enabled}">{transform}<orientation>1</orientation></camera>'
        )
    sensors = _sensor(0, lens)
    cameras.insert(2, '<group id="0" label="g" type="folder">')
    return _document(sensors, "".join([*cameras, "</group>"]), placement or chunk, reference, in_component)


@dataclass(frozen=True)
class Mount:
    """A slave of a rig: its axes as columns and its place, both in the master's camera, in units of the chunk."""

    rotation: np.ndarray
    location: np.ndarray | None


RIG_FRAMES = 2
RIG_FORMS = ("flat", "slaves first", "in a group", "nested", "nested without master_id")


def mounts(count: int, located: bool = True) -> list[Mount]:
    """Slaves that look to the sides and are turned about the axis, so their three angles matter."""
    angles = [(12.0, -20.0, 90.0), (-15.0, 25.0, -40.0)]
    places = [np.array([0.3, -0.05, 0.1]), np.array([-0.2, 0.15, -0.25])]
    return [
        Mount(Shot("", turn, place).axes, place if located else None)
        for turn, place in zip(angles[:count], places[:count], strict=True)
    ]


def rig_name(frame: int, camera: int) -> str:
    """The label of a photo of a rig; camera 0 is the master."""
    return f"frame{frame}_camera{camera}"


def rig_lens(camera: int) -> dict[str, Any]:
    return FRAME | {"f": 41.0 + camera}


def rig_xml(slaves: list[Mount], form: str = "flat", chunk: Similarity | None = None) -> str:
    """The XML file of a rig, whose master has the poses of the first shots."""
    identity = "<rotation>1 0 0 0 1 0 0 0 1</rotation><location>0 0 0</location>"
    sensors = _sensor(0, rig_lens(0), identity)
    for number, mount in enumerate(slaves, 1):
        place = "" if mount.location is None else f"<location>{_text(mount.location)}</location>"
        spread = f"<covariance>{_text(np.eye(6))}</covariance><rotation_covariance>{_text(np.eye(3))}"
        offset = f"<rotation>{_text(mount.rotation)}</rotation>{place}{spread}</rotation_covariance>"
        sensors += _sensor(number, rig_lens(number), offset, ' master_id="0"')
    cameras = ""
    for frame, shot in zip(range(RIG_FRAMES), shots(), strict=False):
        master = 10 * frame
        named = "" if form == "nested without master_id" else f' master_id="{master}"'
        others = "".join(
            f'<camera id="{master + number}" sensor_id="{number}"{named} label="{rig_name(frame, number)}"/>'
            for number in range(1, len(slaves) + 1)
        )
        inside = others if form.startswith("nested") else ""
        first = (
            f'<camera id="{master}" sensor_id="0" component_id="0" label="{rig_name(frame, 0)}" enabled="true">'
            f"<transform>{_text(_pose(shot, chunk))}</transform>{inside}</camera>"
        )
        cameras += {
            "flat": first + others,
            "slaves first": others + first,
            "in a group": f'{first}<group id="{frame}" label="g" type="folder">{others}</group>',
        }.get(form, first)
    return _document(sensors, cameras, chunk)


def _pose(shot: Shot, chunk: Similarity | None) -> np.ndarray:
    """Camera-to-chunk of a shot, (4, 4)."""
    world = Similarity(np.eye(3), np.zeros(3), 1.0) if chunk is None else chunk
    right, top, back = shot.axes.T
    pose = np.eye(4)
    pose[:3, :3] = world.rotation.T @ np.stack([right, -top, -back], axis=1)
    pose[:3, 3] = world.inverse(shot.centre)
    return pose


def _sensor(number: int, lens: dict[str, Any], offset: str = "", attributes: str = "") -> str:
    """A <sensor> with an initial and an adjusted calibration."""
    size = f'<resolution width="{WIDTH}" height="{HEIGHT}"/>'
    numbers = "".join(f"<{key}>{value!r}</{key}>" for key, value in lens.items() if key != "type" and value)
    return (
        f'<sensor id="{number}" label="camera" type="{lens["type"]}"{attributes}>{size}'
        f'<calibration type="{lens["type"]}" class="initial">{size}<f>1.0</f></calibration>'
        f'<calibration type="{lens["type"]}" class="adjusted">{size}{numbers}</calibration>{offset}</sensor>'
    )


def _document(
    sensors: str,
    cameras: str,
    written: Similarity | None,
    reference: str = LOCAL,
    in_component: bool = True,
) -> str:
    """The XML file of sensors, cameras and the transform of the chunk or of its component."""
    placed = (
        ""
        if written is None
        else (
            f'<transform><rotation locked="false">{_text(written.rotation)}</rotation>'
            f"<translation>{_text(written.translation)}</translation><scale>{written.scale!r}</scale></transform>"
        )
    )
    inside, outside = (placed, "") if in_component else ("", placed)
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0">\n  <chunk label="Chunk 1" enabled="true">'
        f'<sensors next_id="1">{sensors}</sensors>'
        f'<components next_id="2" active_id="0"><component id="0" label="Component 1">{inside}</component></components>'
        f'<cameras next_id="9" next_group_id="1">{cameras}</cameras>{outside}<reference>{reference}</reference></chunk>'
        "\n</document>\n"
    )


def _text(values: np.ndarray) -> str:
    return " ".join(repr(float(value)) for value in values.ravel())
