"""Program, place, preflight, estimate, progress: the pure side of a cut."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks._laser_dialogues import recorded_job
from drivers.grbl.messages import Report
from drivers.grbl.settings import Identity, Settings
from fabctl.config.bench import LaserConfig
from fabctl.config.material import LaserPreset, LayerConfig, MaterialConfig, load_material
from fabctl.cut import job
from fabctl.cut.estimate import Dynamics, estimate
from fabctl.cut.place import Affine, lay, read_affine, travel_box_mm
from fabctl.cut.plan import frame_lines, plan_cut, with_air, with_lit_ends
from fabctl.cut.preflight import Sheet, preflight
from fabctl.cut.program import Program, decimal, read_program, split_long
from fabctl.cut.progress import Track, locate
from fabctl.cut.trail import MARK, PROGRAM_BEGINS, read_trail, rest_of
from fabctl.errors import UsageError

LAYER = LayerConfig(power_frac=0.5, feed_mm_s=25.0)
RUBBER = MaterialConfig(
    name="rubber", E_MPa=1.5, nu_ratio=0.45, thickness_mm=2.3, density_kg_m3=1150.0,
    laser=LaserPreset(slit=LAYER, outline=LAYER, engrave=LAYER, mark=LAYER, kerf_mm=0.125),
)  # fmt: skip
SETTINGS = {
    11: 0.01, 12: 0.002, 13: 0, 20: 1, 22: 1, 23: 0, 30: 1000, 31: 0, 32: 1, 100: 250, 101: 250,
    110: 6000, 111: 6000, 120: 500, 121: 500, 130: 300, 131: 200,
}  # fmt: skip
BOARD = Identity(
    "grbl", "1.1h", "V", 128, 15, Settings({k: float(v) for k, v in SETTINGS.items()}), {}, "G54", ("", "")
)
LASER = LaserConfig(url="tcp://x:1", travel_mm=(300.0, 200.0))
IDLE = Report("Idle", machine_mm=(-1.0, -1.0, -1.0))
GOOD = ("G21", "G90", "M8", "M4S0", "G0X-200Y-100F1500S500", "G1X-190", "G0X-200Y-90", "G1X-190", "M5", "M9", "G4P0.01")
DYNAMICS = Dynamics.of(BOARD.settings | {1: 255.0})
LOCKING = Dynamics.of(BOARD.settings)


def with_settings(**changes: float) -> Identity:
    return replace(BOARD, settings=Settings(BOARD.settings | {int(k[1:]): v for k, v in changes.items()}))


def codes(
    lines: tuple[str, ...] = GOOD, board: Identity = BOARD, laser: LaserConfig = LASER, report: Report = IDLE,
    material: MaterialConfig = RUBBER, sheet: Sheet | None = None, homed: bool = True,
) -> set[str]:  # fmt: skip
    program = read_program(lines)
    found = preflight(program, board, report, laser, material, (0.0, 0.0, 0.0), sheet, homed)
    return {finding.code for finding in found}


def test_a_good_job_has_no_findings() -> None:
    assert codes() == set()


REASONS: list[tuple[str, dict[str, object]]] = [
        ("CUT-X", {"lines": ("G21", "M8", "M4S0", "G1X1Y-5F1500S500", "M5")}),
        ("CUT-Y", {"lines": ("G21", "M8", "M4S0", "G1X-1Y-205F1500S500", "M5")}),
        ("CUT-S", {"board": with_settings(_30=255.0)}),
        ("CUT-S-MIN", {"board": with_settings(_31=10.0)}),
        ("CUT-RATE", {"board": with_settings(_110=1000.0)}),
        ("CUT-LASER-MODE", {"board": with_settings(_32=0.0)}),
        ("CUT-INCHES", {"board": with_settings(_13=1.0)}),
        ("CUT-HOMING", {"board": with_settings(_22=0.0)}),
        ("CUT-SOFT-LIMITS", {"board": with_settings(_20=0.0)}),
        ("CUT-TRAVEL", {"board": with_settings(_130=250.0)}),
        ("CUT-STARTUP", {"board": replace(BOARD, startup=("G20", ""))}),
        ("CUT-OVERRIDE", {"report": replace(IDLE, overrides=(120, 100, 100))}),
        ("CUT-STATE", {"report": Report("Door", 1)}),
        ("CUT-LOCKED", {"report": replace(IDLE, state="Alarm")}),
        ("CUT-SWITCH", {"report": replace(IDLE, pins="X")}),
        ("CUT-DOOR", {"report": replace(IDLE, pins="D")}),
        ("CUT-M3", {"lines": tuple(line.replace("M4", "M3") for line in GOOD)}),
        ("CUT-M7", {"lines": ("M7", *GOOD)}),
        ("CUT-AIR", {"lines": tuple(line for line in GOOD if line != "M8")}),
        ("CUT-EMPTY", {"lines": ("G21", "M8", "G0X-5Y-5")}),
        ("CUT-ZERO", {"homed": False}),
        ("CUT-FORBIDDEN", {"lines": (*GOOD, "G10L2P1X0")}),
        ("CUT-FORBIDDEN", {"lines": (*GOOD, "G20")}),
        ("CUT-FORBIDDEN", {"lines": (*GOOD, "G91")}),
        ("CUT-FORBIDDEN", {"lines": (*GOOD, "G1Z-1")}),
        ("CUT-SYNTAX", {"lines": (*GOOD, "$32=0")}),
        ("CUT-LINE-LENGTH", {"lines": (*GOOD, "G1X-190.0" + "0" * 80)}),
        ("CUT-FEED", {"lines": ("M8", "M4S100", "G1X-5Y-5", *GOOD)}),
        ("CUT-MATERIAL-DANGER", {"material": RUBBER.model_copy(update={"never_cut_because": "chlorine"})}),
        ("CUT-PRESET", {"material": RUBBER.model_copy(update={"laser": None})}),
        ("CUT-SHEET", {"sheet": Sheet("other", 2.3)}),
        ("CUT-SHEET", {"sheet": Sheet("rubber", 2.0)}),
        ("CUT-S", {"board": replace(BOARD, settings=Settings({k: v for k, v in BOARD.settings.items() if k != 30}))}),
        ("CUT-RATE", {"board": with_settings(_111=1000.0)}),
        ("CUT-TRAVEL", {"board": with_settings(_131=250.0)}),
        ("CUT-STARTUP", {"board": replace(BOARD, startup=("", "M3S9"))}),
        ("CUT-OVERRIDE", {"report": replace(IDLE, overrides=(100, 100, 90))}),
        ("CUT-SWITCH", {"report": replace(IDLE, pins="PY")}),
        *(("CUT-STATE", {"report": replace(IDLE, state=state)}) for state in ("Run", "Hold", "Jog", "Check", "Sleep")),
        ("CUT-EMPTY", {"lines": ("G21", "M8", "G0X-5")}),
        ("CUT-FORBIDDEN", {"lines": (*GOOD, "G2X-180Y-90R5F600")}),
        ("CUT-FORBIDDEN", {"lines": (*GOOD, "G92X0")}),
        ("CUT-FORBIDDEN", {"lines": (*GOOD, "G38.2X-9F50")}),
        ("CUT-FORBIDDEN", {"lines": (*GOOD, "T1")}),
        ("CUT-FORBIDDEN", {"lines": (*GOOD, "M98")}),
]  # fmt: skip
WARNINGS = {"CUT-S-MIN", "CUT-SOFT-LIMITS", "CUT-TRAVEL", "CUT-ZERO"}


@pytest.mark.parametrize(("expected", "changes"), REASONS)
def test_each_reason_against_a_cut_is_found(expected: str, changes: dict[str, object]) -> None:
    assert expected in codes(**changes)  # type: ignore[arg-type]


@pytest.mark.parametrize(("expected", "changes"), REASONS)
def test_whatever_is_wrong_stops_the_cut_but_for_the_few_that_only_warn(
    expected: str, changes: dict[str, object]
) -> None:
    program = read_program(changes.get("lines", GOOD))  # type: ignore[arg-type]
    rest = {key: value for key, value in changes.items() if key != "lines"}
    given = {"board": BOARD, "report": IDLE, "material": RUBBER, "sheet": None, "homed": True, **rest}
    found = preflight(
        program, given["board"], given["report"], LASER, given["material"], (0.0, 0.0, 0.0), given["sheet"],
        given["homed"],  # type: ignore[arg-type]
    )  # fmt: skip
    levels = {finding.level for finding in found if finding.code == expected}
    untold_power = expected == "CUT-S" and given["board"].setting(30) is None  # type: ignore[attr-defined]
    assert levels == {"warning" if expected in WARNINGS or untold_power else "error"}


def test_no_reason_is_without_its_row() -> None:
    text = "".join((Path(job.__file__).parent / name).read_text() for name in ("preflight.py", "program.py"))
    written = set(re.findall(r'"(CUT-[A-Z0-9-]+)"', text)) | {"CUT-X", "CUT-Y"}
    assert written == {code for code, _ in REASONS}


def test_all_reasons_are_found_at_once() -> None:
    board = replace(with_settings(_32=0.0, _30=100.0), startup=("G20", ""))
    found = codes(("M4S500", "G1X5Y-5F9000S500", "G10L2P1X0"), board, report=Report("Door", 1))
    assert {"CUT-X", "CUT-S", "CUT-RATE", "CUT-LASER-MODE", "CUT-STARTUP", "CUT-STATE", "CUT-FORBIDDEN"} <= found


def test_the_travel_box_follows_the_build_option_and_the_homing_corner() -> None:
    assert travel_box_mm(BOARD, (1.0, 1.0)) == (-300.0, -200.0, 0.0, 0.0)
    assert travel_box_mm(replace(BOARD, options="VZ"), (1.0, 1.0)) == (-300.0, -200.0, 0.0, 0.0)
    positive = replace(with_settings(_23=3.0), options="VZ")
    assert travel_box_mm(positive, (1.0, 1.0)) == (0.0, 0.0, 300.0, 200.0)


@given(
    shift=st.tuples(st.floats(-200, 200), st.floats(-200, 200)),
    turn_rad=st.floats(-math.pi, math.pi),
    offset=st.tuples(st.floats(-50, 50), st.floats(-50, 50)),
)
def test_a_laid_program_burns_where_the_map_puts_it(
    shift: tuple[float, float], turn_rad: float, offset: tuple[float, float]
) -> None:
    c, s = math.cos(turn_rad), math.sin(turn_rad)
    affine = Affine(c, -s, shift[0], s, c, shift[1])
    lines = ("G21", "G90", "M4S0", "G0X10Y20F600S9", "G1X15", "Y30", "G2X25Y30I5J0", "M5")
    before, after = read_program(lines), read_program(lay(lines, affine, (*offset, 0.0)))
    a = [step for step in before.steps if step.burns]
    b = [step for step in after.steps if step.burns]
    for k in (0, 1, -1):
        x, y = affine.at(a[k].end_mm)
        assert math.dist(b[k].end_mm, (x - offset[0], y - offset[1])) < 0.002
    assert sum(step.length_mm for step in b) == pytest.approx(sum(step.length_mm for step in a), abs=0.02)


def test_maps_are_done_one_after_the_other_and_undone() -> None:
    a, b = Affine(0.8, -0.6, 3.0, 0.6, 0.8, -2.0), Affine(1.01, 0.02, -7.0, -0.03, 0.99, 11.0)
    assert a.of(b).at((4.0, 9.0)) == pytest.approx(a.at(b.at((4.0, 9.0))))
    assert b.inverse().at(b.at((4.0, 9.0))) == pytest.approx((4.0, 9.0))
    assert Affine.of_rows(b.rows()) == b


def test_a_camera_map_must_be_rigid(tmp_path: Path) -> None:
    path = tmp_path / "map.json"
    path.write_text('{"sheet_to_machine": [[0, -1, 5], [1, 0, 7]]}')
    assert read_affine(path).at((2.0, 3.0)) == (2.0, 9.0)
    path.write_text('{"sheet_to_machine": [[1.2, 0, 5], [0, 1.2, 7]]}')
    with pytest.raises(UsageError, match="scales"):
        read_affine(path)
    path.write_text("[]")
    with pytest.raises(UsageError):
        read_affine(path)


@given(st.floats(-1e4, 1e4))
def test_coordinates_are_short_and_true(value: float) -> None:
    text = decimal(value)
    assert float(text) == pytest.approx(value, abs=0.00051)
    assert text != "-0"
    assert not ("." in text and text.endswith("0"))


def test_long_cuts_are_divided_and_stay_the_same_cut() -> None:
    lines = ("G21", "G90", "M4S0", "G0X0Y0", "G1X100F300S500", "G0X0", "M5")
    divided = read_program(split_long(lines, 1.0))
    longest_s = max(step.length_mm / step.speed_mm_s for step in divided.steps if step.burns)
    assert longest_s <= 1.001
    assert sum(step.length_mm for step in divided.steps if step.burns) == pytest.approx(100)
    assert divided.steps[-1].beam == 5


@pytest.mark.parametrize("name", ["PVC-film", "soft vinyl", "neoprene-3", "polychloroprene", "Hypalon", "cr-60", "CSM"])
def test_chlorine_is_known_by_its_names_too(name: str) -> None:
    assert codes(material=RUBBER.model_copy(update={"name": name})) == {"CUT-MATERIAL-DANGER"}


@pytest.mark.parametrize("name", ["acrylic-3", "natural-rubber-2.3", "chlorine-free foam", "latex", "EPDM", "eva-foam"])
def test_harmless_names_are_not_taken_for_chlorine(name: str) -> None:
    assert codes(material=RUBBER.model_copy(update={"name": name})) == set()


@pytest.mark.parametrize("name", ["neoprene-2.0", "pvc-0.5"])
def test_the_dangerous_materials_of_the_shelf_are_refused(name: str) -> None:
    assert "CUT-MATERIAL-DANGER" in codes(material=load_material(name, Path("nowhere")))


def test_a_single_move_takes_the_time_of_its_trapezoid() -> None:
    program = read_program(("G21", "G90", "M4S0", "G1X50F1500S5"))
    v, a = 25.0, 500.0
    assert estimate(program.steps[1:], DYNAMICS).total_s == pytest.approx(50 / v + v / a)


def test_every_standstill_lasts_until_the_steppers_have_settled() -> None:
    twice = read_program(("G1X10F1500S5", "M4S0", "M8", "G1X20", "M5", "M9"))
    free_s, locked_s = (estimate(twice.steps, dynamics).total_s for dynamics in (DYNAMICS, LOCKING))
    assert locked_s - free_s == pytest.approx(2 * 0.025)
    assert Dynamics.of({1: 25.0}, firmware="FluidNC").lock_s == 0.0


def test_words_that_change_nothing_wait_for_nothing() -> None:
    lines = ("G1X10F1500S5", "M4S5", "M8", "G1X20S5")
    again = (*lines[:3], "M4", "M8", "S5", "G1X20S5")
    assert [step.sync for step in read_program(again).steps] == [step.sync for step in read_program(lines).steps]
    louder = read_program(("M4S5", "G1X10F1500", "S6", "G1X20S7"))
    assert [step.sync for step in louder.steps] == [True, False, True, False]


def test_the_estimate_is_that_of_a_recorded_board(shared: Path) -> None:
    sent, took_s = recorded_job(shared / "laser" / "grbl-1.1h-dialogues" / "motion.jsonl")
    assert estimate(read_program(sent).steps, LOCKING).total_s == pytest.approx(took_s, rel=0.006)


def test_a_corner_costs_time_and_a_straight_joint_none() -> None:
    straight = read_program(("G1X10F1500S5", "G1X20"))
    corner = read_program(("G1X10F1500S5", "G1Y10"))
    back = read_program(("G1X10F1500S5", "G1X0"))
    times = [estimate(p.steps, DYNAMICS).total_s for p in (straight, corner, back)]
    assert times[0] == pytest.approx(20 / 25 + 25 / 500)
    assert times[0] < times[1] < times[2]
    assert times[2] == pytest.approx(2 * (10 / 25 + 25 / 500))


def test_more_steps_never_make_a_smooth_path_faster() -> None:
    def circle(count: int) -> float:
        turn = 2 * math.pi / count
        points = [(20 * math.cos(k * turn), 20 * math.sin(k * turn)) for k in range(count + 1)]
        lines = ["G0X20Y0", *(f"G1X{x:.4f}Y{y:.4f}F6000S5" for x, y in points)]
        return estimate(read_program(lines).steps, DYNAMICS).total_s

    assert circle(4000) > circle(400)  # fifteen moves of 0.03 mm leave no room to brake from full speed


def test_no_piece_is_faster_than_the_moves_behind_it_can_brake_from() -> None:
    count, piece_mm = 3000, 0.1
    program = read_program([f"G1X{piece_mm * (k + 1):.4f}F6000S5" for k in range(count)])
    took_s = estimate(program.steps, DYNAMICS).total_s
    cruise_mm_s = math.sqrt(2 * 500 * 14 * piece_mm)  # fifteen moves, of which one is being made
    piece_s = 2 * (math.sqrt(cruise_mm_s**2 + 500 * piece_mm) - cruise_mm_s) / 500  # in which it goes up and down again
    assert took_s == pytest.approx(count * piece_s + cruise_mm_s / 500, rel=0.001)


def test_a_pause_is_rounded_up_to_the_board_s_steps() -> None:
    program = read_program(("G4P0.01", "G4P0.06"))
    assert estimate(program.steps, DYNAMICS).total_s == pytest.approx(0.05 + 0.1, abs=0.02)


def test_lines_are_held_back_to_the_seconds_allowed() -> None:
    program = read_program(("G21", "G90", "M4S0", *(f"G1X-{k}F60S5" for k in range(1, 40)), "M5"))
    times = estimate(program.steps, DYNAMICS)
    track = Track(program, times, 5.0)
    sent = track.limit_count()
    for second in range(1, 30):
        assert track.line_end_s[sent - 1] - track.done_s <= 5.0 + 1e-9
        track.reported((-float(second), 0.0), sent, True, float(second))
        assert track.done_s == pytest.approx(second, abs=0.3)
        sent = track.limit_count()
    assert sent > 30


def test_a_crossing_is_decided_by_time() -> None:
    program = read_program(("G0X0Y0", "G1X10F600S5", "G1Y5", "G1X5", "G1Y-5"))
    times = estimate(program.steps, DYNAMICS)
    crossing = (5.0, 0.0)
    early = locate(program.steps, times, crossing, 0, 9, 0.5)
    late = locate(program.steps, times, crossing, 0, 9, times.total_s)
    assert early is not None
    assert late is not None
    assert early.step_index < late.step_index


def test_the_rest_of_a_program_says_every_mode_again() -> None:
    program = read_program(GOOD)
    times = estimate(program.steps, DYNAMICS)
    place = locate(program.steps, times, (-195.0, -100.0), 0, 99, 0.0)
    assert place is not None
    rest = rest_of(program, place)
    assert rest[:6] == ("G21", "G90", "G94", "G17", "M8", "M4S0")
    assert rest[6:8] == ("G0X-195Y-100", "G1X-190Y-100F1500S500")
    burnt = sum(step.length_mm for step in read_program(rest).steps if step.burns)
    assert burnt == pytest.approx(15.0)


def test_every_place_of_a_program_can_be_gone_on_from() -> None:
    program = read_program(("G21", "G90", "M8", "M4S0", "G0X5Y5F900S300", "G1X9", "Y9", "G2X13Y9I2J0", "G0X0Y0", "M5"))
    total = sum(step.length_mm for step in program.steps if step.burns)
    times = estimate(program.steps, DYNAMICS)
    for k, step in enumerate(program.steps):
        here = tuple((a + b) / 2 for a, b in zip(step.start_mm, step.end_mm, strict=True))
        place = locate(program.steps, times, (here[0], here[1]), k, k, 0.0)
        assert place is not None
        place = replace(place, along_ratio=0.5 if step.length_mm else 1.0)
        done = sum(s.length_mm for s in program.steps[:k] if s.burns) + (step.length_mm / 2 if step.burns else 0)
        left = sum(s.length_mm for s in read_program(rest_of(program, place)).steps if s.burns)
        assert done + left == pytest.approx(total, abs=0.01), (k, step)


def test_a_trail_begins_where_the_program_does() -> None:
    program: Program = read_program(GOOD)
    times = estimate(program.steps, DYNAMICS)
    rows = ['{"t_s": 0, "dir": ">", "bytes": "G21\\nG90\\n"}', '{"t_s": 0.1, "dir": "<", "bytes": "ok\\r\\nok\\r\\n"}']
    assert not read_trail("\n".join(rows), program, times, (0.0, 0.0, 0.0)).begun
    rows += [f'{{"t_s": 1, "dir": "{MARK}", "bytes": "{PROGRAM_BEGINS}"}}', rows[0], '{"t_s": 2, "dir": ">", "by']
    trail = read_trail("\n".join(rows), program, times, (0.0, 0.0, 0.0))
    assert (trail.begun, trail.written_count, trail.answered_count) == (True, 2, 0)


def test_air_is_on_before_the_beam_and_off_after_it() -> None:
    lines = with_air(("G21", "M4S0", "G1X1F1S1", "M5", "G4P0.01"), BOARD, RUBBER)
    assert lines == ("G21", "M8", "M4S0", "G1X1F1S1", "M5", "M9", "G4P0.01")
    both = with_air(("M4S0", "M5"), replace(BOARD, options="VM"), RUBBER)
    assert both[:2] == ("M7", "M8")


def test_a_plan_stays_within_what_the_board_may_hold() -> None:
    slow = ("G21", "G90", "G94", "G17", "M4S0", "G0X10Y10", "G1X90F120S500", "M5", "G4P0.01")
    plan = plan_cut(slow, Affine(x_mm=-300.0, y_mm=-200.0), BOARD, IDLE, LASER, RUBBER)
    assert plan.findings == ()
    ends = plan.times.end_s
    steps = plan.program.steps
    lengths = [b - a for s, a, b in zip(steps, (0.0, *ends[:-1]), ends, strict=True) if s.burns]
    assert max(lengths) < LASER.max_run_on_s * 0.3
    assert plan.bounds_mm() == pytest.approx((-290.0, -190.0, -209.9, -190.0), abs=0.1)
    assert "G1" in frame_lines(plan)[5]


def test_the_dark_end_of_a_stroke_is_made_up_for() -> None:
    lines = ("G90", "M4S0", "G0X0Y0", "G1X10F1500S500", "Y10", "G0X0", "M5")
    out = with_lit_ends(lines, DYNAMICS)
    assert out[4] == "X10Y10.012"
    assert out[:4] == lines[:4]


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ("[[1, 0, 1e308], [0, 1, 0]]", "10 m"), ("[[1, 0, 0], [0, 1, -1e5]]", "10 m"),
        ("[[1e308, 0, 0], [0, 1e-308, 0]]", "scales"), ("[[1, 1, 0], [0, 1, 0]]", "scales"),
        ("[[1, 0.5, 0], [0, 0.8660254, 0]]", "shears"),
    ],
)  # fmt: skip
def test_a_map_that_no_bed_has_is_refused(tmp_path: Path, rows: str, said: str) -> None:
    path = tmp_path / "map.json"
    path.write_text(f'{{"sheet_to_machine": {rows}}}')
    with pytest.raises(UsageError, match=said):
        read_affine(path)
