"""Reconcile for a force/torque sensor: what its matrix and its zero do not say about its readings."""
