"""The lab's one tool for bistable auxetic surface structures: design, cut, test, scan, report."""

__version__ = "0.1.0"
