"""A surface in, a sheet out: flatten, tile, average, choose cells, draw, compose, deploy. Pure; disk is `bundle`'s."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from design.cells.contracting import at_cells, openings
from design.cells.library import CellLibrary
from design.cells.monostable import monostable_cells
from design.cells.select import Choice, SelectionCurve, on_curve, select, selection_curve
from design.cells.sheet import Sheet
from design.compensated import compensated
from design.deploy.supports import Support
from design.errors import OutOfLibrary
from design.findings import Finding
from design.flatten import FeasibilityReport, Flattening, Limits, feasibility, flatten
from design.hinged import Widening, as_cut, hinge_of, hinge_range, hinged, widening
from design.job import Job, JobOptions, compose_job
from design.limits import check_count
from design.pattern.assign import averaged, factor
from design.pattern.border import framed, piece_of
from design.pattern.cuts import Cuts, notched
from design.pattern.drawing import Drawing
from design.pattern.holes import holes_of
from design.pattern.paths import Layer, LayerPreset
from design.pattern.seams import Pair, label_paths, seam_pairs
from design.pattern.sheets import Split, fits, split
from design.pattern.slits import hinge_widths_mm, outline_loops, slits_of
from design.pattern.tiling import Array, Place, Tiling, best_place, tile
from design.pattern.tubes import period_mm, tile_tube
from design.predicted import Predicted, predict
from design.spec import DesignSpec, Region
from design.surface import TriMesh
from design.watch import Watch, unwatched

SCALE_ROUNDS_COUNT = 24
SCALE_MARGIN_RATIO = 2e-4  # kept from the end of the library, so that cells come to lie just inside it
CONTACT_FRAC = 1e-4  # of the material lying on other material: less is rounding
HINGE_SAME_MM = 1e-6
WIDENING_ROUNDS_COUNT, WIDENING_SAME_RATIO = 4, 1e-3  # 1e-3 of expansion moves a hinge by a micrometre
PUBLISHED_HIGH_RATIO = 1.75  # what the published pipeline scales the greatest expansion to


@dataclass(frozen=True, slots=True)
class Cells:
    """The tiling on the sheet and what each cell is, `(k,)` arrays."""

    tiling: Tiling
    wanted_ratio: Array
    choice: Choice
    hinge_mm: Array
    kind: tuple[str, ...]  # cut, passive (no slits) or monostable (slits that close again)

    def cut(self) -> NDArray[np.bool_]:
        """Say which cells have slits."""
        return np.array([kind != "passive" for kind in self.kind])

    def bistable(self) -> NDArray[np.bool_]:
        """Say which cells stay open."""
        return np.array([kind == "cut" for kind in self.kind])


@dataclass(frozen=True, slots=True)
class SheetCut:
    """One of several sheets of a design: what is drawn on it, in its own millimetres, and its program."""

    drawing: Drawing
    job: Job


@dataclass(frozen=True, slots=True)
class Design:
    """Everything a design folder holds, before it is written."""

    spec: DesignSpec
    sheet: Sheet
    mesh: TriMesh
    flattening: Flattening  # its flat lies on the sheet
    cells: Cells
    drawing: Drawing
    job: Job
    predicted: Predicted | None
    findings: tuple[Finding, ...]
    library_hash: str
    sheets: tuple[SheetCut, ...] = ()  # where the whole is larger than the bed


def build(
    spec: DesignSpec,
    mesh: TriMesh,
    library: CellLibrary,
    presets: Mapping[Layer, LayerPreset],
    watch: Watch = unwatched,
    findings: Iterable[Finding] = (),
    report: FeasibilityReport | None = None,
) -> Design:
    """Return the design of `mesh`; raise a `DesignError` that carries the findings where there is none.

    `library` must be that of the sheet to cut, with cells of `spec.cell_mm`; `presets` say how each layer is cut;
    `findings` are those of reading the inputs, `report` is the ladder where it was climbed before.
    """
    watch("flattening the surface", 0.0)
    found = list(findings)
    base, library, curve, wide = cells_on_offer(spec, library)
    found += hinge_range(base, library)
    flat = lay_flat(spec, mesh, curve, found, report)
    watch("choosing cells", 0.2)
    flat, tiling, wanted, choice = choose(spec, flat, base, curve, found, wide)
    if spec.compensate:
        cut = np.array([kind == "cut" for kind in kinds_of(spec, tiling)])
        rim: Support = "free" if spec.compensate is True else spec.compensate
        wanted, choice = compensated(flat, tiling, wanted, choice, cut, library, curve, wide, found, watch, rim)
    hinge = hinges_mm(spec, choice, library)
    if curve is None and np.abs(hinge - base.sheet.hinge_mm).max() > HINGE_SAME_MM:
        choice, changed = as_cut(base, choice, hinge)
        found += changed
    found += contact_findings(spec, choice, library)
    watch("drawing slits", 0.4)
    cells = with_monostable(Cells(tiling, wanted, choice, hinge, kinds_of(spec, tiling)), library, found)
    drawing, shift, labelled, parted = draw(spec, cells, library.sheet, flat)
    found += sheet_findings(spec, drawing, flat, labelled, parted)
    cells = replace(cells, tiling=tiling.moved(shift))
    placed = flat.moved_to(flat.flat_mm + shift)
    watch("ordering the cut", 0.5)
    options = JobOptions(tool=spec.tool, spread_mm=spec.spread_mm)
    job = compose_job(drawing, presets, options, remarks=[spec.name])
    sheets = tuple(
        SheetCut(one, compose_job(one, presets, options, remarks=[f"{spec.name}, sheet {k + 1}"]))
        for k, one in enumerate(parted.drawings if parted else ())
    )
    predicted = None
    if spec.response is not None:
        watch("deploying the sheet", 0.6)
        predicted = predict(placed, cells.tiling, choice, cells.bistable(), library, spec.response, watch)
        found += predicted.findings
    return Design(spec, base.sheet, mesh, placed, cells, drawing, job, predicted, tuple(found), library.hash, sheets)


def cells_on_offer(
    spec: DesignSpec, library: CellLibrary
) -> tuple[CellLibrary, CellLibrary, SelectionCurve | None, Widening | None]:
    """Return the library as given and for the design's hinges, the curve of cells, and what a widening hinge needs.

    The published rule has no curve: it takes the library's own entries, whatever the hinge.
    """
    if spec.cells == "contracting":
        return library, library, selection_curve(library, spec.selection), None
    hinge = hinge_of(spec.hinge, library)
    if hinge.rule == "constant" and abs(hinge.width_mm - library.sheet.hinge_mm) < HINGE_SAME_MM:
        curve = None if spec.selection.rule == "published" else selection_curve(library, spec.selection)
        return library, library, curve, None
    cut = hinged(library, hinge)
    if spec.selection.rule == "published":
        return library, cut, None, None
    if hinge.rule == "constant":
        return library, cut, selection_curve(cut, spec.selection), None
    wide = widening(library, hinge, spec.selection)
    return library, cut, wide.curve(), wide


def hinges_mm(spec: DesignSpec, choice: Choice, library: CellLibrary) -> Array:
    """Return the hinge of every cell `(k,)`; a contracting cell's is the slit cell's, drawn smaller with its unit."""
    if spec.cells == "expanding":
        return hinge_widths_mm(choice.expansion_ratio, hinge_of(spec.hinge, library))
    return library.sheet.hinge_mm / at_cells(library, "open_ratio", choice.t_mm, choice.theta_rad)


def contact_findings(spec: DesignSpec, choice: Choice, library: CellLibrary) -> list[Finding]:
    """Return whether contracting cells would lie on themselves once they have closed."""
    if spec.cells == "expanding":
        return []
    overlap = at_cells(library, "overlap_frac", choice.t_mm, choice.theta_rad)
    touching = int((overlap > CONTACT_FRAC).sum())
    if not touching:
        return [Finding("CELLS-CONTACT", "no contracting cell touches itself when it has closed", "info")]
    text = f"{touching} cells lie on themselves when closed, {overlap.max():.1%} of the material at worst"
    return [Finding("CELLS-CONTACT", f"{text}; they will close less than predicted", "warning")]


def lay_flat(
    spec: DesignSpec,
    mesh: TriMesh,
    curve: SelectionCurve | None,
    found: list[Finding],
    report: FeasibilityReport | None = None,
) -> Flattening:
    """Return the flat of `mesh`, by the first rung of the ladder on which the library's range is enough.

    Raises `OutOfLibrary` with what the ladder found where it ends before that. Cones that the specification asks for
    are placed without climbing, and a flat or a rim that is given is taken as it is.
    """
    given = spec.flatten.given_mm is not None or spec.flatten.boundary == "prescribed"
    if curve is None or spec.flatten.cones_count or given:
        flat = flatten(mesh, spec.flatten)
        found += flat.findings
        return flat
    low, high = curve.range_ratio()
    report = report or feasibility(mesh, Limits(low, high, spec.cell_mm), spec.flatten, spec.remedy())
    flat = report.flattening()
    found += [finding for finding in report.findings if finding not in found]
    found += [finding for finding in flat.findings if finding not in found]
    if report.best() is None:
        expansion = flat.expansion_ratio / report.scale_ratio
        raise OutOfLibrary(float(expansion.min()), float(expansion.max()), (low, high), found)
    return flat


def choose(
    spec: DesignSpec,
    flat: Flattening,
    library: CellLibrary,
    curve: SelectionCurve | None,
    found: list[Finding],
    wide: Widening | None = None,
) -> tuple[Flattening, Tiling, Array, Choice]:
    """Return the flat in its final scale and place, its cells, what they must expand by, and the cells chosen."""
    if curve is None:
        tiling = tile(flat.flat_mm, flat.faces, spec.cell_mm).compact()
        wanted = averaged(tiling, flat.flat_mm, flat.faces, flat.expansion_ratio**2, spec.averaging)
        wanted *= PUBLISHED_HIGH_RATIO / wanted.max()
        choice = select(library, wanted, spec.selection)
        found.append(
            Finding("SCALE-PUBLISHED", "the flat was not scaled with the expansions, as published", "warning",
                    hint="the deployed sheet has not the target's size; take another selection rule for that")
        )  # fmt: skip
        return flat, tiling, wanted, choice
    placed, tiling, wanted = scaled(spec, flat, curve, found)
    for _ in range(WIDENING_ROUNDS_COUNT if wide is not None else 0):
        assert wide is not None
        span = float(wanted.min()), float(wanted.max())
        curve = wide.curve(span)
        again: list[Finding] = []
        placed, tiling, wanted = scaled(spec, flat, curve, again)
        if max(abs(wanted.min() - span[0]), abs(wanted.max() - span[1])) < WIDENING_SAME_RATIO:
            break
    return placed, tiling, wanted, on_curve(curve, wanted)


def scaled(
    spec: DesignSpec, flat: Flattening, curve: SelectionCurve, found: list[Finding]
) -> tuple[Flattening, Tiling, Array]:
    """Return the flat scaled so that the cells' expansions lie where the specification wants them in the library.

    Expansions depend on where cells fall, and that on the scale: repeated until the end of the range is met. Raises
    `OutOfLibrary` where the cells ask for a greater spread than the library has.
    """
    low, high = curve.range_ratio()
    room = (low * (1 + SCALE_MARGIN_RATIO), high * (1 - SCALE_MARGIN_RATIO))
    first = _faces_range(flat)
    if first[1] / first[0] > high / low:
        raise OutOfLibrary(*first, (low, high), found)
    flat = flat.scaled(1 / factor(*first, room, spec.scale))
    check_count(flat, spec.cell_mm, found)
    if period_mm(flat) is not None:
        return scaled_tube(spec, flat, (low, high), found)
    place = Place()
    if spec.placement == "optimised":
        place, misfit = best_place(flat.flat_mm, flat.faces, spec.cell_mm)
        found.append(Finding("TILE-FIT", f"flat and cells differ on {misfit:.1%} of the flat's area", "info"))
    flat = flat.moved_to(place.put(flat.flat_mm))
    fits: list[tuple[float, Flattening, Tiling, Array]] = []
    for done_count in range(SCALE_ROUNDS_COUNT):
        tiling = tile(flat.flat_mm, flat.faces, spec.cell_mm, place.shift_mm)
        wanted = averaged(tiling, flat.flat_mm, flat.faces, flat.expansion_ratio**2, spec.averaging)
        change = factor(float(wanted.min()), float(wanted.max()), room, spec.scale)
        if low <= wanted.min() and wanted.max() <= high:
            fits.append((abs(change - 1), flat, tiling, wanted))
        if abs(change - 1) < SCALE_MARGIN_RATIO or wanted.max() / wanted.min() > high / low:
            break
        # Border cells that come and go with the scale can make whole steps alternate for ever; half steps end that.
        flat = flat.scaled(1 / (change if done_count < SCALE_ROUNDS_COUNT // 2 else change**0.5))
    if not fits:
        raise OutOfLibrary(float(wanted.min()), float(wanted.max()), (low, high), found)
    _, flat, tiling, wanted = min(fits, key=lambda fit: fit[0])
    return flat, tiling.compact(), wanted


def scaled_tube(
    spec: DesignSpec, flat: Flattening, limits_ratio: tuple[float, float], found: list[Finding]
) -> tuple[Flattening, Tiling, Array]:
    """Return a tube's flat at the scale nearest to the wanted end at which a whole number of cells goes around."""
    low, high = limits_ratio
    scales = flat.whole_cell_scales(spec.cell_mm, 0.8, 1.25)
    for count, scale in sorted(scales, key=lambda item: abs(np.log(item[1]))):
        scaled_flat = flat.scaled(scale)
        tiling = tile_tube(scaled_flat, spec.cell_mm)
        points, faces, copy = scaled_flat.unrolled()
        area_ratio = scaled_flat.expansion_ratio[copy] ** 2
        wanted = averaged(tiling, points, faces, area_ratio, spec.averaging)
        if low <= wanted.min() and wanted.max() <= high:
            found.append(Finding("TUBE-CELLS", f"{count} cells go around; the seam joins cell to cell", "info"))
            return scaled_flat, tiling, wanted
    raise OutOfLibrary(*_faces_range(flat), limits_ratio, found)


