"""What exchange.c gives to Python; arrays are addresses, 0 for none."""

from typing import TypeAlias

Exchange: TypeAlias = tuple[int, ...]
"""features, own, heard, source, weight; the first layer and its bias, the second, its bias and the second again turned, the head
and its bias; mean, most, known; points, neighbours of a point, channels of a message."""

def forward(given: Exchange, start: int, stop: int, /) -> None: ...
def backward(
    given: Exchange,
    start: int,
    stop: int,
    of_mean: int,
    of_most: int,
    of_known: int,
    of_features: int,
    of_own: int,
    of_heard: int,
    of_first: int,
    of_second: int,
    of_second_bias: int,
    of_head: int,
    of_head_bias: int,
    /,
) -> None: ...
