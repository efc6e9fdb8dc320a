"""The hand's acceptance in a simulated plane, in one process: the estimator in the loop, the truth as judge.

Numbers of the parts are those of the acceptance: 1 kinematics, 2 rolling, 3 regrasps, 4 classifier, 5 force, 6
ellipses, 7 friction cone; deaths, 8, need a running cell.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sioms.hand.contacts import FINGER_M, Likeness, friction_angle_deviation
from sioms.hand.experiments.force import Loop, answer, measured_limit, quasi_static_limit
from sioms.hand.experiments.regrasps import By, Regrasped, regrasp
from sioms.hand.experiments.rolls import Rolled, closed_form, fits_the_arrays, rigid_time, roll
from sioms.hand.experiments.slips import keep_ellipse, slip
from sioms.hand.experiments.starts import Start
from sioms.hand.kinematics import Hand
from sioms.hand.plane import Rig
from sioms.hand.touch import Failed
from sioms.plant.planar import Mount

from .figures import Bar, Report
from .options import Options

PLACE_RAD = math.radians(0.19)
"""Standard deviation of a place of contact in one frame of the source's finger."""
_LOOPS = {"20 Hz": (Loop(0.05), 3.0), "400 Hz, low-pass of 50 ms": (Loop(2.5e-3, 0.05), 1.0)}
_ALL = (Bar("value", 100.0, at_least=True),)
_WITHIN = (Bar("max", 1.0),)
_CLOSE = (Bar("p90", 5.0),)


def bench_hand(options: Options, report: Report) -> None:
    """Try acceptance 1 to 7."""
    random = np.random.default_rng(options.seed)
    _kinematics(random, report)
    _rigid(random, options, report)
    _rolls(random, options, report)
    _regrasps(random, options, report)
    _force(report)
    _ellipses(options, report)
    _cone(options, report)


def share(good: Sequence[bool]) -> float:
    """Return the share of what is true [%]; 0 of nothing."""
    return 100.0 * sum(good) / max(len(good), 1)


# 1


def _kinematics(random: np.random.Generator, report: Report, poses: int = 10_000) -> None:
    hand, there, back, slope = Hand(), 0.0, 0.0, 0.0
    for _ in range(poses):
        q = [*random.uniform(-0.3, 0.3, 2), random.uniform(-3, 3), random.uniform(0.03, 0.2), *random.uniform(-3, 3, 2)]
        rates = random.uniform(-1.0, 1.0, 6).tolist()
        joints = hand.inverse(q)
        there = max(there, _apart(hand.forward(joints), q))
        turned = hand.joint_rates(q, rates)
        back = max(back, _apart(hand.hand_rates(joints, turned), rates))
        h = 1e-6
        low, high = (hand.inverse([a + s * b for a, b in zip(q, rates, strict=True)]) for s in (-h, h))
        numeric = [(b - a) / (2.0 * h) for a, b in zip(low, high, strict=True)]
        slope = max(slope, max(abs(a - b) for a, b in zip(numeric, turned, strict=True)))
    within = [Bar("value", 1e-12)]
    report.value("1 hand to joints and back: largest error", there, "m, rad", bars=within, notes=f"{poses} poses")
    report.value("1 rates to joints and back: largest error", back, "m/s, rad/s", bars=within, notes=f"{poses} poses")
    report.value("1 rates of joints against differences: largest", slope, "m/s, rad/s", bars=[Bar("value", 1e-8)])


def _apart(found: Sequence[float], wanted: Sequence[float]) -> float:
    pairs = list(zip(found, wanted, strict=True))
    turned = [math.remainder(a - b, math.tau) for a, b in pairs]
    return max(abs(turned[i] if i in (2, 4, 5) else a - b) for i, (a, b) in enumerate(pairs))


# 2


