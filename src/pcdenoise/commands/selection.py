"""Which rows of a scan may move and which have a say: classes, a region. Not here: the cleaning of a part (denoising.part)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pcdenoise.commands.options import option
from pcdenoise.errors import ScanError, UsageError

if TYPE_CHECKING:
    from pcdenoise.cloud.scan import Mask, Scan

OnlyClass = Annotated[
    str, option("--only-class", metavar="N,...", help="Only points of these classes move; the others stay to the byte.")
]
Context = Annotated[
    Literal["class", "all"],
    option("--context", help="With --only-class: what shows the surface, points of these classes alone or all points."),
]
Roi = Annotated[
    str,
    option("--roi", metavar="BOX", help="Only points in xmin,ymin,xmax,ymax[,zmin,zmax] move; those around it are looked at."),
]
_CLASS_NAMES = ("classification", "class", "label", "scalar_classification")


@dataclass(frozen=True)
class Selection:
    """What was asked for: classes (None for all), a box (low, high) in the file's unit, and whether other classes are seen."""

    classes: tuple[int, ...] | None = None
    box: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    sees_all: bool = False

    @classmethod
    def of(cls, only_class: str, context: str, roi: str) -> Selection:
        """From option values. Raises UsageError for what is no list of classes or no box."""
        classes = None
        if only_class:
            words = only_class.split(",")
            if not all(word.strip().isdecimal() and int(word) < 256 for word in words):
                raise UsageError(f"--only-class {only_class}: give class numbers from 0 to 255 with commas between, such as 2,6")
            classes = tuple(int(word) for word in words)
        elif context == "all":
            raise UsageError("--context all: says which classes are seen beside --only-class; give that too")
        return cls(classes, _box(roi) if roi else None, context == "all")

    def __str__(self) -> str:
        """The options that it was asked for by."""
        classes = "" if self.classes is None else f"--only-class {','.join(map(str, self.classes))}"
        return " and ".join(filter(None, [classes, "--roi" if self.box else ""]))

    @property
    def settings(self) -> dict[str, Any]:
        """By option name, for the report and the file's provenance; nothing where nothing was selected."""
        chosen: dict[str, Any] = {}
        if self.classes is not None:
            chosen |= {"only_class": list(self.classes), "context": "all" if self.sees_all else "class"}
        return chosen | ({"roi": [*self.box[0], *self.box[1]]} if self.box else {})

    def masks(self, scan: Scan) -> tuple[Mask, Mask]:
        """(N,) rows that may move and (N,) rows that are seen. Raises ScanError if classes are asked for and there are none."""
        import numpy as np

        movable = np.ones(len(scan), np.bool_)
        if self.classes is not None:
            name = next((name for name in scan.attributes if name.lower() in _CLASS_NAMES), None)
            if name is None:
                raise ScanError(f"{scan.origin}: has no classes (no column {_CLASS_NAMES[0]}); leave --only-class out")
            movable = np.isin(scan.attributes[name], self.classes)
        seen = np.ones_like(movable) if self.sees_all else movable.copy()
        if self.box is not None:
            low, high = (np.array(corner) for corner in self.box)
            inside = np.logical_and.reduce((scan.points >= low) & (scan.points <= high), axis=1)
            movable = movable & inside
        return movable, seen


def _box(text: str) -> tuple[tuple[float, ...], tuple[float, ...]]:
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (4, 6):
        raise UsageError(f"--roi {text}: give four or six numbers, xmin,ymin,xmax,ymax or xmin,ymin,xmax,ymax,zmin,zmax")
    low, high = numbers[:2], numbers[2:4]
    low, high = [*low, numbers[4] if numbers[4:] else -float("inf")], [*high, numbers[5] if numbers[4:] else float("inf")]
    if not all(a < b for a, b in zip(low, high, strict=True)):
        raise UsageError(f"--roi {text}: every lower bound must be below its upper one")
    return tuple(low), tuple(high)
