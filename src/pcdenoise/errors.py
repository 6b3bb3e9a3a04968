"""Every error a user can meet, with its exit code. What lives elsewhere: nothing; library code raises these and never prints.

    PcdenoiseError
    ├── UsageError   2    an argument or a setting is wrong
    ├── ScanError    3    a file cannot be read or written as asked
    ├── ModelError   4    a model folder is missing, broken or does not fit
    ├── GateError    5    a quality gate failed
    └── BatchError   1    some inputs of a batch failed

A message is one line that names the file (or setting), the fault and the fix.
"""


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


def in_one_line(fault: BaseException) -> str:
    """What another library's error says, without line breaks and at most 160 characters, to be put into one of ours."""
    return " ".join(str(fault).split())[:160]
