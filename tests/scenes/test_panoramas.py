"""Panoramas: faces of a cube, which photos are cut, and a reconstruction with exact poses."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import panorama_room
import pytest
from cli_runner import clsplat
from PIL import Image

from clsplat.errors import InputError
from clsplat.files.images import read_image, write_png
from clsplat.files.masks import read_mask
from clsplat.scenes.reconstruct.options import ReconstructOptions
from clsplat.scenes.reconstruct.pairs import named_pairs
from clsplat.scenes.reconstruct.panoramas import (
    FACE_FOCAL,
    cut_panoramas,
    face_mask,
    face_of,
    face_pairs,
    face_pixels,
    face_rotations,
    face_size,
    rig_of,
    with_faces,
)
from clsplat.scenes.reconstruct.photo_files import PhotoFile, StagedPhoto, find_photos, stage_photo
from clsplat.scenes.reconstruct.sphere_part import SpherePart, sphere_part
from clsplat.scenes.scene import load_scene

XMP = b'<rdf:Description GPano:ProjectionType="equirectangular" GPano:FullPanoWidthPixels="64"/>'
FACES = list(face_rotations())


def put(path: Path, pixels: np.ndarray, xmp: bytes = b"") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, **({"xmp": xmp, "quality": 95} if xmp else {}))
    return path


def face_rays(face: str, size: int) -> np.ndarray:
    """Directions (S, S, 3) of a face's pixels in the frame of the panorama."""
    focal = FACE_FOCAL * size
    x, y = np.meshgrid(np.arange(size) + 0.5 - size / 2, np.arange(size) + 0.5 - size / 2)
    found = np.stack([x / focal, y / focal, np.ones_like(x)], axis=2) @ face_rotations()[face]
    return found / np.linalg.norm(found, axis=2, keepdims=True)


@pytest.mark.parametrize("face", FACES)
def test_a_pixel_of_a_face_has_the_colour_of_its_direction(face: str) -> None:
    height = 256
    panorama = np.rint(127.5 * (1 + panorama_room.rays(height))).astype(np.uint8)
    size = face_size(2 * height)
    found = face_pixels(panorama, face, size)
    assert found.shape == (size, size, 3)
    wanted = 127.5 * (1 + face_rays(face, size))
    np.testing.assert_allclose(found, wanted, atol=1.6)
    # Rounding has no bias. Half a pixel beside, the mean would differ by half a step.
    np.testing.assert_allclose((found - wanted).mean(axis=(0, 1)), 0, atol=0.1)


def test_there_is_no_seam() -> None:
    """Where the panorama begins does not matter: a panorama of noise that begins elsewhere has the same top, turned."""
    panorama = np.random.default_rng(0).integers(0, 256, (64, 128, 3)).astype(np.uint8)
    found, rolled = face_pixels(panorama, "top", 40), face_pixels(np.roll(panorama, 64, axis=1), "top", 40)
    assert np.abs(found.astype(int) - np.rot90(rolled, 2)).max() <= 1
    turned = face_pixels(np.roll(panorama, 32, axis=1), "right", 40)
    assert np.abs(face_pixels(panorama, "front", 40).astype(int) - turned).max() <= 1


def test_the_faces_are_rotations_to_the_named_sides() -> None:
    looks = {name: rotation.T @ [0, 0, 1] for name, rotation in face_rotations().items()}
    wanted = {"front": (0, 0, 1), "right": (1, 0, 0), "back": (0, 0, -1), "left": (-1, 0, 0), "top": (0, -1, 0)}
    for name, rotation in face_rotations().items():
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1)
        np.testing.assert_allclose(looks[name], wanted[name], atol=1e-12)
    assert face_size(5760) == 1834
    assert face_size(5760) / 2 == pytest.approx(5760 / (2 * math.pi), rel=1e-3), "the resolution of the middle"


def test_masks_are_cut_like_photos() -> None:
    height = 128
    mask = panorama_room.rays(height)[..., 0] > 0.2
    for face in FACES:
        wanted = face_rays(face, 80)[..., 0] > 0.2
        assert np.mean(face_mask(mask, face, 80) != wanted) < 0.02


