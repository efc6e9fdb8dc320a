"""``sioms driver check``: which drivers, in how many processes, and where the report goes."""

from __future__ import annotations

import argparse
import json
import os
import shlex
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from sioms.children import ends_with_us
from sioms.wording import did_you_mean

from .check import Subject, check, trial_names
from .golden import ProbeFailed, probe
from .report import line_of, write_report
from .rigs import MAP_RIGS, RIGS, Rig, find_rig, rig_of
from .trial import Verdict

USAGE = 2
GROUP = "sioms.drivers"


class Unusable(Exception):
    """What was asked for cannot be checked; one sentence."""


def run_check(args: argparse.Namespace) -> int:
    """Check drivers; return 0 when none failed, 1 when one did, 2 for what cannot be checked."""
    names = [rig.title for rig in (*RIGS, *MAP_RIGS)] if args.all else args.drivers
    only = [name.strip() for name in args.only.split(",") if name.strip()]
    try:
        if not names:
            raise Unusable("no driver named; name one, or --all")
        unknown = [name for name in only if name not in trial_names()]
        if unknown:
            raise Unusable(f"no trial {unknown[0]}; there are: {', '.join(trial_names())}")
        reports = [_one(names[0], args, only)] if len(names) == 1 else _many(names, args)
    except Unusable as error:
        print(f"sioms driver check: {error}", file=sys.stderr)
        return USAGE
    if args.json:
        args.json.write_text(json.dumps(reports, indent=1) + "\n", encoding="utf-8")
    if args.report:
        write_report(args.report, reports)
    failed = [
        f"{r['driver']}: {t['name']}" for r in reports for t in r["trials"] if t["verdict"] == Verdict.FAILED.value
    ]
    tried = sum(t["verdict"] != Verdict.NOT_APPLICABLE.value for r in reports for t in r["trials"])
    print(f"\n{tried} trials, {len(failed)} failed" + (f": {', '.join(failed)}" if failed else ""))
    return 1 if failed else 0


def _one(name: str, args: argparse.Namespace, only: list[str]) -> dict[str, Any]:
    """Check one driver in this process, and print its trials as they end."""
    subject = subject_of(name, args.simulator, args.config)
    place = subject.rig.kernel
    if place and not args.simulator and not os.access(place, os.W_OK):
        lacks = "you may not write" if os.path.exists(place) else "this one has no"
        raise Unusable(
            f"{name}: its device is simulated by the kernel, and {lacks} {place}; run it as root where there is one, "
            "or have tests/kernel/run.py start a kernel that has"
        )
    print(f"{name}: {'all trials' if args.full else 'quick trials'}", flush=True)
    results = check(subject, full=args.full, only=only, told=lambda result: print(line_of(result), flush=True))
    return {"driver": name, "full": args.full, "trials": [result.as_dict() for result in results]}


def _many(names: list[str], args: argparse.Namespace) -> list[dict[str, Any]]:
    """Check drivers in processes of their own, some at a time; what each says is printed when it has ended."""

    running: list[subprocess.Popen[str]] = []

    def one(name: str) -> dict[str, Any]:
        with tempfile.TemporaryDirectory(prefix="sioms-check-") as folder:
            out = Path(folder) / "out.json"
            command = [
                sys.executable,
                "-P",
                "-m",
                "sioms.tools.front",
                "driver",
                "check",
                name,
                "--json",
                str(out),
            ]
            command += ["--full"] if args.full else []
            command += ["--only", args.only] if args.only else []
            with subprocess.Popen(
                command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=ends_with_us()
            ) as process:
                running.append(process)
                said, complaint = process.communicate()
            print(said.rpartition("\n\n")[0] + complaint.rstrip(), flush=True)
            if not out.exists():
                raise Unusable(f"{name}: {(complaint.strip().splitlines() or ['it ended without a report'])[-1]}")
            report: dict[str, Any] = json.loads(out.read_text(encoding="utf-8"))[0]
            return report

    with ThreadPoolExecutor(max(1, args.jobs)) as pool:
        try:
            return list(pool.map(one, names))
        except BaseException:  # also when we are told to end
            pool.shutdown(wait=False, cancel_futures=True)
            for process in running:
                process.terminate()
            raise


def subject_of(name: str, simulator: str = "", config: Path | None = None) -> Subject:
    """Find the rig of a driver: the shipped one, the one that its class names, or what the options say.

    Args:
        name: registered name, register map, or path of a Python file.
        simulator: instead of the rig's: module or file, and options.
        config: TOML of the device instead of the rig's.

    Raises:
        Unusable: there is no such driver, or nothing says how it is configured.
    """
    is_file = name.endswith(".py") or "/" in name
    path = Path(name).resolve()
    folder = path.parent if is_file else None
    if path.suffix == ".toml":
        raise Unusable(
            f"{name}: a register map is checked with its driver: give modbus-axis or modbus-io, and in a --config FILE "
            "a "
            f'device with map = "{name}"; --simulator "COMMAND" names what simulates it'
        )
    rig = _named_by_class(path) if is_file else find_rig(name)
    if rig is None and not is_file:
        rig = _registered(name)
    if config is not None:
        tables = config.read_text(encoding="utf-8")
        rig = (
            Rig(str(path) if is_file else name, tables)
            if rig is None
            else replace(rig, tables=tables, axes=(), outputs=())
        )
    if rig is None:
        raise Unusable(
            f"{name}: nothing says how it is configured; set the class attribute rig, or give --config and --simulator"
        )
    if simulator:
        rig = replace(rig, simulator=tuple(shlex.split(simulator)), tcp=rig.line in ("tcp", "udp"))
    return Subject(name, rig, folder)


def _named_by_class(path: Path) -> Rig | None:
    try:
        keys = probe(path.name, path.parent)["rig"]
        return replace(rig_of({"driver": str(path), **keys})) if keys else None
    except (ProbeFailed, ValueError) as error:
        raise Unusable(str(error)) from None


def _registered(name: str) -> Rig | None:
    installed = {entry.name for entry in entry_points(group=GROUP)}
    if name not in installed:
        known = sorted(installed | {rig.title for rig in (*RIGS, *MAP_RIGS)})
        near = did_you_mean(name, known) or f"; there are: {', '.join(known)}"
        raise Unusable(f"{name}: no driver or register map of this name{near}")
    try:
        keys = probe(name)["rig"]
        return rig_of({"driver": name, **keys}) if keys else None
    except (ProbeFailed, ValueError) as error:
        raise Unusable(str(error)) from None
