"""The `$` commands, and the main program that reads lines."""

from __future__ import annotations

from simulators.grbl import report
from simulators.grbl.execute import Status, run_line, synchronise
from simulators.grbl.homing import home
from simulators.grbl.machine import Asked, Machine, Program, State
from simulators.grbl.realtime import poll
from simulators.grbl.settings import LINE_SIZE
from simulators.grbl.words import read_number

OK, BAD_NUMBER, INVALID, SETTING_DISABLED, NOT_IDLE, LOCKED, OVERFLOW = 0, 2, 3, 5, 8, 9, 11


def program(m: Machine) -> Program:
    """Run the board from power-up, for ever."""
    if m.memory.on(22):
        m.state = State.ALARM  # with homing on, the position is unknown until homed or unlocked
    while True:
        m.reinitialise()
        yield m.now_s + m.lock_s()  # what arrives from here on is kept
        for line in m.dialect.before_banner:
            m.say(f"{line}\r\n")
        m.say(f"\r\n{m.dialect.banner}\r\n")
        yield from _main_loop(m)


def _main_loop(m: Machine) -> Program:
    if m.memory.on(21) and m.limits_hit():
        m.state = State.ALARM
        m.say(f"{report.CHECK_LIMITS}\r\n")
    if m.state in (State.ALARM, State.SLEEP):
        m.say(f"{report.LOCKED}\r\n")
        m.state = State.ALARM
    else:
        m.state = State.IDLE
        yield from _startup(m)
    line, comment, overflow = "", "", False
    while True:
        while (byte := m.read()) is not None:
            sign = chr(byte)
            if sign in "\r\n":
                yield from poll(m)
                if m.aborted():
                    return
                status = OVERFLOW if overflow else (yield from _dispatch(m, line))
                yield from _deaf_while_writing(m)
                if status != OK and m.dialect.before_error:
                    m.say(m.dialect.before_error.format(code=status) + "\r\n")
                m.say("ok\r\n" if status == OK else f"error:{status}\r\n")
                line, comment, overflow = "", "", False
            elif comment or overflow:
                if sign == ")" and comment == "(":
                    comment = ""
            elif sign <= " " or sign == "/":
                continue
            elif sign in "(;":
                comment = sign
            elif len(line) >= LINE_SIZE - 1:
                overflow = True
            else:
                line += sign.upper() if "a" <= sign <= "z" else sign
        if m.planner.moves:
            m.asked |= Asked.START
        yield from poll(m)
        if m.aborted():
            return
        unread = m.rx_free() < m.dialect.rx_bytes  # it came during a hold that has just ended
        if not unread and not (m.planner.moves and m.state is State.IDLE):
            yield float("inf")


def _deaf_while_writing(m: Machine) -> Program:
    """The EEPROM is written byte by byte with interrupts off: what comes in meanwhile is lost."""
    if m.memory.pending_s:
        until_s = m.now_s + m.memory.pending_s
        m.memory.pending_s = 0.0
        m.go_deaf(until_s)
        yield until_s


def _startup(m: Machine) -> Program:
    for line in list(m.memory.startup):
        if line:
            status = yield from run_line(m, line)
            m.say(f">{line}:" + ("ok\r\n" if status == OK else f"error:{status}\r\n"))


def _dispatch(m: Machine, line: str) -> Status:
    if not line:
        return OK
    if line[0] == "$":
        return (yield from _command(m, line))
    if m.state in (State.ALARM, State.JOG):
        return LOCKED
    return (yield from run_line(m, line))


def _command(m: Machine, line: str) -> Status:
    letter = line[1:2]
    if not letter:
        m.say(f"{report.HELP}\r\n")
        return OK
    if letter == "J":
        if m.state not in (State.IDLE, State.JOG):
            return NOT_IDLE
        if line[2:3] != "=":
            return INVALID
        return (yield from run_line(m, line))
    if letter in "$GCX":
        return INVALID if len(line) > 2 else _short_command(m, letter)
    if m.state not in (State.IDLE, State.ALARM):
        return NOT_IDLE
    if letter == "#":
        if len(line) > 2:
            return INVALID
        _say_all(m, report.parameters(m))
        return OK
    if letter == "H":
        return (yield from _home(m, line))
    if letter == "S":
        if line != "$SLP":
            return INVALID
        m.asked |= Asked.SLEEP
        return OK
    if letter == "I":
        return _build_info(m, line)
    if letter == "R":
        return _restore(m, line)
    return (yield from _store(m, line, startup=letter == "N"))


def _say_all(m: Machine, lines: list[str]) -> None:
    m.say("".join(f"{line}\r\n" for line in lines))


def _short_command(m: Machine, letter: str) -> int:
    if letter == "$":
        if m.state in (State.RUN, State.HOLD):
            return NOT_IDLE
        _say_all(m, m.memory.lines())
    elif letter == "G":
        m.say(report.modes(m) + "\r\n")
    elif letter == "C":
        if m.state is State.CHECK:
            m.kill()
            m.say("[MSG:Disabled]\r\n")
        elif m.state is not State.IDLE:
            return NOT_IDLE
        else:
            m.state = State.CHECK
            m.say("[MSG:Enabled]\r\n")
    elif m.state is State.ALARM:
        m.say("[MSG:Caution: Unlocked]\r\n")
        m.state = State.IDLE
    return OK


def _home(m: Machine, line: str) -> Status:
    if not m.memory.on(22):
        return SETTING_DISABLED
    m.state = State.HOMING
    if len(line) > 2:
        return INVALID
    yield from home(m)
    if not m.aborted():
        m.state = State.IDLE
        yield m.now_s + m.lock_s()
        yield from _startup(m)
    return OK


def _build_info(m: Machine, line: str) -> int:
    if line == "$I":
        _say_all(m, report.build(m))
        return OK
    if line[2] != "=":
        return INVALID
    m.memory.store_build_note(line[3:])
    return OK


def _restore(m: Machine, line: str) -> int:
    if line[:5] != "$RST=" or len(line) != 6 or line[5] not in "$#*":
        return INVALID
    m.memory.restore(line[5])
    m.say("[MSG:Restoring defaults]\r\n")
    m.kill()
    return OK


def _store(m: Machine, line: str, startup: bool) -> Status:
    """Store `$n=value`, or `$Nn=line` after running the line."""
    if line == "$N":
        _say_all(m, [f"$N{k}={text}" for k, text in enumerate(m.memory.startup)])
        return OK
    if startup and m.state is not State.IDLE:
        return NOT_IDLE
    number = read_number(line, 2 if startup else 1)
    if number is None:
        return BAD_NUMBER
    index, at = number
    if line[at : at + 1] != "=":
        return INVALID
    if startup:
        status = yield from run_line(m, line[at + 1 :])
        if status == OK:
            yield from synchronise(m)
            m.memory.store_startup(int(index), line[at + 1 :])
        return status
    value = read_number(line, at + 1)
    if value is None:
        return BAD_NUMBER
    if value[1] != len(line) or index > 255:
        return INVALID
    status = m.memory.store(int(index), value[0])
    if status == OK and int(index) == 13:
        m.wco_count = 0
    if status == OK and int(index) in (30, 31):
        m.spindle_off()
    return status
