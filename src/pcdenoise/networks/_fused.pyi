"""What fused.c gives to Python; arrays are addresses, 0 for none."""

from typing import TypeAlias

Surroundings: TypeAlias = tuple[int, int, int, int, int, int]
"""points, sources, index, count, neighbours of a point, noise."""

def look(around: Surroundings, start: int, stop: int, embedding: int, normals: int, shapes: int, features: int, /) -> None: ...
def hear(features: int, start: int, stop: int, weight: int, heard: int, width: int, /) -> None: ...
def talk(
    around: Surroundings,
    start: int,
    stop: int,
    normals: int,
    their_normals: int,
    rounds: int,
    n_rounds: int,
    heard: int,
    n_heard: int,
    before: int,
    features: int,
    head: int,
    moves: int,
    width: int,
    /,
) -> None: ...
