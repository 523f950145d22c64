"""Point clouds from files written here byte by byte, as the formats say."""

import struct

import numpy as np
import pytest
import torch

from sensors.vision.camera import pinhole, pixel_rays
from sensors.vision.pcd import lzf_decompressed, read_pcd
from sensors.vision.point_files import read_cloud

POINTS = np.array([[0.1, 0.2, 0.3], [-1.0, 2.0, 0.5], [0.0, 0.0, np.nan], [4.0, 5.0, 6.0]], dtype=np.float32)
COLORS = np.array([[255, 0, 1], [2, 250, 3], [4, 5, 240], [10, 20, 30]], dtype=np.uint8)


def packed():
    wide = COLORS.astype(np.uint32)
    return (wide[:, 0] << 16) | (wide[:, 1] << 8) | wide[:, 2]


def header(way, *, width=4, height=1, fields="x y z rgb", sizes="4 4 4 4", types="F F F U", counts="1 1 1 1", more=""):
    return (
        f"# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS {fields}\nSIZE {sizes}\nTYPE {types}\n"
        f"COUNT {counts}\nWIDTH {width}\nHEIGHT {height}\nVIEWPOINT 1 2 3 0.5 0.5 0.5 0.5\n{more}POINTS "
        f"{width * height}\nDATA {way}\n"
    ).encode()


def lzf(data):
    """Greedy LZF, after its definition: literal runs up to 32 bytes, matches of 3 to 264 bytes up to 8192 back."""
    out, literal, place = bytearray(), bytearray(), 0

    def flush():
        for start in range(0, len(literal), 32):
            run = literal[start : start + 32]
            out.append(len(run) - 1)
            out.extend(run)
        literal.clear()

    while place < len(data):
        best, back = 0, 0
        for start in range(max(0, place - 8192), place):
            length = 0
            while length < 264 and place + length < len(data) and data[start + length] == data[place + length]:
                length += 1
            if length > best:
                best, back = length, place - start
        if best < 3:
            literal.append(data[place])
            place += 1
            continue
        flush()
        offset, length = back - 1, best - 2
        out.extend([(length << 5) | (offset >> 8)] if length < 7 else [(7 << 5) | (offset >> 8), length - 7])
        out.append(offset & 255)
        place += best
    flush()
    return bytes(out)


def same(cloud, shape=(4, 3)):
    assert tuple(cloud.points.shape) == shape
    assert np.allclose(cloud.points.reshape(-1, 3).numpy(), POINTS, equal_nan=True)
    assert np.array_equal(cloud.colors.reshape(-1, 3).numpy(), COLORS)


def rows():
    kind = np.dtype([("p", "<f4", (3,)), ("c", "<u4")])
    table = np.zeros(4, kind)
    table["p"], table["c"] = POINTS, packed()
    return table.tobytes()


def columns():
    return POINTS.T.copy().tobytes() + packed().tobytes()


def write(folder, name, data):
    path = folder / name
    path.write_bytes(data)
    return path


def test_pcd_in_all_three_ways(tmp_path):
    text = "".join(f"{x} {y} {z} {c}\n" for (x, y, z), c in zip(POINTS.tolist(), packed().tolist(), strict=True))
    small = lzf(columns())
    assert len(small) != len(columns())
    bodies = {
        "ascii": text.encode(),
        "binary": rows(),
        "binary_compressed": struct.pack("<II", len(small), len(columns())) + small,
    }
    for way, body in bodies.items():
        cloud = read_cloud(write(tmp_path, f"{way}.pcd", header(way) + body))
        same(cloud)
        assert cloud.normals is None
        # the quaternion turns x to y to z
        assert torch.allclose(cloud.viewpoint[:3], torch.tensor([[0, 0, 1.0, 1], [1.0, 0, 0, 2], [0, 1.0, 0, 3]]))
        same(read_cloud(write(tmp_path, "image.pcd", header(way, width=2, height=2) + body)), (2, 2, 3))


def test_pcd_with_packed_floats_padding_and_normals(tmp_path):
    """As the Point Cloud Library writes its PointXYZRGBNormal."""
    kind = np.dtype([("p", "<f4", (3,)), ("_", "u1", (4,)), ("n", "<f4", (3,)), ("c", "<f4")])
    table = np.zeros(4, kind)
    table["p"], table["n"], table["c"] = POINTS, [0, 0, 1], packed().view(np.float32)
    start = header(
        "binary",
        fields="x y z _ normal_x normal_y normal_z rgb",
        sizes="4 4 4 1 4 4 4 4",
        types="F F F U F F F F",
        counts="1 1 1 4 1 1 1 1",
    )
    cloud = read_cloud(write(tmp_path, "cloud.pcd", start + table.tobytes()), scale=0.001)
    assert np.allclose(cloud.points.numpy(), 0.001 * POINTS, equal_nan=True)
    assert np.array_equal(cloud.colors.numpy(), COLORS)
    assert torch.equal(cloud.normals, torch.tensor([[0.0, 0.0, 1.0]]).expand(4, 3))
    assert torch.allclose(cloud.viewpoint[:3, 3], torch.tensor([0.001, 0.002, 0.003]))


