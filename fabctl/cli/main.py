"""The command `fabctl`. Each noun is a file in this folder and is imported only when it is asked for."""

from __future__ import annotations

import importlib
import io
import sys

import click

from fabctl import __version__
from fabctl.cli.finite import finite

# noun -> (module, one line of help); the line stands here so that `fabctl --help` imports nothing else.
NOUNS: dict[str, tuple[str, str]] = {
    "flow": ("fabctl.cli.flow", "Design, cut, indent, scan and report one specimen."),
    "target": ("fabctl.cli.target", "Make target surfaces: cap, double-bump, saddle, vase and more."),
    "design": ("fabctl.cli.design", "Turn a target surface into a cut sheet; check, compare, coupon."),
    "library": ("fabctl.cli.library", "Build, look into and compare the library of bistable cells."),
    "deploy": ("fabctl.cli.deploy", "Predict the deployed shape, its sag and its response."),
    "cut": ("fabctl.cli.cut", "Cut a design on the laser."),
    "laser": ("fabctl.cli.laser", "Talk to the laser: info, home, jog, frame, settings, test grid."),
    "kerf": ("fabctl.cli.kerf", "Cut and measure kerf coupons."),
    "camera": ("fabctl.cli.camera", "Boards, lens calibration and bed alignment."),
    "specimen": ("fabctl.cli.specimen", "List specimens, note facts, read an engraved id."),
    "rig": ("fabctl.cli.rig", "Talk to the indentation rig: info, jog, tare, home, calibrate."),
    "indent": ("fabctl.cli.indent", "Record and analyse force against displacement."),
    "scan": ("fabctl.cli.scan", "Align a scan with its target and report the deviation."),
    "report": ("fabctl.cli.report", "Write one HTML file about a specimen."),
    "run": ("fabctl.cli.run", "List, show and export run records."),
    "sim": ("fabctl.cli.sim", "Start and stop the simulated devices of a bench."),
    "doctor": ("fabctl.cli.doctor", "Say what of this machine and bench works."),
    "completion": ("fabctl.cli.completion", "Print the shell completion script."),
}


class LazyGroup(click.Group):
    """A group that knows its commands by name and loads each when it is called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the nouns, in the order of the work."""
        return list(NOUNS)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        """Import and return the noun's command."""
        if name not in NOUNS:
            return None
        command: click.Command = importlib.import_module(NOUNS[name][0]).command
        return finite(command)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of nouns without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, line) for name, (_, line) in NOUNS.items()])


@click.command(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="fabctl")
@click.option("--home", metavar="DIR", help="The lab's folder, with runs/ and specimens/ [$FABCTL_HOME, or here].")
@click.pass_context
def cli(ctx: click.Context, home: str | None) -> None:
    """Design, cut, test and scan bistable auxetic surface structures."""
    ctx.obj = home


def main() -> None:
    """Run the command line; every error ends here, as a message and an exit code."""
    from fabctl.cli.common import run_to_the_end

    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # a θ on a terminal that has none ends no command
    sys.exit(run_to_the_end(cli))


if __name__ == "__main__":
    main()