def _start(random: np.random.Generator, likeness: Likeness, most_deg: float = 40.0, least_deg: float = 5.0) -> Start:
    low, high = (0.010, 0.060) if likeness is Likeness.DISK else (0.015, 0.080)
    eta = math.radians(float(random.uniform(least_deg, most_deg)) * float(random.choice((-1.0, 1.0))))
    return Start(likeness, float(random.uniform(low, high)), eta)


def _rigid(random: np.random.Generator, options: Options, report: Report) -> None:
    for likeness in (Likeness.DISK, Likeness.RECTANGLE):
        errors, diverged = [], []
        for _ in range(options.count(4, 50)):
            start = _start(random, likeness)
            errors.append(100.0 * abs(rigid_time(start) / closed_form(start) - 1.0))
            try:
                rigid_time(start, reversed_sign=True)
                diverged.append(False)
            except ValueError:
                diverged.append(True)
        name = f"2 {likeness.value}, rigid"
        report.samples(f"{name}: time off the closed form [%]", errors, "", bars=[Bar("max", 5.0)])
        report.value(f"{name}: never parallel with the sign reversed", share(diverged), "%", bars=_ALL)


def _rolls(random: np.random.Generator, options: Options, report: Report) -> None:
    for likeness in (Likeness.DISK, Likeness.RECTANGLE):
        done, tried, failed = list[Rolled](), 0, list[str]()
        while tried < options.slow(2, 20):
            start = _start(random, likeness)
            if not fits_the_arrays(start):
                continue
            tried += 1
            report.progress(f"roll {likeness.value} {tried}")
            try:
                done.append(roll(start, Rig(), options.seed + tried))
            except (Failed, TimeoutError) as error:
                failed.append(_why(error))
        name, notes = f"2 {likeness.value}, rubber", ", ".join([f"{tried} rolls", *failed])
        report.value(f"{name}: rolled until parallel", 100.0 * len(done) / tried, "%", bars=_ALL, notes=notes)
        if done:
            off = [100.0 * abs(one.time_s / one.expected_s - 1.0) for one in done]
            report.samples(f"{name}: time off the closed form [%]", off, "", bars=_CLOSE)
            ends = [math.degrees(one.last) for one in done]
            report.samples(f"{name}: true friction angle in the end [deg]", ends, "", bars=_WITHIN)


def _why(error: Exception) -> str:
    return error.fault.value if isinstance(error, Failed) else str(error)


# 3 and 4


def _regrasps(random: np.random.Generator, options: Options, report: Report) -> None:
    told: list[Regrasped] = []
    for likeness, by, steps in (
        (Likeness.DISK, By.POSITION, 1), (Likeness.DISK, By.CURVATURE, 3), (Likeness.RECTANGLE, By.POSITION, 1),
    ):  # fmt: skip
        done, tried, failed = list[Regrasped](), options.slow(2, 20), list[str]()
        for number in range(tried):
            report.progress(f"regrasp {likeness.value} by {by.value} {number}")
            try:
                start = _start(random, likeness, 38.0, 0.0)
                done.append(regrasp(start, by, steps, Rig(), options.seed + number))
            except (Failed, TimeoutError) as error:
                failed.append(_why(error))
        told += done
        _tell(f"3 {likeness.value} by {by.value}", by, done, ", ".join([f"{len(done)} of {tried}", *failed]), report)
    sure = [one for one in told if one.etas[0] > _three(one)]
    near = [one for one in told if one.etas[0] <= _three(one)]
    right = [one.told is one.start.likeness for one in sure]
    report.value("4 class right beyond three deviations", share(right), "%", bars=_ALL, notes=f"{len(sure)} grasps")
    wrong = [one for one in near if one.told not in (one.start.likeness, Likeness.PARALLEL)]
    report.value("4 class wrong within three deviations", len(wrong), "", notes=f"of {len(near)}: to roll first")


