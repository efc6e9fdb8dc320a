"""Devices made of devices: axis nodes of outer coordinates over held axes of other devices.

``compound`` is the driver; a kind is a map (``sioms.kinematics``) and a small file with its keys and coordinates.
"""
