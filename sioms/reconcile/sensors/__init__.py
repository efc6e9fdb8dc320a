"""Reconcile for sensors: subjects whose input is known (touches, loads) and whose reading is to be explained.

The workflow, its rules and its verdict are those of the axis; only the model and the effects differ.
"""