def _faces_range(flat: Flattening) -> tuple[float, float]:
    """Return the expansions between which all but the outermost hundredth of the area lies, as a first guess."""
    order = np.argsort(flat.expansion_ratio)
    area = np.cumsum(flat.mesh.face_areas_mm2()[order])
    first, last = np.searchsorted(area, [0.01 * area[-1], 0.99 * area[-1]])
    return float(flat.expansion_ratio[order[first]]), float(flat.expansion_ratio[order[min(last, len(order) - 1)]])


def kinds_of(spec: DesignSpec, tiling: Tiling) -> tuple[str, ...]:
    """Return what each cell is: cut, monostable or passive, the last where regions overlap."""
    passive, monostable = within(spec.passive, tiling), within(spec.monostable, tiling)
    return tuple(np.select([passive, monostable], ["passive", "monostable"], "cut").tolist())


def within(regions: Sequence[Region], tiling: Tiling) -> NDArray[np.bool_]:
    """Say which cells have their middle in one of the circles."""
    middle = (tiling.vertices_mm.min(axis=0) + tiling.vertices_mm.max(axis=0)) / 2
    from_middle = tiling.centres_mm() - middle
    found = np.zeros(len(tiling.cells), dtype=bool)
    for region in regions:
        found |= np.linalg.norm(from_middle - [region.x_mm, region.y_mm], axis=1) < region.radius_mm
    return found


