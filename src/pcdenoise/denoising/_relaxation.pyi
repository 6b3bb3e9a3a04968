"""What relaxation.c gives to Python; arrays are addresses."""

from typing import TypeAlias

Graph: TypeAlias = tuple[int, int]
"""index, neighbours of a point with itself."""

def tangents(
    graph: Graph, start: int, stop: int, points: int, planarity_from: float, planarity_to: float, normals: int, sheet: int, /
) -> None: ...
def push(
    graph: Graph,
    start: int,
    stop: int,
    points: int,
    normals: int,
    sheet: int,
    spacing: int,
    pushing: float,
    longest: float,
    pushed: int,
    /,
) -> None: ...
def land(graph: Graph, start: int, stop: int, points: int, began: int, normals: int, sheet: int, landed: int, /) -> None: ...
