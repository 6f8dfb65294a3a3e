"""A coupon, asked for: `coupon.yaml` in its folder says what it was made from and how it is cut."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from fabctl.config.bench import Positive
from fabctl.config.loader import Model
from fabctl.config.spec import ToolConfig


class CouponConfig(Model):
    """Uniform patches of the cell that a library chooses for one expansion, a hinge width each."""

    name: str = "coupon"
    material: str = "natural-rubber-2.3"
    expansion_ratio: Annotated[float, Field(gt=1)] = 1.5
    hinges_mm: tuple[Positive, ...]
    library: str | None = None
    tool: ToolConfig = ToolConfig()
