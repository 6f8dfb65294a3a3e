"""What the program does between lines: reports, holds, resumes, overrides, alarms. Mirrors the firmware's order.

Generators yield where the firmware waits; see `machine.Program`.
"""

from __future__ import annotations

from dataclasses import replace

from simulators.grbl import report
from simulators.grbl.machine import (
    ALARM_HARD_LIMIT,
    ALARM_SOFT_LIMIT,
    ANY,
    Asked,
    Machine,
    Program,
    SpindleStop,
    State,
    Suspend,
)
from simulators.grbl.modes import FLOOD, MIST

ALARM_PAUSE_S = 0.5
DWELL_STEP_S = 0.050
DOOR_COOLANT_S, DOOR_SPINDLE_S = 1.0, 4.0
HOLDS = Asked.MOTION_CANCEL | Asked.HOLD | Asked.DOOR | Asked.SLEEP
STEPPING = (State.RUN, State.HOLD, State.DOOR, State.HOMING, State.SLEEP, State.JOG)


def poll(m: Machine) -> Program:
    """Do what interrupts asked for; while suspended, stay here."""
    yield from _system(m)
    if m.suspend:
        yield from _suspended(m)


def _system(m: Machine) -> Program:
    if m.alarm:
        yield from _raise_alarm(m)
    asked = m.asked
    if Asked.RESET in asked:
        m.abort = True
        return
    if Asked.STATUS in asked:
        m.say(report.status(m) + "\r\n")
        m.asked &= ~Asked.STATUS
    if asked & HOLDS:
        _begin_hold(m, asked)
        m.asked &= ~HOLDS
    if Asked.START in asked:
        if not asked & (Asked.HOLD | Asked.MOTION_CANCEL | Asked.DOOR):
            _start(m)
        m.asked &= ~Asked.START
    if Asked.CYCLE_DONE in asked:
        yield from _cycle_done(m)
        m.asked &= ~Asked.CYCLE_DONE
    _motion_overrides(m)
    _accessory_overrides(m)
    if m.state in STEPPING:
        prepare(m)


def prepare(m: Machine) -> None:
    """Fill the stepper's queue; a running stepper that had run dry is not restarted by this."""
    m.stepper.prepare()


def wake(m: Machine) -> None:
    """Start stepping."""
    m.stepper.prepare()
    if m.stepper.segments and not m.stepper.awake:
        m.stepper.awake = True
        m.stepper.start(m.now_s)
    elif not m.stepper.segments:
        m.asked |= Asked.CYCLE_DONE
        m.stall()


def _raise_alarm(m: Machine) -> Program:
    code = m.alarm
    m.state = State.ALARM
    m.say(f"ALARM:{code}\r\n")
    if m.dialect.after_alarm:
        m.say(m.dialect.after_alarm.format(code=code) + "\r\n")
    yield m.now_s + ALARM_PAUSE_S
    if code in (ALARM_HARD_LIMIT, ALARM_SOFT_LIMIT):
        m.say("[MSG:Reset to continue]\r\n")
        m.asked &= ~Asked.RESET
        while Asked.RESET not in m.asked:
            yield ANY
    m.alarm = 0


def _begin_hold(m: Machine, asked: Asked) -> None:
    if m.state not in (State.ALARM, State.CHECK):
        if m.state in (State.RUN, State.JOG) and not m.suspend & (Suspend.MOTION_CANCEL | Suspend.JOG_CANCEL):
            m.stepper.look_again()
            m.stepper.holding, m.stepper.ended, m.stepper.update_pin = True, False, False
            if m.state is State.JOG and Asked.SLEEP not in asked:
                m.suspend |= Suspend.JOG_CANCEL
        if m.state is State.IDLE:
            m.suspend = Suspend.HELD
        if Asked.MOTION_CANCEL in asked and m.state is not State.JOG:
            m.suspend |= Suspend.MOTION_CANCEL
        if Asked.HOLD in asked and m.state not in (State.DOOR, State.JOG, State.SLEEP):
            m.state = State.HOLD
        if Asked.DOOR in asked:
            _open_door(m)
    if Asked.SLEEP in asked:
        if m.state is State.ALARM:
            m.suspend |= Suspend.RETRACTED | Suspend.HELD
        m.state = State.SLEEP


