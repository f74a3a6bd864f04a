from typing import NamedTuple
import numpy as np
from scipy.spatial import cKDTree
class Normals(NamedTuple):
    normal: np.ndarray
    cosine: np.ndarray
    sigma_m: np.ndarray
def normals(hits, rays, known, voxel_m, *, planar):
    n = len(hits)
    normal, cosine, sigma = -rays.copy(), np.full(n, 0.7), np.full(n, 0.05)
    k = 4 if planar else 10
    cell = np.floor(hits / voxel_m).astype(np.int64)
    _, which, inverse, counts = np.unique(cell @ np.array([1, 1 << 20, 1 << 40]), return_index=True, return_inverse=True, return_counts=True)
    mean = np.stack([np.bincount(inverse, hits[:, c]) / counts for c in range(3)], 1)
    cloud = np.concatenate([mean, known])
    if len(cloud) <= k: return Normals(normal, cosine, sigma)
    d, near = cKDTree(cloud).query(mean, k=k)
    x = cloud[near]; x = x - x.mean(axis=1, keepdims=True)
    cov = np.einsum("nki,nkj->nij", x, x) / k
    if planar: cov[:, 2, 2] = 1e6
    w, v = np.linalg.eigh(cov)
    flat = (np.sqrt(np.maximum(w[:, 0], 0)) < 0.06) & (w[:, 1] > 8 * w[:, 0]) & (d[:, -1] < 1.5)
    nv, fv = v[inverse][:, :, 0], flat[inverse]
    c = np.einsum("ni,ni->n", nv, rays)
    normal[fv] = (nv * -np.sign(c)[:, None])[fv]
    cosine[fv] = np.abs(c)[fv]
    sigma[fv] = np.sqrt(np.maximum(w[:, 0], 0))[inverse][fv]
    return Normals(normal, cosine, sigma)
def near_free(hits, origin, normals, *, low_m, high_m, sigmas, rng):
    ray = hits - origin; length = np.linalg.norm(ray, axis=1); ray /= length[:, None]
    d = rng.uniform(low_m, high_m, len(hits)) + sigmas * normals.sigma_m
    d = d / np.maximum(normals.cosine, 0.05)
    ok = np.flatnonzero(d < 0.9 * length)
    return hits[ok] - d[ok, None] * ray[ok], ok
def behind(hits, normals, *, low_m, high_m, rng):
    return hits - rng.uniform(low_m, high_m, len(hits))[:, None] * normals.normal
