"""A sampling loop goes before other work where the system allows it, and gives its place back."""

from __future__ import annotations

import os

import pytest

from fabctl.priority import before_other_work


def test_the_place_before_others_is_given_back() -> None:
    was = os.sched_getscheduler(0)
    with before_other_work() as allowed:
        assert os.sched_getscheduler(0) == (os.SCHED_RR if allowed else was)
    assert os.sched_getscheduler(0) == was


def test_without_leave_the_work_is_done_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    with before_other_work() as allowed:
        assert not allowed
