"""Maps in the formats of others: trajectories, pose graphs, COLMAP models, point clouds; written as they are read."""

import json
import os
import shutil
import tempfile
from array import array
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import Final, TextIO

import numpy as np
from numpy.typing import NDArray

from seamark.backend.errors import MapError
from seamark.backend.map_codec import motion_between
from seamark.backend.map_dense import dense_points
from seamark.backend.map_reader import FEATURES, IMAGES
from seamark.backend.map_store import MapStore
from seamark.backend.map_tracks import points_of, posed
from seamark.frontend import se3
from seamark.frontend.camera import Camera

Poses = dict[int, tuple[NDArray[np.float64], float]]
_PLY_ROW: Final = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")])


class Format(StrEnum):
    """What a map can be exported to."""

    TUM = "tum"
    KITTI = "kitti"
    EUROC = "euroc"
    G2O = "g2o"
    COLMAP = "colmap"
    PLY = "ply"


def export_map(
    path: Path, out: Path, kind: Format, component: int | None = None, *, dense: bool = False
) -> dict[str, int]:
    """Write the keyframes of one component (default: that of most keyframes) to ``out``; return what was written.

    ``out`` is a file, for COLMAP a folder, and must not exist. ``dense``: a point cloud of the depth images instead of
    the landmarks. A service may be writing the map. Raises MapError.
    """
    if out.exists():
        raise MapError(f"{out} exists: an export writes something new")
    with MapStore(path, read_only=True) as store:
        poses = posed(store, component)
        if not poses:
            raise MapError(
                f"{path} has no keyframes with poses" + (f" in {component}" if component is not None else "")
            )
        if kind is Format.COLMAP:
            with _made_whole(out) as folder:
                return _colmap(store, poses, folder)
        writer: dict[Format, Callable[[MapStore, Poses, TextIO], dict[str, int]]] = {
            Format.TUM: _tum,
            Format.KITTI: _kitti,
            Format.EUROC: _euroc,
            Format.G2O: _g2o,
        }
        if kind is Format.PLY:
            return _ply(dense_points(store, poses) if dense else _landmark_rows(store, poses), out)
        with _new_file(out) as file:
            return writer[kind](store, poses, file)


def _stamps(store: MapStore) -> dict[int, int]:
    with store.file.reading() as database:
        return dict(map(tuple, database.execute("SELECT id, stamp_ns FROM keyframes")))


def _tum(store: MapStore, poses: Poses, file: TextIO) -> dict[str, int]:
    stamps = _stamps(store)
    for number, (T, _) in sorted(poses.items(), key=lambda item: stamps[item[0]]):
        seconds, rest = divmod(stamps[number], 1_000_000_000)
        numbers = (*T[:3, 3], *se3.to_quaternion(T[:3, :3]))
        file.write(f"{seconds}.{rest:09d} {' '.join(f'{value:.9g}' for value in numbers)}\n")
    return {"poses": len(poses)}


def _kitti(store: MapStore, poses: Poses, file: TextIO) -> dict[str, int]:
    stamps = _stamps(store)
    for _, (T, _) in sorted(poses.items(), key=lambda item: stamps[item[0]]):
        file.write(" ".join(f"{value:.9e}" for value in T[:3].reshape(-1)) + "\n")
    return {"poses": len(poses)}


def _euroc(store: MapStore, poses: Poses, file: TextIO) -> dict[str, int]:
    """Columns as in EuRoC's ground truth, of the camera; what a map does not know (velocity, biases) is zero."""
    names = "p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"
    unknown = "v_RS_R_x [m s^-1],v_RS_R_y [m s^-1],v_RS_R_z [m s^-1],b_w_RS_S_x [rad s^-1],b_w_RS_S_y [rad s^-1],"
    unknown += "b_w_RS_S_z [rad s^-1],b_a_RS_S_x [m s^-2],b_a_RS_S_y [m s^-2],b_a_RS_S_z [m s^-2]"
    file.write(f"#timestamp,{names},{unknown}\n")
    stamps = _stamps(store)
    for number, (T, _) in sorted(poses.items(), key=lambda item: stamps[item[0]]):
        x, y, z, w = se3.to_quaternion(T[:3, :3])
        numbers = [*T[:3, 3], w, x, y, z, *[0.0] * 9]
        file.write(f"{stamps[number]},{','.join(f'{value:.9g}' for value in numbers)}\n")
    return {"poses": len(poses)}


