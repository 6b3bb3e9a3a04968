"""How far a denoised cloud is from the truth: the paper's metric, Chamfer, surface distances, evenness, shrinkage, normals.

Not here: choosing anything by these numbers (nothing may), tables and pictures of them (report.py, pictures.py).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud.neighbours import knn
from pcdenoise.cloud.scan import Points
from pcdenoise.errors import UsageError
from pcdenoise.synthesis.meshes import Closest, Mesh, MeshQueries

Array = NDArray[np.float64]

UNITS = {
    "td": "% of the diagonal",
    "cd": "1e-4, unit sphere",
    "p2s": "1e-4, unit sphere",
    "p2m": "1e-4, unit sphere",
    "shrinkage": "% of the diagonal",
    "normal_error": "degrees",
    "spacing_variation": "std / mean",
}
"""The unit of each number that `evaluate` may return. Lower is better for all; shrinkage is best at 0."""

N_NORMALS = 20_000
K_NORMALS = 16


def evaluate(prediction: Points, clean: Points | None = None, mesh: Mesh | None = None) -> dict[str, float]:
    """Every metric that the given truth allows, of a prediction (N, 3) in the truth's own coordinates; units in UNITS.

    clean (M, 3)  evenly spaced points of the true surface.    mesh  the true surface; needs open3d.

    td    (clean and mesh) mean distance prediction -> mesh plus mean distance clean -> prediction, the mesh's bounding-box
          diagonal being 1: the metric of Total Denoising (ICCV 2019).
    cd    (clean) mean squared distance prediction -> clean plus clean -> prediction, in the clean cloud's unit sphere: PU-Net's.
    p2s   (mesh) mean squared distance prediction -> mesh, in the mesh's unit sphere; p2m adds the mean over faces of the squared
          distance face -> prediction. Both are exact; libraries that skip small triangles report other numbers.
    shrinkage          (consistently oriented mesh) mean depth below the surface; negative where the cloud swelled.
    normal_error       (mesh) mean angle between the plane of 16 neighbours and the nearest face.
    spacing_variation  (always) of the distance to the nearest neighbour: about 0.1 for even points, 0.52 for random ones.
    Raises UsageError for fewer than two points or coordinates that are not numbers.
    """
    _check("prediction", prediction)
    nearest = knn(prediction, 2)[0][:, 1]
    metrics = {"spacing_variation": float(nearest.std() / nearest.mean()) if nearest.mean() > 0 else 0.0}
    if clean is not None:
        _check("clean cloud", clean)
        radius = _unit_sphere(clean)[1]
        to_clean, to_prediction = knn(clean, 1, prediction)[0][:, 0], knn(prediction, 1, clean)[0][:, 0]
        metrics["cd"] = 1e4 * float((to_clean**2).mean() + (to_prediction**2).mean()) / radius**2
    if mesh is not None:
        closest = MeshQueries(mesh).closest(prediction)
        radius = _unit_sphere(mesh.vertices)[1]
        metrics["p2s"] = 1e4 * float((closest.distance**2).mean()) / radius**2
        metrics["p2m"] = metrics["p2s"] + 1e4 * float((face_distances(mesh, prediction) ** 2).mean()) / radius**2
        metrics["normal_error"] = _normal_error(prediction, closest)
        if _is_oriented(mesh):
            depth = -np.einsum("ij,ij->i", prediction - closest.place, closest.normal)
            metrics["shrinkage"] = 100 * float((np.sign(depth) * closest.distance).mean()) / mesh.diagonal
        if clean is not None:
            metrics["td"] = 100 * float(closest.distance.mean() + to_prediction.mean()) / mesh.diagonal
    return {name: metrics[name] for name in UNITS if name in metrics}


def point_errors(prediction: Points, clean: Points | None = None, mesh: Mesh | None = None) -> Array:
    """(N,) distance of each predicted point to the mesh, else to the nearest clean point, in file units.

    Raises UsageError without any truth or for coordinates that are not numbers.
    """
    _check("prediction", prediction)
    if mesh is not None:
        return MeshQueries(mesh).closest(prediction).distance
    if clean is None:
        raise UsageError("errors need a truth; give a clean cloud (--clean) or a mesh (--mesh)")
    _check("clean cloud", clean)
    return knn(clean, 1, prediction)[0][:, 0]


def face_distances(mesh: Mesh, points: Points) -> Array:
    """(F,) distance from each face of a mesh to the nearest of (N, 3) points.

    Branch and bound: a face is halved until the points near the centre of each piece must include its nearest one, or the piece
    cannot hold the face's minimum, or it is 1 % of its distance in size: the result is exact where points are near a face and
    at most 1 % too large where none is.
    """
    best = np.full(len(mesh.faces), np.inf)
    smallest = 1e-6 * mesh.diagonal
    points = np.unique(points, axis=0)
    pieces, face = mesh.corners, np.arange(len(mesh.faces))
    k = min(8, len(points))
    while len(pieces):
        centre = pieces.mean(axis=1)
        reach = np.linalg.norm(pieces - centre[:, None], axis=2).max(axis=1)
        distance, index = knn(points, k, centre)
        exact = _triangle_distances(np.repeat(pieces, k, axis=0), points[index.ravel()]).reshape(-1, k).min(axis=1)
        np.minimum.at(best, face, exact)
        # A point not among the k is at least distance[k-1] from the centre, so at least that less `reach` from the piece.
        undecided = (distance[:, -1] - reach < best[face]) & (reach > np.maximum(0.01 * best[face], smallest)) & (k < len(points))
        pieces, face = _halved(pieces[undecided]), np.repeat(face[undecided], 2)
        k = min(2 * k, 32, len(points))
    return best


def _halved(triangles: Array) -> Array:
    """(2M, 3, 3) the halves of (M, 3, 3) triangles cut through the longest edge, the two of one triangle in sequence."""
    rows = np.arange(len(triangles))
    longest = np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=2).argmax(axis=1)
    a, b, c = (triangles[rows, (longest + i) % 3] for i in range(3))
    middle = (a + b) / 2
    return np.stack([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)], axis=1).reshape(-1, 3, 3)


def _triangle_distances(triangles: Array, points: Points) -> Array:
    """(M,) distances between (M, 3, 3) triangles and (M, 3) points, row by row."""
    edges = np.roll(triangles, -1, axis=1) - triangles
    offsets = points[:, None] - triangles
    length2 = np.maximum(np.einsum("mij,mij->mi", edges, edges), np.finfo(np.float64).tiny)
    along = np.clip(np.einsum("mij,mij->mi", offsets, edges) / length2, 0.0, 1.0)
    to_edges = np.linalg.norm(offsets - along[..., None] * edges, axis=2).min(axis=1)
    normal = np.cross(edges[:, 0], edges[:, 1])
    area = np.linalg.norm(normal, axis=1)
    side = np.einsum("mij,mij->mi", np.cross(edges, offsets), np.broadcast_to(normal[:, None], edges.shape))
    over = (area > 0) & (side >= 0).all(axis=1)
    height = np.abs(np.einsum("mi,mi->m", offsets[:, 0], normal)) / np.where(area > 0, area, 1.0)
    distances: Array = np.where(over, height, to_edges)
    return distances


def _normal_error(prediction: Points, closest: Closest) -> float:
    """Mean angle in degrees, of at most N_NORMALS points, between the plane through K_NORMALS neighbours and the nearest face."""
    chosen = slice(None, None, -(-len(prediction) // N_NORMALS))
    neighbours = prediction[knn(prediction, K_NORMALS, prediction[chosen])[1]]
    centred = neighbours - neighbours.mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", centred, centred))[1][:, :, 0]
    cosine = np.abs(np.einsum("ni,ni->n", normals, closest.normal[chosen]))
    return float(np.degrees(np.arccos(np.minimum(cosine, 1.0))).mean())


def _is_oriented(mesh: Mesh) -> bool:
    """Whether no two faces run along a shared edge in the same direction, so that outside is outside everywhere."""
    edges = mesh.faces.ravel() * len(mesh.vertices) + np.roll(mesh.faces, -1, axis=1).ravel()
    return len(np.unique(edges)) == len(edges)


def _unit_sphere(points: Points) -> tuple[Array, float]:
    """Box centre and largest distance from it."""
    centre = (points.max(axis=0) + points.min(axis=0)) / 2
    return centre, float(np.linalg.norm(points - centre, axis=1).max())


def _check(name: str, points: Points) -> None:
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 2:
        raise UsageError(f"the {name} must be at least two points with three coordinates, got an array of shape {points.shape}")
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise UsageError(f"the {name} has {len(bad)} rows that are not finite (first: row {bad[0]}); leave them out")
