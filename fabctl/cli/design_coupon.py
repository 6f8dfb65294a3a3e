"""`fabctl design coupon` and `coupon-read`: a sheet that checks the library on real rubber, and what it showed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fabctl.cli.common import MATERIAL, json_option, lab, progress, show
from fabctl.cli.finite import numbers
from fabctl.cli.paths import SPECIMEN, SPECIMEN_OR_FILE, InFile, OutFolder
from fabctl.errors import DONE, OUT_OF_TOLERANCE

if TYPE_CHECKING:
    from fabctl.coupon import Measured

library_option = click.option("--library", type=InFile(), help="Library of cells (.npz), or a published map (.csv).")


@click.command()
@click.option("--expansion", "expansion_ratio", type=click.FloatRange(1, 3, min_open=True), default=1.5,
              show_default=True, help="Of the cell to try.")  # fmt: skip
@click.option("--hinges-mm", default="0.20,0.25,0.30,0.35,0.40,0.45", show_default=True, help="Ladder of hinge widths.")
@click.option(
    "--material", type=MATERIAL, default="natural-rubber-2.3", show_default=True, help="Material file or its name."
)
@library_option
@click.option("-o", "--output", type=OutFolder(), required=True, help="Folder for the coupon.")
@click.option("--replace", is_flag=True, help="Replace a design or coupon that lies in that folder.")
@json_option
def coupon(
    expansion_ratio: float,
    hinges_mm: str,
    material: str,
    library: Path | None,
    output: Path,
    replace: bool,
    as_json: bool,
) -> None:
    """Make a sheet of uniform patches, one a hinge width, to check the library on the real material.

    The folder is cut as a design's is (`fabctl cut run`). Lengths are measured from a notch of a patch's left border
    to the notch across; the form to fill in is coupon.csv.
    """
    from fabctl.config.coupon import CouponConfig
    from fabctl.designing import write_coupon

    hinges = tuple(numbers(hinges_mm, "--hinges-mm"))
    if not all(0.01 <= hinge <= 10 for hinge in hinges):
        raise click.UsageError("--hinges-mm takes widths from 0.01 to 10 mm")
    chosen_from = None if library is None else str(library.resolve())
    asked = CouponConfig(material=material, expansion_ratio=expansion_ratio, hinges_mm=hinges, library=chosen_from)
    made, bundle = write_coupon(output, asked, lab().root, replace, progress())
    width, height = made.drawing.size_mm
    lines = [f"{output}: {len(made.patches)} patches on {width:.0f} × {height:.0f} mm"]
    for patch in made.patches:
        expected = "not bistable" if patch.expansion_ratio is None else f"expands by {patch.expansion_ratio:.4f}"
        lines.append(f"{patch.label.split()[0]}  hinge {patch.hinge_mm:.3f} mm  {expected}")
    rows = [{"patch": p.label, "hinge_mm": p.hinge_mm, "expansion_ratio": p.expansion_ratio} for p in made.patches]
    show({"folder": str(output), "patches": rows, "facts": bundle.manifest["facts"]}, as_json, lines)


@click.command("coupon-read")
@click.argument("form", type=SPECIMEN_OR_FILE)
@click.option("--length-error-mm", type=click.FloatRange(0, 100), default=0.2, show_default=True,
              help="Standard error of one reading of a length.")  # fmt: skip
@click.option(
    "--specimen", type=SPECIMEN, help="Specimen that the form belongs to, where it is not the specimen's own."
)
@json_option
def coupon_read(form: str, length_error_mm: float, specimen: str | None, as_json: bool) -> None:
    """Read a coupon's filled FORM: measured expansions and open-close cycles against the map.

    FORM is coupon.csv in its folder, that folder, or a specimen that was cut as a coupon (S-0001: the form in its own
    folder). Hinges and expected expansions come from the folder's cells.csv, not from the form. What is known of a
    specimen goes into its record and its report. Exit code 6 where a patch is off the map by more than its
    uncertainty.
    """
    from fabctl.coupon import as_rows, keep_result, open_coupon, read_form, sentence, write_measured
    from fabctl.workspace import SPECIMEN

    if specimen is None and SPECIMEN.fullmatch(form) and not Path(form).exists():
        specimen = form
        path = lab().specimen(form).design
    else:
        path = Path(form)
    path = path / "coupon.csv" if path.is_dir() else path
    cut = open_coupon(path.parent if specimen is None else lab().specimen(specimen).design, path)
    patches = read_form(path, length_error_mm, cut)
    data: dict[str, Any] = {"patches": as_rows(patches)}
    if specimen is not None:
        run = keep_result(lab(), specimen, path, patches, length_error_mm, cut)
        data |= {"specimen": specimen, "run": run.run_id}
    data["file"] = str(write_measured(path, patches, length_error_mm))
    code = DONE if all(patch.agrees() for patch in patches) else OUT_OF_TOLERANCE
    show(data, as_json, [*_read_lines(patches), sentence(patches)], code, sentence(patches))


def _read_lines(patches: Sequence[Measured]) -> Iterator[str]:
    yield f"{'patch':6}{'hinge, mm':>10}{'expected':>10}{'measured':>10}{'± 95 %':>9}{'off':>9}  cycles"
    for patch in patches:
        told = f"{patch.expected_ratio or 1.0:10.4f}"
        ended = f", torn at {patch.failed_at_count}" if patch.failed_at_count is not None else ""
        yield (
            f"{patch.patch:6}{patch.hinge_mm:10.3f}{told}{patch.expansion_ratio:10.4f}{patch.uncertainty_ratio:9.4f}"
            f"{patch.off_ratio():+9.4f}  {patch.cycles_count}{ended}"
        )
