"""`sioms tactile design|reproduce|calibrate|score|shape|experiment`: work with elastic cylindrical fingers from the
shell.

Long work tells on stderr what it is doing; reports are single HTML pages.  Numerical and drawing libraries
are imported when a subcommand runs, not before.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from sioms.arguments import not_negative, positive, whole


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the `tactile` command to the `sioms` parser."""
    parser = subparsers.add_parser("tactile", help="design, calibrate and measure elastic fingers")
    commands = parser.add_subparsers(dest="tactile_command", required=True, metavar="COMMAND")

    design = commands.add_parser("design", help="predict the accuracy of a finger design")
    design.add_argument("--core-mm", type=positive, default=9.6, help="core radius (default 9.6)")
    design.add_argument("--outer-mm", type=positive, default=12.7, help="outer radius (default 12.7)")
    design.add_argument("--depth-mm", type=positive, default=2.4, help="effective depth of the elements (default 2.4)")
    design.add_argument("--elements", type=whole(1), default=16, help="number of elements (default 16)")
    design.add_argument("--pitch-deg", type=positive, default=9.22, help="angle between elements (default 9.22)")
    design.add_argument("--poisson", type=not_negative, default=0.46, help="Poisson's ratio (default 0.46)")
    design.add_argument("--shear-pa", type=positive, default=8.3e4, help="shear modulus in Pa (default 8.3e4)")
    design.add_argument("--noise-percent", type=positive, default=0.1, help="strain noise in per cent (default 0.1)")
    design.add_argument("-o", "--output", type=Path, default=Path("design.html"), help="report (default design.html)")

    reproduce = commands.add_parser(
        "reproduce", help="recompute the published figures and tables, beside the published values"
    )
    reproduce.add_argument("-o", "--output", type=Path, default=Path("reproduce.html"), help="report")
    reproduce.add_argument("--quick", action="store_true", help="a tenth of the Monte Carlo frames")

    calibrate = commands.add_parser("calibrate", help="calibrate a finger from recorded touches")
    calibrate.add_argument("data", type=Path, help="folder with recordings (*.npz) and nominal.json or nominal.toml")
    calibrate.add_argument("-o", "--output", type=Path, default=Path("finger.toml"), help="calibrated finger")
    calibrate.add_argument("-r", "--report", type=Path, help="report (default: the output's name with .html)")
    calibrate.add_argument(
        "--contact",
        choices=("frictionless", "adhering", "hertz"),
        help="contact model, instead of choosing it from the data",
    )
    calibrate.add_argument("--no-map", action="store_true", help="do not identify the E map directly")
    calibrate.add_argument("--edge-deg", type=positive, default=45.0, help="half angle of the edge (default 45)")

    calibrate.add_argument(
        "--doubtful", action="store_true", help="write the finger even if the calibration is refused"
    )

    score = commands.add_parser("score", help="calibrate with part of the touches, test on the rest, print a table")
    score.add_argument("data", type=Path, nargs="+", help="folders of recordings, or folders of such folders")
    score.add_argument("--truth", type=Path, help="folder with the truth of generated data, NAME.json")
    score.add_argument("--jobs", type=whole(1), help="processes (default: one for each core)")
    score.add_argument("--edge-deg", type=positive, default=45.0, help="half angle of the edge (default 45)")

    shape = commands.add_parser("shape", help="fit recorded frames on all cores: a table of what touched")
    shape.add_argument("data", type=Path, nargs="+", help="recordings (*.npz with raw and time), or folders of them")
    shape.add_argument("--finger", type=Path, required=True, help="calibrated finger (from calibrate)")
    shape.add_argument("-o", "--output", type=Path, default=Path("shapes.csv"), help="table (default shapes.csv)")
    shape.add_argument("--jobs", type=whole(1), help="processes (default: one for each core)")
    shape.add_argument("--settle", type=whole(1), default=20, help="untouched frames averaged (default 20)")
    shape.add_argument(
        "--load-deviation",
        type=not_negative,
        metavar="N/M",
        help="use the recorded force, known to this deviation in N/m",
    )
    shape.add_argument("--plain", action="store_true", help="fit in plain numpy even where numba is installed")

    experiment = commands.add_parser(
        "experiment",
        help="probe a simulated finger through the daemon, calibrate it, tabulate it beside the published one",
    )
    experiment.add_argument("-o", "--output", type=Path, default=Path("finger"), help="folder (default finger)")
    experiment.add_argument("--quick", action="store_true", help="about a fifth of the touches")
    experiment.add_argument(
        "--finger",
        help='fields of the simulated finger, "gain = 3.0; creep = 0.1" (default: faults as published)',
    )
    experiment.add_argument("--recorded", action="store_true", help="tabulate what is in the folder; probe nothing")


def run(args: argparse.Namespace) -> int:
    """Run the chosen subcommand; return the exit status, 1 with a message for what the user can mend."""
    try:
        match args.tactile_command:
            case "design":
                from sioms.tactile.command.design import design

                return design(args)
            case "reproduce":
                from sioms.tactile.command.reproduce import reproduce

                return reproduce(args)
            case "calibrate":
                from sioms.tactile.command.calibrate import calibrate

                return calibrate(args)
            case "score":
                from sioms.tactile.command.score import score

                return score(args)
            case "shape":
                from sioms.tactile.command.shape import shape

                return shape(args)
            case "experiment":
                from sioms.tactile.command.experiment import experiment

                return experiment(args)
    except (ValueError, OSError, KeyError, RuntimeError) as error:
        print(f"sioms tactile {args.tactile_command}: {_sentence(error)}", file=sys.stderr)
        return 1
    raise AssertionError(args.tactile_command)


def _sentence(error: Exception) -> str:
    """Return what an error says, without its number; of a file also which."""
    if not isinstance(error, OSError) or not error.strerror:
        return str(error)
    return f"open {error.filename}: {error.strerror.lower()}" if error.filename else error.strerror
