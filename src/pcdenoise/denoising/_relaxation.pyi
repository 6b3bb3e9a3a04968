"""What relaxation.c gives to Python; arrays are addresses."""

from typing import TypeAlias

Graph: TypeAlias = tuple[int, int]
"""index, neighbours of a point with itself."""

def tangents(
    graph: Graph, start: int, stop: int, points: int, planarity_from: float, planarity_to: float, normals: int, sheet: int, /
) -> None: ...
def even(
    graph: Graph,
    start: int,
    stop: int,
    points: int,
    began: int,
    normals: int,
    spacing: int,
    held: int,
    pace: int,
    waves: int,
    directions: int,
    open_from: float,
    open_to: float,
    wall: float,
    evened: int,
    /,
) -> None: ...
def land(graph: Graph, start: int, stop: int, points: int, began: int, normals: int, sheet: int, landed: int, /) -> None: ...
