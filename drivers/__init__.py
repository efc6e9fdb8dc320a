"""Installed as ``sioms.drivers``; the bare folder name is not importable."""

if __name__ != "sioms.drivers":
    raise ImportError("import sioms.drivers, not drivers: the folder is a part of the package sioms")
