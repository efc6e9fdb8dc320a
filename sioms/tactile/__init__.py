"""Sense with an elastic cylindrical finger: its mechanics, its calibration, and the shape of what it touches.

Physics only: numpy and scipy, no input or output, no clocks.  SI units and radians; tension positive for
tractions and strains; loads P [N/m] compression positive.  `cylinder`, `emap`, `contact` and `width` are the
forward model, `estimator` inverts it frame by frame, `finger` is the calibrated finger as a file, `chain`
turns raw frames into strains.
"""
