"""Simulated physics of the workcell: motors, steppers, contacts and sensors.

Pure and vectorised over axes: arrays in, arrays out, no clock, no I/O, no thread. SI units; where an
axis may be linear or rotary, "position" is m or rad, "mass" kg or kg m^2, "force" N or N m.

Concurrency: an object belongs to the thread that steps it.
"""
