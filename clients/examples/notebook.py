# %% [markdown]
# # A map in this process
# `MappingService` takes scans, `KernelMap` answers: no server, no network. Editors open this file as a notebook.

# %%
from __future__ import annotations

import numpy as np

from potclient.datasets import open_dataset
from potserver import AtomDictionary, KernelMap, MappingService, Scan

recording = open_dataset("generated", n_generated=6)
atoms = AtomDictionary.builtin()
service = MappingService(atoms)

# %% [markdown]
# Each scan gets atoms carried to it, and is then fused into the map.

# %%
for recorded in recording:
    update = service.integrate(
        Scan(
            points=recorded.points,
            T_map_sensor=recorded.T_map_sensor,
            is_return=recorded.is_return,
            robot_id="rover",
        )
    )
    print(
        f"revision {update.map_revision}: {update.map_kernels} kernels, {update.n_kernels_added} of them new"
    )

# %% [markdown]
# A snapshot never changes; ask it anywhere, at any resolution.

# %%
snapshot: KernelMap = service.snapshot
scan = recording[0]
ends = scan.in_map[scan.is_return]
half_way = (ends + scan.T_map_sensor[:3, 3]) / 2
for name, points in (("at the ends of beams", ends), ("half-way to them", half_way)):
    answer = snapshot.occupancy(np.asarray(points, np.float64))
    print(f"{name}: median P(occupied) {np.median(answer.mean):.2f}, observed {answer.observed.mean():.0%}")

# %% [markdown]
# Unknown is answered as unknown, not as free.

# %%
nowhere = snapshot.occupancy(np.array([[500.0, 500.0, 500.0]]))
print(f"far away: P(occupied) {nowhere.mean[0]:.2f}, observed {bool(nowhere.observed[0])}")
