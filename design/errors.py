"""What can go wrong in a design. Faults of input are findings; these stop the work at once."""

from __future__ import annotations

from collections.abc import Sequence

from design.findings import Finding


class DesignError(Exception):
    """Root of everything the design package raises; carries the findings that led to it, if any."""

    def __init__(self, message: str, findings: Sequence[Finding] = ()) -> None:
        super().__init__(message, tuple(findings))
        self.message = message
        self.findings = tuple(findings)

    def __str__(self) -> str:
        return "\n  ".join([self.message, *map(str, self.findings)])


class UnreadableFile(DesignError):
    """A file that somebody named is missing, empty, cut short, or not what its name says."""


class MeshError(DesignError):
    """The target mesh cannot be used."""


class UnreadableMesh(MeshError, UnreadableFile):
    """The bytes are not a mesh."""


class FlattenError(DesignError):
    """The surface could not be laid flat without flips or overlap."""


class OutOfLibrary(DesignError):
    """Cells ask for an expansion that no cell of the library has."""

    def __init__(
        self, low_ratio: float, high_ratio: float, limits_ratio: tuple[float, float], findings: Sequence[Finding] = ()
    ) -> None:
        span, room = high_ratio / low_ratio, limits_ratio[1] / limits_ratio[0]
        super().__init__(
            f"the cells need expansions {low_ratio:.3f} to {high_ratio:.3f} (spread {span:.3f}), the library has "
            f"{limits_ratio[0]:.3f} to {limits_ratio[1]:.3f} (spread {room:.3f}); "
            "optimise the boundary, add cones or choose a flatter target",
            findings,
        )
        self.low_ratio, self.high_ratio, self.limits_ratio = low_ratio, high_ratio, limits_ratio


class BundleError(DesignError):
    """A design folder is missing a file, was edited after the build, or is of another version."""


class NoBundle(BundleError, UnreadableFile):
    """There is no design folder, or nothing in it that can be read as one."""


class NotConverged(DesignError):
    """A solver stopped without an answer; says how far it came."""

    def __init__(self, what: str, residual_ratio: float, iterations_count: int, hint: str = "") -> None:
        tail = f"; {hint}" if hint else ""
        super().__init__(
            f"{what} did not converge: residual {residual_ratio:.3g} after {iterations_count} iterations{tail}"
        )
        self.what, self.residual_ratio, self.iterations_count, self.hint = what, residual_ratio, iterations_count, hint
