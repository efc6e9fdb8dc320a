"""Reconcile for the tactile finger: what the simulation of its outputs lacks."""
