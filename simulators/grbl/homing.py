"""`$H`: look for the switches fast, find them again slowly, and pull off. Z first, then X and Y together."""

from __future__ import annotations

import math

from simulators.grbl.machine import (
    ALARM_HOMING_DOOR,
    ALARM_HOMING_NO_SWITCH,
    ALARM_HOMING_PULL_OFF,
    ALARM_HOMING_RESET,
    ANY,
    Asked,
    Machine,
    Program,
)
from simulators.grbl.realtime import poll

CYCLES = ((2,), (0, 1))
SEARCH_RATIO, LOCATE_RATIO = 1.5, 5.0
PHASES = 4  # seek, pull off, locate, pull off


def home(m: Machine) -> Program:
    """Home all axes; ends with `m.aborted()` set where it failed."""
    for axes in CYCLES:
        yield from _home_axes(m, axes)
    yield from poll(m)
    if not m.aborted():
        m.homed = True
        m.sync_position()


def _home_axes(m: Machine, axes: tuple[int, ...]) -> Program:
    if m.aborted():
        return
    travel_mm = max(SEARCH_RATIO * m.memory[130 + k] for k in axes)
    approach, feed = True, m.memory[25]
    for _ in range(PHASES):
        yield from _phase(m, axes, approach, travel_mm, feed)
        if m.aborted():
            return
        approach = not approach
        travel_mm = m.memory[27] * (LOCATE_RATIO if approach else 1.0)
        feed = m.memory[24] if approach else m.memory[25]
    steps = list(m.position_steps())
    for k in axes:
        at_mm = -m.memory[27]
        if _negative(m, k):
            at_mm = m.memory[27] - m.memory[130 + k]
        if "Z" in m.options:
            at_mm = 0.0
        steps[k] = round(at_mm * m.memory[100 + k])
    m.declare_position((steps[0], steps[1], steps[2]))
    m.stepper.holding = m.stepper.ended = m.stepper.update_pin = False


def _negative(m: Machine, axis: int) -> bool:
    return bool(int(m.memory[23]) & (1 << axis))


def _phase(m: Machine, axes: tuple[int, ...], approach: bool, travel_mm: float, feed: float) -> Program:
    steps = [0 if k in axes else p for k, p in enumerate(m.position_steps())]
    m.declare_position((steps[0], steps[1], steps[2]))
    target = list(m.position_mm())
    for k in axes:
        target[k] = travel_mm if approach != _negative(m, k) else -travel_mm
    start = m.position_steps()
    built = m.planner.build(
        (target[0], target[1], target[2]), start, feed * math.sqrt(len(axes)), False, 5, 0.0, False, True
    )
    if built is None:
        return
    m.stepper.system_move = built[0]
    m.stepper.ended, m.stepper.locked = False, set()
    m.stepper.prepare()
    m.stepper.awake = True
    m.stepper.start(m.now_s)
    while True:
        if approach:
            m.stepper.locked |= m.limits_hit() & set(axes)
        m.stepper.prepare()
        if m.asked & (Asked.DOOR | Asked.RESET | Asked.CYCLE_DONE):
            if _failed(m, axes, approach):
                m.kill()
                m.stepper.system_move = None
                yield from poll(m)
                return
            m.asked &= ~Asked.CYCLE_DONE
            break
        if approach and m.stepper.locked >= set(axes):
            break
        yield ANY
    m.stepper.reset(m.now_s)
    yield m.now_s + m.memory[26] / 1000


def _failed(m: Machine, axes: tuple[int, ...], approach: bool) -> bool:
    if Asked.RESET in m.asked:
        m.alarm = ALARM_HOMING_RESET
    if Asked.DOOR in m.asked:
        m.alarm = ALARM_HOMING_DOOR
    if not approach and m.limits_hit() & set(axes):
        m.alarm = ALARM_HOMING_PULL_OFF
    if approach and Asked.CYCLE_DONE in m.asked:
        m.alarm = ALARM_HOMING_NO_SWITCH
    return bool(m.alarm)