def _open_door(m: Machine) -> None:
    m.say("[MSG:Check Door]\r\n")
    if Suspend.JOG_CANCEL not in m.suspend:
        if m.state is State.DOOR and Suspend.RESTORE in m.suspend:
            m.suspend &= ~(Suspend.RETRACTED | Suspend.RESTORE | Suspend.RESTORED)
            m.suspend |= Suspend.RESTART_RETRACT
        if m.state is not State.SLEEP:
            m.state = State.DOOR
    m.suspend |= Suspend.AJAR


def _start(m: Machine) -> None:
    if m.state is State.DOOR and Suspend.AJAR not in m.suspend:
        if Suspend.RESTORED in m.suspend:
            m.state = State.IDLE
        elif Suspend.RETRACTED in m.suspend:
            m.suspend |= Suspend.RESTORE
    ready = m.state is State.IDLE or (m.state is State.HOLD and Suspend.HELD in m.suspend)
    if not ready:
        return
    if m.state is State.HOLD and m.spindle_stop:
        m.spindle_stop |= SpindleStop.RESTORE_AND_START
        return
    m.stepper.holding = m.stepper.ended = m.stepper.update_pin = False
    cancelled = Suspend.MOTION_CANCEL in m.suspend
    m.suspend = Suspend.NONE
    if m.planner.moves and not cancelled:
        m.state = State.RUN
        wake(m)
    else:
        m.state = State.IDLE


def _cycle_done(m: Machine) -> Program:
    held = m.state in (State.HOLD, State.DOOR, State.SLEEP)
    if held and not m.soft_limit_hit and Suspend.JOG_CANCEL not in m.suspend:
        m.planner.replan()
        if m.stepper.holding:
            m.suspend |= Suspend.HELD
        m.stepper.holding = False
        return
    if Suspend.JOG_CANCEL in m.suspend:
        m.stepper.holding = m.stepper.ended = m.stepper.update_pin = False
        m.stepper.reset(m.now_s)
        yield m.now_s + m.lock_s()
        m.planner.reset(m.stepper.position)
        m.sync_position()
    if Suspend.AJAR in m.suspend:
        m.suspend &= ~Suspend.JOG_CANCEL
        m.suspend |= Suspend.HELD
        m.state = State.DOOR
    else:
        m.suspend, m.state = Suspend.NONE, State.IDLE


def _motion_overrides(m: Machine) -> None:
    if not m.motion_override:
        return
    asked = set(m.motion_override)
    m.motion_override.clear()
    feed, rapid = m.overrides.feed, m.overrides.rapid
    if 0x90 in asked:
        feed = 100
    feed += sum(step for code, step in ((0x91, 10), (0x92, -10), (0x93, 1), (0x94, -1)) if code in asked)
    feed = max(min(feed & 0xFF, 200), 10)  # one byte, and so below nothing lies the most
    for code, value in ((0x95, 100), (0x96, 50), (0x97, 25)):
        rapid = value if code in asked else rapid
    if (feed, rapid) != (m.overrides.feed, m.overrides.rapid):
        m.overrides.feed, m.overrides.rapid = feed, rapid
        m.ov_count = 0
        m.planner.override_changed()
        m.planner.replan()


def _accessory_overrides(m: Machine) -> None:
    if not m.accessory_override:
        return
    asked = set(m.accessory_override)
    m.accessory_override.clear()
    power = 100 if 0x99 in asked else m.overrides.spindle
    power += sum(step for code, step in ((0x9A, 10), (0x9B, -10), (0x9C, 1), (0x9D, -1)) if code in asked)
    power = max(min(power & 0xFF, 200), 10)
    if power != m.overrides.spindle:
        m.overrides.spindle = power
        if m.state is State.IDLE:
            m.set_spindle(m.parser.modes.spindle, m.parser.s_count)
        else:
            m.stepper.update_pin = True
        m.ov_count = 0
    if 0x9E in asked and m.state is State.HOLD:
        if not m.spindle_stop:
            m.spindle_stop = SpindleStop.BEGIN
        elif SpindleStop.ACTIVE in m.spindle_stop:
            m.spindle_stop |= SpindleStop.RESTORE
    turned = (FLOOD if 0xA0 in asked else 0) | (MIST if 0xA1 in asked and m.parser.has_mist else 0)
    if turned and m.state in (State.IDLE, State.RUN, State.HOLD, State.JOG):
        coolant = m.parser.modes.coolant ^ turned
        m.set_coolant(coolant)
        m.parser = replace(m.parser, modes=replace(m.parser.modes, coolant=coolant))


