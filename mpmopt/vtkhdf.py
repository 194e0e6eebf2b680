"""The motion of a body as a VTKHDF file, which ParaView and VTK read."""

from __future__ import annotations

from uuid import uuid4

import h5py
import numpy as np

from mpmopt.motion import with_image
from mpmopt.simulate import Simulation

FRAMES = 101
QUADRILATERAL = 9  # VTK's number of the cell type


def motion(simulation: Simulation, frames: int = FRAMES) -> bytes:
    """Run a simulation and return its motion as the content of a VTKHDF file.

    An unstructured grid of one quadrilateral for each particle, deformed as the particle is, at
    equal intervals from start to end; of a scene with a mirror, the whole body. The mesh is stored
    once, the points and the data of the cells for each time: signal (of the particle's actuator),
    velocity, jacobian (det F) and stretch (the largest singular value of F). Lengths and times are
    the scene's.

    Parameters
    ----------
    simulation : Simulation
        Of N particles.
    frames : int, optional

    Raises
    ------
    SimulationError
        As the simulation does.
    """
    scene = simulation.scene
    steps = np.unique(np.rint(np.linspace(0, scene.steps, frames)).astype(int))
    states = simulation.run(list(steps))
    actuator = simulation.particles.actuator
    if scene.mirror is not None:
        states = np.array([with_image(state, scene.mirror) for state in states])
        actuator = np.tile(actuator, 2)
    times, _, count = states.shape
    states = states.transpose(0, 2, 1)
    F = states[..., 8:12].reshape(times, count, 2, 2)
    half = 0.5 * scene.grid.dx / scene.particles_per_cell
    corners = half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    points = np.zeros((times, count, 4, 3), np.float32)
    points[..., 0:2] = states[:, :, None, 0:2] + np.einsum("tpij,kj->tpki", F, corners)
    signal = np.zeros((times, count))
    driven = actuator >= 0
    now = np.minimum(steps, scene.steps - 1)  # the last step's signal is that of its start
    signal[:, driven] = simulation.signal[now][:, actuator[driven]]
    velocity = np.zeros((times, count, 3), np.float32)
    velocity[..., 0:2] = states[..., 2:4]
    data = {
        "signal": signal,
        "velocity": velocity,
        "jacobian": np.linalg.det(F),
        "stretch": np.linalg.norm(F, ord=2, axis=(2, 3)),
    }
    # In memory, as run files are.
    with h5py.File(f"motion-{uuid4()}", "w", driver="core", backing_store=False) as file:
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
        group["Values"] = steps * scene.time_step
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
