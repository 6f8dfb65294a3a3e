"""From a design folder and a material to the program of one cut, with the specimen's id engraved. **W**

The id stands on the tag twice: as text for people, and as a pair of small markers that `fabctl specimen read` finds in
a photograph.
"""

from __future__ import annotations

from pathlib import Path

from design.bundle import Bundle, open_bundle
from design.export.gcode import GcodeOptions
from design.job import compose_job
from design.pattern.drawing import Box
from design.pattern.paths import LAYERS, CutPath, Layer, LayerPreset
from fabctl.config.coupon import CouponConfig
from fabctl.config.loader import load
from fabctl.config.material import MaterialConfig, load_material
from fabctl.config.spec import SpecConfig
from fabctl.cut.job import Compose
from fabctl.cut.preflight import Sheet
from fabctl.designing import job_options
from fabctl.vision.ids import LARGEST, id_paths, id_size_modules, number_of

SPOT_MM = 0.1  # of a laser whose bench file is not at hand
PITCH_SPOTS = 1.5  # between strokes that fill an engraved area: charred rubber is wider than the spot


def open_design(path: Path) -> tuple[Bundle, SpecConfig | CouponConfig]:
    """Return the design or coupon in a folder, checked against its hashes, and what it was made from."""
    bundle = open_bundle(path)
    if bundle.kind == "coupon":
        return bundle, load(bundle.file("coupon.yaml"), CouponConfig)
    return bundle, load(bundle.file("spec.yaml"), SpecConfig)


def sheet_of(spec: SpecConfig | CouponConfig, home: Path) -> Sheet:
    """Return the sheet that the design was made for."""
    material = load_material(spec.material, home)
    return Sheet(material.name, material.thickness_mm)


def composer(
    bundle: Bundle,
    spec: SpecConfig | CouponConfig,
    material: MaterialConfig,
    sheet: int | None = None,
    spot_mm: float = SPOT_MM,
) -> Compose:
    """Return the function that makes the program for a specimen's id and a board's full power.

    `sheet`, from 1, is one of those that a design larger than the bed is split over; `spot_mm` is the beam's spot.
    """
    kerf_mm = material.laser.kerf_mm if material.laser is not None else 0.1
    presets = presets_of(material)
    drawing = bundle.drawing(sheet)

    def compose(specimen: str, s_max_count: float) -> tuple[str, ...]:
        options = job_options(spec.tool, kerf_mm, GcodeOptions(s_max_count=s_max_count))
        id_text = specimen if drawing.id_anchor is not None else ""
        code = code_strokes(specimen, drawing.code_box, spot_mm) if id_text and drawing.code_box else []
        return compose_job(drawing, presets, options, id_text, code).lines

    return compose


def code_strokes(specimen: str, box: Box, spot_mm: float) -> list[CutPath]:
    """Return the strokes of the id's two markers, as large as `box` allows and in its middle.

    None for an id beyond the last that two markers can carry; its text is engraved all the same.
    """
    if number_of(specimen) > LARGEST:
        return []
    across, up = id_size_modules()
    module_mm = min(box.width_mm / across, box.height_mm / up)
    x_mm = box.x_mm + (box.width_mm - across * module_mm) / 2
    y_mm = box.y_mm + (box.height_mm - up * module_mm) / 2
    return id_paths(specimen, module_mm, x_mm, y_mm, pitch_mm=PITCH_SPOTS * spot_mm, spot_mm=spot_mm)


def presets_of(material: MaterialConfig) -> dict[Layer, LayerPreset]:
    """Return how each layer is cut; holes are cut as the outline is."""
    laser = material.laser
    if laser is None:
        return {layer: LayerPreset(0.0, 1.0) for layer in LAYERS}  # preflight refuses it; nothing is cut with these
    by_name = {"slit": laser.slit, "outline": laser.outline, "hole": laser.outline}
    by_name |= {"engrave": laser.engrave, "mark": laser.mark}
    return {
        layer: LayerPreset(by_name[layer].power_frac, by_name[layer].feed_mm_s, by_name[layer].passes_count)
        for layer in LAYERS
    }