def _tell(name: str, by: By, done: Sequence[Regrasped], notes: str, report: Report) -> None:
    good = [one.etas[1] < _three(one) for one in done]
    bars = [Bar("value", 95.0, at_least=True)] if by is By.POSITION else []
    report.value(f"{name}: within three deviations after one", share(good), "%", bars=bars, notes=notes)
    if not done:
        return
    report.samples(f"{name}: true friction angle after one [deg]", [math.degrees(one.etas[1]) for one in done], "")
    if by is By.CURVATURE:
        off = [100.0 * (one.radius_m / one.start.size_m - 1.0) for one in done]
        spread = f"standard deviation {np.std(off):.1f} %"
        report.value(f"{name}: bias of rc", float(np.mean(off)), "%", notes=spread)
        report.samples(f"{name}: regrasps until within three deviations", [_steps(one) for one in done], "")


def _three(one: Regrasped) -> float:
    """Return three standard deviations of a friction angle by one frame of each finger."""
    apart = 2.0 * one.start.size_m if one.start.likeness is Likeness.DISK else one.start.size_m
    return 3.0 * friction_angle_deviation(apart, PLACE_RAD, FINGER_M)


def _steps(one: Regrasped) -> float:
    return float(next((n for n, eta in enumerate(one.etas) if n and eta < _three(one)), len(one.etas)))


# 5


def _force(report: Report) -> None:
    mount = Mount()
    for name, (loop, time_s) in _LOOPS.items():
        limit = measured_limit(loop, mount, time_s)
        report.value(
            f"5 {name}: gain at which force becomes unstable", limit, "m/(s N)",
            notes=f"2/(k T + 2 c) = {quasi_static_limit(loop, mount):.2f}",
        )  # fmt: skip
        half, below, above = (answer(loop, part * limit, mount, 2.0 * time_s) for part in (0.5, 0.9, 1.1))
        report.value(f"5 {name}: overshoot at half of it", 100.0 * half.overshoot, "%", bars=[Bar("value", 10.0)])
        report.value(f"5 {name}: swing at 0.9 of it, of the step", 100.0 * below.swing, "%", bars=[Bar("value", 10.0)])
        unstable = [Bar("value", 50.0, at_least=True)]
        report.value(f"5 {name}: swing at 1.1 of it, of the step", 100.0 * above.swing, "%", bars=unstable)


# 6


def _ellipses(options: Options, report: Report) -> None:
    opposite, same = ((0.0, 2.0), (15.0, 0.0), (-30.0, 2.0), (40.0, -3.0)), ((0.0, 24.0), (10.0, -24.0), (70.0, 18.0))
    kept, lost = (
        [
            keep_ellipse(0.030, 0.020, math.radians(turn), 1e-3 * beside, Rig(), options.seed)
            for turn, beside in starts[: options.count(2, 4)]
        ]
        for starts in (opposite, same)
    )
    good = [one.held and one.apart_m < 0.0405 and one.last < math.radians(1.0) for one in kept]
    apart = "distance of contacts " + ", ".join(f"{1e3 * one.apart_m:.2f}" for one in kept) + " mm of 40"
    report.value("6 ellipse on opposite halves: smallest diameter", share(good), "%", bars=_ALL, notes=apart)
    told = [not one.held and one.fault is not None for one in lost]
    faults = ", ".join(one.fault.value if one.fault else "held" for one in lost)
    report.value("6 ellipse on the same half: refused, or lost", share(told), "%", bars=_ALL, notes=faults)


# 7


def _cone(options: Options, report: Report) -> None:
    frictions = (0.6, 1.0) if options.quick else (0.6, 0.8, 1.0, 1.2, 1.4)
    found = [slip(friction, Rig(), options.seed) for friction in frictions]
    off = [math.degrees(abs(one.at - one.cone)) for one in found]
    report.samples("7 slip begins beside atan mu by [deg]", off, "", bars=_WITHIN)
    before = "s before: " + ", ".join(f"{one.warned_s:.1f}" for one in found)
    report.value("7 warned before", share([one.warned_s > 0.0 for one in found]), "%", bars=_ALL, notes=before)