def _g2o(store: MapStore, poses: Poses, file: TextIO) -> dict[str, int]:
    """Vertices, odometry edges and accepted loops; information in g2o's order: translation, then rotation."""
    for number, (T, _) in poses.items():
        file.write(f"VERTEX_SE3:QUAT {number} {_g2o_pose(T)}\n")
    edges = 0
    nodes = {node.id: node for node in store.load_nodes()}
    for node in nodes.values():
        before = None if node.previous_id is None else nodes.get(node.previous_id)
        if before is None or node.id not in poses or before.id not in poses:
            continue
        if node.T_odom_cam is None or before.T_odom_cam is None:
            continue
        T = motion_between(before.T_odom_cam, node.T_odom_cam)
        T[:3, 3] *= poses[before.id][1]
        file.write(f"EDGE_SE3:QUAT {before.id} {node.id} {_g2o_pose(T)} {_information(node.covariance)}\n")
        edges += 1
    loops = 0
    for loop in store.load_loops():
        if loop.accepted and loop.T_match_query is not None and {loop.query_id, loop.match_id} <= set(poses):
            T = loop.T_match_query.copy()
            T[:3, 3] *= poses[loop.match_id][1]
            file.write(
                f"EDGE_SE3:QUAT {loop.match_id} {loop.query_id} {_g2o_pose(T)} {_information(loop.covariance)}\n"
            )
            loops += 1
    return {"vertices": len(poses), "odometry_edges": edges, "loop_edges": loops}


def _g2o_pose(T: NDArray[np.float64]) -> str:
    return " ".join(f"{value:.9g}" for value in (*T[:3, 3], *se3.to_quaternion(T[:3, :3])))


def _information(covariance: NDArray[np.float64] | None) -> str:
    matrix: NDArray[np.floating] = np.eye(6)
    if covariance is not None:
        floor = 1e-12 * max(1.0, float(np.abs(covariance).max()))
        matrix = np.linalg.inv(covariance + floor * np.eye(6))
    order = [3, 4, 5, 0, 1, 2]
    return " ".join(f"{value:.9g}" for value in matrix[np.ix_(order, order)][np.triu_indices(6)])


def _colmap(store: MapStore, poses: Poses, folder: Path) -> dict[str, int]:
    """Write cameras.txt, images.txt, points3D.txt and images/; of all observations only their numbers are in memory."""
    (folder / "images").mkdir(parents=True)
    nodes = {node.id: node for node in store.load_nodes() if node.id in poses and node.camera is not None}
    seen = [number for number in store.keyframe_ids(recognisable=True) if number in nodes]
    cameras = {camera: number for number, camera in enumerate(dict.fromkeys(nodes[n].camera for n in seen), 1)}
    (folder / "cameras.txt").write_text("".join(f"{n} {_colmap_camera(c)}\n" for c, n in cameras.items()))  # type: ignore[arg-type]
    count = 0
    pairs_of: dict[int, array[int]] = {}  # keyframe -> index of a feature, its point, the next index, ...
    with (folder / "points3D.txt").open("w") as file:
        for point in points_of(store, {number: poses[number] for number in seen}):
            if len(point.views) < 2:
                continue
            count += 1
            track = " ".join(f"{view} {index}" for view, index in point.views)
            x, y, z = point.position
            file.write(f"{point.id} {x:.9g} {y:.9g} {z:.9g} 128 128 128 {point.error_px:.4g} {track}\n")
            for view, index in point.views:
                pairs_of.setdefault(view, array("i")).extend((index, point.id))
    with (folder / "images.txt").open("w") as file:
        for number in seen:
            keyframe = store.keyframe(number, (FEATURES, IMAGES))
            name = f"{number:08d}.jpg"
            (folder / "images" / name).write_bytes(keyframe.jpeg)
            T = se3.inverse(poses[number][0])
            x, y, z, w = se3.to_quaternion(T[:3, :3])
            numbers = " ".join(f"{value:.9g}" for value in (w, x, y, z, *T[:3, 3]))
            file.write(f"{number} {numbers} {cameras[keyframe.camera]} {name}\n")
            # COLMAP has the centre of the top-left pixel at (0.5, 0.5).
            points = keyframe.features.points + 0.5
            pairs = pairs_of.pop(number, array("i"))
            point_of = dict(zip(pairs[::2], pairs[1::2], strict=True))
            named = (f"{u:.3f} {v:.3f} {point_of.get(i, -1)}" for i, (u, v) in enumerate(points.tolist()))
            file.write(" ".join(named) + "\n")
    return {"cameras": len(cameras), "images": len(seen), "points": count}


