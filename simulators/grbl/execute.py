"""Carrying out a line: lines and arcs into the planner, dwells, probing, offsets, the laser and the air."""

from __future__ import annotations

import math
from collections.abc import Generator
from dataclasses import replace

from simulators.grbl import report
from simulators.grbl.gcode import PLANES, Fault, parse
from simulators.grbl.machine import (
    ALARM_PROBE_BEFORE,
    ALARM_PROBE_MISSED,
    ALARM_SOFT_LIMIT,
    ANY,
    Asked,
    Machine,
    Program,
    State,
)
from simulators.grbl.modes import Block, Parser, Vector
from simulators.grbl.realtime import DWELL_STEP_S, poll, wake
from simulators.grbl.settings import G28, G30

Status = Generator[float, None, int]
OK, TRAVEL_EXCEEDED = 0, 15
ARC_EPSILON_RAD = 5e-7
ARC_CORRECTION_COUNT = 12


def run_line(m: Machine, line: str) -> Status:
    """Parse and carry out one line of G-code; return the number the board answers with, 0 for ok."""
    try:
        block = parse(line, m.parser, m.memory)
    except Fault as fault:
        return fault.code
    if block.jog:
        return (yield from _jog(m, block))
    yield from _set_speed(m, block)
    modes = block.modes
    power = block.s_count if modes.motion in (1, 2, 3) or not m.memory.on(32) else 0.0
    m.parser = replace(m.parser, feed_mm_min=block.feed_mm_min, s_count=block.s_count, tool=block.tool)
    if m.parser.modes.spindle != modes.spindle:
        yield from spindle_sync(m, modes.spindle, power)
    if m.parser.modes.coolant != modes.coolant:
        if m.state is not State.CHECK:
            yield from synchronise(m)
            m.set_coolant(modes.coolant)
        m.parser = replace(m.parser, modes=replace(m.parser.modes, coolant=modes.coolant))
    if block.action == "dwell":
        yield from _dwell(m, block.dwell_s)
    yield from _set_offsets(m, block)
    m.parser = replace(m.parser, modes=replace(modes, flow=-1))
    if block.action in ("g28", "g30"):
        if block.axis_command:
            yield from line_to(m, block.target_mm, block, power, rapid=True)
        yield from line_to(m, block.second_mm, block, power, rapid=True)
        m.parser = replace(m.parser, position_mm=block.second_mm)
    if modes.motion != 80 and block.axis_command == "motion":
        yield from _move(m, block, power)
    if modes.flow >= 0:
        yield from _program_flow(m, modes.flow)
    return OK


def _set_speed(m: Machine, block: Block) -> Program:
    """An S word without motion waits for the queue and then sets the pin; under M3 so do some mode changes."""
    now, laser = m.parser.modes, m.memory.on(32)
    cuts = block.modes.motion in (1, 2, 3)
    is_motion = laser and block.has_axes and block.axis_command == "motion"
    force = laser and not is_motion and now.spindle == 3 and (now.motion in (1, 2, 3)) != cuts
    if (m.parser.s_count != block.s_count or force) and now.spindle != 5 and not is_motion:
        yield from spindle_sync(m, now.spindle, 0.0 if laser and not cuts else block.s_count)


def _set_offsets(m: Machine, block: Block) -> Program:
    """Change offsets in the firmware's order; a change waits for standstill, and so does a write to the memory."""
    if block.axis_command == "length":
        length = block.target_mm[2] if block.modes.tool_length == 43 else 0.0
        if length != m.parser.tool_length_mm:
            yield from _shift(m, replace(m.parser, tool_length_mm=length))
    if m.parser.modes.system != block.modes.system:
        system_mm = m.memory.offsets_mm[block.modes.system]
        modes = replace(m.parser.modes, system=block.modes.system)
        yield from _shift(m, replace(m.parser, modes=modes, system_mm=system_mm))
    if block.action == "g10":
        yield from synchronise(m)
        m.memory.store_offset(block.system, block.second_mm)
        if block.system == block.modes.system:
            yield from _shift(m, replace(m.parser, system_mm=block.second_mm))
    elif block.action in ("g28.1", "g30.1"):
        yield from synchronise(m)
        m.memory.store_offset(G28 if block.action == "g28.1" else G30, m.parser.position_mm)
    elif block.action == "g92":
        yield from _shift(m, replace(m.parser, g92_mm=block.target_mm))
    elif block.action == "g92.1":
        yield from _shift(m, replace(m.parser, g92_mm=(0.0, 0.0, 0.0)))


