"""What can go wrong in the tool itself, and the exit code of each."""

from __future__ import annotations

from collections.abc import Sequence

from design.errors import BundleError as BundleError  # one error, whoever finds the folder wanting
from design.findings import Finding

DONE, BUG, USAGE, REFUSED, DEVICE, OPERATOR, OUT_OF_TOLERANCE = range(7)


class FabctlError(Exception):
    """Root of the tool's own errors; `exit_code` is what the command line ends with."""

    exit_code = REFUSED


class ConfigError(FabctlError):
    """A file is not what it should be; `complaints` names every fault with file and line."""

    exit_code = USAGE

    def __init__(self, complaints: Sequence[str]) -> None:
        super().__init__(*complaints)
        self.complaints = tuple(complaints)

    def __str__(self) -> str:
        return "\n".join(self.complaints)


class UsageError(FabctlError):
    """The command asks for something that is not there: an unknown specimen, a missing file."""

    exit_code = USAGE


class RefusedError(FabctlError):
    """The check before the work found reasons against it."""

    def __init__(self, what: str, findings: Sequence[Finding]) -> None:
        super().__init__(what, tuple(findings))
        self.what, self.findings = what, tuple(findings)

    def __str__(self) -> str:
        return "\n  ".join([self.what, *map(str, self.findings)])


class UnreadableInput(RefusedError):
    """A file is not of the kind that was expected, or holds nothing of it."""

    exit_code = USAGE


class RecordError(FabctlError):
    """A run folder cannot be written or read."""

    exit_code = DEVICE


class BenchBusy(FabctlError):
    """Somebody else works at this bench."""

    exit_code = DEVICE


class ClusterAway(FabctlError):
    """The machines that should share the work cannot be reached."""

    exit_code = DEVICE


class WorkerDied(FabctlError):
    """A process that shared the work is gone; what was finished is kept."""

    exit_code = DEVICE


class Stopped(FabctlError):
    """The operator said stop. Not a failure."""

    exit_code = OPERATOR