def _colmap_camera(camera: Camera) -> str:
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5
    size, distortion = f"{camera.width} {camera.height}", list(camera.distortion)
    if len(distortion) <= 4:
        model, numbers = ("OPENCV", [fx, fy, cx, cy, *distortion]) if distortion else ("PINHOLE", [fx, fy, cx, cy])
    else:
        model, numbers = "FULL_OPENCV", [fx, fy, cx, cy, *distortion, *[0.0] * (8 - len(distortion))]
    return f"{model} {size} {' '.join(f'{value:.12g}' for value in numbers)}"


def _landmark_rows(store: MapStore, poses: Poses) -> Iterator[NDArray[np.void]]:
    for batch in _batches(point.position for point in points_of(store, poses)):
        rows = np.zeros(len(batch), _PLY_ROW)
        for axis, name in enumerate("xyz"):
            rows[name] = batch[:, axis]
        yield rows


def _ply(points: Iterator[NDArray[np.void]], out: Path) -> dict[str, int]:
    """Write a binary point cloud; the header comes last, because only then the number of points is known."""
    count, row = 0, _PLY_ROW
    with _made_whole(out) as partial, tempfile.TemporaryFile(dir=out.absolute().parent) as body:
        for rows in points:
            body.write(rows.tobytes())
            count, row = count + len(rows), rows.dtype
        body.seek(0)
        header = f"ply\nformat binary_little_endian 1.0\ncomment {json.dumps('Seamark, frame of the map')}\n"
        kinds = {name: "float" if row[name].kind == "f" else "uchar" for name in row.names or ()}
        properties = "".join(f"property {kind} {name}\n" for name, kind in kinds.items())
        header += f"element vertex {count}\n{properties}end_header\n"
        with partial.open("wb") as file:
            file.write(header.encode())
            while chunk := body.read(1 << 20):
                file.write(chunk)
    return {"points": count}


def _batches(positions: Iterable[NDArray[np.float64]]) -> Iterator[NDArray[np.float64]]:
    batch: list[NDArray[np.float64]] = []
    for position in positions:
        batch.append(position)
        if len(batch) == 4096:
            yield np.array(batch)
            batch = []
    if batch:
        yield np.array(batch)


@contextmanager
def _made_whole(out: Path) -> Iterator[Path]:
    """Give the name under which a file or folder is made, which gets its own name when all is written."""
    partial = out.with_name(out.name + ".partial")
    try:
        _remove(partial)  # of an export that was killed
        yield partial
        partial.rename(out)
    except OSError as error:
        raise MapError(f"{out} cannot be written: {error.strerror}") from error
    finally:
        _remove(partial)


@contextmanager
def _new_file(out: Path) -> Iterator[TextIO]:
    """Write under another name until all is written."""
    with _made_whole(out) as partial, partial.open("w", encoding="utf-8") as file:
        yield file
        file.flush()
        os.fsync(file.fileno())


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