def _shift(m: Machine, parser: Parser) -> Program:
    """Take new offsets, wait for standstill, and let the next report show them."""
    m.parser = parser
    yield from synchronise(m)
    m.wco_count = 0


def synchronise(m: Machine) -> Program:
    """Wait until every queued move is made."""
    if m.planner.moves:
        m.asked |= Asked.START
    while True:
        yield from poll(m)
        if m.aborted() or not (m.planner.moves or m.state is State.RUN):
            return
        yield ANY


def spindle_sync(m: Machine, mode: int, speed: float) -> Program:
    """Wait for the queue, then set the laser pin."""
    if m.state is not State.CHECK:
        yield from synchronise(m)
        m.set_spindle(mode, speed)
    m.parser = replace(m.parser, modes=replace(m.parser.modes, spindle=mode))


def _dwell(m: Machine, seconds: float) -> Program:
    if m.state is State.CHECK:
        return
    yield from synchronise(m)
    for _ in range(math.ceil(seconds / DWELL_STEP_S - 1e-6)):
        if m.aborted():
            return
        yield from poll(m)
        yield m.now_s + DWELL_STEP_S


def line_to(m: Machine, target_mm: Vector, block: Block, power: float, rapid: bool) -> Program:
    """Queue one straight move; waits while the planner is full, and checks the soft limits."""
    if m.memory.on(20) and m.state is not State.JOG and outside_travel(m, target_mm):
        yield from _soft_limit(m)
    if m.state is State.CHECK:
        return
    while True:
        yield from poll(m)
        if m.aborted():
            return
        if not m.planner.full:
            break
        if m.state is State.IDLE:
            m.asked |= Asked.START
        else:
            yield ANY
    built = m.planner.build(
        target_mm,
        m.planner.position_steps,
        block.feed_mm_min,
        block.modes.feed_mode == 93,
        m.parser.modes.spindle,
        power,
        rapid,
        block.jog or block.modes.motion > 380,
    )
    if built is not None:
        m.planner.add(*built)
    elif m.memory.on(32) and m.parser.modes.spindle == 3:
        yield from spindle_sync(m, 3, power)


def outside_travel(m: Machine, target_mm: Vector) -> bool:
    """Return whether `target_mm` (machine coordinates) lies outside the travel the settings allow."""
    to_zero = "Z" in m.options
    for k, (value, travel) in enumerate(zip(target_mm, m.memory.axes(130), strict=True)):
        positive = to_zero and int(m.memory[23]) & (1 << k)
        low, high = (0.0, travel) if positive else (-travel, 0.0)
        if not low <= value <= high:
            return True
    return False


def _soft_limit(m: Machine) -> Program:
    m.soft_limit_hit = True
    if m.state is State.RUN:
        m.asked |= Asked.HOLD
        while True:
            yield from poll(m)
            if m.aborted():
                return
            if m.is_in(State.IDLE):
                break
            yield ANY
    m.kill()
    m.alarm = ALARM_SOFT_LIMIT
    yield from poll(m)


def _move(m: Machine, block: Block, power: float) -> Program:
    motion = block.modes.motion
    if motion in (0, 1):
        yield from line_to(m, block.target_mm, block, power, rapid=motion == 0)
    elif motion in (2, 3):
        yield from _arc(m, block, power)
    else:
        reached = yield from _probe(m, block, power)
        if not reached:
            return
    m.parser = replace(m.parser, position_mm=block.target_mm)


