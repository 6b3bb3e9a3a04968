"""Every error a user can meet, with its exit code. What lives elsewhere: nothing; library code raises these and never prints.

    PcdenoiseError
    ├── UsageError   2    an argument or a setting is wrong
    ├── ScanError    3    a file cannot be read or written as asked
    ├── ModelError   4    a model folder is missing, broken or does not fit
    ├── GateError    5    a quality gate failed
    └── BatchError   1    some inputs of a batch failed

A message is one line that names the file (or setting), the fault and the fix.
"""

import os

_OUT_OF_MEMORY = (
    "can't allocate memory",
    "not enough memory",
    "out of memory",
    "can't start new thread",
    "failed to map segment",
)
"""How torch, the threading module and the loader of libraries say it, in a RuntimeError or ImportError."""


class PcdenoiseError(Exception):
    """Root of all expected errors."""

    exit_code = 1


class UsageError(PcdenoiseError):
    """A wrong argument, flag or configuration value."""

    exit_code = 2


class ScanError(PcdenoiseError):
    """A scan or mesh file that cannot be read, written or converted as asked."""

    exit_code = 3


class ModelError(PcdenoiseError):
    """A model folder that is missing, damaged or made for something else."""

    exit_code = 4


class GateError(PcdenoiseError):
    """A quality gate asked for by the user did not hold; the output, if any, is complete."""

    exit_code = 5


class BatchError(PcdenoiseError):
    """Some inputs of a batch failed; the others are done."""

    exit_code = 1


def of_the_system(fault: Exception, place: str = "") -> ScanError | None:
    """What the user is told when disk, memory or a permission failed while at a place (a file); None if the fault is a bug."""
    said = in_one_line(fault)
    if isinstance(fault, MemoryError) or any(words in said for words in _OUT_OF_MEMORY):
        return ScanError(
            f"{place}{': ' * bool(place)}out of memory; free some, split the scan into tiles, or use fewer --threads"
        )
    if isinstance(fault, OSError) and not isinstance(fault, BrokenPipeError):
        where = place if fault.filename is None else fault.filename
        if isinstance(fault, FileExistsError) and where:  # of mkdir, which is content with a folder
            return not_a_folder(os.fsdecode(where))
        return ScanError(f"{where or 'stdout'}: {fault.strerror or said}; check the path, its permissions and free space")
    return None


def not_a_folder(path: str) -> ScanError:
    """What the user is told where a file stands in the place of a folder."""
    return ScanError(f"{path}: is a file where a folder is needed; choose another name")


def is_a_folder(path: object) -> ScanError:
    """What the user is told where a folder stands in the place of a file that is to be written."""
    return ScanError(f"{path}: is a folder; name a file in it")


def exists_already(path: object) -> ScanError:
    """What the user is told where a file stands that must not be replaced."""
    return ScanError(f"{path}: exists already; choose another name or allow overwriting (--overwrite)")


def cannot_be_written(place: object, fault: OSError, check: str = "the folder's permissions and free space") -> ScanError:
    """What the user is told where the system takes no file; check: what to look at."""
    return ScanError(f"{place}: cannot be written ({fault.strerror}); check {check}")


def in_one_line(fault: BaseException) -> str:
    """What another library's error says, without line breaks and at most 160 characters, to be put into one of ours."""
    return " ".join(str(fault).split())[:160]
