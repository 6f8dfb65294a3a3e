"""The record of a cut that never began: refused, not answered, or without a board that speaks. **W**"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drivers.errors import DeviceError
from fabctl.errors import RefusedError, Stopped
from fabctl.records.folder import start_run

if TYPE_CHECKING:
    from fabctl.bench import Bench
    from fabctl.cut.job import CutOrder
    from fabctl.workspace import Workspace


@contextmanager
def kept(
    lab: Workspace, bench: Bench, order: CutOrder, dry_run: bool = False, more: Mapping[str, Any] | None = None
) -> Iterator[None]:
    """Keep a run record of a job that ends inside the block, which is before anything moved; a dry run keeps none.

    The outcome is *refused* with its findings, *stopped* where the operator said no, *failed* where the board did not
    answer.
    """
    try:
        yield
    except (RefusedError, Stopped, DeviceError, KeyboardInterrupt) as fault:
        if not dry_run:
            _keep(lab, bench, order, fault, more or {})
        raise


def _keep(lab: Workspace, bench: Bench, order: CutOrder, fault: BaseException, more: Mapping[str, Any]) -> None:
    config = {
        "bench": bench.config.model_dump(mode="json"),
        "material": order.material.model_dump(mode="json"),
        "origin": order.origin,
        **more,
    }
    run = start_run(lab.runs, order.kind, inputs=design_files(order.design), config=config)
    if isinstance(fault, RefusedError):
        run.finish("refused", str(fault), findings=[found.as_dict() for found in fault.findings])
    elif isinstance(fault, DeviceError):
        run.finish("failed", str(fault), fault=type(fault).__name__)
    else:
        run.finish("stopped", str(fault) or "stopped by the operator before anything moved")


def design_files(design: Path) -> list[Path]:
    """Return the files of a design folder (or the one file that says what is cut), for the manifest."""
    return [design] if design.is_file() else sorted(path for path in design.iterdir() if path.is_file())
