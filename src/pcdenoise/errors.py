"""Every error a user can meet, with its exit code. What lives elsewhere: nothing; library code raises these and never prints.

    PcdenoiseError
    ├── UsageError   2    an argument or a setting is wrong
    ├── ScanError    3    a file cannot be read or written as asked
    ├── ModelError   4    a model folder is missing, broken or does not fit
    ├── GateError    5    a quality gate failed
    └── BatchError   1    some inputs of a batch failed

A message is one line that names the file (or setting), the fault and the fix.
"""

_OUT_OF_MEMORY = ("can't allocate memory", "not enough memory", "out of memory", "can't start new thread")
"""How torch and the threading module say it, in a RuntimeError."""


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


def of_the_system(fault: Exception) -> ScanError | None:
    """What the user is told when the disk, the memory or a permission failed; None if the fault is none of these but a bug."""
    said = in_one_line(fault)
    if isinstance(fault, MemoryError) or any(words in said for words in _OUT_OF_MEMORY):
        return ScanError("out of memory; free some, split the scan into tiles, or use fewer --threads")
    if isinstance(fault, OSError) and not isinstance(fault, BrokenPipeError):
        where = f"{fault.filename}: " if fault.filename is not None else ""
        return ScanError(f"{where}{fault.strerror or said}; check the path, its permissions and free space")
    return None


def in_one_line(fault: BaseException) -> str:
    """What another library's error says, without line breaks and at most 160 characters, to be put into one of ours."""
    return " ".join(str(fault).split())[:160]