def _arc(m: Machine, block: Block, power: float) -> Program:
    """Cut an arc into chords that leave the circle by at most `$12`."""
    first, second, normal = PLANES[block.modes.plane]
    start, centre = m.parser.position_mm, block.second_mm
    hub = (start[first] + centre[first], start[second] + centre[second])
    spoke = (-centre[first], -centre[second])
    goal = (block.target_mm[first] - hub[0], block.target_mm[second] - hub[1])
    sweep = math.atan2(spoke[0] * goal[1] - spoke[1] * goal[0], spoke[0] * goal[0] + spoke[1] * goal[1])
    if block.modes.motion == 2:
        sweep -= 2 * math.pi if sweep >= -ARC_EPSILON_RAD else 0.0
    else:
        sweep += 2 * math.pi if sweep <= ARC_EPSILON_RAD else 0.0
    tolerance = m.memory[12]
    square = tolerance * (2 * block.radius_mm - tolerance)
    count = int(abs(0.5 * sweep * block.radius_mm) / math.sqrt(square)) if square > 0 and not math.isnan(sweep) else 0
    if count and block.modes.feed_mode == 93:
        block.feed_mm_min *= count
        block.modes = replace(block.modes, feed_mode=94)
    for k in range(1, count):
        angle = sweep * k / count
        point = list(start)
        point[first] = hub[0] + spoke[0] * math.cos(angle) - spoke[1] * math.sin(angle)
        point[second] = hub[1] + spoke[0] * math.sin(angle) + spoke[1] * math.cos(angle)
        point[normal] = start[normal] + (block.target_mm[normal] - start[normal]) * k / count
        yield from line_to(m, (point[0], point[1], point[2]), block, power, rapid=False)
        if m.aborted():
            return
    yield from line_to(m, block.target_mm, block, power, rapid=False)


def _probe(m: Machine, block: Block, power: float) -> Generator[float, None, bool]:
    """Move towards a probe that nothing ever touches; G38.2 and G38.4 call that an alarm.

    Moving away from it (G38.4, G38.5) is one from the start: an open probe is already away.
    """
    if m.state is State.CHECK:
        return True
    yield from synchronise(m)
    if m.aborted():
        return False
    m.probe_found = False
    if m.probe_triggered(away=block.modes.motion in (384, 385)):
        m.alarm = ALARM_PROBE_BEFORE
        yield from poll(m)
        return False
    yield from line_to(m, block.target_mm, block, power, rapid=False)
    m.asked |= Asked.START
    while True:
        yield from poll(m)
        if m.aborted():
            return False
        if m.is_in(State.IDLE):
            break
        yield ANY
    quiet = block.modes.motion in (383, 385)
    if quiet:
        m.probe_steps = m.position_steps()
    else:
        m.alarm = ALARM_PROBE_MISSED
    yield from poll(m)
    m.stepper.reset(m.now_s)
    yield m.now_s + m.lock_s()
    m.planner.reset(m.stepper.position)
    m.say(report.probe(m) + "\r\n")
    return True


def _program_flow(m: Machine, flow: int) -> Program:
    yield from synchronise(m)
    if flow == 0:
        if m.state is not State.CHECK:
            m.asked |= Asked.HOLD
            yield from poll(m)
        return
    now = replace(m.parser.modes, motion=1, plane=17, distance=90, feed_mode=94, system=0, spindle=5, coolant=0)
    m.parser = replace(m.parser, modes=now)
    m.overrides.feed = m.overrides.rapid = m.overrides.spindle = 100
    if m.state is not State.CHECK:
        m.parser = replace(m.parser, system_mm=m.memory.offsets_mm[0])
        m.wco_count = 0
        m.set_spindle(5, 0.0)
        m.set_coolant(0)
    m.say("[MSG:Pgm End]\r\n")


def _jog(m: Machine, block: Block) -> Status:
    if m.memory.on(20) and outside_travel(m, block.target_mm):
        return TRAVEL_EXCEEDED
    yield from line_to(m, block.target_mm, block, m.parser.s_count, rapid=False)
    if m.state is State.IDLE and m.planner.moves:
        m.state = State.JOG
        wake(m)
    m.parser = replace(m.parser, position_mm=block.target_mm)
    return OK
