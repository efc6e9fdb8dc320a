"""Installed as ``sioms.tools``; the bare folder name is not importable."""

if __name__ != "sioms.tools":
    raise ImportError("import sioms.tools, not tools: the folder is a part of the package sioms")
