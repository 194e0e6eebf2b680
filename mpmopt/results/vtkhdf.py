"""The motion of a body as a VTKHDF file, which ParaView and VTK read."""

from __future__ import annotations

import numpy as np

from mpmopt.assess.trajectory import Motion
from mpmopt.io.checksums import file_in_memory

QUADRILATERAL = 9  # VTK's number of the cell type


def content(motion: Motion) -> bytes:
    """A motion as the content of a VTKHDF file.

    An unstructured grid of one quadrilateral for each particle, deformed as the particle is. The
    mesh is stored once, the points and the data of the cells for each time: signal (of the
    particle's actuator), velocity, jacobian (det F) and stretch (the largest singular value of F).
    Lengths and times are the scene's.

    Parameters
    ----------
    motion : Motion
        At instants that differ.
    """
    times, _, count = motion.position.shape
    F = motion.deformation.transpose(0, 2, 1).reshape(times, count, 2, 2)
    corners = 0.5 * motion.spacing * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    points = np.zeros((times, count, 4, 3), np.float32)
    points[..., 0:2] = motion.position.transpose(0, 2, 1)[:, :, None]
    points[..., 0:2] += np.einsum("tpij,kj->tpki", F, corners)
    velocity = np.zeros((times, count, 3), np.float32)
    velocity[..., 0:2] = motion.velocity.transpose(0, 2, 1)
    data = {
        "signal": motion.largest * motion.actuation,
        "velocity": velocity,
        "jacobian": np.linalg.det(F),
        "stretch": np.linalg.norm(F, ord=2, axis=(2, 3)),
    }
    with file_in_memory() as file:
        file.attrs["made_by"] = "mpmopt"
        root = file.create_group("VTKHDF")
        root.attrs["Version"] = (2, 0)
        root.attrs["Type"] = np.bytes_("UnstructuredGrid")
        root["NumberOfPoints"] = np.array([4 * count])
        root["NumberOfCells"] = np.array([count])
        root["NumberOfConnectivityIds"] = np.array([4 * count])
        root["Connectivity"] = np.arange(4 * count)
        root["Offsets"] = np.arange(0, 4 * count + 1, 4)
        root["Types"] = np.full(count, QUADRILATERAL, np.uint8)
        root["Points"] = points.reshape(-1, 3)
        group = root.create_group("Steps")
        group.attrs["NSteps"] = times
        group["Values"] = motion.frames * motion.scene.time_step
        group["NumberOfParts"] = np.ones(times, int)
        # Where each time's part begins: the mesh is the same for all.
        for name in ("PartOffsets", "CellOffsets", "ConnectivityIdOffsets"):
            group[name] = np.zeros((times, 1) if name != "PartOffsets" else times, int)
        group["PointOffsets"] = 4 * count * np.arange(times)
        for name, values in data.items():
            root[f"CellData/{name}"] = values.astype(np.float32).reshape(-1, *values.shape[2:])
            group[f"CellDataOffsets/{name}"] = count * np.arange(times)
        file.flush()
        return file.id.get_file_image()
