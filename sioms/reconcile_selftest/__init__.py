"""Axes with hidden effects for a blind test of ``sioms.reconcile``.

Nothing here imports the solver, nor the solver anything from here: another integrator, other formulas for
friction and contact, noise of its own. The truth stays in the memory of the process that generates.
"""
