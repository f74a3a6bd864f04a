"""Draw docs/pictures/sharp.png: the same scans mapped by `default` and by `sharp`, beside the truth.

    python docs/pictures/sharp.py [OUT]      some twenty seconds

The picture is a horizontal slice of a made-up office at 1 m. White is unobserved.
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from potclient.datasets import open_dataset
from potclient.towns import TownRecording
from potserver import AtomDictionary, MappingService, MappingSettings
from potserver.recordings import to_scan

DATASET, N_SCANS, EVERY, THIN = "town:offices:23", 20, 5, 4
HEIGHT_M, HALF_M, CELL_M = 1.0, 6.0, 0.03


def main() -> None:
    out = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_name("sharp.png")
    recording = open_dataset(DATASET, max_range_m=25.0, n_generated=N_SCANS * EVERY)
    assert isinstance(recording, TownRecording)
    scans = [recording[EVERY * k] for k in range(N_SCANS)]
    centre = scans[N_SCANS // 2].T_map_sensor[:2, 3]
    along = np.arange(-HALF_M, HALF_M, CELL_M)
    x, y = np.meshgrid(centre[0] + along, centre[1] + along)
    points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, HEIGHT_M)])
    truth = recording.town.occupied(points, scans[-1].stamp_ns / 1e9).reshape(x.shape)
    panels = [("truth", np.where(truth, 1.0, 0.0))]
    for profile in ("default", "sharp"):
        service = MappingService(AtomDictionary(()), MappingSettings.of_profile(profile))
        for k, scan in enumerate(scans):
            mapped = to_scan(scan, k)
            keep = slice(None, None, THIN)
            service.integrate(type(mapped)(
                points=mapped.points[keep], is_return=mapped.is_return[keep], T_map_sensor=mapped.T_map_sensor, seq=k,
                stamp_ns=mapped.stamp_ns,
            ))  # fmt: skip
        answer = service.snapshot.occupancy(points)
        panels.append((f"profile {profile}", np.where(answer.observed, answer.mean, np.nan).reshape(x.shape)))
    figure, axes = plt.subplots(1, 3, figsize=(10.5, 3.8), dpi=100, layout="constrained")
    extent = (-HALF_M, HALF_M, -HALF_M, HALF_M)
    for axis, (title, p) in zip(axes, panels, strict=True):
        shown = axis.imshow(p, origin="lower", extent=extent, cmap="coolwarm", vmin=0.0, vmax=1.0)
        if title != "truth":
            axis.contour(truth, levels=[0.5], extent=extent, colors="black", linewidths=0.6, origin="lower")
        axis.set_title(title, fontsize=10, loc="left")
        axis.set_xticks([])
        axis.set_yticks([])
    figure.colorbar(shown, ax=axes, label="P(occupied)", shrink=0.8)
    figure.savefig(out)
    print(f"wrote {out}")


if __name__ == "__main__":
    main()
