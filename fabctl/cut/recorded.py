"""The record of a cut that runs: its program and wire while it runs, and how it ended on every way out. **W**"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from drivers.errors import DeviceError
from drivers.grbl.laser import Laser, Leaving
from drivers.grbl.run import StoppedByOperator
from drivers.transport.tap import read_log
from fabctl.cut.plan import CutPlan
from fabctl.cut.trail import begins
from fabctl.cut.wirelog import WireLog
from fabctl.errors import FabctlError, RecordError, RefusedError, Stopped
from fabctl.events import Emit, Event
from fabctl.records.ending import signals_heard
from fabctl.records.folder import RunFolder, write_atomically


@contextmanager
def recorded(
    begin: Callable[[], RunFolder], laser: Laser, log: WireLog, emit: Emit, plan: CutPlan
) -> Iterator[tuple[RunFolder, Emit]]:
    """Make the run's folder by `begin` and keep its record: job and wire while it runs, the outcome on every way out.

    An interrupt that comes while the folder is made waits until it can be written down.
    """
    with one_interrupt(laser) as listen:
        run = begin()
        try:
            listen(True)
            yield run, _listener(run, laser, log, emit, plan)
            listen(False)
        except (KeyboardInterrupt, StoppedByOperator) as fault:
            unwritten = _end(run, laser, "stopped", "stopped by the operator")
            raise Stopped("\n".join([f"stopped; {how_to_go_on(run)}", *unwritten])) from fault
        except BaseException as fault:
            status = _status(fault)
            notes = _end(run, laser, status, **_told(fault))
            for note in [*notes, *([how_to_go_on(run)] if status == "failed" else [])]:
                fault.add_note(note)
            raise
        run.finish("done")


def _status(fault: BaseException) -> str:
    if isinstance(fault, Stopped):
        return "stopped"
    return "refused" if isinstance(fault, RefusedError) else "failed"


def _told(fault: BaseException) -> dict[str, str]:
    """Return what the outcome says of the fault."""
    if isinstance(fault, DeviceError):
        return {"message": str(fault), "fault": type(fault).__name__}
    return {"message": str(fault) if isinstance(fault, FabctlError) else f"{type(fault).__name__}: {fault}"}


def _end(run: RunFolder, laser: Laser, status: str, message: str, **more: str) -> list[str]:
    """Write down how the run ended; return what to tell where the disk takes it not, which hides no other fault."""
    left = _left(laser)
    try:
        run.finish(status, message, **more, **left)
    except (RecordError, OSError) as fault:
        return [f"how it ended could not be recorded: {fault}; free space on the disk before going on"]
    return []


def _listener(run: RunFolder, laser: Laser, log: WireLog, emit: Emit, plan: CutPlan) -> Emit:
    write_atomically(run.artefact("job.nc"), plan.text)
    log.write_to(run.path / "wire.log")
    write_event = run.log_events()

    def tell(event: Event) -> None:
        if "mark" in event.data:
            log.mark(str(event.data["mark"]), laser.clock.now_s())
        write_event(event)
        emit(event)

    return tell


@contextmanager
def one_interrupt(laser: Laser) -> Iterator[Callable[[bool], None]]:
    """Let the first Ctrl-C, SIGTERM or SIGHUP interrupt, and a Ctrl-C after it only make `off` reset at once.

    (Other signals come twice by themselves: from the system to the whole group, and from a flow to its step.)

    An exception in the middle of making the machine safe, or of writing down how it was left, would undo both. The
    first, too, waits while the function that this yields has not been told to listen.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda _: None
        return
    heard = listening = raised = False

    def interrupt_once() -> None:
        nonlocal raised
        if heard and listening and not raised:
            raised = True
            raise KeyboardInterrupt

    def hear(number: int, _frame: FrameType | None) -> None:
        nonlocal heard
        laser.hurried = laser.hurried or (heard and number == signal.SIGINT)
        heard = True
        interrupt_once()

    def listen(now: bool) -> None:
        nonlocal listening
        listening = now
        interrupt_once()

    before = {number: signal.signal(number, hear) for number in signals_heard()}
    try:
        yield listen
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    listen(True)


def has_begun(run: RunFolder) -> bool:
    """Return whether the run's own program had begun: before that, nothing was burnt."""
    path = run.path / "wire.log"
    if not path.is_file():
        return False
    with path.open(encoding="ascii", errors="replace") as rows:
        return any(begins(row) for line in rows for row in read_log(line))


def how_to_go_on(run: RunFolder) -> str:
    """Return what the operator can do after a run that did not end by itself."""
    manifest = run.manifest()
    earlier = manifest["config"].get("resumed")
    if has_begun(run):
        further = f"; fabctl cut run … --resume {run.run_id}" if manifest["kind"] == "cut" else ""
        return f"{run.run_id} says how far it came{further}"
    return f"nothing was cut; fabctl cut run … --resume {earlier}" if earlier else "nothing was cut: start it again"


def _left(laser: Laser) -> dict[str, Any]:
    """Make sure the beam is off, and return how the machine was left."""
    try:
        left = laser.left or laser.off()
    except Exception as fault:  # noqa: BLE001 - whatever it is, how the run ended is written down
        left = Leaving(False, False, None, str(fault))
    return {
        "beam_off_confirmed": left.confirmed,
        "position_known": left.position_known,
        "machine_mm": list(left.machine_mm) if left.machine_mm else None,
    }