def with_monostable(cells: Cells, library: CellLibrary, found: list[Finding]) -> Cells:
    """Return the cells with those that are to spring back replaced by cells that the library knows to do so."""
    mono = np.array([kind == "monostable" for kind in cells.kind])
    if not mono.any():
        return cells
    choice = cells.choice
    t_mm, theta_rad, expansion_ratio = choice.t_mm.copy(), choice.theta_rad.copy(), choice.expansion_ratio.copy()
    t_mm[mono], theta_rad[mono] = monostable_cells(library, choice.theta_rad[mono])
    expansion_ratio[mono] = 1.0
    stiffness_mJ, barrier_mJ = np.where(mono, 0.0, choice.stiffness_mJ), np.where(mono, 0.0, choice.barrier_mJ)
    text = f"{int(mono.sum())} cells have slits but spring back to flat; the prediction takes them as uncut"
    found.append(Finding("CELLS-MONOSTABLE", text, "warning", hint="they are softer than that: take shape with care"))
    return replace(cells, choice=Choice(t_mm, theta_rad, expansion_ratio, stiffness_mJ, barrier_mJ))


def sheet_findings(
    spec: DesignSpec, drawing: Drawing, flat: Flattening, labelled: Sequence[Pair], parted: Split | None
) -> list[Finding]:
    """Return what is doubtful about the sheet as it is drawn, and which labels help to join it."""
    found = []
    if drawing.id_anchor is None and spec.border.id_height_mm > 0:
        found.append(Finding("ID-PLACE", "no lower edge has room for the tag: no id can be engraved", "warning"))
    if spec.bed_mm is not None and not fits(drawing.size_mm, spec.bed_mm):
        found.append(bed_finding(drawing, spec.bed_mm, parted))
    open_seams = [seam for seam in flat.seams if not seam.closes_tube]
    if open_seams:
        text = f"the flat has {len(open_seams)} seam(s) to cones; cells do not run on across them"
        found.append(Finding("SEAM-OPEN", text, "warning", hint="join the seam's two sides by hand"))
    if flat.seams and labelled:
        text = f"{len(labelled)} pairs of cells that meet are labelled, {labelled[0].label} to {labelled[-1].label}"
        found.append(Finding("SEAM-LABELS", text, "info"))
    elif flat.seams:
        found.append(Finding("SEAM-LABELS", "no cell along the seams has room for a label", "warning"))
    return found


