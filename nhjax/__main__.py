"""The command line of nhjax, with the commands `nhjax list` and `nhjax run STUDY`."""

import argparse
import inspect
import json
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax

from . import __version__
from ._errors import IntegrationError
from ._method import CLOSURES
from .studies import ArgumentError, plan, QUICK, shown, STUDIES, write


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    arguments = _parser().parse_args(argv)
    if arguments.command == "list":
        for name, study in STUDIES.items():
            print(f"{name:<16}{_headline(study)}")
        return 0
    # The studies reach errors of 1e-16, which float32 cannot show.
    jax.config.update("jax_enable_x64", True)
    return _run(**vars(arguments))


def _run(
    command: str,
    study: str,
    parser: argparse.ArgumentParser,
    out: Path | None,
    json_output: bool,
    progress: bool | None,
    quick: bool,
    length_in_steps: int | None = None,
    **options: Any,
) -> int:
    del command
    function = STUDIES[study]
    out = Path("nhjax-results") / study if out is None else out
    if progress is None:
        progress = sys.stderr.isatty()
    if quick:
        options = {**QUICK[study], **options}
    try:
        if length_in_steps is not None:
            if length_in_steps < 1:
                parser.error(
                    f"argument --num-steps: must be at least 1: {length_in_steps}"
                )
            dt = options.get("dt", inspect.signature(function).parameters["dt"].default)
            options["final_time"] = length_in_steps * max(dt)
        # Create the folder before the computation, so that an error appears at once.
        out.mkdir(parents=True, exist_ok=True)
        if not json_output:
            print(plan(study, function, options), end="\n\n", flush=True)
        result = function(progress=progress, **options)
    except ArgumentError as error:
        name = error.argument.replace("_", "-")
        if length_in_steps is not None and name == "final-time":
            name = "num-steps"
        parser.error(f"argument --{name}: {error.problem}")
    except OSError as error:
        parser.error(f"argument --out: {error}")
    except IntegrationError as error:
        print(f"nhjax: {error}", file=sys.stderr)
        return 1
    record = write(result, out)
    if json_output:
        print(json.dumps(record, indent=2))
    else:
        print(f"{result.table()}\n\nVerdict: {result.verdict()}.")
        files = record["files"]
        for path in (*files["figures"], files["data"], files["record"]):
            print(f"wrote {path}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="nhjax",
        description="Experiments with integrators for nonholonomic systems.",
    )
    parser.add_argument("--version", action="version", version=__version__)
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    commands.add_parser("list", help="list the studies")
    run = commands.add_parser("run", help="run a study and write its results")
    studies = run.add_subparsers(dest="study", metavar="STUDY", required=True)
    for name, function in STUDIES.items():
        headline = _headline(function)
        study = studies.add_parser(name, help=headline, description=headline)
        study.set_defaults(parser=study)
        _add_options(study, function)
    return parser


def _add_options(parser: argparse.ArgumentParser, function: Callable) -> None:
    parameters = inspect.signature(function).parameters
    # Studies with a `final_time` also accept the length of the run as a number of
    # steps. Studies that set the length in steps have their own option for it.
    length = (
        parser.add_mutually_exclusive_group() if "final_time" in parameters else None
    )
    for name, parameter in parameters.items():
        if name == "progress":
            continue
        default = parameter.default
        told = "" if default is None else f" (default: {shown(default)})"
        keywords = dict(_OPTIONS[name])
        keywords["help"] += told
        group = length if length and name == "final_time" else parser
        # Without the option, the study itself supplies the default.
        group.add_argument(
            f"--{name.replace('_', '-')}", default=argparse.SUPPRESS, **keywords
        )
    if length:
        length.add_argument(
            "--num-steps",
            type=int,
            metavar="N",
            dest="length_in_steps",
            default=argparse.SUPPRESS,
            help="instead of --final-time: as long as N steps of the largest step size",
        )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="where to write the results (default: nhjax-results/STUDY)",
    )
    parser.add_argument(
        "--json",
        action="store_true",
        dest="json_output",
        help="print the record of the run, as JSON, instead of a table",
    )
    parser.add_argument(
        "--quick",
        action="store_true",
        help="a small form of the study; other options override its values",
    )
    parser.add_argument(
        "--progress",
        action=argparse.BooleanOptionalAction,
        help="progress bars on the standard error stream (default: on a terminal)",
    )


def _number(text: str) -> float:
    """Parse a float or "pi", which may be divided by a number, as in pi/10."""
    numerator, slash, denominator = text.partition("/")
    value = math.pi if numerator == "pi" else float(numerator)
    divisor = float(denominator) if slash else 1.0
    if divisor == 0:
        raise ValueError(f"{text} divides by zero")
    return value / divisor


# argparse shows the name of the conversion function in its error messages.
_number.__name__ = "number"

_OPTIONS: dict[str, dict[str, Any]] = {
    "stages": {"type": int, "nargs": "+", "metavar": "S", "help": "numbers of stages"},
    "dt": {
        "type": _number,
        "nargs": "+",
        "metavar": "H",
        "help": "step sizes, such as 0.1 or pi/10",
    },
    "final_time": {"type": _number, "metavar": "T", "help": "the length of the runs"},
    "num_steps": {
        "type": int,
        "metavar": "N",
        "help": "the length of every run in steps",
    },
    "retraction": {"metavar": "NAME", "help": "cayley or exponential"},
    "members": {
        "type": int,
        "metavar": "J",
        "help": "the ensemble holds the members 0..J",
    },
    "closure": {
        "choices": CLOSURES,
        "help": "how the multiplier is closed from step to step",
    },
    "times": {
        "type": _number,
        "nargs": "+",
        "metavar": "T",
        "help": "when to report the error (default: 10 50 100 200, within the run)",
    },
    "save_every": {
        "type": int,
        "metavar": "K",
        "help": "save the energies after every K steps",
    },
    "system": {"metavar": "NAME", "help": "particle or sleigh"},
    "regimes": {"nargs": "+", "metavar": "REGIME", "help": "low and high energy"},
    "epsilon": {"type": _number, "metavar": "E", "help": "perturbation of the driver"},
    "short_time": {
        "type": _number,
        "metavar": "T",
        "help": "how much of the run the short-term figures show",
    },
}


def _headline(function: Callable) -> str:
    return (inspect.getdoc(function) or "").partition("\n")[0]


if __name__ == "__main__":
    sys.exit(main())
