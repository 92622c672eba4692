"""A whole run in one file, NAME.vtkhdf, which ParaView opens: Kitware's VTKHDF of PolyData with time steps, written by h5py.

Source: https://docs.vtk.org/en/latest/vtk_file_formats/vtkhdf_file_format/vtkhdf_specifications.html, version 2.0.
"""

from pathlib import Path
from typing import Any

import numpy as np

from jfrnn.sph.errors import SceneError

_TOPOLOGIES = ("Vertices", "Lines", "Polygons", "Strips")
_WHOLE = "whole"  # an attribute outside of what the format says: whether the last frame was written to its end


def check_library() -> None:
    """Raise where h5py is not installed, saying what to install."""
    try:
        import h5py  # noqa: F401
    except ImportError as error:
        raise SceneError(
            "hdf: a file .vtkhdf is written by h5py, which is not installed: pip install h5py, or leave hdf out"
        ) from error


def follow(path: Path, snapshots: Path, step: int) -> None:
    """Bring a series up to a step: frames that it lacks are read from STEP.vtp, those after the step are removed.

    A series that a kill left half written is made anew.
    """
    import h5py

    frames = {int(each.stem): each for each in sorted(snapshots.glob("*.vtp")) if int(each.stem) <= step}
    try:
        file = h5py.File(path, "r+")
        fits = bool(file.attrs[_WHOLE])
    except (OSError, KeyError):
        file, fits = None, False
    if file is None or not fits:
        if file is not None:
            file.close()
        file = _begin(path)
    with file:
        file.attrs[_WHOLE] = False
        file.flush()
        there = np.asarray(file["steps"])
        kept = int(np.argmin(np.append(there[: len(frames)] == np.array(list(frames))[: len(there)], False)))
        _cut(file, kept)
        for number, frame in list(frames.items())[kept:]:
            _add(file, number, frame)
        file.flush()
        file.attrs[_WHOLE] = True


def _begin(path: Path) -> Any:  # noqa: ANN401
    """Return a new file with no frames."""
    import h5py

    file = h5py.File(path, "w")
    file.attrs[_WHOLE] = True
    root = file.create_group("VTKHDF")
    root.attrs["Version"] = np.array([2, 0])
    root.attrs.create("Type", np.bytes_("PolyData"))  # the reader wants ASCII of fixed length
    times = root.create_group("Steps")
    times.attrs["NSteps"] = 0
    _grow(file, "steps", np.zeros(0, np.int64))
    _grow(root, "Points", np.zeros((0, 3)))
    for name in ("NumberOfPoints", "Steps/NumberOfParts", "Steps/PartOffsets", "Steps/PointOffsets"):
        _grow(root, name, np.zeros(0, np.int64))
    _grow(times, "Values", np.zeros(0))
    for name in ("CellOffsets", "ConnectivityIdOffsets"):
        _grow(times, name, np.zeros((0, len(_TOPOLOGIES)), np.int64))
    for topology in _TOPOLOGIES:
        for name in ("NumberOfCells", "NumberOfConnectivityIds", "Connectivity", "Offsets"):
            _grow(root, f"{topology}/{name}", np.zeros(0, np.int64))
    return file


def _grow(group: Any, name: str, rows: np.ndarray) -> None:  # noqa: ANN401
    """Add rows to a dataset, which is made where there is none."""
    if name not in group:
        group.create_dataset(name, data=rows, maxshape=(None, *rows.shape[1:]), chunks=(1024, *rows.shape[1:]))
        return
    data, before = group[name], len(group[name])
    data.resize(before + len(rows), axis=0)
    data[before:] = rows


def _cut(file: Any, kept: int) -> None:  # noqa: ANN401
    """Keep the first frames alone."""
    root = file["VTKHDF"]
    points = int(root["NumberOfPoints"][:kept].sum())
    lengths = {"Points": points, "Vertices/Connectivity": points, "Vertices/Offsets": points + kept}
    lengths |= {f"PointData/{name}": points for name in root.get("PointData", ())}
    lengths |= {f"{topology}/Offsets": kept for topology in _TOPOLOGIES[1:]}
    per_frame = [f"{topology}/{name}" for topology in _TOPOLOGIES for name in ("NumberOfCells", "NumberOfConnectivityIds")]
    per_frame += ["NumberOfPoints", *(f"Steps/{name}" for name in root["Steps"] if name != "PointDataOffsets")]
    per_frame += [f"Steps/PointDataOffsets/{name}" for name in root["Steps"].get("PointDataOffsets", ())]
    for name, length in lengths.items() | dict.fromkeys(per_frame, kept).items():
        root[name].resize(length, axis=0)
    file["steps"].resize(kept, axis=0)
    root["Steps"].attrs["NSteps"] = kept


def _add(file: Any, step: int, frame: Path) -> None:  # noqa: ANN401
    """Add a frame: its particles, each a vertex, and what is known of each."""
    import pyvista

    cloud, root = pyvista.read(frame), file["VTKHDF"]
    times, n, before = root["Steps"], cloud.n_points, len(root["Points"])
    number = len(times["Values"])
    for name, array in cloud.point_data.items():
        _grow(times, f"PointDataOffsets/{name}", np.array([before]))
        _grow(root, f"PointData/{name}", np.asarray(array))
    _grow(root, "Points", np.asarray(cloud.points))
    _grow(root, "NumberOfPoints", np.array([n]))
    for topology, cells in zip(_TOPOLOGIES, (n, 0, 0, 0), strict=True):
        _grow(root, f"{topology}/NumberOfCells", np.array([cells]))
        _grow(root, f"{topology}/NumberOfConnectivityIds", np.array([cells]))
        _grow(root, f"{topology}/Connectivity", np.arange(cells))
        _grow(root, f"{topology}/Offsets", np.arange(cells + 1))
    for name in ("CellOffsets", "ConnectivityIdOffsets"):
        _grow(times, name, np.array([[before, 0, 0, 0]]))
    for name, value in (("Values", float(cloud.field_data["time"][0])), ("NumberOfParts", 1), ("PartOffsets", number)):
        _grow(times, name, np.array([value]))
    _grow(times, "PointOffsets", np.array([before]))
    _grow(file, "steps", np.array([step]))
    times.attrs["NSteps"] = number + 1
