"""What neighbours.c gives to Python; arrays are addresses."""

from typing import TypeAlias

Tree: TypeAlias = tuple[int, int, int, int]
"""axes, rows, boxes, number of points."""

def n_nodes(n: int, /) -> int: ...
def plant(points: int, n: int, axes: int, rows: int, boxes: int, /) -> None: ...
def nearest(tree: Tree, queries: int, start: int, stop: int, k: int, distances: int, rows: int, wide_rows: int, /) -> None: ...