@pytest.mark.parametrize(
    "data", [b"", b"a", b"ab" * 500, bytes(1000), bytes(np.random.default_rng(0).integers(0, 4, 1500, np.uint8))]
)
def test_lzf_comes_back(data):
    assert lzf_decompressed(lzf(data), len(data)) == data


def test_lzf_by_hand():
    # three bytes as they are, then nine bytes from three back: the run repeats itself
    assert lzf_decompressed(bytes([2, 1, 2, 3, (7 << 5), 0, 2]), 12) == bytes([1, 2, 3] * 4)
    for wrong, message in (
        (bytes([5, 1]), "part of one"),
        (bytes([0, 1, 7 << 5]), "part of one"),
        (bytes([0, 1, 1 << 5, 4]), "place before"),
        (bytes([0, 1]), "expected 7 bytes"),
    ):
        with pytest.raises(ValueError, match=message):
            lzf_decompressed(wrong, 7)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"not a cloud", "ends with DATA"),
        (header("binary") + rows()[:-3], "4 points of 16 bytes"),
        (header("ascii") + b"1 2 3 4\n", "4 lines of 4 numbers"),
        (header("ascii") + b"1 2 three 4\n" * 4, "three"),
        (header("zip"), "binary_compressed"),
        (header("binary", fields="a b c d") + rows(), "fields x, y and z"),
        (header("binary", sizes="4 4 4"), "SIZE"),
        (header("binary", types="F F F Q"), "TYPE"),
        (header("binary", sizes="4 4 4 99999999999"), "SIZE of 1, 2"),
        (header("binary", sizes="4 4 -1 4"), "SIZE of 1, 2"),
        (header("binary").replace(b"POINTS 4", b"POINTS 5") + rows(), "WIDTH times HEIGHT"),
        (header("binary_compressed") + struct.pack("<II", 100, 64) + b"abc", "64 bytes from 100"),
        (header("binary_compressed") + b"abc", "two sizes"),
        (header("binary").replace(b" 0.5 0.5\n", b"\n") + rows(), "VIEWPOINT"),
    ],
)
def test_broken_pcd_is_refused_with_what_is_wrong(tmp_path, data, message):
    with pytest.raises(ValueError, match=message):
        read_cloud(write(tmp_path, "cloud.pcd", data))


def test_pcd_of_doubles_and_bytes():
    table = np.zeros(2, np.dtype([("x", "<f8"), ("label", "u1")]))
    table["x"], table["label"] = [1.5, -2.5], [3, 4]
    start = header("binary", width=2, fields="x label", sizes="8 1", types="F U", counts="1 1")
    columns = read_pcd(start + table.tobytes()).columns
    assert columns["x"].tolist() == [1.5, -2.5] and columns["label"].tolist() == [3, 4]


def test_ply_ascii_and_binary(tmp_path):
    names = [*(f"property float {n}" for n in "xyz"), *(f"property uchar {n}" for n in ("red", "green", "blue"))]
    for form in ("ascii", "binary_little_endian", "binary_big_endian"):
        start = "\n".join(["ply", f"format {form} 1.0", "element vertex 4", *names, "end_header", ""]).encode()
        if form == "ascii":
            lines = zip(POINTS.tolist(), COLORS.tolist(), strict=True)
            body = "".join(" ".join(map(str, [*p, *c])) + "\n" for p, c in lines).encode()
        else:
            order = "<" if "little" in form else ">"
            table = np.zeros(4, np.dtype([("p", f"{order}f4", (3,)), ("c", "u1", (3,))]))
            table["p"], table["c"] = POINTS, COLORS
            body = table.tobytes()
        cloud = read_cloud(write(tmp_path, "cloud.ply", start + body))
        same(cloud)
        assert cloud.viewpoint is None and cloud.normals is None
    with pytest.raises(ValueError, match="PLY header"):
        read_cloud(write(tmp_path, "no.ply", b"solid"))
    with pytest.raises(ValueError, match="expected vertices as its first element"):
        read_cloud(write(tmp_path, "none.ply", b"ply\nformat ascii 1.0\nelement verte8 1\nend_header\n0 0 0\n"))


