"""Commands for axes: write records made of the words that are given."""

from __future__ import annotations

from struct import error as struct_error

from sioms.protocol.flags import QUANTITIES, ControlMode, NodeClass
from sioms.protocol.records import AXIS_WRITE, WRITE

from .arguments import integer, number

_COLUMNS = WRITE[NodeClass.AXIS]
_DEFAULT = {name: 0.0 if column.code == "d" else 0 for name, column in _COLUMNS.items()}
_FLAGS = {name: ControlMode(column.flag) for name, column in _COLUMNS.items() if column.code == "d"}
_QUANTITY = {name: flag for name, flag in _FLAGS.items() if flag & QUANTITIES}
_WITH = {name: flag for name, flag in _FLAGS.items() if not flag & QUANTITIES}
_TOGETHER = [
    group
    for flag in dict.fromkeys(_WITH.values())
    if len(group := [name for name, theirs in _WITH.items() if theirs == flag]) > 1
]


def command(
    axis: int = 0,
    *,
    wait: int | object | None = None,
    signal: int | object | None = None,
    synch: bool = False,
    relative: bool = False,
    **values: float,
) -> bytes:
    """Make one axis write record; its control mode follows from the words that are given.

    Args:
        axis: index of the axis in the node.
        wait: marker (or its number) to wait for before it starts.
        signal: marker (or its token) to signal when it ends.
        synch: hold it until the external synch.
        relative: ``position`` counts from where the preceding command ends.
        **values: ``position``, ``velocity``, ``acceleration``, ``jerk``, ``force`` or
            ``force_velocity`` say what is commanded; ``position`` with ``velocity`` passes the
            position at that velocity. ``time`` [s], ``max_velocity`` with ``max_acceleration``,
            ``k kz kp kb`` (all four), ``force_offset`` and ``max_force`` may be added. SI units.

    Returns:
        The packed record; records are joined with ``+`` or given to ``write`` as a list.

    Raises:
        TypeError: a word that is not a number.
        ValueError: an unknown word, nothing commanded, or words of a group missing.

    Example:
        >>> len(command(position=0.1, time=0.5))
        144
    """
    fields = dict(_DEFAULT)
    mode = ControlMode(0)
    for name, value in values.items():
        flag = _FLAGS.get(name)
        if flag is None:
            raise ValueError(f"make command: unknown word {name}; there are: {', '.join([*_QUANTITY, *_WITH])}")
        fields[name] = number(f"make command: {name}", value)
        mode |= flag
    for group in _TOGETHER:
        missing = [name for name in group if name not in values]
        if missing and len(missing) < len(group):
            raise ValueError(f"make command: {', '.join(missing)} missing; {', '.join(group)} go together")
    if not mode & QUANTITIES:
        raise ValueError(f"make command: no setpoint; give one of {', '.join(_QUANTITY)}")
    fields["axis"] = integer("make command: axis", axis, "the index of an axis")
    if wait is not None:
        mode |= ControlMode.SPECIFIED_WAIT_MARKER
        fields["wait_marker_number"] = integer("make command: wait", wait, "a marker or its number")
    if signal is not None:
        mode |= ControlMode.SPECIFIED_SIGNAL_MARKER
        fields["signal_marker_number"] = integer("make command: signal", signal, "a marker or its token")
    if synch:
        mode |= ControlMode.WAIT_FOR_EXTERNAL_SYNCH
    if relative:
        mode |= ControlMode.RELATIVE
    fields["control_mode"] = int(mode)
    try:
        return AXIS_WRITE.pack(*fields.values())
    except struct_error as error:
        whole = {name: fields[name] for name in ("axis", "wait_marker_number", "signal_marker_number")}
        raise ValueError(f"make command: {whole}: {error}") from None