def bed_finding(drawing: Drawing, bed_mm: tuple[float, float], parted: Split | None) -> Finding:
    """Return what follows from a sheet that is larger than the bed."""
    width, height = drawing.size_mm
    text = f"the sheet of {width:.0f} × {height:.0f} mm is larger than the bed of {bed_mm[0]:g} × {bed_mm[1]:g} mm"
    if parted is None:
        hint = "take smaller cells, the high end of expansions, cones"
        return Finding(
            "SHEET-BED", f"{text}, and no part of it with its tag and margins is small enough", "warning", hint=hint
        )
    count, labels = len(parted.drawings), len(parted.pairs)
    text = f"{text}: it is split over {count} sheets, and {labels} pairs of cells that meet are labelled 1 to {labels}"
    return Finding(
        "SHEET-SPLIT", text, "warning", hint="cut each by `--sheet N`; join the sheets before they are opened"
    )


def draw(
    spec: DesignSpec, cells: Cells, sheet: Sheet, flat: Flattening
) -> tuple[Drawing, Array, list[Pair], Split | None]:
    """Return the drawing of the cells with everything around them, by how much it moved them, and the seams' labels.

    Where it is larger than the bed, also how it is split over sheets, if it can be.
    """
    tiling, choice, cut = cells.tiling, cells.choice, cells.cut()
    cuts: Cuts
    if spec.cells == "contracting":
        cuts = holes_of(tiling, openings(choice.t_mm, choice.theta_rad, sheet), cut)
    else:
        cuts = slits_of(tiling, choice.t_mm, choice.theta_rad, cells.hinge_mm, sheet.slit_mm, cut)
    inside = cuts.inside(tiling, cut)
    piece, closed = notched(piece_of(outline_loops(tiling), spec.border.margin_mm), inside.halves)
    paths = inside.paths + closed
    mouths = np.array([path.points_mm[-1] for path in paths if path.opens]).reshape(-1, 2)
    labels, labelled = label_paths(tiling, cuts, cut, seam_pairs(tiling, flat))
    drawing, shift = framed(piece, mouths, paths + labels, spec.border, spec.cell_mm)
    parted = None
    if spec.bed_mm is not None and not fits(drawing.size_mm, spec.bed_mm):
        parted = split(tiling, cuts, cut, spec.border, spec.bed_mm, labels)
    return drawing, shift, labelled, parted