def test_npz_of_points_and_of_an_image(tmp_path):
    pose = np.eye(4)
    pose[:3, 3] = 1, 2, 3
    np.savez(tmp_path / "points.npz", points=POINTS, colors=COLORS, world_T_camera=pose)
    cloud = read_cloud(tmp_path / "points.npz")
    same(cloud)
    assert cloud.viewpoint[:3, 3].tolist() == [1, 2, 3]
    depth = np.array([[500, 0, 700], [800, 900, 65535]], dtype=np.uint16)
    intrinsics = pinhole(2, 3, 0.8)
    np.savez(tmp_path / "image.npz", depth=depth, intrinsics=intrinsics.numpy(), color=np.zeros((2, 3, 3), np.uint8))
    cloud = read_cloud(tmp_path / "image.npz")
    metres = torch.tensor([[0.5, torch.nan, 0.7], [0.8, 0.9, torch.nan]])
    expected = pixel_rays(2, 3, intrinsics) * metres[..., None]
    assert torch.allclose(cloud.points, expected, equal_nan=True) and tuple(cloud.colors.shape) == (2, 3, 3)


@pytest.mark.parametrize("scale", [1, 255])
def test_floating_colours_are_parts_of_one_or_whole_numbers(tmp_path, scale):
    given = (COLORS / (255 / scale)).astype(np.float32)
    np.savez(tmp_path / "points.npz", points=POINTS, colors=given)
    assert np.array_equal(read_cloud(tmp_path / "points.npz").colors.numpy(), COLORS)


def test_ply_with_floating_colours(tmp_path):
    names = [f"property {kind} {n}" for kind, ns in (("float", "xyz"), ("{}", ("red", "green", "blue"))) for n in ns]
    text = "\n".join(
        ["ply", "format ascii 1.0", "element vertex 2", *names, "end_header", "0 0 1 1 0 1", "0 1 1 0 0 {}", ""]
    )
    cloud = read_cloud(write(tmp_path, "parts.ply", text.format(*["float"] * 3, 0.5).encode()))
    assert cloud.colors.tolist() == [[255, 0, 255], [0, 0, 128]]
    cloud = read_cloud(write(tmp_path, "bytes.ply", text.format(*["uchar"] * 3, 1).encode()))
    assert cloud.colors.tolist() == [[1, 0, 1], [0, 0, 1]], "bytes that are small are dark"


@pytest.mark.parametrize(
    "colors", [COLORS * 1.01, COLORS.astype(np.int16) - 1, COLORS.astype(np.uint16) * 257, COLORS > 9]
)
def test_colours_that_are_neither_are_refused(tmp_path, colors):
    np.savez(tmp_path / "points.npz", points=POINTS, colors=colors)
    with pytest.raises(ValueError, match="colours"):
        read_cloud(tmp_path / "points.npz")


@pytest.mark.parametrize("name", ["cloud.npz", "cloud.pcd", "cloud.ply"])
def test_damage_is_told_as_such(tmp_path, name):
    """A byte that is another one, anywhere: read, or refused in words, and nothing else."""
    path, random = tmp_path / name, np.random.default_rng(1000)
    if name.endswith("npz"):
        np.savez_compressed(path, points=np.tile(POINTS, (50, 1)), colors=np.tile(COLORS, (50, 1)))
    elif name.endswith("pcd"):
        path.write_bytes(header("binary_compressed") + struct.pack("<II", len(lzf(columns())), 64) + lzf(columns()))
    else:
        names = "".join(f"property float {n}\n" for n in "xyz")
        start = f"ply\nformat binary_little_endian 1.0\nelement vertex 4\n{names}end_header\n"
        path.write_bytes(start.encode() + POINTS.tobytes())
    raw, refused = path.read_bytes(), 0
    for _ in range(150):
        damaged = bytearray(raw)
        damaged[int(random.integers(len(raw)))] ^= int(random.integers(1, 256))
        path.write_bytes(damaged)
        try:
            read_cloud(path)
        except ValueError:
            refused += 1
    assert refused > 10


def test_other_files_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"\.ply, \.pcd, \.npz"):
        read_cloud(tmp_path / "cloud.las")
    with pytest.raises(FileNotFoundError):
        read_cloud(tmp_path / "cloud.pcd")
    for arrays, message in (
        ({"depths": np.zeros((2, 2))}, "found depths"),
        ({"points": np.zeros((4, 2))}, "got \\(4, 2\\)"),
        ({"points": np.array([["a", "b", "c"]])}, "to be real numbers"),
        ({"points": POINTS, "colors": COLORS[:2]}, "as many colors"),
        ({"points": POINTS, "world_T_camera": np.eye(3)}, "world_T_camera"),
    ):
        np.savez(tmp_path / "wrong.npz", **arrays)
        with pytest.raises(ValueError, match=message):
            read_cloud(tmp_path / "wrong.npz")
    (tmp_path / "wrong.npz").write_bytes(b"PK\x03\x04cut off")
    with pytest.raises(ValueError, match="could not read"):
        read_cloud(tmp_path / "wrong.npz")
    with pytest.raises(ValueError, match="scale"):
        read_cloud(tmp_path / "wrong.npz", scale=0.0)
