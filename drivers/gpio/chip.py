"""A Linux GPIO chip through libgpiod's Python binding: lines found and requested, failures told in sentences.

The binding (package ``gpiod``, version 2) is loaded when it is asked for, so that nothing else needs it.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Mapping
from typing import Any

from sioms.sdk.exchange import LinkError


def load_binding() -> Any:
    """Return the module ``gpiod``.

    Raises:
        ValueError: it is not there, or the first generation, which bears the same name.
    """
    try:
        import gpiod
    except ImportError:
        raise ValueError("the Python binding of libgpiod is missing; install sioms[gpio], or gpiod 2") from None
    if not hasattr(gpiod, "request_lines"):
        raise ValueError("the Python binding of libgpiod is version 1; install sioms[gpio], or gpiod 2")
    return gpiod


class GpioChip:
    """A chip that is open; ``with`` closes it, requests outlive it.

    Args:
        binding: the module.
        path: of the chip's device.

    Raises:
        LinkError: it cannot be opened.

    Concurrency: one thread.
    """

    def __init__(self, binding: Any, path: str) -> None:
        self._path = path
        try:
            self._chip = binding.Chip(path)
        except OSError as error:
            hint = {
                errno.ENOENT: "no such chip; gpiodetect lists those there are",
                errno.EACCES: "no permission; put the daemon's user into the group of the file, or write a udev rule",
                errno.ENODEV: "this is not a GPIO chip; gpiodetect lists the chips",
            }.get(error.errno or 0, os.strerror(error.errno or errno.EIO).lower())
            raise LinkError(f"open {path}: {hint}") from None

    def __enter__(self) -> GpioChip:
        return self

    def __exit__(self, *_: object) -> None:
        self._chip.close()

    def offset(self, line: int | str) -> int:
        """Return the offset of a line given by offset or name.

        Raises:
            LinkError: there is none.
        """
        try:
            return int(self._chip.line_offset_from_id(line))
        except OSError:
            raise LinkError(f"open {self._path}: no line is named {line!r}; gpioinfo lists the names") from None
        except ValueError:
            many = self._chip.get_info().num_lines
            raise LinkError(f"open {self._path}: line {line}; it has {many}, want 0 to {many - 1}") from None

    def request(self, lines: Mapping[int, Any], consumer: str, event_buffer: int) -> Any:
        """Return a request of lines, offset to settings.

        Raises:
            LinkError: a line is held by somebody else, or cannot do what is asked.
        """
        try:
            return self._chip.request_lines(dict(lines), consumer=consumer, event_buffer_size=event_buffer)
        except OSError as error:
            text = os.strerror(error.errno or errno.EIO).lower()
            if error.errno == errno.EBUSY:
                text = ", ".join(filter(None, map(self._holder, lines))) or "a line is in use"
            if error.errno in (errno.EINVAL, errno.ENOTSUP, errno.ENXIO):
                text = "the chip cannot do what is asked; check bias, drive, and whether it has edges"
            raise LinkError(f"request lines of {self._path}: {text}") from None

    def _holder(self, offset: int) -> str:
        info = self._chip.get_line_info(offset)
        if not info.used:
            return ""
        return f"line {offset} ({info.name or 'no name'}) is held by {info.consumer or 'the kernel'}"