def test_cut_panoramas_have_names_places_and_masks(tmp_path: Path) -> None:
    pixels = np.zeros((32, 64, 3), np.uint8)
    for number in range(2):
        put(tmp_path / "photos" / "day" / f"a{number}.jpg", pixels)
    put(
        tmp_path / "photos" / "masks" / "day" / "a1.png",
        np.where(panorama_room.rays(32)[..., 2] > 0, 255, 0).astype(np.uint8),
    )
    steps: list[int] = []
    photos = cut_panoramas(find_photos(tmp_path / "photos"), tmp_path / "faces", steps.append)
    assert steps == [1, 2]
    cut = [(n, face) for n in range(2) for face in FACES if (n, face) != (1, "back")]  # its mask hides all of that face
    assert [photo.name for photo in photos] == [f"day/a{n}_{face}.jpg" for n, face in cut]
    assert [photo.place for photo in photos] == [f"{face}/{n:06}" for n, face in cut]
    assert [face_of(photo) for photo in photos[:5]] == FACES
    assert all(photo.mask is None for photo in photos[:5])
    by_face = {face_of(photo): photo for photo in photos[5:]}
    for face, share in (("front", 1.0), ("right", 0.5)):
        mask = by_face[face].mask
        assert mask is not None
        assert read_mask(mask).mean() == pytest.approx(share, abs=0.06)
    for folder in ("work", "masks"):
        (tmp_path / folder).mkdir()
    staged = [stage_photo(photo, n, tmp_path / "work", tmp_path / "masks") for n, photo in enumerate(photos)]
    ready = [photo for photo in staged if isinstance(photo, StagedPhoto)]
    assert len(ready) == 9
    assert ready[3].staged == "left/000000.jpg"
    assert (tmp_path / "work" / "left" / "000000.jpg").exists()
    rig = rig_of(ready)
    assert [name for name, _, _ in rig] == FACES
    assert [len(group) for _, _, group in rig] == [2, 2, 1, 2, 2]
    np.testing.assert_array_equal(rig[0][1], np.eye(3))
    without = rig_of([photo for photo in ready if face_of(photo.source) != "front"])
    np.testing.assert_array_equal(without[0][1], np.eye(3), "the first face is the reference")
    np.testing.assert_array_equal(without[1][1] @ face_rotations()["right"], face_rotations()["back"])


def test_pairs_of_faces() -> None:
    assert set(face_pairs(FACES, FACES, False)) == {(a, b) for a in range(4) for b in range(4)} | {(4, 4)}
    near = set(face_pairs(FACES, FACES, True))
    assert near == {(a, b) for a in range(4) for b in range(4) if (a - b) % 4 != 2} | {(4, 4)}


def test_pairs_by_name(tmp_path: Path) -> None:
    photos = []
    for number in range(3):
        for face in FACES:
            source = PhotoFile(f"a{number}_{face}.jpg", tmp_path, place=f"{face}/{number:06}")
            photos.append(StagedPhoto(source, None, f"{source.place}.jpg"))  # type: ignore[arg-type]
    pairs = named_pairs(photos, "auto", is_video=False)
    assert len(pairs) == len(set(pairs)) == 3 * 17
    assert all(a.rpartition("/")[2] != b.rpartition("/")[2] for a, b in pairs), "never two faces of one panorama"
    assert len(named_pairs(photos, "auto", is_video=True)) == 3 * 13
    plain = [StagedPhoto(PhotoFile(f"{n}.jpg", tmp_path), None, f"{n:06}.jpg") for n in range(3)]  # type: ignore[arg-type]
    assert named_pairs(plain, "auto", False) == [
        ("000000.jpg", "000001.jpg"),
        ("000000.jpg", "000002.jpg"),
        ("000001.jpg", "000002.jpg"),
    ]


