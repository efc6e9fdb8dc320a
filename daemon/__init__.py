"""Installed as ``sioms.daemon``; the bare folder name is not importable."""

if __name__ != "sioms.daemon":
    raise ImportError("import sioms.daemon, not daemon: the folder is a part of the package sioms")
