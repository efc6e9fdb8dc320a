"""What the head of a column says that it holds: the words of it, not its numbers.

Several words are weighed together: a reference of torque is what the drive is told, one of position what the controller
is told; a current beside a position is a present one.
"""

from __future__ import annotations

import re

#: Words in the head of a column that tell what it probably is.
WORDS = {
    "time": ("time", "zeit", "stamp", "timestamp", "temps", "tiempo", "tempo"),
    "command": (
        "cmd", "command", "commanded", "ref", "reference", "set", "setpoint", "target", "soll", "qg", "desired", "des",
        "demand", "goal",
    ),
    "velocity": (
        "vel", "velocity", "speed", "rpm", "omega", "dq", "qd", "qdot", "dtheta", "dphi", "thetadot", "gyro",
        "geschwindigkeit", "drehzahl", "vitesse", "velocidad",
    ),
    "acceleration": ("acc", "accel", "acceleration", "ddq", "qdd", "beschleunigung"),
    "position": (
        "pos", "position", "enc", "encoder", "angle", "actual", "ist", "qm", "counts", "theta", "phi", "displacement",
        "disp", "deflection", "rotation", "stroke", "winkel", "weg", "place",
    ),
    "force_measured": (
        "current", "cur", "iq", "amp", "amps", "ampere", "amperes", "measured", "meas", "strom", "courant", "corriente",
        "loadcell",
    ),
    "force": (
        "force", "torque", "effort", "out", "output", "tau", "moment", "voltage", "volt", "volts", "vir", "pwm", "duty",
        "kraft", "drehmoment", "spannung", "fuerza",
    ),
    "index": ("index", "mark"),
}  # fmt: skip
#: Letters that tell what a column is where no word does; F is a force, f may be a frequency.
LETTERS = {
    "t": "time", "v": "velocity", "w": "velocity", "a": "acceleration", "q": "position", "x": "position",
    "y": "position", "i": "force_measured", "u": "force", "F": "force", "T": "force", "z": "index",
}  # fmt: skip
_PARTS = re.compile(r"[\W_]+|(?<=[a-z])(?=[A-Z])")
_NUMBER = re.compile(r"\d+$")


def meaning(name: str) -> str | None:
    """Return the quantity that the words of a head mean together; None where they mean none.

    Args:
        name: without its unit.
    """
    words = [_NUMBER.sub("", w) for w in _PARTS.split(name) if w]
    said = [q for w in words for q, known in WORDS.items() if w.lower() in known]
    if not said:
        letters = [_letter(w) for w in words if len(w) == 1]
        return letters[0] if len(letters) == 1 else None
    for rate in ("acceleration", "velocity"):
        if rate in said:
            return rate
    if "command" in said:
        return "force" if {"force", "force_measured"} & set(said) else "command"
    if "force_measured" in said:
        return "position" if "position" in said and not {"force"} & set(said) else "force_measured"
    return said[0]


def _letter(word: str) -> str | None:
    return LETTERS.get(word, LETTERS.get(word.lower()) if word != "f" else None)
