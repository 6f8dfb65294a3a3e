"""The commands of camera, kerf, specimen and inspection, as a person types them, on files."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from numpy.typing import NDArray

from design.pattern.drawing import Drawing, as_json
from drivers.errors import TransportError
from fabctl.cli.main import cli
from fabctl.config.bench import CameraConfig
from fabctl.config.boards import config_of, load_board, write_board
from fabctl.config.material import load_material
from fabctl.errors import USAGE, RefusedError, UsageError
from fabctl.records.folder import start_run
from fabctl.vision.bed import alignment_path, lens_path
from fabctl.vision.lens import Lens, write_lens
from fabctl.vision.register import read_registration
from fabctl.workspace import Workspace
from simulators.camera.picture import Studio
from tests.fabctl.vision.conftest import BED, REGISTRATION, SHEET, WebCamera, bed_scene
from tests.fabctl.vision.test_cuts import JOB, photograph_coupon, trace_of

Fabctl = Callable[..., dict[str, Any]]


@pytest.fixture
def fabctl(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Fabctl:
    monkeypatch.chdir(tmp_path)

    def run(*words: str, exit_code: int = 0) -> dict[str, Any]:
        done = CliRunner().invoke(cli, ["--home", str(tmp_path), *words, "--json"])
        if done.exception and not isinstance(done.exception, SystemExit):
            raise done.exception
        assert done.exit_code == exit_code, done.output
        found: dict[str, Any] = json.loads(done.stdout)
        return found

    return run


@pytest.fixture
def aligned(fabctl: Fabctl, tmp_path: Path, lens: Lens, bed_picture: NDArray[np.uint8]) -> Path:
    """Return a picture of the bed in a lab whose camera is calibrated and aligned."""
    write_lens(lens, lens_path(Workspace(tmp_path).bench_state("sim")))
    for sheet in (BED, REGISTRATION):
        write_board(config_of(sheet), tmp_path / "configs" / "boards" / f"{sheet.name}.yaml")
    cv2.imwrite(str(tmp_path / "bed.png"), bed_picture)
    made = fabctl("camera", "align", "--image", "bed.png")
    assert made["rms_mm"] < 0.05
    assert Path(made["error_map"]).is_file()
    return tmp_path / "bed.png"


def test_boards_are_written_and_their_measured_size_noted(fabctl: Fabctl, tmp_path: Path) -> None:
    files = fabctl("camera", "board", "charuco", "--squares", "6x5", "--square-mm", "10", "--marker-mm", "7")["files"]
    assert all(Path(path).stat().st_size > 100 for path in files.values())
    fabctl("camera", "board", "marks", "registration", "--size-mm", "150x100")
    noted = fabctl("camera", "board", "measured", "registration", "149.25", "100")
    assert noted["ratio"] == pytest.approx([0.995, 1.0])
    sheet = load_board("registration", tmp_path).mark_sheet()
    assert sheet.marks[1].x_mm == pytest.approx(142 * 0.995)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("charuco", "--squares", "3x"), "whole numbers, such as 10x7"),
        (("charuco", "--squares", "3.7x4.2"), "whole numbers, such as 10x7"),
        (("charuco", "--squares", "3x2"), "3x3 squares at least"),
        (("charuco", "--squares", "100x100"), "200 in all at most"),
        (("charuco", "--name", "../lens"), "not a name"),
        (("marks", "bed", "--size-mm", "300x"), "such as 300x200"),
        (("marks", "bed", "--size-mm", "300x200", "--name", "A bed"), "not a name"),
    ],
)
def test_a_board_that_cannot_be_is_refused_with_one_that_can(words: tuple[str, ...], said: str, tmp_path: Path) -> None:
    done = CliRunner().invoke(cli, ["--home", str(tmp_path), "camera", "board", *words])
    assert done.exit_code == USAGE
    assert said in done.output
    assert not (tmp_path / "configs").exists()


def test_pictures_of_another_size_are_named_in_a_calibration(
    fabctl: Fabctl, tmp_path: Path, board_pictures: list[NDArray[np.uint8]]
) -> None:
    fabctl("camera", "board", "charuco")
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"{k}.png"), board_pictures[k])
    cv2.imwrite(str(tmp_path / "odd.png"), board_pictures[0][:600])
    with pytest.raises(UsageError, match=r"3 pictures have 1050 x 725 px, but odd.png has 1050 x 600"):
        fabctl("camera", "calibrate", "0.png", "odd.png", "1.png", "2.png")


@pytest.mark.parametrize(
    "change",
    [
        {"t_mm": [math.nan, 0.0, 800.0]},
        {"height_mm": math.inf},
        {"R": [[1.0, 0.0], [0.0, 1.0]]},
        {"made_utc": "yesterday"},
        {"made_utc": "2026-11-22T00:00:00"},
    ],
    ids=["no place", "no height", "flat", "no time", "no zone"],
)
def test_an_alignment_with_a_damaged_number_is_none(
    fabctl: Fabctl, aligned: Path, tmp_path: Path, change: dict[str, object]
) -> None:
    path = alignment_path(Workspace(tmp_path).bench_state("sim"))
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(UsageError, match="not an alignment"):
        fabctl("camera", "check", "--image", str(aligned))


def test_a_registration_with_a_damaged_number_is_none(fabctl: Fabctl, aligned: Path, tmp_path: Path) -> None:
    fabctl("camera", "register", "--thickness-mm", "2.3", "--image", str(aligned))
    path = tmp_path / "registration.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "height_mm": math.nan}))
    with pytest.raises(UsageError, match="not a registration"):
        read_registration(path)


def test_a_camera_may_be_a_bare_number_and_must_be_something() -> None:
    assert CameraConfig.model_validate({"url": 0}).url == "0"
    for nothing in ("", None, True):
        with pytest.raises(ValueError, match="url"):
            CameraConfig.model_validate({"url": nothing})


def test_a_lens_is_calibrated_from_a_folder_of_pictures(
    fabctl: Fabctl, tmp_path: Path, board_pictures: list[NDArray[np.uint8]]
) -> None:
    fabctl("camera", "board", "charuco")
    for k, picture in enumerate(board_pictures):
        cv2.imwrite(str(tmp_path / f"{k}.png"), picture)
    made = fabctl("camera", "calibrate", *(f"{k}.png" for k in range(10)))
    assert made["rms_px"] < 0.1
    assert Path(made["lens"]).is_file()
    assert cv2.imread(made["picture"]).shape[:2] == board_pictures[0].shape
    with pytest.raises(RefusedError, match="do not suffice"):
        fabctl("camera", "calibrate", "0.png", "1.png")


def test_a_lens_is_calibrated_live_and_one_that_is_unplugged_meanwhile_leaves_none(
    fabctl: Fabctl, tmp_path: Path, board_pictures: list[NDArray[np.uint8]], web_camera: WebCamera
) -> None:
    fabctl("camera", "board", "charuco")
    web_camera.use_on(tmp_path)
    web_camera.pictures = list(board_pictures[:4])
    with pytest.raises(TransportError, match="no picture"):
        fabctl("camera", "calibrate", "--views", "10")
    assert not lens_path(Workspace(tmp_path).bench_state("sim")).exists()
    web_camera.pictures = list(board_pictures)
    assert fabctl("camera", "calibrate", "--views", "10")["views_count"] == 10


def test_pictures_that_cannot_be_read_are_left_out_of_a_calibration_by_name(
    fabctl: Fabctl, tmp_path: Path, board_pictures: list[NDArray[np.uint8]]
) -> None:
    fabctl("camera", "board", "charuco")
    for k, picture in enumerate(board_pictures):
        cv2.imwrite(str(tmp_path / f"{k}.png"), picture)
    (tmp_path / "0.png").write_bytes(b"ftypheic")
    assert fabctl("camera", "calibrate", *(f"{k}.png" for k in range(10)))["views_count"] == 9
    with pytest.raises(UsageError, match="none of the 1 files"):
        fabctl("camera", "calibrate", "0.png")


def test_a_bed_is_aligned_by_the_run_that_engraved_its_marks(fabctl: Fabctl, aligned: Path, tmp_path: Path) -> None:
    runs = Workspace(tmp_path).runs
    run = start_run(runs, "marks", config={"placement": [[1.0, 0.0, -300.0], [0.0, 1.0, -200.0]]})
    words = ("camera", "align", "--image", str(aligned), "--engraved")
    with pytest.raises(UsageError, match="no finished run"):
        fabctl(*words, run.run_id)
    run.finish("done")
    made = fabctl(*words, run.run_id)
    witness = json.loads(Path(made["alignment"]).read_text())["witnesses"][0]
    mark = BED.mark(witness["id"])
    assert mark is not None
    assert (witness["x_mm"], witness["y_mm"]) == pytest.approx((mark.x_mm - 300, mark.y_mm - 200))
    with pytest.raises(UsageError, match="2020-marks"):
        fabctl(*words, "2020-marks")


def test_a_sheet_is_registered_with_the_job_drawn_on_the_bed(fabctl: Fabctl, tmp_path: Path, aligned: Path) -> None:
    assert fabctl("camera", "check", "--image", str(aligned))["findings"] == []
    (tmp_path / "design").mkdir()
    (tmp_path / "design" / "paths.json").write_text(json.dumps(as_json(Drawing((150.0, 100.0), tuple(JOB)))))
    made = fabctl("camera", "register", "--thickness-mm", "2.3", "--image", str(aligned), "--design", "design")
    stored = json.loads((tmp_path / "registration.json").read_text())
    assert np.array(stored["sheet_to_machine"]) == pytest.approx(np.array(made["sheet_to_machine"]))
    assert np.array(stored["sheet_to_machine"])[:, 2] == pytest.approx([90, 40], abs=0.1)
    assert cv2.imread(made["overlay"]).shape[2] == 3


def test_without_a_lens_or_an_alignment_the_next_command_is_named(
    fabctl: Fabctl, aligned: Path, tmp_path: Path
) -> None:
    state = Workspace(tmp_path).bench_state("sim")
    alignment_path(state).unlink()
    with pytest.raises(UsageError, match="fabctl camera align"):
        fabctl("camera", "check", "--image", str(aligned))
    lens_path(state).unlink()
    with pytest.raises(UsageError, match="fabctl camera calibrate"):
        fabctl("camera", "align", "--image", str(aligned))


def test_a_cut_is_inspected_where_its_run_laid_it(fabctl: Fabctl, tmp_path: Path, aligned: Path) -> None:
    lab = Workspace(tmp_path)
    (tmp_path / "design").mkdir()
    (tmp_path / "design" / "paths.json").write_text(json.dumps(as_json(Drawing((150.0, 100.0), tuple(JOB)))))
    specimen = lab.new_specimen(tmp_path / "design")
    placement = [[1.0, 0.0, 100.0], [0.0, 1.0, 60.0]]
    config = {"placement": placement, "material": {"thickness_mm": SHEET.thickness_mm}}
    start_run(lab.runs, "cut", specimen=specimen.name, config=config).finish("done")
    at = np.array([100.0, 60.0])
    jobs = [(type(p)(p.layer, p.points_mm + at, p.closed), 0.6, 25.0) for k, p in enumerate(JOB) if k != 3]
    cv2.imwrite("after.png", Studio(bed_scene(SHEET)).frame(0, trace_of(jobs)))
    found = fabctl("cut", "inspect", specimen.name, "--image", "after.png", exit_code=6)
    assert [path["path"] for path in found["faulty"]] == [3]
    assert found["paths_count"]["missing"] == 1
    assert cv2.imread(found["picture"]) is not None


def test_a_measured_kerf_goes_into_the_labs_own_material_file(fabctl: Fabctl, tmp_path: Path) -> None:
    made = fabctl("kerf", "coupon", "--material", "natural-rubber-2.3", "--powers", "0.5,0.7")
    assert (Path(made["folder"]) / "coupon.nc").read_text().startswith("G21")
    cv2.imwrite("coupon.png", photograph_coupon(over_light=True))
    words = ("kerf", "measure", "coupon.png", "--coupon", "coupon/coupon.json")
    before = load_material("natural-rubber-2.3", tmp_path)
    assert "kerf_mm" not in fabctl(*words)
    found = fabctl(*words, "--write")
    after = load_material("natural-rubber-2.3", tmp_path)
    assert after.laser is not None and before.laser is not None
    assert after.laser.kerf_mm == pytest.approx(found["kerf_mm"], abs=1e-4)
    assert after.laser.slit == before.laser.slit
    assert "# The paper's sheet" in (tmp_path / "configs/materials/natural-rubber-2.3.yaml").read_text()


def test_specimens_are_listed_noted_and_known_by_their_engraved_id(fabctl: Fabctl, tmp_path: Path) -> None:
    (tmp_path / "design").mkdir()
    (tmp_path / "design" / "spec.yaml").write_text("x: 1\n")
    name = Workspace(tmp_path).new_specimen(tmp_path / "design").name
    fabctl("specimen", "note", name, "thickness_mm=2.31", "batch=B7")
    shown = fabctl("specimen", "show", name)
    assert (shown["thickness_mm"], shown["batch"]) == (2.31, "B7")
    assert [row["id"] for row in fabctl("specimen", "list")["specimens"]] == [name]
    from fabctl.vision.ids import id_sheet

    page = np.full((200, 320), 220, np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_ARUCO_MIP_36h12)
    for k, mark in enumerate(id_sheet(name, 1.0).marks):
        page[60:140, 60 + 100 * k : 140 + 100 * k] = cv2.aruco.generateImageMarker(dictionary, mark.id, 80)
    cv2.imwrite("photo.png", page)
    (row,) = fabctl("specimen", "read", "photo.png")["specimens"]
    assert (row["id"], row["known"]) == (name, True)
    cv2.imwrite("blank.png", cv2.resize(np.tile(np.array([[40, 200]], np.uint8), (60, 60)), (240, 240)))
    with pytest.raises(RefusedError, match="no specimen id"):
        fabctl("specimen", "read", "blank.png")
    cv2.imwrite("mirror.png", page[:, ::-1])
    with pytest.raises(RefusedError, match=f"{name} is seen in a mirror"):
        fabctl("specimen", "read", "mirror.png")
