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


def open3d_statistical(points: np.ndarray) -> Callable[[], Any]:
    cloud = _open3d(points)
    return lambda: cloud.remove_statistical_outlier(NEIGHBOURS, 2.0)


def open3d_radius(points: np.ndarray) -> Callable[[], Any]:
    cloud = _open3d(points)
    return lambda: cloud.remove_radius_outlier(NEIGHBOURS // 2, 0.15)


def scipy_knn(points: np.ndarray) -> Callable[[], Any]:
    from scipy.spatial import cKDTree

    return lambda: cKDTree(points).query(points, k=NEIGHBOURS, workers=-1)


PEERS = {"CGAL jet": cgal_jet, "Open3D statistical": open3d_statistical, "Open3D radius": open3d_radius, "scipy kNN": scipy_knn}

if __name__ == "__main__":
    points = np.load(sys.argv[2])
    work = PEERS[sys.argv[1]](points - np.round(points.mean(axis=0)))
    cpu, wall = time.process_time(), time.perf_counter()
    work()
    print(json.dumps({"cpu_s": time.process_time() - cpu, "wall_s": time.perf_counter() - wall}))