def test_which_photos_are_panoramas(tmp_path: Path) -> None:
    wide, square = np.zeros((32, 64, 3), np.uint8), np.zeros((32, 32, 3), np.uint8)
    whole = SpherePart((64, 32), 0, 0, (64, 32))
    assert sphere_part(put(tmp_path / "a.jpg", wide, XMP)) == whole
    assert whole.is_whole
    assert sphere_part(put(tmp_path / "b.jpg", wide)) is None
    assert sphere_part(put(tmp_path / "c.jpg", square, XMP)) is None

    def cut(*files: Path, panoramas: str = "auto") -> list[str]:
        photos = [PhotoFile(file.name, file) for file in files]
        return [photo.name for photo in with_faces(tmp_path, photos, panoramas, tmp_path / "faces", lambda step: None)]

    faces = [f"a_{face}.jpg" for face in FACES]
    assert cut(tmp_path / "a.jpg") == faces
    assert cut(tmp_path / "a.jpg", panoramas="no") == ["a.jpg"]
    assert cut(tmp_path / "a.jpg", panoramas="yes") == faces
    assert cut(tmp_path / "c.jpg") == ["c.jpg"]
    with pytest.warns(UserWarning, match="twice as wide as high: if they are panoramas, use `clsplat reco"):
        assert cut(tmp_path / "b.jpg") == ["b.jpg"]
    with pytest.raises(InputError, match=r"1 of 2 photos are panoramas: put them into a folder of their own"):
        cut(tmp_path / "a.jpg", tmp_path / "c.jpg")
    with pytest.raises(InputError, match=r"c.jpg: is 32x32 px, a panorama is twice as wide as high"):
        cut(tmp_path / "a.jpg", tmp_path / "c.jpg", panoramas="yes")
    (tmp_path / "d.jpg").write_bytes(b"no photo")
    assert cut(tmp_path / "a.jpg", tmp_path / "d.jpg") == [*faces, "d.jpg"], "its reader names it later"
    write_png(tmp_path / "mask.png", np.zeros((10, 10), np.uint8))
    with pytest.raises(InputError, match=r"mask.png: is 10x10 px; make it as large as the panorama"):
        cut_panoramas([PhotoFile("a.jpg", tmp_path / "a.jpg", tmp_path / "mask.png")], tmp_path / "f", lambda n: None)
    with pytest.raises(InputError, match="panoramas 'perhaps': use one of auto, yes, no"):
        ReconstructOptions(panoramas="perhaps")


