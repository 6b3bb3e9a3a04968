"""One peer on one cloud: python peers.py NAME CLOUD.npy prints its CPU and wall seconds as JSON. Needs numpy and that peer.

The clock runs over the peer's own work; reading and handing over the points is not counted.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

NEIGHBOURS = 24
AROUND = object()
"""Stands for these neighbours among a smoother's arguments."""


def cgal_jet(points: np.ndarray) -> Callable[[], Any]:
    from CGAL import CGAL_Point_set_processing_3 as processing
    from CGAL.CGAL_Kernel import Point_3
    from CGAL.CGAL_Point_set_3 import Point_set_3

    cloud = Point_set_3()
    for x, y, z in points.tolist():
        cloud.insert(Point_3(x, y, z))
    return lambda: processing.jet_smooth_point_set(cloud, NEIGHBOURS)


def _open3d(points: np.ndarray) -> Any:
    import open3d

    return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))


def _open3d_smoother(name: str, *arguments: Any) -> Callable[[np.ndarray], Callable[[], Any]]:
    """One of Open3D 0.20's smoothers, with 24 neighbours as the others have; its radii are in metres, for the street."""

    def prepared(points: np.ndarray) -> Callable[[], Any]:
        import open3d

        cloud = _open3d(points)
        around = open3d.geometry.KDTreeSearchParamKNN(NEIGHBOURS)
        return lambda: getattr(cloud, name)(*(around if argument is AROUND else argument for argument in arguments))

    return prepared


def scipy_knn(points: np.ndarray) -> Callable[[], Any]:
    from scipy.spatial import cKDTree

    return lambda: cKDTree(points).query(points, k=NEIGHBOURS, workers=-1)


PEERS = {
    "CGAL jet": cgal_jet,
    "Open3D MLS": _open3d_smoother("smooth_mls", AROUND),
    "Open3D bilateral": _open3d_smoother("smooth_bilateral", AROUND, 0.1, 0.06),
    "Open3D Laplacian": _open3d_smoother("smooth_laplacian", 1, 0.5, NEIGHBOURS),
    "Open3D Taubin": _open3d_smoother("smooth_taubin", 1, 0.5, -0.53, NEIGHBOURS),
    "scipy kNN": scipy_knn,
}

if __name__ == "__main__":
    points = np.load(sys.argv[2])
    work = PEERS[sys.argv[1]](points - np.round(points.mean(axis=0)))
    cpu, wall = time.process_time(), time.perf_counter()
    work()
    print(json.dumps({"cpu_s": time.process_time() - cpu, "wall_s": time.perf_counter() - wall}))