def _suspended(m: Machine) -> Program:
    move = m.planner.moves[0] if m.planner.moves else None
    mode, speed = (move.spindle, move.s_count) if move else (m.parser.modes.spindle, m.parser.s_count)
    coolant = m.coolant if move else m.parser.modes.coolant
    if m.memory.on(32):
        m.accessory_override.append(0x9E)  # a hold in laser mode darkens the beam
    while m.suspend:
        if m.aborted():
            return
        before = (m.suspend, m.spindle_stop, m.state, m.asked)
        if Suspend.HELD in m.suspend:
            if m.state in (State.DOOR, State.SLEEP):
                yield from _door_or_sleep(m, mode, speed, coolant)
                if m.aborted():
                    return
            elif m.spindle_stop:
                _stop_or_restore(m, mode, speed)
            elif m.stepper.update_pin:
                m.set_spindle(mode, speed)
                m.stepper.update_pin = False
        yield from _system(m)
        if m.suspend and (m.suspend, m.spindle_stop, m.state, m.asked) == before and not m.aborted():
            yield ANY


def _stop_or_restore(m: Machine, mode: int, speed: float) -> None:
    lit = m.parser.modes.spindle != 5
    if SpindleStop.BEGIN in m.spindle_stop:
        if lit:
            m.set_spindle(5, 0.0)
        m.spindle_stop = SpindleStop.ACTIVE if lit else SpindleStop.NONE
    elif m.spindle_stop & (SpindleStop.RESTORE | SpindleStop.RESTORE_AND_START):
        if lit:
            m.say("[MSG:Restoring spindle]\r\n")
            if m.memory.on(32):
                m.stepper.update_pin = True
            else:
                m.set_spindle(mode, speed)
        if SpindleStop.RESTORE_AND_START in m.spindle_stop:
            m.asked |= Asked.START
        m.spindle_stop = SpindleStop.NONE


def _door_or_sleep(m: Machine, mode: int, speed: float, coolant: int) -> Program:
    if Suspend.RETRACTED not in m.suspend:
        m.spindle_stop = SpindleStop.NONE
        m.set_spindle(5, 0.0)
        m.set_coolant(0)
        m.suspend &= ~Suspend.RESTART_RETRACT
        m.suspend |= Suspend.RETRACTED
        return
    if m.state is State.SLEEP:
        m.say("[MSG:Sleeping]\r\n")
        m.set_spindle(5, 0.0)
        m.set_coolant(0)
        yield m.now_s + m.lock_s()
        while not m.aborted():
            yield from _system(m)
            if not m.aborted():
                yield ANY
        return
    if not m.world.door_is_open:
        m.suspend &= ~Suspend.AJAR
    if Suspend.RESTORE in m.suspend:
        if m.parser.modes.spindle != 5:
            if m.memory.on(32):
                m.stepper.update_pin = True
            else:
                m.set_spindle(mode, speed)
                yield from _pause(m, DOOR_SPINDLE_S)
        if m.parser.modes.coolant and Suspend.RESTART_RETRACT not in m.suspend:
            m.set_coolant(coolant)
            yield from _pause(m, DOOR_COOLANT_S)
        if Suspend.RESTART_RETRACT not in m.suspend:
            m.suspend |= Suspend.RESTORED
            m.asked |= Asked.START


def _pause(m: Machine, seconds: float) -> Program:
    for _ in range(round(seconds / DWELL_STEP_S)):
        if m.aborted() or Suspend.RESTART_RETRACT in m.suspend:
            return
        yield from _system(m)
        yield m.now_s + DWELL_STEP_S