def xmp_of_part(whole: int, left: int, top: int, width: int, height: int, as_elements: bool = False) -> bytes:
    """XMP data of a photo that shows a part of a panorama of this width [px]."""
    numbers = {"FullPanoWidthPixels": whole, "FullPanoHeightPixels": whole // 2, "CroppedAreaLeftPixels": left}
    numbers |= {"CroppedAreaTopPixels": top, "CroppedAreaImageWidthPixels": width}
    numbers["CroppedAreaImageHeightPixels"] = height
    texts = {"ProjectionType": "equirectangular"} | {name: str(value) for name, value in numbers.items()}
    one = "<GPano:{0}>{1}</GPano:{0}>" if as_elements else '<rdf:Description GPano:{0}="{1}"/>'
    return "".join(one.format(name, text) for name, text in texts.items()).encode()


@pytest.mark.parametrize("as_elements", [False, True])
def test_a_part_of_the_sphere_is_where_its_photo_says(tmp_path: Path, as_elements: bool) -> None:
    whole = np.rint(127.5 * (1 + panorama_room.rays(128))).astype(np.uint8)  # 256 x 128
    part = whole[32:96, 64:192]  # twice as wide as high, as a whole one
    file = put(tmp_path / "part.jpg", part, xmp_of_part(256, 64, 32, 128, 64, as_elements))
    found = sphere_part(file)
    assert found == SpherePart((256, 128), 64, 32, (128, 64))
    reduced = put(tmp_path / "small.jpg", part[::2, ::2], xmp_of_part(256, 64, 32, 128, 64, as_elements))
    assert sphere_part(reduced) == SpherePart((128, 64), 32, 16, (64, 32)), "the numbers are those of the larger photo"
    outside = put(tmp_path / "outside.jpg", part, xmp_of_part(256, 200, 32, 128, 64, as_elements))
    assert sphere_part(outside) == SpherePart((128, 64), 0, 0, (128, 64)), "its numbers contradict each other"

    faces = cut_panoramas([PhotoFile("part.jpg", file)], tmp_path / "faces", lambda n: None)
    assert [face_of(face) for face in faces] == ["front", "right", "left", "top"], "it shows nothing of the back"
    size = face_size(256)
    for face in faces:
        assert face.mask is not None
        shown, rays = read_mask(face.mask), face_rays(face_of(face), size)
        longitude, latitude = np.arctan2(rays[..., 0], rays[..., 2]), np.arcsin(-rays[..., 1])
        inside = (np.abs(longitude) < np.pi / 2) & (np.abs(latitude) < np.pi / 4)
        assert np.mean(shown != inside) < 0.05
        well_inside = (np.abs(longitude) < np.pi / 2 - 0.1) & (np.abs(latitude) < np.pi / 4 - 0.1)
        colours = 127.5 * (1 + rays)
        assert np.abs(read_image(face.file)[well_inside] - colours[well_inside]).mean() < 3, "JPEG rounds colours"


def test_panoramas_of_two_sizes_have_faces_of_one_size(tmp_path: Path) -> None:
    """In the search for poses a face has one camera. Faces of another size would be lost from it, and from the rig."""
    files = [
        put(tmp_path / f"{n}.png", np.zeros((height, 2 * height, 3), np.uint8)) for n, height in enumerate((32, 48))
    ]
    faces = cut_panoramas([PhotoFile(file.name, file) for file in files], tmp_path / "faces", lambda n: None)
    assert len(faces) == 10
    assert {read_image(face.file).shape for face in faces} == {(face_size(96), face_size(96), 3)}


def test_a_panorama_that_exif_turns_is_refused(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6  # orientation
    Image.fromarray(np.zeros((32, 64, 3), np.uint8)).save(tmp_path / "a.jpg", exif=exif)
    with pytest.raises(InputError, match=r"a.jpg: its EXIF data turn it by 90 degrees, .*; store it upright"):
        cut_panoramas([PhotoFile("a.jpg", tmp_path / "a.jpg")], tmp_path / "f", lambda n: None)


def test_a_mask_that_hides_a_whole_panorama(tmp_path: Path) -> None:
    file = put(tmp_path / "a.png", np.zeros((32, 64, 3), np.uint8))
    write_png(tmp_path / "mask.png", np.zeros((32, 64), np.uint8))
    with pytest.raises(InputError, match=r"mask.png: hides every face of .*a.png: leave the photo out"):
        cut_panoramas([PhotoFile("a.png", file, tmp_path / "mask.png")], tmp_path / "f", lambda n: None)


def test_transparent_panoramas_stay_transparent(tmp_path: Path) -> None:
    pixels = np.full((32, 64, 4), 200, np.uint8)
    photo = PhotoFile("a.png", put(tmp_path / "a.png", pixels))
    (front, *_) = cut_panoramas([photo], tmp_path / "faces", lambda n: None)
    assert front.name == "a_front.png"
    np.testing.assert_array_equal(read_image(front.file), 200)


@pytest.mark.slow
def test_the_poses_of_panoramas_in_a_room(tmp_path: Path) -> None:
    """One is smaller than the others, and one shows a part of the sphere."""
    textures = panorama_room.walls()
    truth = panorama_room.walk(7)
    for number, (place, turn) in enumerate(truth):
        height, xmp = 320 if number == 2 else 400, XMP
        pixels = panorama_room.room(place, turn, height, textures)
        if number == 4:
            pixels, xmp = pixels[50:350, 200:600], xmp_of_part(800, 200, 50, 400, 300)
        put(tmp_path / "photos" / f"pano_{number}.jpg", pixels, xmp)
    said = clsplat("reconstruct", tmp_path / "photos", "-o", tmp_path / "scene")
    assert "34 of 34 photos placed" in said, "one shows nothing of what is behind it"
    scene = load_scene(tmp_path / "scene")
    centres, wanted, turns = [], [], []
    for view in scene.views:
        stem, face = Path(view.name).stem.rsplit("_", 1)
        place, turn = truth[int(stem.rsplit("_", 1)[1])]
        pose = view.camera.cam_from_world
        centres.append(-pose[:3, :3].T @ pose[:3, 3])
        wanted.append(place)
        turns.append((pose[:3, :3], face_rotations()[face] @ turn.T))
        assert view.camera.fx == pytest.approx(view.camera.width / 2)
    # The similarity between both worlds (Umeyama 1991).
    a, b = (points - np.mean(points, axis=0) for points in (np.array(centres), np.array(wanted)))
    u, s, vt = np.linalg.svd(b.T @ a)
    mirror = np.diag([1, 1, np.linalg.det(u @ vt)])
    rotation, scale = u @ mirror @ vt, np.trace(np.diag(s) @ mirror) / np.sum(a**2)
    assert np.linalg.norm(scale * a @ rotation.T - b, axis=1).max() < 2e-3
    for found, expected in turns:
        assert (np.trace(found @ rotation.T @ expected.T) - 1) / 2 > np.cos(np.radians(0.1))
