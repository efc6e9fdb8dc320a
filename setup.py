"""What pyproject.toml cannot say: a wheel with compiled steps is for one machine, and for every version of Python."""

from pathlib import Path

from setuptools import Distribution, setup
from setuptools.command.bdist_wheel import bdist_wheel

STEPS = Path(__file__).with_name("sioms") / "native" / "_steps.so"


class WithSteps(Distribution):
    """A distribution that is bound to a machine where the steps have been compiled."""

    def has_ext_modules(self) -> bool:
        return STEPS.exists()


class AnyPython(bdist_wheel):  # type: ignore[misc]
    """The library of steps uses nothing of Python."""

    def get_tag(self) -> tuple[str, str, str]:
        _, _, machine = super().get_tag()
        return "py3", "none", machine


setup(distclass=WithSteps, cmdclass={"bdist_wheel": AnyPython})
